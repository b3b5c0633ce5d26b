"""One recording from its first frame to its last: steadied, compared with the background, followed, concluded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import cv2
import numpy as np

from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.video import VideoSource
from visfuse_cli.pipeline import Run, ahead, foreseen, helper
from visfuse_cli.records import Array, Frame, GroundCamera, Image, TimeAudit
from visfuse_cli.threads import give_back, thread_cap
from visfuse_cli.tracking.camera_watch import CameraWatch
from visfuse_cli.tracking.elsewhere import HandOver
from visfuse_cli.tracking.foreground import Detections, Detector, MovingRegions
from visfuse_cli.tracking.ground import GroundTracker
from visfuse_cli.tracking.headlights import Headlights
from visfuse_cli.tracking.ledger import Ledger, Recording
from visfuse_cli.tracking.options import SpeedOptions
from visfuse_cli.tracking.privacy import Strangers
from visfuse_cli.tracking.targets import Abandoned, Track
from visfuse_cli.tracking.zones import Region
from visfuse_cli.vision.empty import empty_picture
from visfuse_cli.vision.points import MovingPoints
from visfuse_cli.vision.steady import at_rest

WARMUP_PICTURES = 31
TOGETHER = 500  # frames of tracks that have ended wait for one another: settling them at once takes less time
FORESEEN = 3  # frames that are compared with the background before their turn
STEADIED_PX = 0.3  # what is left of a shake between two pictures, at most


@dataclass(slots=True)
class Findings:
    """What a run has found so far, by clip where it is a clip's own."""

    ledger: Ledger
    audits: dict[str, TimeAudit] = field(default_factory=dict)
    began: dict[str, datetime | None] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)  # about times of day
    watches: dict[str, CameraWatch] = field(default_factory=dict)
    suns: dict[str, dict[str, Any] | None] = field(default_factory=dict)
    strangers: dict[str, Strangers] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Clip:
    """One recording and everything its frames need."""

    name: str
    source: VideoSource
    camera: GroundCamera
    config: SpeedOptions
    boxes: dict[int, Array] | None


def follow(clip: Clip, run_: Run, spool: TrackSpool, findings: Findings, first_id: int, label: str | None) -> int:
    """Follow everything in one clip; returns the next free id."""
    # One core belongs to the tracker: a pool as large as the machine would wait for it, spinning.
    cv2.setNumThreads(thread_cap() or max(1, cv2.getNumberOfCPUs() - 1))
    findings.ledger.drawn[clip.name] = []
    strangers = findings.strangers[clip.name] = Strangers(clip.camera)
    with helper() as compare, helper() as follow_corners:
        with run_.stage("warm up"):
            empty = _empty_scene(clip.source, clip.config.background.warmup_s)
            give_back()
            watch = findings.watches[clip.name] = CameraWatch(empty)
            look, lamps = _detector(clip, empty, compare, follow_corners), Headlights(empty, clip.camera)
        tracker = GroundTracker(clip.camera, clip.config, first_id)
        of = Recording(clip.name, label, clip.camera, findings.began[clip.name], watch.image_from_rest)
        settling = _Settling(of, tracker, lamps, run_, spool, findings.ledger)
        for frame in foreseen(_steadied(clip.source, watch, run_), look.foresee, FORESEEN):
            tracker.predict(frame.t)
            with run_.stage("detect"):
                evidence = look.evidence(frame, tracker.expected())
            with run_.stage("track"):
                ended = tracker.update(frame.index, evidence)
                if clip.config.privacy.blur:
                    strangers.add(frame.index, tracker.unexplained)
                lamps.look(frame, tracker.tracks, tracker.headings())
            with run_.stage("conclude"):
                settling.take(*ended)
            with run_.stage("learn"):
                look.learn(frame, tracker)
        settling.take(*tracker.finish(), last=True)
    give_back()
    findings.suns[clip.name] = look.report()
    audit = findings.audits[clip.name] = clip.source.audit()
    for warning in (*audit.warnings, *watch.warnings(clip.name)):
        run_.warn(warning)
    return tracker.next_id


def _empty_scene(source: VideoSource, warmup_s: float) -> Image:
    """The scene without its traffic, from the first `warmup_s` seconds; the pictures it comes from are not kept."""
    with ahead(lambda: sampled(source, warmup_s)) as waiting:
        pictures, shake = at_rest(waiting)
    return empty_picture(pictures, min(STEADIED_PX, shake))


def _steadied(source: VideoSource, watch: CameraWatch, run_: Run) -> Iterator[Frame]:
    """The frames in which the scene is recognised, as the camera at rest sees them."""
    for frame in run_.prepared(source, watch.steadied):
        run_.count("frames")
        if frame is not None:
            yield frame


def _detector(clip: Clip, empty: Image, compare: HandOver, follow_corners: HandOver) -> Detector:
    config = clip.config
    region = Region(np.array(config.region)) if config.region else None
    if clip.boxes is not None:
        return Detections(clip.camera, clip.boxes, region)
    # People turn and bend: their corners tell little.
    corners = MovingPoints(clip.camera) if config.target.motion == "bicycle" else None
    smallest = config.target.smallest
    return MovingRegions(
        clip.camera, config.background, config.regions, smallest, empty, region, corners, compare, follow_corners
    )


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
            for taken in self.ledger.take(self.waiting, self.of, self.tracker.dynamics, self.lamps.only_light):
                self.spool.add(taken.record)
                self.run.count("rejected" if taken.record["summary"]["rejected"] else "vehicles")
                for identity in taken.displaced:
                    self.spool.amend(identity, rejected=taken.reason)
                    self.run.count("rejected")
                    self.run.count("vehicles", -1)
            self.waiting = []
            self.ledger.forget(self.of, self.tracker.since())
