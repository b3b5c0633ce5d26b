"""Small clips with exact stamps, for tests."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np

MS = Fraction(1, 1000)


def pictures(n, width=64, height=48, seed=0):
    """n smooth pictures (height, width, 3) that all differ."""
    rng = np.random.default_rng(seed)
    corner = rng.integers(30, 200, (n, 3))
    ramp = np.linspace(0, 50, width)[None, :, None] + np.linspace(0, 20, height)[:, None, None]
    return [
        (np.ones((height, width, 1)) * c + ramp * (1 + k % 3) / 3).clip(0, 255).astype(np.uint8)
        for k, c in enumerate(corner)
    ]


def write_clip(
    path: Path, stamps, images=None, tick=Fraction(1, 90000), codec="libx264", pix_fmt="yuv420p", **stream_options
):
    """A clip whose pictures carry exactly these stamps (ticks); the container is told by the name."""
    images = images or pictures(len(stamps))
    height, width = images[0].shape[:2]
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=stream_options.pop("rate", 25))
        stream.width, stream.height, stream.pix_fmt = width, height, pix_fmt
        stream.time_base = stream.codec_context.time_base = tick
        stream.codec_context.max_b_frames = stream_options.pop("b_frames", 0)
        turn = stream_options.pop("turn", None)
        if turn is not None:
            stream.set_display_rotation(turn)
        stream.options = {key: str(value) for key, value in stream_options.items()}
        for stamp, image in zip(stamps, images, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts, frame.time_base = stamp, tick
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
