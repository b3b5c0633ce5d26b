"""The ground-plane tracker: predict every target, measure around the predictions, update; births and ends."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.cameras import project
from visfuse_cli.maths.gaussian import mahalanobis
from visfuse_cli.records import Array, Boxes, GroundCamera
from visfuse_cli.records import Region as ImageRegion
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking import endings, measure, texture
from visfuse_cli.tracking.association import footprint_overlap
from visfuse_cli.tracking.births import Nursery
from visfuse_cli.tracking.dynamics import Dynamics, Prediction, Step
from visfuse_cli.tracking.endings import ONE_PLACE, trimmed
from visfuse_cli.tracking.evidence import Evidence
from visfuse_cli.tracking.hypotheses import LEAST_OPEN, Guess, gains
from visfuse_cli.tracking.joining import WAIT_S, goes_on, lasting
from visfuse_cli.tracking.lookback import Recent
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.targets import REVERSES, Abandoned, Comparison, Sample, Track
from visfuse_cli.tracking.zones import Region
from visfuse_cli.vision import wireframe

VAGUE_M = 1.5  # m: a pose less certain than this is no measurement
YOUNG, LEAP = 12, 4.0  # frames after which one measurement may not change the velocity by more (m/s)
SEEN_SHARE = 0.4  # of the unhidden area of a box that must have moved and of its border that must be found
LIKENESS_S = 0.4  # s over which the share of the border that is found is averaged
DOUBTFUL, MOVED_M = 0.25, 2.0  # share of the border that is not clear, to compare, and again so many m further
WAIT_AT_MOST_S = 6.0  # before a doubtful track is compared again
BETTER, COMPARED = 1.2, 8  # times as much then, over so many of the last frames
LOOK_BACK_FRAMES = 120  # at most
HIDDEN = 0.8  # of a box in view, below which the corners on it tell how fast it goes
SLIP_S, SLIPS = 0.3, (1.8, 0.6)  # s, and deviations by which corners leave a box, until they have it with them again
REACH_PX, REACH_SHARE = (4.0, 24.0), 0.2  # how far from its prediction an outline is looked for; of its height
MISLED = ("no longer looks like itself", "jumped", "lost")  # ends of tracks that may have left their vehicle
BESIDE_M = 6.0  # m between two tracks that may be parts of one vehicle


class GroundTracker:
    """Follows everything that moves on one ground plane; memory is bounded by what is alive.

    Each frame: `predict(t)`, then `update(frame, evidence)`, which returns what ended.
    """

    def __init__(self, camera: GroundCamera, settings: TrackerSettings, first_id: int = 1) -> None:
        self.camera = camera
        self.settings = settings
        self.dynamics: Dynamics = dynamics_tools.for_target(settings.target, settings.filter)
        self.tracks: list[Track] = []
        self.unexplained: list[ImageRegion] = []  # what moved in the last frame and belongs to no track
        self.next_id = first_id
        self._nursery = Nursery(camera, settings, self.dynamics)
        self._region = Region(np.array(settings.region)) if settings.region else None
        self._gate = gate_size(len(self.dynamics.H), settings.pose.gate)
        self._t = 0.0
        self._expected: list[Prediction] = []  # of each track, at the predicted time
        self._recent: Recent = deque()
        self._held: list[Track] = []  # ended, but a new track may turn out to go on from them

    def predict(self, t: float) -> None:
        """Advance every track to time t (s)."""
        self._t = t
        self._expected = []
        if self.tracks:
            self._expected = dynamics_tools.predict(
                self.dynamics,
                [track.steps[-1] for track in self.tracks],
                np.array([t - track.samples[-1].t for track in self.tracks]),
                np.array([track.size[0] for track in self.tracks]),
            )

    def update(self, frame: int, evidence: Evidence) -> tuple[list[Track], list[Abandoned]]:
        """Measure every track, and let the rest become tracks; returns the tracks and candidates that ended."""
        if self.tracks:
            self._measure(frame, evidence)
        self._remember(frame, evidence)
        self._reconsider(evidence)
        self.unexplained = evidence.leftovers(*self.boxes())
        self._nursery.feed(frame, self._t, self.unexplained)
        self.next_id = self._nursery.born(self.next_id, self.tracks, self._held, self._recent, self._boxes_at)
        self._held += self._end()
        return self._released(), self._nursery.give_up(self._t)

    def finish(self) -> tuple[list[Track], list[Abandoned]]:
        """End everything that is still alive."""
        tracks = [trimmed(track, "end of footage") for track in self.tracks]
        tracks, self.tracks, self._held = self._held + tracks, [], []
        return tracks, self._nursery.finish()

    def since(self) -> int:
        """The first frame that a track may hold which has not been given back yet."""
        return min([self._recent[0][0], *(track.samples[0].frame for track in (*self.tracks, *self._held))])

    def headings(self) -> list[float]:
        """Headings (rad) of the followed targets, as last known."""
        return [float(self.dynamics.heading(track.steps[-1].posterior.mean)) for track in self.tracks]

    def expected(self) -> Boxes:
        """Pose (N, 3) and size (N, 3) of the tracks where they are predicted."""
        pose = [dynamics_tools.pose(self.dynamics, prediction.prior.mean) for prediction in self._expected]
        return np.array(pose).reshape(-1, 3), np.array([track.size for track in self.tracks]).reshape(-1, 3)

    def boxes(self) -> Boxes:
        """Pose (N, 3) and size (N, 3) of the tracks, as last known."""
        pose = [dynamics_tools.pose(self.dynamics, track.steps[-1].posterior.mean) for track in self.tracks]
        return np.array(pose).reshape(-1, 3), np.array([track.size for track in self.tracks]).reshape(-1, 3)

    def _boxes_at(self, frame: int, without: Sequence[Track] = ()) -> Boxes:
        """Pose (N, 3) and size (N, 3) of the tracks that were followed in a frame, there, but for some."""
        pose, size = [], []
        for track in self.tracks:
            if any(track is each for each in without):
                continue
            k = bisect_left(track.samples, frame, key=lambda sample: sample.frame)
            if k < len(track.samples) and track.samples[k].frame == frame:
                pose.append(dynamics_tools.pose(self.dynamics, track.steps[k].posterior.mean))
                size.append(track.size)
        return np.array(pose).reshape(-1, 3), np.array(size).reshape(-1, 3)

    def _remember(self, frame: int, evidence: Evidence) -> None:
        if self._recent:
            self._recent[-1][2].pack()
        self._recent.append((frame, self._t, evidence))
        life, recent = self.settings.life, self._recent
        least = life.confirm_frames + 2
        while len(recent) > LOOK_BACK_FRAMES or (len(recent) > least and self._t - recent[0][1] > life.look_back_s):
            recent.popleft()

    def _measure(self, frame: int, evidence: Evidence) -> None:
        pose = np.array([dynamics_tools.pose(self.dynamics, expected.prior.mean) for expected in self._expected])
        size = np.array([track.size for track in self.tracks])
        sigma = np.array([track.size_sigma for track in self.tracks])
        look = evidence.look(pose, size, self._reach(pose))
        fit = measure.fit_poses(self.camera, look.outlines, pose, size, sigma, self.settings.pose)
        border = np.where(np.isnan(look.likeness), look.border, look.likeness) * fit.agreed
        there = fit.ok & measure.looks_right(fit, look.outlines) & (look.moved > SEEN_SHARE) & ~(border < SEEN_SHARE)
        there &= look.open > LEAST_OPEN
        along, pace, ahead, doubt = self._paces(pose, size, evidence)
        slips = np.array([self._slips(*each) for each in zip(self.tracks, ahead, doubt, strict=True)])
        taken = self._taken(fit, pose, there & ~slips)
        for k, track in enumerate(self.tracks):
            step = taken[k] if k in taken else dynamics_tools.coast(self._expected[k])
            if np.isfinite(border[k]):
                share = min(1.0, (self._t - track.samples[-1].t) / LIKENESS_S)
                track.likeness += (border[k] - track.likeness) * share
                seen = look.border[k] * fit.agreed[k] * np.nan_to_num(look.clear[k], nan=1.0)
                track.doubt += (1 - seen - track.doubt) * share
            if k in taken:
                track.last_measured, track.refused_since = self._t, None
            elif there[k] and not slips[k]:
                track.refused += 1
                track.refused_since = self._t if track.refused_since is None else track.refused_since
            if np.isfinite(pace[k]) and (slips[k] or look.open[k] < HIDDEN):
                step = dynamics_tools.take_speed(self.dynamics, step, along[k], pace[k], doubt[k])
            track.samples.append(Sample.of(frame, self._t, look, k, border, k in taken))
            track.steps.append(step)

    def _taken(self, fit: wireframe.BoxFit, pose: Array, seen: NDArray[np.bool_]) -> dict[int, Step]:
        """The steps of those of the tracks (N,) whose box was `seen` and is believed, by their place among the tracks.

        Their sizes are learnt; `pose` (N, 3) is where they were expected.
        """
        which = np.flatnonzero(seen)
        if not len(which):
            return {}
        z, R = self.dynamics.measured(*measure.measurements(fit[which], pose[which]))
        steps = dynamics_tools.take_each(self.dynamics, [self._expected[k] for k in which], z, R)
        plausible = self._plausible([self.tracks[k] for k in which], steps, z, R)
        self._learn_sizes([self.tracks[k] for k in which[plausible]], fit[which[plausible]])
        return {int(k): step for k, step, good in zip(which, steps, plausible, strict=True) if good}

    def _slips(self, track: Track, ahead: float, doubt: float) -> bool:
        """Whether a box is left behind by the corners on it, which are `ahead` (m/s, deviation `doubt`) of it."""
        share = min(1.0, (self._t - track.samples[-1].t) / SLIP_S)
        track.slip = track.slip + (ahead / doubt - track.slip) * share if np.isfinite(ahead) else 0.0
        track.slips = bool(abs(track.slip) > SLIPS[track.slips])
        return track.slips

    def _paces(self, pose: Array, size: Array, evidence: Evidence) -> tuple[Array, Array, Array, Array]:
        """Headings (N, 2), and as the corners on the boxes tell: speeds (N,) m/s along them, how much faster (N,) that
        is than expected, and the deviations (N,); NaN where they tell nothing."""
        along = np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
        if (corners := evidence.corners()) is None:
            nothing = np.full(len(pose), np.nan)
            return along, nothing, nothing, nothing
        velocity = self.dynamics.planar(np.array([each.prior.mean for each in self._expected]))[0][:, 2:]
        expected = np.sum(velocity * along, axis=1)
        pace, doubt = texture.paces(self.camera, pose, size, expected, corners.moves)
        return along, pace, pace - expected, doubt

    def _reconsider(self, evidence: Evidence) -> None:
        """Look at the track with the most doubt about it as if it were new, and put the better guess in its place."""
        due = [track for track in self.tracks if track.doubt > DOUBTFUL and self._comparable(track)]
        if not due:
            return
        track = max(due, key=lambda each: each.doubt)
        box = np.append(dynamics_tools.pose(self.dynamics, track.steps[-1].posterior.mean), track.size)
        track.compared = Comparison(
            self._t + track.compared.wait, box[:2], min(2 * track.compared.wait, WAIT_AT_MOST_S)
        )
        frame, parts = self._recent[-1][0], self._doubtful_beside(track)
        guess = self._nursery.rival(evidence, box, self._boxes_at(frame, without=[track, *parts]))
        if guess is None:
            return
        replaced = [track, *(part for part in parts if self._shares_place(part, guess))]
        before = partial(self._boxes_at, without=replaced)
        if guess.gain < self._explained(replaced, before, [self._recent[-1]]):
            return
        velocity = self.dynamics.planar(track.steps[-1].posterior.mean)[0][2:]
        gone = sorted(replaced, key=lambda each: -len(each.samples))
        better = self._nursery.grown(guess, velocity, track.id, self._recent, before, gone, False)
        if better is None:
            return
        if lasting(track, better.samples[0].frame, len(better.samples)):  # what it was before would be lost
            return
        lately = self._spread(better.traced_from)
        if self._explained([better], before, lately) < BETTER * self._explained(replaced, before, lately):
            return
        better.compared = track.compared
        self.tracks[self.tracks.index(track)] = better
        self.tracks = [each for each in self.tracks if not any(each is part for part in replaced)]
        self._held += [trimmed(each, f"part of track {better.id}") for each in gone if each.id != better.id]

    def _spread(self, since: int) -> list[tuple[int, float, Evidence]]:
        """Some of the frames since one of the last, evenly spread."""
        frames = [each for each in self._recent if each[0] >= since]
        return frames[:: -max(1, len(frames) // COMPARED)]

    def _explained(
        self, tracks: list[Track], others: Callable[[int], Boxes], lately: list[tuple[int, float, Evidence]]
    ) -> float:
        """How much of some of the last frames a few tracks explain, each as if it alone stood among the others."""
        looked_at = {frame: evidence for frame, _, evidence in lately}
        total = 0.0
        for track in tracks:
            common = [k for k, sample in enumerate(track.samples) if sample.frame in looked_at]
            frames = [track.samples[k].frame for k in common]
            pose = np.array([dynamics_tools.pose(self.dynamics, track.steps[k].posterior.mean) for k in common])
            size = np.tile(track.size, (len(common), 1))
            taken = [others(frame) for frame in frames]
            total += float(np.nansum(gains(self.camera, [looked_at[frame] for frame in frames], pose, size, taken)))
        return total

    def _doubtful_beside(self, track: Track) -> list[Track]:
        """The other tracks near enough to be a part of the same vehicle, none of them sure."""
        here = track.steps[-1].posterior.mean[:2]
        return [
            other
            for other in self.tracks
            if other is not track
            and other.doubt > DOUBTFUL
            and float(np.hypot(*(other.steps[-1].posterior.mean[:2] - here))) < BESIDE_M
        ]

    def _shares_place(self, track: Track, guess: Guess) -> bool:
        pose = dynamics_tools.pose(self.dynamics, track.steps[-1].posterior.mean)
        return bool(footprint_overlap(pose[None], track.size[None], guess.pose[None], guess.size[None]) > ONE_PLACE)

    def _comparable(self, track: Track) -> bool:
        way = track.steps[-1].posterior.mean[:2] - track.compared.place
        return self._t >= track.compared.due and float(np.hypot(*way)) > MOVED_M

    def _released(self) -> list[Track]:
        """The ended tracks that nothing can go on from any more."""
        begin = self._recent[0][1]
        done = [track for track in self._held if track.samples[-1].t < begin - WAIT_S[1]]
        self._held = [track for track in self._held if track.samples[-1].t >= begin - WAIT_S[1]]
        return done

    def _reach(self, pose: Array) -> Array:
        """How far off (N,) px the outlines may be: three deviations of the predicted place and of the size."""
        feet = np.column_stack([pose[:, :2], np.zeros(len(pose))])
        height, sigma = (
            np.array([getattr(track, name)[2] for track in self.tracks]) for name in ("size", "size_sigma")
        )
        low, J = project(self.camera, feet)
        high, _ = project(self.camera, feet + np.column_stack([0 * feet[:, :2], height]))
        cov = np.array([expected.prior.cov[:2, :2] for expected in self._expected])
        spread = np.einsum("nij,njk,nik->n", J[:, :, :2], cov, J[:, :, :2])  # trace: px^2
        upright = np.nan_to_num(np.linalg.norm(high - low, axis=1))
        reach = 3 * np.sqrt(np.nan_to_num(spread) + (upright * sigma / height) ** 2)
        return np.clip(reach, REACH_PX[0], np.maximum(REACH_PX[1], REACH_SHARE * upright))

    def _plausible(self, tracks: list[Track], steps: list[Step], z: Array, R: Array) -> NDArray[np.bool_]:
        """Which (n,) of some steps have enough outline to place the box, lie inside the gate, and are no leap of speed
        and no driving backwards at speed."""
        H = self.dynamics.H
        prior = dynamics_tools.stacked([step.prior for step in steps])
        after = dynamics_tools.stacked([step.posterior for step in steps])
        gamma = dynamics_tools.residual(self.dynamics, z, prior.mean)
        near = mahalanobis(gamma, H @ prior.cov @ H.T + R) <= self._gate
        velocity = self.dynamics.planar(after.mean)[0][:, 2:]
        gained = velocity - self.dynamics.planar(prior.mean)[0][:, 2:]
        heading = self.dynamics.heading(after.mean)
        ahead = np.sum(velocity * np.column_stack([np.cos(heading), np.sin(heading)]), axis=1)
        young = np.array([len(track.samples) < YOUNG for track in tracks])
        placed = R[:, 0, 0] + R[:, 1, 1] <= VAGUE_M**2
        return placed & near & (ahead >= -REVERSES) & (young | (np.hypot(*gained.T) < LEAP))

    def _learn_sizes(self, tracks: list[Track], fit: wireframe.BoxFit) -> None:
        """Take in what the boxes of n tracks say about their sizes."""
        if not tracks:
            return
        size, sigma = (np.array([getattr(track, name) for track in tracks]) for name in ("size", "size_sigma"))
        told, pull = measure.told_of_size(fit, size, sigma)
        # Frames of one target share their errors (the same light, the same shadow): each counts as a tenth.
        cov = np.linalg.inv(np.eye(3) * sigma[..., None] ** -2.0 + told / 10)
        step = (cov @ pull[..., None])[..., 0] / 10
        size = np.maximum(size + np.clip(step, -sigma, sigma), 0.2)
        sigma = np.maximum(np.sqrt(np.diagonal(cov, axis1=1, axis2=2)), 0.03)
        for k, track in enumerate(tracks):
            track.size, track.size_sigma = size[k], sigma[k]

    def _end(self) -> list[Track]:
        """Take out and return the tracks that have come to an end."""
        reasons = endings.reasons(
            self.tracks, self.boxes(), self.camera, self.dynamics, self.settings.life, self._region, self._t
        )
        ended = [trimmed(track, why) for track, why in zip(self.tracks, reasons, strict=True) if why]
        self.tracks = [track for track, why in zip(self.tracks, reasons, strict=True) if not why]
        return [track for track in ended if track.ended_by not in MISLED or not self._passed_on(track)]

    def _passed_on(self, ended: Track) -> bool:
        """Whether what a track was before it lost its vehicle now belongs to the one that follows that vehicle."""
        for k, track in enumerate(self.tracks):
            if goes_on(ended, track, self.dynamics):
                self.tracks[k] = self._nursery.joined(ended, track)
                return True
        return False
