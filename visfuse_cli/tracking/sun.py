"""Where the sun stands, told from the shadows beside vehicles whose size is known; and what of a picture is shadow."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.cameras import project
from visfuse_cli.maths.medians import median
from visfuse_cli.records import Array, GroundCamera, Image
from visfuse_cli.vision import contour
from visfuse_cli.vision.background import FOREGROUND, SHADOW
from visfuse_cli.vision.lens import distort_points

COURSES, LENGTHS = 72, np.geomspace(0.2, 4.5, 16)  # directions that shadows may fall in, and their m per m of height
EVERY_S = 0.4  # between looks
LEAST_PX = 400.0  # area of a silhouette that is worth a look
STEP_M, AROUND_M = 0.55, 1.0  # grid of ground points around a vehicle, and how far it reaches beyond the longest shadow
HIT, MISS = np.log(0.8 / 0.1), np.log(0.2 / 0.9)  # log odds of a ground point in a shadow that has changed, or not
POINTS = 700  # about one vehicle, at most
WORTH = 4.0  # log odds that one look at one vehicle is worth at most: its points are no independent witnesses
VEHICLES, SURE = 4, 6.0  # vehicles, and log odds above those of no shadow, from which the sun is known
TOLD = 0.17  # of what the looks are worth at most: reflections and the dark beneath vehicles tell less than shadows
SPREAD = 0.96  # length of the mean direction of what is likely: above, there is one direction
ENOUGH = 120  # looks after which the sun is known well
DARKER = 0.92  # of the background: what is no darker is no shadow
COLOUR = 14.0  # grey levels that a shadow may change the colour by
CLEAR = 1.15  # times as light as the darkest that colour takes for shadow: it needs no help
ALIKE = 0.35  # of the usual darkness that shadows may differ by
SAMPLES, KNOWN, LEAST_DARK_PX = 60, 10, 40  # pictures that tell how dark shadows are, and pixels of one that do


@dataclass(frozen=True, slots=True)
class Shadow:
    """Where shadows fall: `per_metre` (2,) m on the ground for a metre of height; `vehicles` that told of it."""

    per_metre: Array
    vehicles: int

    def report(self) -> dict[str, Any]:
        """For run.json: the way to the sun, degrees anticlockwise from +X on the ground and above it."""
        azimuth = float(np.degrees(np.arctan2(-self.per_metre[1], -self.per_metre[0])) % 360)
        elevation = float(np.degrees(np.arctan2(1, np.hypot(*self.per_metre))))
        return {"azimuth_deg": round(azimuth, 1), "elevation_deg": round(elevation, 1), "vehicles": self.vehicles}


class Sun:
    """Gathers over a recording what the surroundings of vehicles say about where their shadows fall."""

    def __init__(self, camera: GroundCamera) -> None:
        self._camera = camera
        course = np.arange(COURSES) * 2 * np.pi / COURSES
        unit = np.column_stack([np.cos(course), np.sin(course)])
        self._tried = (unit[:, None] * LENGTHS[:, None]).reshape(-1, 2)  # (S, 2)
        self._odds = np.zeros(len(self._tried))
        self._due = -np.inf
        self._looks = 0
        self._vehicles: set[int] = set()
        self.shadow: Shadow | None = None

    def look(
        self, t: float, labels: Image, pose: Array, size: Array, settled: NDArray[np.bool_], ids: list[int]
    ) -> None:
        """Take in a labelled picture at t (s) with N boxes (N, 3), (N, 3), of which some are settled."""
        if t < self._due or not settled.any() or self._looks >= ENOUGH:
            return
        owner = contour.owners(self._camera, pose, size)
        area = np.bincount(owner.ravel(), minlength=len(pose) + 1)[1 : len(pose) + 1] * settled
        best = int(np.argmax(area))
        if area[best] < LEAST_PX:
            return
        self._due, self._looks = t + EVERY_S, self._looks + 1
        self._vehicles.add(ids[best])
        self._weigh(labels, owner, pose[best], size[best])
        self._conclude()

    def _weigh(self, labels: Image, owner: Image, pose: Array, size: Array) -> None:
        """Add what one vehicle's surroundings say."""
        reach = float(np.hypot(*size[:2]) / 2 + min(LENGTHS[-1] * size[2], 8.0) + AROUND_M)
        side = np.arange(-reach, reach + STEP_M, STEP_M)
        local = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)  # in the vehicle's axes
        half = size[:2] / 2
        local = local[(np.abs(local) > half).any(axis=1)]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        ground = local @ np.array([[c, s], [-s, c]]) + pose[:2]
        pixels, _ = project(self._camera, np.column_stack([ground, np.zeros(len(ground))]))
        if self._camera.ground.lens is not None:
            pixels = distort_points(np.nan_to_num(pixels, nan=-1e4), self._camera.ground.lens)
        whole = np.nan_to_num(pixels, nan=-1e4).round().astype(int)
        seen = ((whole >= 0) & (whole < np.array(labels.shape[::-1]))).all(axis=1)
        local, whole = local[seen], whole[seen]
        free = owner[whole[:, 1], whole[:, 0]] == 0
        fewer = max(1, -(-np.count_nonzero(free) // POINTS))
        local, whole = local[free][::fewer], whole[free][::fewer]
        changed = labels[whole[:, 1], whole[:, 0]] > 0
        fall = self._tried @ np.array([[c, -s], [s, c]])  # in the vehicle's axes
        shaded = _shaded(local, fall, half, float(size[2]))
        odds = shaded @ np.where(changed, HIT, MISS)
        self._odds += WORTH * odds / max(float(np.abs(odds).max()), 1.0)

    def _conclude(self) -> None:
        likely = np.exp(self._odds - self._odds.max())
        likely /= likely.sum()
        course = self._tried / np.linalg.norm(self._tried, axis=1, keepdims=True)
        agree = float(np.hypot(*(likely @ course)))
        sure = self._odds.max() > max(SURE, TOLD * WORTH * self._looks)
        known = len(self._vehicles) >= VEHICLES and sure and agree > SPREAD
        self.shadow = Shadow(likely @ self._tried, len(self._vehicles)) if known else None


def _shaded(points: Array, fall: Array, half: Array, height: float) -> NDArray[np.float32]:
    """Which points (P, 2) lie in the shadow of a box of half sides (2,) and a height, by way (S, 2) that it falls."""
    low, high = np.zeros((len(fall), len(points)), np.float32), np.full((len(fall), len(points)), height, np.float32)
    for axis in (0, 1):
        way = fall[:, axis, None].astype(np.float32)
        way = np.where(np.abs(way) < 1e-6, 1e-6, way)
        ends = [(points[None, :, axis].astype(np.float32) + side * np.float32(half[axis])) / way for side in (-1, 1)]
        np.maximum(low, np.minimum(*ends), out=low)
        np.minimum(high, np.maximum(*ends), out=high)
    return (low < high).astype(np.float32)


def shadow_picture(camera: GroundCamera, pose: Array, size: Array, per_metre: Array) -> Image:
    """Mask (H, W), 255 where the shadows of N boxes fall and none of the boxes stands."""
    width, height = camera.image_size
    mask = np.zeros((height, width), np.uint8)
    half = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    turn = np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)
    foot = (half * size[:, None, :2]) @ turn + pose[:, None, :2]
    ground = np.concatenate([foot, foot + size[:, 2, None, None] * per_metre], axis=1)  # (N, 8, 2)
    pixels, _ = project(camera, np.concatenate([ground, np.zeros((*ground.shape[:2], 1))], axis=-1))
    for hull in contour.hulls_of(camera, np.moveaxis(pixels, -1, 0)):
        if len(hull):
            cv2.fillConvexPoly(mask, hull, 255)
    return np.asarray(cv2.subtract(mask, cv2.compare(contour.owners(camera, pose, size), 0, cv2.CMP_GT)), np.uint8)


class Shade:
    """How dark shadows are, learnt where geometry says that they fall, and what is cut off the foreground by it."""

    def __init__(self, ratio: float) -> None:
        self._ratio = ratio  # darkest that colour alone takes for shadow, as a share of the lit ground
        self._found: deque[float] = deque(maxlen=SAMPLES)
        self._usual = 0.0  # the median of what was found

    @property
    def needed(self) -> bool:
        """Whether colour alone does not tell shadows, or nobody knows yet."""
        return len(self._found) < KNOWN or self._usual <= CLEAR * self._ratio

    def cut(self, labels: Image, image: Image, empty: Image, where: Image) -> Image:
        """Labels with the foreground that is as dark as shadows are made shadow `where` one falls."""
        places = cv2.findNonZero(cv2.bitwise_and(where, labels))
        if places is None:
            return labels
        u, v = places.reshape(-1, 2).T
        place = v * labels.shape[1] + u
        seen, lit = (picture.reshape(-1, 3)[place].T.astype(np.float32) for picture in (image, empty))
        share = seen.sum(axis=0) / np.maximum(lit.sum(axis=0), 1.0)
        grey = np.abs(seen - share * lit).max(axis=0) < COLOUR
        darker = grey & (share < DARKER)
        if np.count_nonzero(darker) >= LEAST_DARK_PX:
            self._found.append(median(share[darker]))
            self._usual = median(np.array(self._found))
        if len(self._found) < KNOWN or not self.needed:
            return labels
        shadow = darker & (np.abs(share - self._usual) < ALIKE * self._usual) & (labels.ravel()[place] == FOREGROUND)
        cleaned = labels.copy()
        cleaned.ravel()[place[shadow]] = SHADOW
        return cleaned
