"""The annotated videos, the mosaic, and the plan from above."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from itertools import tee
from pathlib import Path

from visfuse_cli.commands.fuse_cameras.results import Results
from visfuse_cli.commands.fuse_cameras.scene import Scene, open_footage, spacing, tolerance
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.fusing.annotate import Drawn, GroundPlan, active, draw_view, mosaic, mosaic_size
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.pipeline import Run
from visfuse_cli.records import RunRequest


def plan_of(scene: Scene, results: Results) -> GroundPlan:
    return GroundPlan(scene.views, results.extent)


def drawn_tracks(scene: Scene, config: FuseConfig, spool: TrackSpool, results: Results) -> Iterator[Drawn]:
    """The settled tracks in the order of their first frames."""
    centroid = config.fusion.point == "centroid"
    for _, identity in sorted(results.begun):
        yield Drawn(spool.read(identity), scene.R, scene.t, config.display.units, centroid)


def annotate(
    scene: Scene,
    offsets: dict[str, float],
    folder: Path,
    request: RunRequest,
    run_: Run,
    spool: TrackSpool,
    results: Results,
) -> None:
    """Write each camera's annotated video and the mosaic from a second decode."""
    sources = open_footage(scene, request)
    plan = plan_of(scene, results)
    with ExitStack() as stack:
        rate = next(iter(sources.values())).nominal_rate
        sinks = {}
        for name, source in sources.items():
            writer = VideoWriter(folder / f"annotated-{name}.mp4", source.width, source.height, source.nominal_rate)
            sinks[name] = stack.enter_context(run_.background(stack.enter_context(writer)))
        writer = VideoWriter(folder / "mosaic.mp4", *mosaic_size(scene.views), rate)
        whole = stack.enter_context(run_.background(stack.enter_context(writer)))
        instants, again = tee(run_.synchronise(sources, tolerance(sources), offsets, spacing(sources)))
        frames = (instant.index for instant in again)
        drawn = drawn_tracks(scene, request.config, spool, results)
        for people, instant in zip(active(drawn, frames), instants, strict=True):
            for view in scene.views:
                frame = instant.frames.get(view.name)
                if frame is not None:
                    draw_view(frame.image, view, people, instant.t)
                    sinks[view.name].write(frame.image, frame.t)
            pictures = {name: frame.image for name, frame in instant.frames.items()}
            whole.write(mosaic(scene.views, pictures, plan.now(people)), instant.t)
