"""The ground-plane tracker: predict every target, measure around the predictions, update; births and ends."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from visfuse_cli.maths import homography
from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.cameras import ground_scale, project
from visfuse_cli.maths.gaussian import mahalanobis
from visfuse_cli.records import Array, GroundCamera, Region
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking import measure
from visfuse_cli.tracking.association import Claim, boxes_of, claim, footprint_contains, reach_of, region_boxes
from visfuse_cli.tracking.dynamics import Dynamics, Prediction, Step
from visfuse_cli.tracking.settings import SizePrior, TrackerSettings
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.wireframe import DIRECTIONS, FAN, Outlines

VAGUE_M = 1.5  # m: a pose less certain than this is no measurement
YOUNG, LEAP = 12, 4.0  # frames after which one measurement may not change the velocity by more (m/s)
FRAGMENT_GAP = 0.25  # of a region's size: parts of one vehicle lie closer together, two vehicles mostly apart
ALIEN_PX, ALIEN_SHARE = 8.0, 0.25  # how far a tangent may stick out of its prediction, px or share of the size


@dataclass(slots=True)
class Sample:
    """One frame of a target: tangents (K,) of its region, which of them count, whether the whole region was in view
    and its own; `measured` when they were used."""

    frame: int
    t: float
    support: Array
    valid: np.ndarray
    whole: bool
    measured: bool


@dataclass(slots=True)
class Track:
    """A confirmed target: its samples, one filter step for each, and the belief of its size (m)."""

    id: int
    prior_class: SizePrior
    size: Array
    size_sigma: Array
    samples: list[Sample]
    steps: list[Step]
    last_measured: float
    refused: int = 0  # measurements that fell outside the gate
    refused_since: float | None = None  # s: since when all of them did
    ended_by: str = ""


@dataclass(slots=True)
class Candidate:
    """A region that may become a track once it has moved on the ground."""

    samples: list[Sample]
    anchors: list[tuple[float, float, float, float]]  # t, X, Y, m per px, where the foot of the region is seen
    box: Array
    drift: Array = field(default_factory=lambda: np.zeros(2))  # px/s
    missed_since: float | None = None


@dataclass(frozen=True, slots=True)
class Abandoned:
    """A candidate given up, for the rejection ledger."""

    samples: tuple[Sample, ...]
    position: tuple[float, float] | None
    reason: str


class GroundTracker:
    """Follows everything that moves on one ground plane; memory is bounded by what is alive.

    Each frame: `predict(t)`, then `update(frame, regions)`, which returns what ended.
    """

    def __init__(
        self, camera: GroundCamera, settings: TrackerSettings, first_id: int = 1, upright: bool = False
    ) -> None:
        self.camera = camera
        self.settings = settings
        self.dynamics: Dynamics = dynamics_tools.for_target(settings.target, settings.filter)
        self.tracks: list[Track] = []
        self.candidates: list[Candidate] = []
        self.next_id = first_id
        self._upright = upright
        self._gate = gate_size(len(self.dynamics.H), settings.pose.gate)
        self._t = 0.0
        self._expected: list[Prediction] = []  # of each track, at the predicted time
        self._pose = np.zeros((0, 3))
        self._reach = np.zeros((0, DIRECTIONS))

    def predict(self, t: float) -> None:
        """Advance every track to time t (s) and project the outline each is expected to have."""
        self._t = t
        self._expected = []
        if self.tracks:
            prediction = dynamics_tools.predict(
                self.dynamics,
                [track.steps[-1].posterior for track in self.tracks],
                np.array([t - track.samples[-1].t for track in self.tracks]),
                np.array([track.size[0] for track in self.tracks]),
            )
            self._expected = [prediction[k] for k in range(len(self.tracks))]
        self._pose = np.array([self._pose_of(expected.prior.mean) for expected in self._expected]).reshape(-1, 3)
        self._reach = self._outline(self._pose)

    def update(self, frame: int, regions: list[Region]) -> tuple[list[Track], list[Abandoned]]:
        """Give the frame's regions to tracks and candidates; returns the tracks and candidates that ended."""
        claims = claim(regions, self._reach)
        self._measure(frame, claims.of)
        free = [region for region, near in zip(regions, claims.near | claims.used, strict=True) if not near]
        self._feed_candidates(frame, free)
        self._confirm()
        return self._end(), self._give_up()

    def finish(self) -> tuple[list[Track], list[Abandoned]]:
        """End everything that is still alive."""
        tracks = [self._trimmed(track, "end of footage") for track in self.tracks]
        left = [self._abandon(candidate, "too short") for candidate in self.candidates]
        self.tracks, self.candidates = [], []
        return tracks, left

    def outlines(self) -> list[Array]:
        """Outlines (k, 2) px of the followed targets at the last predicted time."""
        return [
            wireframe.silhouette(self.camera, pose, track.size)
            for pose, track in zip(self._pose, self.tracks, strict=False)
        ]

    def _pose_of(self, x: Array) -> Array:
        return np.array([x[0], x[1], self.dynamics.heading(x)])

    def _outline(self, pose: Array) -> Array:
        size = np.array([track.size for track in self.tracks]).reshape(-1, 3)
        pixels, _ = project(self.camera, wireframe.corners(pose, size))
        return np.asarray(np.max(np.nan_to_num(pixels @ FAN.T, nan=-1e9), axis=1))

    def _seen(self, frame: int, region: Region, own: np.ndarray | None = None) -> Sample:
        support, valid = wireframe.outline(region.hull, region.at_border, self._upright)
        if own is not None:
            valid = valid & own
        border = 0.0 if self._upright else self.settings.pose.border_px
        whole = not region.at_border.any() and (own is None or bool(own.all()))
        return Sample(frame, self._t, support + border, valid, whole, True)

    def _unseen(self, frame: int) -> Sample:
        return Sample(frame, self._t, np.zeros(DIRECTIONS), np.zeros(DIRECTIONS, bool), False, False)

    def _measure(self, frame: int, claims: list[Claim | None]) -> None:
        if not claims:
            return
        samples = [self._unseen(frame) if c is None else self._seen(frame, c.region, c.own) for c in claims]
        for sample, reach in zip(samples, self._reach, strict=True):
            # What sticks out of the prediction is somebody else's, joined to this one in the picture.
            alien = sample.valid & (sample.support > reach + max(ALIEN_PX, ALIEN_SHARE * float(np.ptp(reach)) / 2))
            sample.valid &= ~alien
            sample.whole &= not alien.any()
        outlines = Outlines(np.array([s.support for s in samples]), np.array([s.valid for s in samples]))
        size = np.array([track.size for track in self.tracks])
        sigma = np.array([track.size_sigma for track in self.tracks])
        fit = measure.fit_poses(self.camera, outlines, self._pose, size, sigma, self.settings.pose)
        for k, (track, sample) in enumerate(zip(self.tracks, samples, strict=True)):
            step = dynamics_tools.coast(self._expected[k], track.steps[-1].memory)
            sample.measured = False
            if fit.ok[k] and sample.valid.any():
                z, R = self.dynamics.measured(*measure.measurement(fit, k, self._pose[k]))
                tried = dynamics_tools.take(self.dynamics, self._expected[k], z, R, step.memory)
                if self._plausible(track, tried, z, R, fit, k):
                    step, sample.measured = tried, True
                    track.last_measured, track.refused_since = sample.t, None
                    self._learn_size(track, fit, k)
                else:
                    track.refused += 1
                    track.refused_since = sample.t if track.refused_since is None else track.refused_since
            track.samples.append(sample)
            track.steps.append(step)

    def _plausible(self, track: Track, step: Step, z: Array, R: Array, fit: wireframe.BoxFit, k: int) -> bool:
        """Enough outline to place the box, a box that looks like its region, inside the gate, and no leap of speed."""
        if R[0, 0] + R[1, 1] > VAGUE_M**2 or fit.rms[k] > max(6.0, 0.15 * np.ptp(self._reach[k])):
            return False
        H = self.dynamics.H
        gamma = dynamics_tools.residual(self.dynamics, z, step.prior.mean)
        if mahalanobis(gamma, H @ step.prior.cov @ H.T + R) > self._gate:
            return False
        before, after = (self.dynamics.planar(x)[0][2:] for x in (step.prior.mean, step.posterior.mean))
        return len(track.samples) < YOUNG or float(np.hypot(*(after - before))) < LEAP

    def _learn_size(self, track: Track, fit: wireframe.BoxFit, k: int) -> None:
        # Frames of one target share their errors (the same light, the same shadow): each counts as a tenth.
        variance = np.diagonal(fit.cov[k, 3:, 3:])
        noise = 10 / np.clip(1 / variance - 1 / track.size_sigma**2, 1e-6, None)
        alone = track.size + (fit.size[k] - track.size) / np.clip(1 - variance / track.size_sigma**2, 0.05, 1)
        gain = track.size_sigma**2 / (track.size_sigma**2 + noise)
        track.size = np.maximum(track.size + gain * np.clip(alone - track.size, -0.5, 0.5), 0.2)
        track.size_sigma = np.maximum(track.size_sigma * np.sqrt(1 - gain), 0.03)

    def _feed_candidates(self, frame: int, regions: list[Region]) -> None:
        drifted = [c.box + np.tile(c.drift * (self._t - c.samples[-1].t), 2) for c in self.candidates]
        claims = claim(regions, reach_of(np.array(drifted).reshape(-1, 4)), FRAGMENT_GAP)
        for candidate, claimed in zip(self.candidates, claims.of, strict=True):
            if claimed is not None and claimed.own.all():
                self._extend(candidate, frame, claimed.region)
            elif candidate.missed_since is None:
                candidate.missed_since = self._t
        for region, used in zip(regions, claims.used, strict=True):
            if not used:
                fresh = Candidate([], [], region_boxes([region])[0])
                self._extend(fresh, frame, region)
                self.candidates.append(fresh)

    def _extend(self, candidate: Candidate, frame: int, region: Region) -> None:
        box = region_boxes([region])[0]
        if candidate.samples:
            dt = self._t - candidate.samples[-1].t
            moved = (box - candidate.box).reshape(2, 2).mean(axis=0) / max(dt, 1e-6)
            candidate.drift = 0.5 * candidate.drift + 0.5 * moved
        candidate.box, candidate.missed_since = box, None
        sample = self._seen(frame, region)
        candidate.samples.append(sample)
        if sample.valid[[0, DIRECTIONS // 4, DIRECTIONS // 2]].all():  # right, bottom and left side in the picture
            foot = np.array([[(box[0] + box[2]) / 2, box[3]]])
            scale = float(ground_scale(self.camera, foot)[0])
            if np.isfinite(scale) and scale < self.settings.life.max_scale:
                X, Y = homography.apply(self.camera.ground.ground_from_image, foot)[0]
                candidate.anchors.append((self._t, float(X), float(Y), scale))

    def _confirm(self) -> None:
        waiting = []
        for candidate in self.candidates:
            track = self._born(candidate) if candidate.missed_since is None else None
            if track is None:
                waiting.append(candidate)
            else:
                self.tracks.append(track)
                self.next_id += 1
        self.candidates = waiting

    def _born(self, candidate: Candidate) -> Track | None:
        """A track, when the candidate's foot has moved far and straight enough on the ground to tell its heading."""
        life = self.settings.life
        if len(candidate.anchors) < life.confirm_frames or candidate.anchors[-1][3] > life.birth_scale:
            return None
        a = np.array(candidate.anchors)
        t = a[:, 0] - a[:, 0].mean()
        velocity = t @ (a[:, 1:3] - a[:, 1:3].mean(axis=0)) / max(t @ t, 1e-12)
        way = velocity * (a[-1, 0] - a[0, 0])
        stray = a[:, 1:3] - a[:, 1:3].mean(axis=0) - t[:, None] * velocity
        noise = max(float(np.sqrt(np.mean(stray**2))), 2 * a[:, 3].mean() / np.sqrt(len(a)))
        if np.hypot(*way) < max(life.confirm_m, 4 * noise):
            return None
        heading = float(np.arctan2(velocity[1], velocity[0]))
        samples = candidate.samples
        times = np.array([s.t for s in samples])
        feet = np.column_stack([np.interp(times, a[:, 0], a[:, k]) for k in (1, 2)])
        before = np.clip(times - a[0, 0], None, 0)[:, None] * velocity
        pose = np.column_stack([feet + before, np.full(len(times), heading)])
        outlines = Outlines(np.array([s.support for s in samples]), np.array([s.valid for s in samples]))
        prior, size, size_sigma, fit = measure.classify(
            self.camera, outlines, pose, self.settings.target.classes, self.settings.pose
        )
        fit = measure.fit_poses(self.camera, outlines, fit.pose, size, np.full(3, 0.05), self.settings.pose, 0.12)
        return self._replay(samples, outlines, fit, heading, velocity, prior, size, size_sigma)

    def _replay(
        self,
        samples: list[Sample],
        outlines: Outlines,
        fit: wireframe.BoxFit,
        heading: float,
        velocity: Array,
        prior: SizePrior,
        size: Array,
        size_sigma: Array,
    ) -> Track | None:
        """Run the filter over the frames seen before confirmation."""
        fits = fit.rms < max(6.0, 0.15 * float(np.median(measure.extent(outlines))))
        usable = np.flatnonzero(fit.ok & fits & (np.sqrt(fit.cov[:, 0, 0] + fit.cov[:, 1, 1]) < 2.0))
        if len(usable) < 2 or usable[-1] != len(samples) - 1:
            return None
        # What came before an outline that no box fits was another thing: two vehicles apart since.
        first = int(max(usable[0], np.flatnonzero(~fits)[-1] + 1 if not fits.all() else 0))
        start = self.dynamics.begin(np.append(fit.pose[first, :2], heading), velocity)
        steps = [Step(start, start, np.eye(len(start.mean)), None, None)]
        for k in range(first + 1, len(samples)):
            dt = np.array([samples[k].t - samples[k - 1].t])
            expected = dynamics_tools.predict(self.dynamics, [steps[-1].posterior], dt, size[:1])[0]
            samples[k].measured = k in usable
            if k in usable:
                pose, cov = measure.measurement(fit, k, np.append(fit.pose[k, :2], heading), 0.12)
                z, R = self.dynamics.measured(pose, cov)
                steps.append(dynamics_tools.take(self.dynamics, expected, z, R, steps[-1].memory))
            else:
                steps.append(dynamics_tools.coast(expected, steps[-1].memory))
        return Track(self.next_id, prior, size, size_sigma, samples[first:], steps, samples[-1].t)

    def _end(self) -> list[Track]:
        ended: list[Track] = []
        alive: list[Track] = []
        pose = np.array([self._pose_of(track.steps[-1].posterior.mean) for track in self.tracks]).reshape(-1, 3)
        box = boxes_of(self._outline(pose)) if len(pose) else np.zeros((0, 4))
        feet, _ = project(self.camera, np.column_stack([pose[:, :2], np.zeros(len(pose))]))
        scale = ground_scale(self.camera, feet)
        width, height = self.camera.image_size
        for k, track in enumerate(self.tracks):
            outside = box[k, 2] < 0 or box[k, 3] < 0 or box[k, 0] > width or box[k, 1] > height
            twin = next(
                (
                    o
                    for o in alive
                    if footprint_contains(self._pose_of(o.steps[-1].posterior.mean), o.size, pose[k, :2])
                ),
                None,
            )
            if twin is not None and len(track.samples) < len(twin.samples):
                ended.append(self._trimmed(track, f"same vehicle as track {twin.id}"))
            elif outside or not np.isfinite(box[k]).all():
                ended.append(self._trimmed(track, "left the picture"))
            elif scale[k] > self.settings.life.max_scale:
                ended.append(self._trimmed(track, "left the measurable zone"))
            elif track.refused_since is not None and self._t - track.refused_since > self.settings.life.max_refused_s:
                ended.append(self._trimmed(track, "no longer looks like itself"))
            elif self._t - track.last_measured > self.settings.life.max_coast_s:
                ended.append(self._trimmed(track, "lost"))
            else:
                alive.append(track)
        self.tracks = alive
        return ended

    def _twin(self, track: Track, pose: Array, others: list[Track]) -> Track | None:
        """An older track in whose footprint this one stands: one vehicle followed twice."""
        for other in others:
            where = self._pose_of(other.steps[-1].posterior.mean)
            if len(track.samples) < len(other.samples) and footprint_contains(where, other.size, pose[:2]):
                return other
        return None

    def _trimmed(self, track: Track, reason: str) -> Track:
        """The track without the predictions after its last measurement."""
        while len(track.samples) > 1 and not track.samples[-1].measured:
            track.samples.pop()
            track.steps.pop()
        track.ended_by = reason
        return track

    def _give_up(self) -> list[Abandoned]:
        left: list[Abandoned] = []
        alive: list[Candidate] = []
        life = self.settings.life
        for candidate in self.candidates:
            age = self._t - candidate.samples[0].t
            missing = candidate.missed_since is not None and self._t - candidate.missed_since > 0.3
            if missing:
                left.append(self._abandon(candidate, "too short"))
            elif age > life.tentative_s:
                left.append(self._abandon(candidate, "did not move"))
            else:
                alive.append(candidate)
        self.candidates = alive
        return left

    def _abandon(self, candidate: Candidate, reason: str) -> Abandoned:
        position = candidate.anchors[-1][1:3] if candidate.anchors else None
        return Abandoned(tuple(candidate.samples), position, reason)
