"""Where a pan-tilt head looks, and what of the ground lies under a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.maths.cameras import ground_camera
from visfuse_cli.maths.gaze import ORDERS
from visfuse_cli.records import Array, GroundMap, Lens

MIRROR = np.array([-1.0, -1.0, 1.0])  # the frontal plane's axes point left and up, a picture's right and down
STEP = 1e-3  # px: of numerical Jacobians


@dataclass(frozen=True, slots=True)
class Head:
    """A head at rest over the ground: P (3, 4) world metres (z up) -> its frontal plane, `centre` (3,) m, the lens."""

    P: Array
    centre: Array
    lens: Lens
    order: str

    def rotation(self, gaze: Array) -> Array:
        """(3, 3) from the camera's axes as it looks at elevation and vergence (2,) rad to its axes at rest."""
        (ce, cv), (se, sv) = np.cos(gaze), np.sin(gaze)
        up = np.array([[1, 0, 0], [0, ce, -se], [0, se, ce]])
        left = np.array([[cv, 0, -sv], [0, 1, 0], [sv, 0, cv]])
        return np.asarray(up @ left if self.order == ORDERS[0] else left @ up)

    def pixels(self, points: Array, gaze: Array) -> Array:
        """Pixels (..., 2) of world points (..., 3) m as the camera looks that way; NaN behind it."""
        seen = (points @ self.P[:, :3].T + self.P[:, 3]) @ self.rotation(gaze)
        depth = np.where(seen[..., 2:] > 1e-6, seen[..., 2:], np.nan)
        return np.asarray(seen[..., :2] / depth @ self.lens.K[:2, :2].T + self.lens.K[:2, 2])

    def ground(self, pixels: Array, gaze: Array, height: float) -> Array:
        """World places (..., 2) m at `height` m over the ground under pixels (..., 2); NaN above the horizon."""
        rays = np.concatenate(
            [(pixels - self.lens.K[:2, 2]) / np.diag(self.lens.K)[:2], np.ones_like(pixels[..., :1])], -1
        )
        d = np.linalg.solve(self.P[:, :3], (rays @ self.rotation(gaze).T)[..., None])[..., 0]
        reach = (height - self.centre[2]) / np.where(d[..., 2:] < -1e-9, d[..., 2:], np.nan)
        return np.asarray(self.centre[:2] + reach * d[..., :2])

    def jacobian(self, pixel: Array, gaze: Array, height: float) -> Array:
        """d place / d pixel (2, 2), m/px."""
        steps = STEP * np.eye(2)
        return np.asarray(
            (self.ground(pixel + steps, gaze, height) - self.ground(pixel - steps, gaze, height)).T / (2 * STEP)
        )

    def depth(self, place: Array, height: float) -> float:
        """How far off (m) a place (2,) is."""
        return float(np.linalg.norm(np.append(place, height) - self.centre))


def rest(ground: GroundMap, lens: Lens, order: str, source: str, size: tuple[int, int]) -> tuple[GroundMap, Head]:
    """The map from gaze to ground and the head behind it; raises InputError where no camera fits the homography.

    A homography from pixels is taken as that of the picture at rest, of footage of that `size` (w, h) px.
    """
    if ground.input == "pixel":
        if ground.image_size is not None and ground.image_size != size:
            made, seen = ("x".join(map(str, each)) for each in (ground.image_size, size))
            raise InputError(f"{source}: was made for {made} footage, but this is {seen}; calibrate at this size")
        ground = _by_gaze(ground, (ground.lens or lens).K)
    signs = np.tile(MIRROR, 3)
    mirrored = replace(
        ground,
        ground_from_image=ground.ground_from_image * MIRROR,
        cov=ground.cov * np.outer(signs, signs),
        lens=Lens(np.eye(3), np.zeros(5)),
    )
    camera = ground_camera(mirrored, (2, 2))
    return ground, Head(camera.image_from_world, camera.centre, lens, order)


def _by_gaze(ground: GroundMap, K: Array) -> GroundMap:
    """A map from pixels as one from the frontal plane's axes, left and up."""
    image_from_gaze = K * MIRROR
    J = np.kron(np.eye(3), image_from_gaze.T)  # of the entries, row by row
    return replace(
        ground, ground_from_image=ground.ground_from_image @ image_from_gaze, cov=J @ ground.cov @ J.T, input="gaze"
    )


def ground_shift(ground: GroundMap, places: Array) -> Array:
    """d place / d homography entries (T, 2, 9) at places (T, 2) m on the ground."""
    inverse = np.linalg.inv(ground.ground_from_image)
    at = np.column_stack([places, np.ones(len(places))]) @ inverse.T
    at = at / at[:, 2:]
    w = at @ ground.ground_from_image[2]
    J = np.zeros((len(places), 2, 9))
    J[:, 0, 0:3] = J[:, 1, 3:6] = at / w[:, None]
    J[:, :, 6:9] = -places[:, :, None] * at[:, None, :] / w[:, None, None]
    return J
