"""How tracks begin: regions that nothing explains, watched until they have moved on the ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from visfuse_cli.maths import homography
from visfuse_cli.maths.cameras import ground_scale
from visfuse_cli.records import Array, Boxes, GroundCamera, Region
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking import measure
from visfuse_cli.tracking.association import claim, footprint_overlap, region_boxes
from visfuse_cli.tracking.dynamics import Dynamics, Step
from visfuse_cli.tracking.evidence import Evidence, LabelEvidence
from visfuse_cli.tracking.hypotheses import HEADING_SIGMA, Guess, best_guess
from visfuse_cli.tracking.joining import part_before, places
from visfuse_cli.tracking.lookback import Recent, trace
from visfuse_cli.tracking.scan import headings, scan, velocity_of
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.targets import REVERSES, Abandoned, Sample, Track, velocity_at_start
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.points import Courses
from visfuse_cli.vision.wireframe import DIRECTIONS, Outlines

SCAN_S = 0.3, 1.2  # s between searches inside of a region: at first, and at most
MOST_GROWN = 2  # of the boxes found there that are followed back
ASK_AGAIN_S = 0.1, 0.8  # s until a candidate that was none is looked at again: at first, and at most
COURSE_FRAMES = 25  # the last frames of a candidate that tell its course
SEEN = 0.6  # share of the frames of a new track in which its vehicle is seen
LOST_S = 0.3  # s: a candidate unseen for longer is given up


@dataclass(slots=True)
class Candidate:
    """A region that may become a track once it has moved on the ground."""

    samples: list[tuple[int, float]]  # frame, t
    anchors: list[tuple[float, float, float, float]]  # t, X, Y, m per px, where the foot of the region is seen
    box: Array
    region: Region
    drift: Array = field(default_factory=lambda: np.zeros(2))  # px/s
    missed_since: float | None = None
    asked_again: float = 0.0  # s: not before
    patience: float = ASK_AGAIN_S[0]  # s until then
    scanned_again: float = 0.0  # s: not before
    scan_patience: float = SCAN_S[0]  # s until then


class Nursery:
    """Candidates, and the rule by which they become tracks."""

    def __init__(self, camera: GroundCamera, settings: TrackerSettings, dynamics: Dynamics) -> None:
        self._camera, self._settings, self._dynamics = camera, settings, dynamics
        self._candidates: list[Candidate] = []

    def feed(self, frame: int, t: float, regions: list[Region]) -> None:
        """Give the frame's unexplained regions to candidates, new ones where none fits."""
        drifted = [c.box + np.tile(c.drift * (t - c.samples[-1][1]), 2) for c in self._candidates]
        given = claim(regions, np.array(drifted).reshape(-1, 4))
        for candidate, number in zip(self._candidates, given, strict=True):
            if number >= 0:
                self._extend(candidate, frame, t, regions[number])
            elif candidate.missed_since is None:
                candidate.missed_since = t
        for number, region in enumerate(regions):
            if number not in given:
                fresh = Candidate([], [], region_boxes([region])[0], region)
                self._extend(fresh, frame, t, region)
                self._candidates.append(fresh)

    def born(
        self, next_id: int, tracks: list[Track], held: list[Track], recent: Recent, taken_at: Callable[[int], Boxes]
    ) -> int:
        """Add the candidates that are tracks from this frame on to `tracks`, numbered from `next_id`; the next id.

        Those that go on from a track `held` take its number and its place.
        """
        waiting = []
        for candidate in self._candidates:
            track = None
            t = candidate.samples[-1][1]
            if candidate.missed_since is None and t >= candidate.asked_again:
                track = self._confirmed(candidate, next_id, recent, taken_at, held)
            if track is None:
                waiting.append(candidate)
            else:
                next_id = _added(track, tracks, held, next_id)
        self._candidates = waiting
        return self._scanned(next_id, tracks, held, recent, taken_at)

    def _scanned(
        self, next_id: int, tracks: list[Track], held: list[Track], recent: Recent, taken_at: Callable[[int], Boxes]
    ) -> int:
        """Add the vehicles found inside of regions to `tracks`; the next free id."""
        frame, t, evidence = recent[-1]
        due = [c for c in self._candidates if c.missed_since is None and t >= c.scanned_again]
        if not due or not isinstance(evidence, LabelEvidence) or (corners := evidence.corners()) is None:
            return next_id
        for candidate in due:
            candidate.scanned_again = t + candidate.scan_patience
            candidate.scan_patience = min(2 * candidate.scan_patience, SCAN_S[1])
            guesses = self._guessed(candidate.region, evidence, corners.courses, taken_at(frame))
            grown = [
                track
                for guess, velocity in guesses[:MOST_GROWN]
                if (track := self.grown(guess, velocity, next_id, recent, taken_at, held)) is not None
            ]
            if grown:
                next_id = _added(max(grown, key=_seen), tracks, held, next_id)
        return next_id

    def _guessed(
        self, region: Region, evidence: LabelEvidence, courses: Courses, taken: Boxes
    ) -> list[tuple[Guess, Array]]:
        """Boxes that explain a part of a region, with their velocities (2,) m/s; the one that explains most first."""
        low, high = region.box[:2], region.box[:2] + region.box[2:]
        here = courses[np.all((courses.place >= low) & (courses.place <= high), axis=1)]
        found = []
        for heading in headings(here.course):
            guesses = scan(self._camera, self._settings, evidence, region.box, region.around_area, heading, taken)
            velocities = [velocity_of(self._camera, guess, here) for guess in guesses]
            found += [(guess, v) for guess, v in zip(guesses, velocities, strict=True) if v is not None]
        return sorted(found, key=lambda each: -each[0].gain)

    def rival(self, evidence: Evidence, box: Array, taken: Boxes) -> Guess | None:
        """The best other box for what stands where a box (6,) of pose and size is believed, among those `taken`."""
        hull = wireframe.silhouette(self._camera, box[:3], box[3:])
        if not len(hull):
            return None
        expected = np.concatenate([hull.min(axis=0), hull.max(axis=0)])
        guesses: list[Guess] = []
        regions = evidence.leftovers(*taken)
        found = claim(regions, expected[None])[0]
        if found >= 0:
            guess = best_guess(self._camera, self._settings, evidence, regions[found], float(box[2]), taken, False)
            guesses += [guess] if guess is not None else []
        if isinstance(evidence, LabelEvidence):
            place = np.append(expected[:2], expected[2:] - expected[:2])
            guesses += scan(self._camera, self._settings, evidence, place, np.inf, float(box[2]), taken, False)
        here = [
            g for g in guesses if footprint_overlap(g.pose[None], g.size[None], box[None, :3], box[None, 3:])[0, 0] > 0
        ]
        return max(here, key=lambda guess: guess.gain, default=None)

    def give_up(self, t: float) -> list[Abandoned]:
        """The candidates that were lost or have stood too long."""
        left: list[Abandoned] = []
        alive: list[Candidate] = []
        for candidate in self._candidates:
            if candidate.missed_since is not None and t - candidate.missed_since > LOST_S:
                left.append(_abandoned(candidate, "too short"))
            elif t - candidate.samples[0][1] > self._settings.life.tentative_s:
                left.append(_abandoned(candidate, "did not move"))
            else:
                alive.append(candidate)
        self._candidates = alive
        return left

    def finish(self) -> list[Abandoned]:
        """Give up all that are left."""
        left = [_abandoned(candidate, "too short") for candidate in self._candidates]
        self._candidates = []
        return left

    def _extend(self, candidate: Candidate, frame: int, t: float, region: Region) -> None:
        box = region_boxes([region])[0]
        if candidate.samples:
            dt = t - candidate.samples[-1][1]
            moved = (box - candidate.box).reshape(2, 2).mean(axis=0) / max(dt, 1e-6)
            candidate.drift = 0.5 * candidate.drift + 0.5 * moved
        candidate.box, candidate.region, candidate.missed_since = box, region, None
        candidate.samples.append((frame, t))
        border = 0.0 if region.upright else self._settings.pose.border_px
        outline = wireframe.tangents(region.hull, region.at_border, region.upright, border)
        if outline.valid[[0, DIRECTIONS // 4, DIRECTIONS // 2]].all():  # right, bottom and left side in the picture
            foot = np.array([[(box[0] + box[2]) / 2, box[3]]])
            scale = float(ground_scale(self._camera, foot)[0])
            if np.isfinite(scale) and scale < self._settings.life.max_scale:
                X, Y = homography.apply(self._camera.ground.ground_from_image, foot)[0]
                candidate.anchors.append((t, float(X), float(Y), scale))

    def _confirmed(
        self,
        candidate: Candidate,
        identity: int,
        recent: Recent,
        taken_at: Callable[[int], Boxes],
        held: list[Track],
    ) -> Track | None:
        """A track, when the candidate moved far and straight enough to tell its heading and a vehicle is seen there."""
        velocity = self._course(candidate)
        if velocity is None:
            return None
        heading = float(np.arctan2(velocity[1], velocity[0]))
        frame, t, evidence = recent[-1]
        candidate.asked_again = t + candidate.patience
        candidate.patience = min(2 * candidate.patience, ASK_AGAIN_S[1])
        settings, camera = self._settings, self._camera
        guess = best_guess(camera, settings, evidence, candidate.region, heading, taken_at(frame))
        if guess is None:
            return None
        return self.grown(guess, velocity, identity, recent, taken_at, held)

    def grown(
        self,
        guess: Guess,
        velocity: Array,
        identity: int,
        recent: Recent,
        taken_at: Callable[[int], Boxes],
        earlier: list[Track],
        beyond_doubt: bool = True,
    ) -> Track | None:
        """A track from what was guessed in the last frame, followed back and joined to the one of the `earlier` tracks
        that it goes on from, whose number it has. None when it was hardly seen before."""
        camera, settings = self._camera, self._settings
        samples, pose = trace(camera, settings, self._dynamics, recent, taken_at, guess, velocity, beyond_doubt)
        found, ahead = _driven(samples, pose)
        if settings.target.motion == "bicycle" and ahead < -REVERSES:
            guess = replace(guess, pose=guess.pose + [0, 0, np.pi])  # it was given the course of another
            samples, pose = trace(camera, settings, self._dynamics, recent, taken_at, guess, found, beyond_doubt)
        used = np.array([sample.measured for sample in samples], dtype=bool)
        if used.sum() < settings.life.confirm_frames or used.mean() < SEEN:
            return None
        if np.hypot(*(pose[-1, :2] - pose[0, :2])) < settings.life.confirm_m:
            return None
        for old in earlier:
            before = part_before(old, self._dynamics, samples, pose, guess.size)
            if before is not None:
                return self._track(old.id, before[0] + samples, np.concatenate([before[1], pose]), samples[0].frame)
        return self._track(identity, samples, pose, samples[0].frame)

    def joined(self, old: Track, new: Track) -> Track:
        """A track with what an older one was before it began."""
        kept = [sample for sample in old.samples if sample.frame < new.samples[0].frame]
        pose = places([*old.steps[: len(kept)], *new.steps], self._dynamics)
        return self._track(old.id, kept + new.samples, pose, new.traced_from)

    def _track(self, identity: int, samples: list[Sample], pose: Array, traced_from: int) -> Track:
        """A track from its samples so far, its poses (n, 3) in them being roughly known."""
        camera, settings = self._camera, self._settings
        used = np.array([sample.measured for sample in samples], dtype=bool)
        outlines = Outlines.stack([sample.outline for sample in samples])
        classes = settings.target.classes
        tried = measure.classify(camera, outlines[used], pose[used], classes, settings.pose, measure.median_size)
        size, size_sigma = measure.believed(tried)
        fit = measure.fit_poses(camera, outlines, pose, size, np.full(3, 0.05), settings.pose, HEADING_SIGMA)
        first = velocity_at_start(samples, pose)
        steps = self._replay(samples, fit, pose, first, size)
        last = samples[int(np.flatnonzero(used)[-1])].t
        return Track(identity, tried[0].prior, size, size_sigma, samples, steps, last, traced_from=traced_from)

    def _course(self, candidate: Candidate) -> Array | None:
        """Velocity (2,) m/s of a region's foot, once it is known."""
        life = self._settings.life
        if len(candidate.anchors) < life.confirm_frames or candidate.anchors[-1][3] > life.birth_scale:
            return None
        for frames in (COURSE_FRAMES, len(candidate.anchors)):  # what creeps needs longer
            a = np.array(candidate.anchors[-frames:])
            t = a[:, 0] - a[:, 0].mean()
            velocity = t @ (a[:, 1:3] - a[:, 1:3].mean(axis=0)) / max(t @ t, 1e-12)
            way = velocity * (a[-1, 0] - a[0, 0])
            stray = a[:, 1:3] - a[:, 1:3].mean(axis=0) - t[:, None] * velocity
            noise = max(float(np.sqrt(np.mean(stray**2))), 2 * a[:, 3].mean() / np.sqrt(len(a)))
            if np.hypot(*way) > max(life.confirm_m, 4 * noise):
                return np.asarray(velocity)
        return None

    def _replay(
        self, samples: list[Sample], fit: wireframe.BoxFit, pose: Array, velocity: Array, size: Array
    ) -> list[Step]:
        """Run the filter over the frames seen before confirmation, poses (n, 3) in them being roughly known."""
        start = self._dynamics.begin(np.append(fit.pose[0, :2], pose[0, 2]), velocity)
        steps = [dynamics_tools.first(self._dynamics, start)]
        z, R = self._dynamics.measured(*measure.measurements(fit, pose, HEADING_SIGMA))
        for k in range(1, len(samples)):
            dt = np.array([samples[k].t - samples[k - 1].t])
            expected = dynamics_tools.predict(self._dynamics, steps[-1:], dt, size[:1])[0]
            if samples[k].measured and fit.ok[k]:
                steps.append(dynamics_tools.take(self._dynamics, expected, z[k], R[k]))
            else:
                steps.append(dynamics_tools.coast(expected))
        return steps


def _added(track: Track, tracks: list[Track], held: list[Track], next_id: int) -> int:
    """Add a new track, which takes the place of the one `held` that it goes on from; the next free id."""
    tracks.append(track)
    held[:] = [old for old in held if old.id != track.id]
    return max(next_id, track.id + 1)


def _driven(samples: list[Sample], pose: Array) -> tuple[Array, float]:
    """Mean velocity (2,) m/s of a thing at poses (n, 3), and how much of it goes the way it faces in the end."""
    if len(pose) < 2:
        return np.zeros(2), 0.0
    velocity = (pose[-1, :2] - pose[0, :2]) / (samples[-1].t - samples[0].t)
    return velocity, float(velocity @ [np.cos(pose[-1, 2]), np.sin(pose[-1, 2])])


def _seen(track: Track) -> float:
    """How much of a track's border was seen, on average."""
    return float(np.mean([sample.border for sample in track.samples if sample.border >= 0]))


def _abandoned(candidate: Candidate, reason: str) -> Abandoned:
    position = candidate.anchors[-1][1:3] if candidate.anchors else None
    return Abandoned(candidate.samples[0][1], candidate.samples[-1][1], len(candidate.samples), position, reason)
