"""Everybody followed through the footage, set of frames by set of frames; and the clocks found out by it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visfuse_cli.commands.fuse_cameras.scene import Scene, open_footage, spacing, tolerance
from visfuse_cli.errors import UsageError
from visfuse_cli.files.video import VideoSource
from visfuse_cli.fusing import clocks
from visfuse_cli.fusing.eyes import BoxEyes, Eyes, PictureEyes
from visfuse_cli.fusing.person import Person
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.fusing.tracker import Tracker
from visfuse_cli.pipeline import Run
from visfuse_cli.records import RunRequest

CLOCK_S = 60.0  # s of footage from which clocks are estimated
CLOCK_STEP_S = 0.2  # s between the frames that the first, coarse round looks at
CLOCK_ROUNDS = 3  # through the footage: where clocks were far off, others are believed once they are not
CLOCK_DONE_S = 0.02


def eyes_of(scene: Scene, sources: dict[str, VideoSource], config: FuseConfig) -> Eyes:
    """What looks at each set of frames: boxes from outside where there are any, else the pictures.

    Raises UsageError where pictures are to be associated as boxes are.
    """
    if scene.footage[0].boxes is not None:
        return BoxEyes(scene.views, [each.boxes or {} for each in scene.footage], config)
    if config.sight.association != "one-to-one":
        raise UsageError(
            f"sight.association: {config.sight.association} is for boxes of a detector, <camera>.txt in the scene; "
            "in pictures everybody is looked for where they are expected: leave it at one-to-one"
        )
    return PictureEyes(scene.views, list(sources.values()), config)


def follow(
    scene: Scene,
    sources: dict[str, VideoSource],
    eyes: Eyes,
    tracker: Tracker,
    offsets: dict[str, float],
    run_: Run,
) -> Iterator[list[Person]]:
    """Follow everybody through the footage; yields, set by set, whom nobody follows any more."""
    for instant in run_.synchronise(sources, tolerance(sources), offsets, spacing(sources)):
        with run_.stage("detect"):
            eyes.detect(instant)
        with run_.stage("fuse"):
            tracker.predict(instant.t)
        with run_.stage("look"):
            sightings = eyes.look(tracker)
        with run_.stage("fuse"):
            tracker.update(instant.index, sightings)
            inside, clear = eyes.visible(tracker.beliefs)
            tracker.miss(clear & eyes.open, sightings)
            tracker.watch(clear & eyes.open)
            ended = tracker.end(instant.t, np.count_nonzero(inside, axis=1))
        with run_.stage("newcomers"):
            tracker.begin(instant.index, instant.t, eyes.newcomers(tracker))
        with run_.stage("learn"):
            eyes.learn(instant.t, tracker)
        yield ended


def estimated_offsets(
    scene: Scene, eyes: Eyes, offsets: dict[str, float], request: RunRequest, run_: Run
) -> dict[str, float]:
    """The clocks' offsets (s by camera): places that cameras see alone agree roughly, tracks of all of them exactly."""
    config: FuseConfig = request.config
    begin = request.start or 0.0
    part = replace(request, end=min(begin + CLOCK_S, request.end or np.inf))
    walks = [clocks.Walks() for _ in scene.names]
    for camera, source in enumerate(open_footage(scene, part).values()):
        due = -np.inf
        for frame in run_.frames(source):
            if frame.t >= due:
                due = frame.t + CLOCK_STEP_S
                walks[camera].add(frame.t, eyes.alone(camera, frame))
    given = np.array([offsets[name] for name in scene.names])
    found = clocks.coarse(walks, given, config.fusion.largest_offset)
    if found is None:
        run_.warn(
            "--estimate-offsets: too few people walk where cameras see them alone; fusion.offsets is left as it is"
        )
        return offsets
    for _ in range(CLOCK_ROUNDS):
        eyes.restart()
        tracker, now = Tracker(eyes.P, config), dict(zip(scene.names, found.tolist(), strict=True))
        ended = follow(scene, open_footage(scene, part), eyes, tracker, now, run_)
        people = [person for some in ended for person in some] + tracker.finish()
        late = clocks.refined(people, eyes.P, config)
        found = found + late
        if np.abs(late).max() < CLOCK_DONE_S:
            break
    eyes.restart()
    return {name: round(float(seconds), 4) for name, seconds in zip(scene.names, found, strict=True)}
