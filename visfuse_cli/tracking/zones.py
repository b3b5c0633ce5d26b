"""Where things are followed: a region of interest on the ground, and what of it the calibration can be trusted with."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.calibration_error import SPEED_KMH, speed_error
from visfuse_cli.maths.cameras import project, raised
from visfuse_cli.maths.homography import apply, depth
from visfuse_cli.maths.polygons import contains, distance
from visfuse_cli.records import Array, Gaussian, GroundCamera, GroundMap, Image
from visfuse_cli.tracking.conclude import Path
from visfuse_cli.vision.lens import undistort_points

MARGIN_M = 6.0  # around the region: what is about to enter is followed there already
HEIGHTS_M = (0.0, 0.8, 1.6, 2.4, 3.2, 4.0)  # above the ground, at which a vehicle in the region may show
COARSE = 4  # px: places at which the picture is asked


class Region:
    """A polygon (k, 2) m on the ground; nothing outside of it is tracked."""

    def __init__(self, polygon: Array) -> None:
        self._polygon = np.asarray(polygon, dtype=float)

    def holds(self, position: Array) -> NDArray[np.bool_]:
        """Which ground points (..., 2) m lie inside."""
        return contains(self._polygon, position)

    def near(self, position: Array) -> NDArray[np.bool_]:
        """Which ground points (..., 2) m lie inside or so close that they may be about to enter."""
        return self.holds(position) | (distance(self._polygon, position) < MARGIN_M)

    def picture(self, camera: GroundCamera) -> Image:
        """Mask (H, W), 255 where something that stands in the region or next to it may show."""
        width, height = camera.image_size
        v, u = np.mgrid[0 : height + COARSE : COARSE, 0 : width + COARSE : COARSE].astype(float)
        pixels = np.column_stack([u.ravel(), v.ravel()])
        if camera.ground.lens is not None:
            pixels = undistort_points(pixels, camera.ground.lens)
        shown = np.zeros(len(pixels), dtype=bool)
        for level in HEIGHTS_M:
            if level < camera.centre[2]:
                ground, seen = _on_ground(raised(camera, level).ground, pixels)
                shown[seen] |= self.near(ground)
        mask = np.where(shown.reshape(u.shape), 255, 0).astype(np.uint8)
        large = cv2.resize(mask, (mask.shape[1] * COARSE, mask.shape[0] * COARSE), interpolation=cv2.INTER_NEAREST)
        return np.ascontiguousarray(large[:height, :width])

    def part(self, path: Path) -> Path | None:
        """The longest stretch of a path that lies inside; None where it never does."""
        inside = np.concatenate([[False], self.holds(path.planar.mean[:, :2]), [False]])
        turns = np.flatnonzero(inside[1:] != inside[:-1])
        if not len(turns):
            return None
        begins, ends = turns[::2], turns[1::2]
        longest = int(np.argmax(ends - begins))
        return stretch(path, slice(int(begins[longest]), int(ends[longest])))


def stretch(path: Path, part: slice) -> Path:
    """Some of the states of a path; None of what was said of it as a whole changes."""
    return replace(
        path,
        planar=Gaussian(path.planar.mean[part], path.planar.cov[part]),
        **{
            name: getattr(path, name)[part]
            for name in ("frame", "t", "measured", "pose_cov", "heading", "size_pull", "calibration", "pixel", "ahead")
        },
    )


def trusted(camera: GroundCamera, position: Array, noise_px: float, share: float) -> NDArray[np.bool_]:
    """Which ground points (N, 2) m lie where the calibration promises a speed to `share` of itself.

    The promise is that of the picture that `calibrate-homography` draws: one standard deviation of 50 km/h over a
    second, with `noise_px` at each end.
    """
    pixels, _ = project(camera, np.column_stack([position, np.zeros(len(position))]))
    seen = np.isfinite(pixels).all(axis=1)
    error = speed_error(camera.ground, np.nan_to_num(pixels), noise_px)
    return np.asarray(seen & (np.nan_to_num(error, nan=np.inf) <= share * SPEED_KMH))


def _on_ground(ground: GroundMap, pixels: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Ground points (k, 2) m of the pixels (N, 2) below the horizon, and which (N,) those are."""
    seen = depth(ground.ground_from_image, pixels) * ground.ground_sign > 1e-9
    return np.asarray(apply(ground.ground_from_image, pixels[seen])), np.asarray(seen)
