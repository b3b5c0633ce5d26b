"""The people in each set of pictures: backgrounds taken away, silhouettes measured around who is expected."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.fusing.body import Body, usual_body
from visfuse_cli.fusing.clocks import places_alone
from visfuse_cli.fusing.person import Person
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.fusing.sighting import expect, learn_body, lowest, tracked_point
from visfuse_cli.fusing.tracker import PRIOR_LOOKS, Newcomer, Tracker, beginning
from visfuse_cli.fusing.visibility import standing
from visfuse_cli.records import Array, Gaussian, Image, Sighting
from visfuse_cli.vision import silhouettes
from visfuse_cli.vision.background import Background
from visfuse_cli.vision.backing import backed
from visfuse_cli.vision.ground_shadows import GroundShadows
from visfuse_cli.vision.matching import agree
from visfuse_cli.vision.occupancy import Occupancy
from visfuse_cli.vision.silhouettes import Expected
from visfuse_cli.vision.straighten import Straight

LEAST_SHARE = 0.2  # of a person that a camera must see
TRIES = 10  # places looked at in one set of pictures
ROUNDS = 3  # in which a newcomer's place and box settle
START_SIGMA = 0.15  # m: how far a place of the search may be off
FLOATING_M = 0.35  # how far from the ground a newcomer may seem to stand
MARGIN = 0.12  # share of its height around somebody followed in which nobody new is looked for, and nothing learnt


class Camera:
    """One camera's eye: straight pictures, their background, and what moves in the latest."""

    def __init__(self, straight: Straight, empty: Image, config: FuseConfig) -> None:
        self.straight = straight
        self._empty, self._settings = empty, config.background
        self.restart()

    def restart(self) -> None:
        """Begin with the empty scene as background."""
        settings = self._settings
        self._background = Background(settings.model, settings.threshold, settings.shadow_ratio, settings.memory_s)
        self._background.start(self._empty)
        self._picture: Image = self._empty
        self.labels: Image = np.zeros(self._empty.shape[:2], np.uint8)
        self.mask = self.labels

    def look(self, image: Image) -> None:
        """Find out what moves in a frame of the footage."""
        self._picture = self.straight.picture(image)
        self.labels = self._background.detect(self._picture)
        self.mask = silhouettes.moving(self.labels)

    def learn(self, t: float, boxes: Array) -> None:
        """Adapt to the latest picture, except inside boxes [u0, v0, u1, v1] (n, 4) px."""
        self._background.learn(self._picture, t, [box[[0, 1, 2, 1, 2, 3, 0, 3]].reshape(4, 2) for box in boxes])


class PictureWatch:
    """Turns each set of pictures into sightings of people, under cameras P (C, 3, 4) that lead to straight pixels."""

    def __init__(self, cameras: list[Camera], P: Array, config: FuseConfig) -> None:
        self._cameras, self._P, self._config = cameras, P, config
        sizes = np.array([camera.straight.size for camera in cameras])
        self._occupancy = Occupancy(P, sizes, config.person.height)
        self._shadows = GroundShadows(P, sizes, self._occupancy.places) if len(self._occupancy.places) else None
        self._dt: dict[int, float] = {}
        self._distrusted: list[int] = []

    def settle(self, cameras: list[int]) -> None:
        """Tell people from shadows in the latest pictures of `cameras`, by what they say of the same ground."""
        if self._shadows is None:
            return
        settled = self._shadows.settle({camera: self._cameras[camera].labels for camera in cameras})
        for camera, labels in settled.items():
            self._cameras[camera].mask = silhouettes.moving(labels)

    def places(self, camera: int) -> Array:
        """Where on the ground (k, 2) m what moves in one camera's latest picture alone puts people."""
        _, _, blobs, _ = cv2.connectedComponentsWithStats(self._cameras[camera].mask)
        x, y, w, h = blobs[1:, :4].T.astype(float)
        boxes = np.column_stack([x, y, x + w, y + h]) - 0.5
        person, size = self._config.person, np.array(self._cameras[camera].straight.size)
        return places_alone(self._P[camera], boxes, size, person.height, person.width)

    def look(self, dt: dict[int, float], tracker: Tracker) -> list[dict[int, Sighting]]:
        """Sightings of everybody followed, by the cameras in `dt` (s), whose pictures were looked at."""
        self._dt, self._distrusted = dt, tracker.distrusted
        expected = self._expected(tracker.people)
        there = self._backed(tracker.beliefs, [person.body for person in tracker.people])
        return [self._sightings(expected, there[k], k, person.body) for k, person in enumerate(tracker.people)]

    def newcomers(self, tracker: Tracker) -> list[Newcomer]:
        """People in what moves and belongs to nobody who is followed."""
        expected = self._expected(tracker.people)
        left = {camera: self._cameras[camera].mask.copy() for camera in self._dt}
        for camera, mask in left.items():
            for box in self._widened(expected[camera].box):
                _clear(mask, box)
        found: list[Newcomer] = []
        tried = [person.belief.mean[:2] for person in tracker.people]
        nearest = self._config.life.nearest
        for _ in range(TRIES):
            place = self._occupancy.likeliest(left, tried, nearest)
            if place is None:
                break
            new = self._newcomer(place, tracker.people)
            if new is not None and min((np.linalg.norm(new.place.mean[:2] - p) for p in tried), default=9.0) > nearest:
                found.append(new)
                tried.append(new.place.mean[:2])
                for camera, box in self._boxes_of(new).items():
                    _clear(left[camera], box)
            tried.append(place)
        return found

    def followed(self, tracker: Tracker) -> dict[int, Array]:
        """Boxes [u0, v0, u1, v1] (n, 4) px, with a margin, of everybody followed, by camera."""
        expected = self._expected(tracker.people)
        return {camera: self._widened(expected[camera].box) for camera in self._dt}

    def _expected(self, people: list[Person]) -> list[Expected]:
        return expect(
            self._P,
            _stacked([person.belief for person in people]),
            [person.body for person in people],
            np.array([0 if person.confirmed else 1 for person in people], dtype=np.intp),
            self._config,
        )

    def _backed(self, beliefs: Gaussian, bodies: list[Body]) -> list[dict[int, Array]]:
        """Where in the pictures people with these beliefs (T, 6) and bodies (T) can be: boxes (n, 4) px by camera."""
        foot = standing(beliefs, np.array([body.ends.height for body in bodies]), self._config)
        masks = {camera: self._cameras[camera].mask for camera in self._dt}
        outside = {camera: self._cameras[camera].straight.outside for camera in self._dt}
        return backed(self._P, masks, outside, foot)

    def _sightings(self, expected: list[Expected], room: dict[int, Array], who: int, body: Body) -> dict[int, Sighting]:
        """What each camera sees of one of the expected people, whose lengths are learnt."""
        found, assumed = {}, body.ends.mean
        for camera, dt in self._dt.items():
            there = expected[camera]
            if not (np.isfinite(there.box[who]).all() and there.depth[who] > 0):
                continue
            eye = self._cameras[camera]
            seen = silhouettes.sides(eye.mask, eye.straight.outside, there, who, room.get(camera))
            if seen is None or seen.share < LEAST_SHARE:
                continue
            measured = tracked_point(there, who, seen, body, self._config)
            if measured is not None:
                z, R, lever = measured
                rim = seen.rim[seen.rim[:, 1] <= lowest(there, who)]
                if not len(rim):
                    continue
                found[camera] = Sighting(z, R, eye.straight.shown(rim), dt, lever, float(lever @ assumed))
                if camera not in self._distrusted:
                    learn_body(body, assumed, there, who, seen)
        return found

    def _newcomer(self, place: Array, people: list[Person]) -> Newcomer | None:
        """Whoever stands near a place (2,) m, if two cameras or more agree on it and on somebody of human size."""
        person = self._config.person
        body = usual_body(person.height, person.height_sigma, person.width, 2.0)
        level = 0.0 if self._config.fusion.point == "foot" else body.ends.height / 2
        at = Gaussian(np.array([*place, level]), START_SIGMA**2 * np.eye(3))
        sightings: dict[int, Sighting] = {}
        for _ in range(ROUNDS):
            belief = beginning(at, self._config)
            everybody = [*(other.belief for other in people), belief]
            expected = expect(
                self._P,
                _stacked(everybody),
                [*(other.body for other in people), body],
                np.array([0] * len(people) + [1], dtype=np.intp),
                self._config,
            )
            there = self._backed(_stacked([belief]), [body])[0]
            sightings = self._sightings(expected, there, len(people), body)
            cameras = sorted(set(sightings) - set(self._distrusted))
            if len(cameras) < 2:
                return None
            z, R = (np.stack([getattr(sightings[camera], name) for camera in cameras]) for name in ("z", "R"))
            agreed = agree(self._P[cameras], z, R)
            if agreed is None:
                return None
            point, used = agreed
            at = Gaussian(point.mean, point.cov)
            sightings = {camera: sightings[camera] for camera, good in zip(cameras, used, strict=True) if good}
        level = at.mean[2] - (0.0 if self._config.fusion.point == "foot" else body.ends.height / 2)
        if abs(level) > FLOATING_M or not person.shortest < body.ends.height < person.tallest:
            return None
        return Newcomer(at, sightings, body.ends.height)

    def _boxes_of(self, new: Newcomer) -> dict[int, Array]:
        person = self._config.person
        body = usual_body(new.height, person.height_sigma, person.width, PRIOR_LOOKS)
        belief = _stacked([beginning(new.place, self._config)])
        expected = expect(self._P, belief, [body], np.zeros(1, dtype=np.intp), self._config)
        boxes = {camera: self._widened(expected[camera].box) for camera in self._dt}
        return {camera: box[0] for camera, box in boxes.items() if len(box)}  # none where it is behind the camera

    @staticmethod
    def _widened(boxes: Array) -> Array:
        """Boxes (n, 4) px with a margin; those that are not finite are left out."""
        boxes = boxes[np.isfinite(boxes).all(axis=1)]
        return boxes + MARGIN * (boxes[:, 3:] - boxes[:, 1:2]) * [-1, -1, 1, 1]


def _stacked(beliefs: list[Gaussian]) -> Gaussian:
    if not beliefs:
        return Gaussian(np.zeros((0, 6)), np.zeros((0, 6, 6)))
    return Gaussian(np.stack([belief.mean for belief in beliefs]), np.stack([belief.cov for belief in beliefs]))


def _clear(mask: Image, box: Array) -> None:
    u0, v0, u1, v1 = np.maximum(np.rint(box), 0).astype(int)
    mask[v0:v1, u0:u1] = 0
