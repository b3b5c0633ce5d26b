"""Footage in: exact times, honest audits, damage survived, bad input named."""

import threading
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from clips import MS, pictures, write_clip

from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files.timing import TimeAuditor
from visfuse_cli.files.video import describe, is_clip_folder, list_clips, open_source

DATA = Path(__file__).parents[2] / "shared" / "data"


def read(path, **options):
    with open_source(path, **options) as source:
        frames = list(source.frames())
        return source, frames, source.audit()


def write_images(folder, images, stamps=None, suffix=".png"):
    folder.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"frame{k}{suffix}"), image)
    if stamps is not None:
        lines = [f"{k},{t!r}" for k, t in enumerate(stamps)]
        (folder / "timestamps.csv").write_text("\n".join(["frame,t", *lines]) + "\n")
    return folder


def video_file(folder):
    return write_clip(folder / "a.mp4", [k * 3600 for k in range(12)], b_frames=2), {}


def images_with_rate(folder):
    return write_images(folder / "a", pictures(12)), {"fps": 25.0}


def images_with_stamps(folder):
    return write_images(folder / "a", pictures(12), [7 + k / 25 for k in range(12)]), {}


@pytest.mark.parametrize("backend", [video_file, images_with_rate, images_with_stamps])
def test_every_kind_of_footage_keeps_the_same_promises(backend, tmp_path):
    path, options = backend(tmp_path)
    source, frames, audit = read(path, camera="left", **options)
    assert (source.width, source.height, source.frame_count) == (64, 48, 12)
    assert source.nominal_rate == pytest.approx(25)
    assert [f.index for f in frames] == list(range(12))
    assert [f.t for f in frames] == pytest.approx([k / 25 for k in range(12)], abs=1e-12)
    for frame, drawn in zip(frames, pictures(12), strict=True):
        assert frame.camera == "left"
        assert frame.image.shape == (48, 64, 3)
        assert frame.image.dtype == np.uint8
        assert np.abs(frame.image.mean((0, 1)) - drawn.mean((0, 1))).max() < 4
    assert (audit.frames, audit.dropped, audit.irregular, audit.duplicated, audit.lost) == (12, 0, 0, 0, 0)
    assert audit.warnings == ()

    source, window, audit = read(path, start=0.1, end=0.2, **options)
    assert [f.index for f in window] == [3, 4]
    assert source.frame_count == 2
    assert (audit.frames, audit.lost) == (2, 0)
    np.testing.assert_array_equal(window[0].image, frames[3].image)

    with open_source(path, **options) as again:  # a second reading sees the same, whatever was drawn on the first
        for frame in again.frames():
            frame.image[:] = 0
        assert again.audit().duplicated == 0
        np.testing.assert_array_equal(next(again.frames()).image, frames[0].image)

    with pytest.raises(InputError, match=r"ends before 9\.0 s"):
        read(path, start=9.0, **options)


def test_variable_rate_start_offset_and_ntsc_stamps_are_exact(tmp_path):
    stamps = [500, 533, 601, 634, 900, 917]
    _, frames, audit = read(write_clip(tmp_path / "v.mkv", stamps, tick=MS))
    assert [f.t for f in frames] == [(s - 500) / 1000 for s in stamps]
    assert audit.dropped == 0

    ntsc = [k * 1001 for k in range(60)]
    source, frames, audit = read(
        write_clip(tmp_path / "n.mp4", ntsc, tick=Fraction(1, 30000), rate=Fraction(30000, 1001))
    )
    assert [f.t for f in frames] == [float(Fraction(k * 1001, 30000)) for k in range(60)]
    assert source.nominal_rate == pytest.approx(30000 / 1001)
    assert audit.nominal_interval_s == pytest.approx(1001 / 30000)


def test_a_matroska_clip_that_starts_late_has_lost_nothing(tmp_path):
    _, frames, audit = read(write_clip(tmp_path / "late.mkv", [2000 + 40 * k for k in range(30)], tick=MS))
    assert len(frames) == 30
    assert (audit.lost, audit.dropped, audit.warnings) == (0, 0, ())


def test_audit_counts_dropped_and_repeated_frames(tmp_path):
    kept = [k for k in range(40) if k not in (7, 20, 21)]
    images = pictures(len(kept))
    images[30] = images[29]
    clip = write_clip(tmp_path / "d.mp4", [3600 * k for k in kept], images, crf=0, preset="ultrafast")
    _, _, audit = read(clip)
    assert (audit.dropped, audit.irregular, audit.duplicated, audit.lost) == (3, 0, 1, 0)
    assert len(audit.warnings) == 2
    assert audit.warnings[0].startswith("d.mp4: 3 frames missing in gaps of the time stamps, first at 0.240 s")


@pytest.mark.parametrize(
    ("stamps", "resolution", "dropped", "irregular"),
    [
        ([k / 240 for k in range(50)], 0.0, 0, 0),
        ([round(k / 240, 3) for k in range(500)], 0.001, 0, 0),  # 4 and 5 ms: rounding, not irregularity
        ([0, 0.04, 0.08, 0.12, 0.16, 0.23, 0.24, 0.28], 0.0, 0, 2),  # one frame late
        ([0, 0.1, 0.3, 0.34, 0.9, 1.0, 2.5, 2.6, 4.0], 0.0, 0, 8),  # no beat at all
        ([0.0], 0.0, 0, 0),
        ([], 0.0, 0, 0),
    ],
)
def test_time_audit_on_stamps(stamps, resolution, dropped, irregular):
    auditor = TimeAuditor("clip", resolution)
    for t in stamps:
        auditor.add(t)
    audit = auditor.result()
    assert (audit.dropped, audit.irregular) == (dropped, irregular)


def test_equal_stamps_are_duplicates_and_left_out(tmp_path):
    folder = write_images(tmp_path / "e", pictures(5), [0.0, 0.1, 0.1, 0.2, 0.3])
    _, frames, audit = read(folder)
    assert [f.index for f in frames] == [0, 1, 3, 4]
    assert audit.duplicated == 1


@pytest.mark.skipif(not hasattr(av.VideoStream, "set_display_rotation"), reason="this PyAV cannot write a rotation")
@pytest.mark.parametrize("turn", [90, -90, 180])
def test_display_rotation_is_applied_as_opencv_does(turn, tmp_path):
    clip = write_clip(tmp_path / "r.mp4", [0, 3600, 7200], turn=turn)
    source, frames, _ = read(clip)
    capture = cv2.VideoCapture(str(clip))
    expected = capture.read()[1]
    assert (source.height, source.width) == frames[0].image.shape[:2] == expected.shape[:2]
    assert np.abs(frames[0].image.astype(int) - expected).max() < 12


@pytest.mark.parametrize(
    ("codec", "pix_fmt", "size"),
    [
        ("libx264", "yuv444p", (47, 63)),
        ("mjpeg", "yuvj420p", (48, 64)),
        ("ffv1", "gray", (48, 64)),
        ("ffv1", "yuv420p", (47, 63)),
    ],
)
def test_other_pixel_formats_and_odd_sizes(codec, pix_fmt, size, tmp_path):
    images = [np.full((*size, 3), v, np.uint8) for v in (0, 128, 255)]
    clip = write_clip(tmp_path / "p.mkv", [0, 40, 80], images, tick=MS, codec=codec, pix_fmt=pix_fmt)
    _, frames, _ = read(clip)
    for frame, drawn in zip(frames, images, strict=True):
        assert frame.image.shape == drawn.shape
        assert np.abs(frame.image.astype(int) - drawn).max() <= 3


def truncated(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path


def noisy(n):
    rng = np.random.default_rng(1)
    return [rng.integers(0, 255, (48, 64, 3)).astype(np.uint8) for _ in range(n)]


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".ts"])
def test_a_truncated_file_yields_its_readable_part(suffix, tmp_path):
    name = tmp_path / f"t{suffix}"
    if suffix == ".mp4":  # the index must come first to survive
        with av.open(str(name), "w", options={"movflags": "faststart"}) as container:
            stream = container.add_stream("libx264", rate=25)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            for k, image in enumerate(noisy(50)):
                frame = av.VideoFrame.from_ndarray(image, format="bgr24")
                frame.pts, frame.time_base = k, Fraction(1, 25)
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
    else:
        tick = MS if suffix == ".mkv" else Fraction(1, 90000)
        write_clip(name, [round(k / 25 / tick) for k in range(50)], noisy(50), tick=tick)
    _, frames, audit = read(truncated(name, 0.5))
    assert 15 < len(frames) < 40
    if suffix != ".ts":  # a transport stream announces nothing
        assert audit.lost == 50 - len(frames)
        assert any("lost" in text for text in audit.warnings)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".ts"])
def test_a_damaged_stretch_is_passed_over(suffix, tmp_path):
    tick = MS if suffix == ".mkv" else Fraction(1, 90000)
    clip = write_clip(tmp_path / f"x{suffix}", [round(k / 25 / tick) for k in range(60)], noisy(60), tick=tick)
    data = bytearray(clip.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 6000] = bytes(6000)
    clip.write_bytes(data)
    _, frames, audit = read(clip)
    assert len(frames) < 60
    assert frames[-1].t == pytest.approx(59 * 0.04)
    assert audit.lost + audit.dropped == 60 - len(frames)  # each once
    assert audit.warnings


def test_hostile_files_are_named_in_one_line(tmp_path):
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "text.mp4").write_text("not a video\n" * 50)
    (tmp_path / "none").mkdir()
    truncated(write_clip(tmp_path / "headless.mp4", [k * 3600 for k in range(20)]), 0.6)
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    cv2.imwrite(str(tmp_path / "picture.png"), pictures(1)[0])
    wanted = {
        "missing.mp4": "No such file",
        "empty.mp4": "is empty",
        "text.mp4": "cannot be read as a video",
        "none": "no images",
        "headless.mp4": "cannot be read as a video",
        "sound.mp4": "holds no video",
        "picture.png": "holds no video",
    }
    for name, text in wanted.items():
        with pytest.raises(InputError, match=text) as caught:
            read(tmp_path / name)
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_rate_is_never_guessed(tmp_path):
    folder = write_images(tmp_path / "i", pictures(3))
    with pytest.raises(InputError, match=r"video\.fps.*timestamps\.csv"):
        read(folder)
    bare = write_clip(tmp_path / "m.mjpeg", range(5), tick=Fraction(1, 25), codec="mjpeg", pix_fmt="yuvj420p")
    with pytest.raises(InputError, match=r"video\.fps"):
        read(bare)
    assert [f.t for f in read(bare, fps=10)[1]] == [0, 0.1, 0.2, 0.3, 0.4]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frame,t\n0,0\n1,0.1\n", "2 rows for 3 images"),
        ("frame,t\n0,0\n2,0.2\n1,0.1\n", "line 3: frame 2 where 1"),
        ("frame,t\n0,0.5\n1,0.1\n2,0.2\n", "line 3: t = 0.1 comes before"),
        ("frame,t\n0,0\n1,soon\n2,1\n", "line 3: frame '1', t 'soon'"),
        ("frame,t\n0,0\n1\n2,1\n", "line 3: frame '1', t 'None'"),
        ("frame,t\n0,0\n1,nan\n2,1\n", "line 3: t 'nan'"),
        ("frame,time\n0,0\n", "line 1: no column t"),
        ("", "line 1: no column frame and t"),
    ],
)
def test_timestamps_errors_name_the_line(text, said, tmp_path):
    folder = write_images(tmp_path / "i", pictures(3))
    (folder / "timestamps.csv").write_text(text)
    with pytest.raises(InputError, match=said):
        read(folder)


def test_image_folders(tmp_path):
    deep = [np.full((20, 30), v, np.uint16) for v in (100, 2000, 4095)]
    _, frames, _ = read(write_images(tmp_path / "deep", deep), fps=10)
    assert [int(f.image[0, 0, 0]) for f in frames] == [6, 125, 255]  # one scale, of 12 bits in use
    _, frames, _ = read(write_images(tmp_path / "natural", noisy(12)), fps=10)
    np.testing.assert_array_equal(frames[10].image, noisy(12)[10])

    odd = write_images(tmp_path / "odd", pictures(3))
    cv2.imwrite(str(odd / "frame2.png"), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(InputError, match=r"frame2\.png: is 10x10.*64x48"):
        read(odd, fps=10)

    (odd / "frame2.png").write_bytes(b"broken")
    _, frames, audit = read(odd, fps=10)
    assert ([f.index for f in frames], audit.lost) == ([0, 1], 1)
    assert "frame2.png cannot be decoded" in audit.warnings[0]


@pytest.mark.parametrize("window", [(2, 1), (1, 1), (-1, None), (float("nan"), None), (None, 0)])
def test_windows_that_hold_nothing_are_usage_errors(window, tmp_path):
    with pytest.raises(UsageError, match="--"):
        open_source(tmp_path, start=window[0], end=window[1])


def test_folders_of_clips(tmp_path):
    for k in (10, 2):
        write_clip(tmp_path / f"c{k}.mp4", [0, 3600])
    (tmp_path / ".hidden.mp4").touch()
    (tmp_path / "notes.txt").touch()
    assert is_clip_folder(tmp_path)
    assert [p.name for p in list_clips(tmp_path)] == ["c2.mp4", "c10.mp4"]
    assert not is_clip_folder(tmp_path / "c2.mp4")
    cv2.imwrite(str(tmp_path / "a.png"), pictures(1)[0])
    with pytest.raises(InputError, match=r"clips .* and images"):
        is_clip_folder(tmp_path)
    with pytest.raises(InputError, match="No such file"):
        is_clip_folder(tmp_path / "nowhere")


def test_describe_tells_inputs_apart(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    alone = describe(tmp_path / "a")
    assert alone["size"] == 3
    assert alone["sha256"].startswith("ba7816bf")
    before = describe(tmp_path)
    (tmp_path / "a").rename(tmp_path / "b")
    assert describe(tmp_path)["sha256"] != before["sha256"]
    with pytest.raises(InputError, match="No such file"):
        describe(tmp_path / "a")


def test_decoding_lives_in_the_thread_that_iterates(tmp_path):
    with open_source(write_clip(tmp_path / "a.mp4", [k * 3600 for k in range(8)])) as source:
        result = []
        worker = threading.Thread(target=lambda: result.extend(f.index for f in source.frames()))
        worker.start()
        worker.join()
        assert result == list(range(8)) == [f.index for f in source.frames()]


@pytest.mark.skipif(not DATA.exists(), reason="the real footage is not here")
def test_real_footage():
    source, frames, audit = read(DATA / "speed-arterial" / "clip.mp4", end=4)
    assert (frames[0].t, len(frames), source.creation_time.isoformat()) == (0.0, 100, "2016-03-24T04:03:35+00:00")
    assert (audit.dropped, audit.irregular, audit.lost) == (0, 0, 0)
    with open_source(DATA / "stereo-conveyor" / "left.mp4", end=1) as source:
        times = [f.t for f in source.frames()]
    with av.open(str(DATA / "stereo-conveyor" / "left.mp4")) as container:
        stamps = [f.pts for f, _ in zip(container.decode(video=0), times, strict=False)]
    assert times == [s / 90000 for s in stamps]
