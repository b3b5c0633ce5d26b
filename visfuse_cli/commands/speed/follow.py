"""One recording from its first frame to its last: steadied, compared with the background, followed, concluded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import cv2
import numpy as np

from visfuse_cli.elsewhere import ahead, apart
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.video import VideoSource
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array, GroundCamera, Image, TimeAudit
from visfuse_cli.threads import give_back
from visfuse_cli.tracking.camera_watch import CameraLog, Motions
from visfuse_cli.tracking.foreground import Detections, Detector, MovingRegions
from visfuse_cli.tracking.ground import GroundTracker
from visfuse_cli.tracking.headlights import Headlights
from visfuse_cli.tracking.ledger import Ledger, Recording
from visfuse_cli.tracking.lookout import Comparing, look_out
from visfuse_cli.tracking.options import SpeedOptions
from visfuse_cli.tracking.privacy import Strangers
from visfuse_cli.tracking.targets import Abandoned, Track
from visfuse_cli.tracking.zones import Region
from visfuse_cli.vision.empty import empty_picture
from visfuse_cli.vision.steady import at_rest

WARMUP_PICTURES = 31
TOGETHER = 500  # frames of tracks that have ended wait for one another: settling them at once takes less time
FORESEEN = 3  # frames that are looked at before their turn
STEADIED_PX = 0.3  # what is left of a shake between two pictures, at most


@dataclass(slots=True)
class Findings:
    """What a run has found so far, by clip where it is a clip's own."""

    ledger: Ledger
    audits: dict[str, TimeAudit] = field(default_factory=dict)
    began: dict[str, datetime | None] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)  # about times of day
    cameras: dict[str, CameraLog] = field(default_factory=dict)
    motions: dict[str, Motions] = field(default_factory=dict)
    suns: dict[str, dict[str, Any] | None] = field(default_factory=dict)
    strangers: dict[str, Strangers] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Clip:
    """One recording and everything its frames need."""

    name: str
    source: VideoSource
    footage: Callable[[], VideoSource]  # opens it once more, in another process
    camera: GroundCamera
    config: SpeedOptions
    boxes: dict[int, Array] | None


def follow(clip: Clip, run_: Run, spool: TrackSpool, findings: Findings, first_id: int, label: str | None) -> int:
    """Follow everything in one clip; returns the next free id."""
    findings.ledger.drawn[clip.name] = []
    strangers = findings.strangers[clip.name] = Strangers(clip.camera)
    motions = findings.motions[clip.name] = Motions()
    with apart() as begin:
        with run_.stage("warm up"):
            empty = _empty_scene(clip.source, clip.config.background.warmup_s)
            give_back()
            cv2.setNumThreads(1)  # the other cores belong to the lookout
            detector, lamps = _detector(clip), Headlights(empty, clip.camera)
        tracker = GroundTracker(clip.camera, clip.config, first_id)
        of = Recording(clip.name, label, clip.camera, findings.began[clip.name], motions.image_from_rest)
        settling = _Settling(of, tracker, detector, lamps, run_, spool, findings.ledger)
        lookout = begin(look_out, clip.footage, clip.camera, empty, _comparing(clip), lag=FORESEEN)
        for seen in run_.until_stopped(lookout, clip.source.frame_count):
            run_.count("frames")
            if seen is None:
                lookout.answer(None)
                continue
            frame = seen.frame
            motions.note(frame)
            tracker.predict(frame.t)
            with run_.stage("detect"):
                evidence = detector.evidence(seen, tracker.expected())
            with run_.stage("track"):
                ended = tracker.update(frame.index, evidence)
                lookout.answer(tracker.boxes())
                if clip.config.privacy.blur:
                    strangers.add(frame.index, tracker.unexplained)
                lamps.look(frame, tracker.tracks, tracker.headings())
            with run_.stage("conclude"):
                settling.take(*ended)
            with run_.stage("learn"):
                detector.learn(frame.t, tracker)
        settling.take(*tracker.finish(), last=True)
        audit, log = lookout.finish()
    give_back()
    findings.suns[clip.name] = None if detector.shadow is None else detector.shadow.report()
    findings.audits[clip.name], findings.cameras[clip.name] = audit, log
    for warning in (*audit.warnings, *log.warnings(clip.name)):
        run_.warn(warning)
    return tracker.next_id


def _empty_scene(source: VideoSource, warmup_s: float) -> Image:
    """The scene without its traffic, from the first `warmup_s` seconds; the pictures it comes from are not kept."""
    with ahead(lambda: sampled(source, warmup_s)) as waiting:
        pictures, shake = at_rest(waiting)
    return empty_picture(pictures, min(STEADIED_PX, shake))


def _detector(clip: Clip) -> Detector:
    config = clip.config
    if clip.boxes is not None:
        return Detections(clip.camera, clip.boxes, Region(np.array(config.region)) if config.region else None)
    return MovingRegions(clip.camera, config.background.shadow_ratio, config.regions, config.target.smallest)


def _comparing(clip: Clip) -> Comparing | None:
    config = clip.config
    if clip.boxes is not None:
        return None
    watched = Region(np.array(config.region)).picture(clip.camera) if config.region else None
    # People turn and bend: their corners tell little.
    return Comparing(config.background, config.regions.speck, watched, corners=config.target.motion == "bicycle")


def sampled(source: VideoSource, warmup_s: float) -> Iterator[Any]:
    """Pictures spread over the first `warmup_s` seconds; the first picture at least."""
    span = warmup_s * source.nominal_rate
    if source.frame_count is not None:
        span = min(span, source.frame_count)
    step = max(1, round(span / WARMUP_PICTURES))
    first: float | None = None
    for frame in source.frames(step):
        if first is not None and frame.t - first >= warmup_s:
            return
        first = frame.t if first is None else first
        yield frame.image


@dataclass(slots=True)
class _Settling:
    """Turns what ended into records and table rows, a few tracks at a time."""

    of: Recording
    tracker: GroundTracker
    detector: Detector
    lamps: Headlights
    run: Run
    spool: TrackSpool
    ledger: Ledger
    waiting: list[Track] = field(default_factory=list)

    def take(self, tracks: list[Track], abandoned: list[Abandoned], last: bool = False) -> None:
        """Take in what ended; with the `last` of it nothing waits any longer."""
        for candidate in abandoned:
            self.ledger.give_up(candidate, self.of)
            self.run.count("regions that never became a track")
        self.waiting += tracks
        if self.waiting and (last or sum(len(track.samples) for track in self.waiting) >= TOGETHER):
            shadow = self.detector.shadow
            fall = None if shadow is None else shadow.per_metre
            only_light = self.lamps.only_light
            for taken in self.ledger.take(self.waiting, self.of, self.tracker.dynamics, only_light, fall):
                self.spool.add(taken.record)
                self.run.count("rejected" if taken.record["summary"]["rejected"] else "vehicles")
                for identity in taken.displaced:
                    self.spool.amend(identity, rejected=taken.reason)
                    self.run.count("rejected")
                    self.run.count("vehicles", -1)
            self.waiting = []
            self.ledger.forget(self.of, self.tracker.since())
