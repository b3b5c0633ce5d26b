"""How tracks begin: regions that nothing explains, watched until they have moved on the ground."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from visfuse_cli.maths import homography
from visfuse_cli.maths.cameras import ground_scale
from visfuse_cli.records import Array, GroundCamera, Region
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking import measure
from visfuse_cli.tracking.association import claim, region_boxes
from visfuse_cli.tracking.dynamics import Dynamics, Step
from visfuse_cli.tracking.evidence import Evidence
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.targets import Abandoned, Sample, Track
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.wireframe import DIRECTIONS, Outlines

HEADING_SIGMA = 0.12  # rad: the course of a region's foot
LOOKS, BIRTH_REACH_PX = 3, 16.0  # a new box is looked for this often, so far around
BORDER_SEEN, AREA_MOVED = 0.6, 0.6  # shares of its border and its area that must be found
CLEAR = 0.4  # share of its border that must have background outside: a window of a grey car has paint
UNUSUAL = 3.0  # deviations of a size from its class
LOST_S = 0.3  # s: a candidate unseen for longer is given up


@dataclass(slots=True)
class Candidate:
    """A region that may become a track once it has moved on the ground."""

    samples: list[Sample]
    anchors: list[tuple[float, float, float, float]]  # t, X, Y, m per px, where the foot of the region is seen
    box: Array
    drift: Array = field(default_factory=lambda: np.zeros(2))  # px/s
    missed_since: float | None = None


class Nursery:
    """Candidates, and the rule by which they become tracks."""

    def __init__(self, camera: GroundCamera, settings: TrackerSettings, dynamics: Dynamics) -> None:
        self._camera, self._settings, self._dynamics = camera, settings, dynamics
        self._candidates: list[Candidate] = []

    def feed(self, frame: int, t: float, regions: list[Region]) -> None:
        """Give the frame's unexplained regions to candidates, new ones where none fits."""
        drifted = [c.box + np.tile(c.drift * (t - c.samples[-1].t), 2) for c in self._candidates]
        given, used = claim(regions, np.array(drifted).reshape(-1, 4))
        for candidate, region in zip(self._candidates, given, strict=True):
            if region is not None:
                self._extend(candidate, frame, t, region)
            elif candidate.missed_since is None:
                candidate.missed_since = t
        for region, taken in zip(regions, used, strict=True):
            if not taken:
                fresh = Candidate([], [], region_boxes([region])[0])
                self._extend(fresh, frame, t, region)
                self._candidates.append(fresh)

    def born(self, next_id: int, evidence: Evidence, pose: Array, size: Array) -> list[Track]:
        """The candidates that are tracks from this frame on, numbered from `next_id`; the boxes (N, 3) are taken."""
        tracks: list[Track] = []
        waiting = []
        for candidate in self._candidates:
            track = None
            if candidate.missed_since is None:
                track = self._confirmed(candidate, next_id + len(tracks), evidence, (pose, size))
            if track is None:
                waiting.append(candidate)
            else:
                tracks.append(track)
        self._candidates = waiting
        return tracks

    def give_up(self, t: float) -> list[Abandoned]:
        """The candidates that were lost or have stood too long."""
        left: list[Abandoned] = []
        alive: list[Candidate] = []
        for candidate in self._candidates:
            if candidate.missed_since is not None and t - candidate.missed_since > LOST_S:
                left.append(_abandoned(candidate, "too short"))
            elif t - candidate.samples[0].t > self._settings.life.tentative_s:
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
            dt = t - candidate.samples[-1].t
            moved = (box - candidate.box).reshape(2, 2).mean(axis=0) / max(dt, 1e-6)
            candidate.drift = 0.5 * candidate.drift + 0.5 * moved
        candidate.box, candidate.missed_since = box, None
        border = 0.0 if region.upright else self._settings.pose.border_px
        outline = wireframe.tangents(region.hull, region.at_border, region.upright, border)
        candidate.samples.append(Sample(frame, t, outline, not region.at_border.any(), True))
        if outline.valid[[0, DIRECTIONS // 4, DIRECTIONS // 2]].all():  # right, bottom and left side in the picture
            foot = np.array([[(box[0] + box[2]) / 2, box[3]]])
            scale = float(ground_scale(self._camera, foot)[0])
            if np.isfinite(scale) and scale < self._settings.life.max_scale:
                X, Y = homography.apply(self._camera.ground.ground_from_image, foot)[0]
                candidate.anchors.append((t, float(X), float(Y), scale))

    def _confirmed(
        self, candidate: Candidate, identity: int, evidence: Evidence, taken: tuple[Array, Array]
    ) -> Track | None:
        """A track, when the candidate moved far and straight enough to tell its heading and a vehicle fits to it."""
        course = self._course(candidate)
        if course is None:
            return None
        velocity, feet = course
        heading = float(np.arctan2(velocity[1], velocity[0]))
        pose = np.column_stack([feet, np.full(len(feet), heading)])
        samples = candidate.samples
        outlines = Outlines.stack([s.outline for s in samples])
        for sized in measure.classify(self._camera, outlines, pose, self._settings.target.classes, self._settings.pose):
            shape = self._seen_as(sized, evidence, taken)
            if shape is not None:
                break
        else:
            return None
        size, size_sigma = shape
        fit = measure.fit_poses(
            self._camera, outlines, sized.fit.pose, size, np.full(3, 0.05), self._settings.pose, HEADING_SIGMA
        )
        fits = measure.looks_right(fit, outlines)
        usable = fit.ok & fits & (np.sqrt(fit.cov[:, 0, 0] + fit.cov[:, 1, 1]) < 2.0)
        if usable.sum() < 2 or not usable[-1]:
            return None
        # What came before an outline that no box fits was another thing: two vehicles apart since.
        first = int(np.argmax(usable))
        if not fits.all():
            first = max(first, int(np.flatnonzero(~fits)[-1]) + 1)
        for sample, used in zip(samples, usable, strict=True):
            sample.measured = bool(used)
        steps = self._replay(samples[first:], fit[first:], heading, velocity, size)
        return Track(identity, sized.prior, size, size_sigma, samples[first:], steps, samples[-1].t)

    def _course(self, candidate: Candidate) -> tuple[Array, Array] | None:
        """Velocity (2,) m/s and foot (n, 2) m of each sample, once they are known."""
        life = self._settings.life
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
        times = np.array([s.t for s in candidate.samples])
        feet = np.column_stack([np.interp(times, a[:, 0], a[:, k]) for k in (1, 2)])
        return velocity, feet + np.clip(times - a[0, 0], None, 0)[:, None] * velocity

    def _seen_as(
        self, sized: measure.Sized, evidence: Evidence, taken: tuple[Array, Array]
    ) -> tuple[Array, Array] | None:
        """Size and deviation (3,) when this frame shows a thing of that class where the regions say it is."""
        pose, size = sized.fit.pose[-1], sized.size
        mean, sigma = measure.prior_arrays(sized.prior)
        for _ in range(LOOKS):
            boxes = np.vstack([taken[0], pose]), np.vstack([taken[1], size])
            reach = np.full(len(boxes[0]), BIRTH_REACH_PX)
            look = evidence.look(*boxes, reach)
            outline = look.outlines[-1:]
            fit = measure.fit_poses(self._camera, outline, pose[None], mean, sigma, self._settings.pose, HEADING_SIGMA)
            pose, size = fit.pose[0], fit.size[0]
        seen = look.border[-1] > BORDER_SEEN and look.moved[-1] > AREA_MOVED and look.clear[-1] > CLEAR
        usual = np.all(np.abs(size - mean) < UNUSUAL * sigma)
        if not (seen and usual and fit.ok[0] and measure.looks_right(fit, outline)[0]):
            return None
        return size, np.minimum(sized.size_sigma, sigma)

    def _replay(
        self, samples: list[Sample], fit: wireframe.BoxFit, heading: float, velocity: Array, size: Array
    ) -> list[Step]:
        """Run the filter over the frames seen before confirmation."""
        start = self._dynamics.begin(np.append(fit.pose[0, :2], heading), velocity)
        steps = [Step(start, start, np.eye(len(start.mean)), None, None)]
        for k in range(1, len(samples)):
            dt = np.array([samples[k].t - samples[k - 1].t])
            expected = dynamics_tools.predict(self._dynamics, [steps[-1].posterior], dt, size[:1])[0]
            if samples[k].measured:
                pose, cov = measure.measurement(fit, k, np.append(fit.pose[k, :2], heading), HEADING_SIGMA)
                z, R = self._dynamics.measured(pose, cov)
                steps.append(dynamics_tools.take(self._dynamics, expected, z, R, steps[-1].memory))
            else:
                steps.append(dynamics_tools.coast(expected, steps[-1].memory))
        return steps


def _abandoned(candidate: Candidate, reason: str) -> Abandoned:
    position = candidate.anchors[-1][1:3] if candidate.anchors else None
    return Abandoned(tuple(candidate.samples), position, reason)
