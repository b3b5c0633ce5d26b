"""Boxes of an external detector, instant by instant: gathered into people and given to those who are followed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.clocks import places_alone
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.fusing.shares import shared
from visfuse_cli.fusing.tracker import Newcomer, Tracker
from visfuse_cli.fusing.visibility import visibility
from visfuse_cli.maths import multiview, people
from visfuse_cli.maths.assignment import assign, gate_size
from visfuse_cli.maths.gaussian import log_density, mahalanobis
from visfuse_cli.records import Array, Gaussian, Sighting, View
from visfuse_cli.vision.lens import undistort_points
from visfuse_cli.vision.matching import Boxes, agree, groups

PLACE_SIGMA = 0.1  # m: what a place changes by as other cameras come to see the person
GROUND_SIGMA = 0.03  # m: how flat the ground is taken to be


class BoxWatch:
    """Turns each instant's boxes [x, y, w, h, score] (n, 5) px by camera into sightings of people."""

    def __init__(self, views: list[View], P: Array, config: FuseConfig) -> None:
        self._views, self._P, self._config = views, P, config
        self._sizes = np.array([view.size for view in views])
        self._left: list[NDArray[np.intp]] = []
        self._boxes: Boxes | None = None
        self._shown: Array = np.zeros((0, 4))
        self._dt: Array = np.zeros(0)

    def look(self, boxes: dict[int, Array], dt: dict[int, float], tracker: Tracker) -> list[dict[int, Sighting]]:
        """Sightings of everybody who is followed; what is left is kept for `newcomers`."""
        gathered = self._gather(boxes, dt)
        if gathered is None:
            self._left = []
            return [{} for _ in tracker.people]
        known = np.array([person.confirmed for person in tracker.people], dtype=bool)
        sightings: list[dict[int, Sighting]] = [{} for _ in known]
        turns, free = [known, ~known], np.ones(len(gathered), dtype=bool)
        if self._config.sight.association == "jpda":
            free = self._share(gathered, tracker, known, sightings)
            turns = [~known]
        grouped = [np.flatnonzero(free)[group] for group in groups(gathered.of(free), self._P)]
        given = self._given(tracker, grouped, [self._place(group) for group in grouped], turns)
        self._left = [group for k, group in enumerate(grouped) if k not in set(given.values())]
        for who, which in given.items():
            sightings[who] = self._sightings(grouped[which])
        return sightings

    def _share(
        self, boxes: Boxes, tracker: Tracker, known: NDArray[np.bool_], sightings: list[dict[int, Sighting]]
    ) -> NDArray[np.bool_]:
        """Tell whoever is known (T,) of the boxes by how likely they are theirs; returns which are nobody's yet."""
        beliefs = Gaussian(tracker.beliefs.mean[known], tracker.beliefs.cov[known])
        told, claimed = shared(boxes, self._shown, self._dt, self._sizes, self._P, beliefs, self._config)
        for who, seen in zip(np.flatnonzero(known), told, strict=True):
            sightings[who] = seen
        return ~claimed

    def newcomers(self, tracker: Tracker) -> list[Newcomer]:
        """People in what is left of the last instant, seen by two cameras or more."""
        boxes = self._boxes
        if boxes is None:
            return []
        person = self._config.person
        found: list[Newcomer] = []
        for group in self._left:
            group = group[~np.isin(boxes.camera[group], tracker.distrusted)]
            if len(group) < 2:
                continue
            agreed = agree(self._P[boxes.camera[group]], boxes.z[group], boxes.R[group])
            if agreed is None:
                continue
            used = group[agreed[1]]
            weight = 1 / boxes.height_sigma[used] ** 2
            height = float(np.sum(boxes.height[used] * weight) / np.sum(weight))
            if not person.shortest < height < person.tallest:
                continue
            apart = np.linalg.norm(tracker.beliefs.mean[:, :2] - agreed[0].mean[:2], axis=1)
            if np.any(apart < self._config.life.nearest):
                continue
            found.append(Newcomer(self._on_ground(agreed[0], height), self._sightings(used), height))
        return self._undenied(found, tracker)

    def _undenied(self, found: list[Newcomer], tracker: Tracker) -> list[Newcomer]:
        """Those newcomers whom more cameras see than have a clear sight of the place and do not."""
        known = tracker.beliefs
        mean = np.zeros((len(known.mean) + len(found), 6))
        mean[: len(known.mean)] = known.mean
        for k, new in enumerate(found, start=len(known.mean)):
            mean[k, :3] = new.place.mean
        _, clear = visibility(Gaussian(mean, np.zeros((0, 6, 6))), self._sizes, self._P, self._config)
        return [
            new
            for new, sights in zip(found, clear[len(known.mean) :], strict=True)
            if len(set(np.flatnonzero(sights).tolist()) - set(new.sightings)) < len(new.sightings)
        ]

    def _on_ground(self, point: Gaussian, height: float) -> Gaussian:
        """The same point, knowing that people stand on the ground."""
        foot = self._config.fusion.point == "foot"
        level, sigma = (0.0, GROUND_SIGMA) if foot else (height / 2, GROUND_SIGMA + 0.05)
        gain = point.cov[:, 2] / (point.cov[2, 2] + sigma**2)
        cov = point.cov - np.outer(gain, point.cov[2])
        return Gaussian(point.mean + gain * (level - point.mean[2]), (cov + cov.T) / 2)

    def places(self, camera: int, boxes: Array) -> Array:
        """Where on the ground (k, 2) m one camera's boxes [x, y, w, h, ...] (n, 5) alone put people."""
        straight = self._straight(np.full(len(boxes), camera, dtype=np.intp), boxes[:, :4])
        person = self._config.person
        return places_alone(self._P[camera], straight, self._sizes[camera], person.height, person.width)

    def _gather(self, boxes: dict[int, Array], dt: dict[int, float]) -> Boxes | None:
        camera, shown = [], []
        for index, rows in boxes.items():
            camera += [index] * len(rows)
            shown.append(rows[:, :4])
        self._boxes = None
        if not camera:
            return None
        self._shown = np.concatenate(shown)
        cameras = np.array(camera, dtype=np.intp)
        self._dt = np.array([dt[index] for index in camera])
        self._boxes = self._described(cameras, self._straight(cameras, self._shown))
        return self._boxes

    def _straight(self, camera: NDArray[np.intp], shown: Array) -> Array:
        """Boxes [u0, v0, u1, v1] (n, 4) px as cameras without distortion would show them."""
        u0, v0, w, h = shown.T
        box = np.column_stack([u0, v0, u0 + w, v0 + h])
        for index in np.unique(camera):
            lens = self._views[index].lens
            if not np.any(lens.D):
                continue
            mine = camera == index
            left, top, right, bottom = box[mine].T
            across, down = (left + right) / 2, (top + bottom) / 2
            sides = [(left, down), (across, top), (right, down), (across, bottom)]
            straight = [undistort_points(np.column_stack(side), lens) for side in sides]
            box[mine] = np.column_stack([straight[0][:, 0], straight[1][:, 1], straight[2][:, 0], straight[3][:, 1]])
        return box

    def _described(self, camera: NDArray[np.intp], box: Array) -> Boxes:
        """What each box says of its person: place, height, tracked point."""
        P, config = self._P[camera], self._config
        tall = box[:, 3] - box[:, 1]
        side = config.sight.box_share * tall
        foot = np.column_stack([(box[:, 0] + box[:, 2]) / 2, box[:, 3]])
        middle = (box[:, :2] + box[:, 2:]) / 2
        along = np.tile(np.diag([0.5, 1.0]), (len(box), 1, 1)) * (side**2)[:, None, None]
        place = multiview.ground_point(P, foot, along, 0.0, GROUND_SIGMA)
        standing = np.column_stack([np.nan_to_num(place.mean, nan=1e6), np.zeros(len(box))])
        usual = np.full(len(box), config.person.height)
        expected = people.boxes(P, people.outline(standing, usual, np.full(len(box), config.person.width)))
        height = usual * tall / np.maximum(expected[:, 3] - expected[:, 1], 1e-6)
        if config.fusion.point == "foot":
            z, R = foot, along
        else:
            model = (expected[:, :2] + expected[:, 2:]) / 2
            centre, _ = multiview.project(P, standing + [0, 0, config.person.height / 2])
            z = middle + np.nan_to_num(centre - model)
            R = np.tile(0.5 * np.eye(2), (len(box), 1, 1)) * (side**2)[:, None, None]
        sigma = np.nan_to_num(height, nan=1.0) * config.sight.box_share * np.sqrt(2) + 0.05
        return Boxes(camera, z, R, place, np.nan_to_num(height, nan=0.0), sigma)

    def _place(self, group: NDArray[np.intp]) -> Gaussian:
        """Where on the ground (2,) all boxes of a group say that their person is."""
        assert self._boxes is not None
        ground = self._boxes.ground
        weight = np.linalg.inv(ground.cov[group])
        cov = np.linalg.inv(weight.sum(axis=0))
        return Gaussian(cov @ np.einsum("iab,ib->a", weight, ground.mean[group]), cov)

    def _given(
        self,
        tracker: Tracker,
        grouped: list[NDArray[np.intp]],
        places: list[Gaussian],
        turns: list[NDArray[np.bool_]],
    ) -> dict[int, int]:
        """Which group belongs to whom: one to one, by one-step conditional maximum likelihood. Wu 2010, eq. 7.

        `turns` says who (T,) may choose, one turn after the other.
        """
        beliefs = tracker.beliefs
        usable = [k for k, place in enumerate(places) if np.isfinite(place.mean).all()]
        if not len(beliefs.mean) or not usable:
            return {}
        mean = np.stack([places[k].mean for k in usable])
        cov = np.stack([places[k].cov for k in usable])
        residual = mean[None] - beliefs.mean[:, None, :2]
        S = beliefs.cov[:, None, :2, :2] + cov[None] + PLACE_SIGMA**2 * np.eye(2)
        cost = -log_density(residual, S)  # n = 2, the size of what is measured: Wu 2010, eq. 7
        cost = np.where(mahalanobis(residual, S) < gate_size(2, self._config.sight.gate), cost, np.inf)
        alone = np.array([len(grouped[k]) < 2 for k in usable])
        new = np.array([not person.confirmed for person in tracker.people])
        cost[np.ix_(new, alone)] = np.inf  # one camera alone begins nobody
        given: dict[int, int] = {}
        for turn in turns:  # who is known for longer has the first claim
            taken = np.isin(usable, list(given.values()))
            pairs, _, _ = assign(np.where(turn[:, None] & ~taken, cost + 2.0 * alone, np.inf))
            given |= {int(who): usable[int(which)] for who, which in pairs}
        return given

    def _sightings(self, group: NDArray[np.intp]) -> dict[int, Sighting]:
        boxes = self._boxes
        assert boxes is not None
        return {
            int(boxes.camera[k]): Sighting(boxes.z[k], boxes.R[k], self._shown[k], float(self._dt[k])) for k in group
        }
