"""What a calibration promises: the speed error to expect at each place of the image."""

from __future__ import annotations

import numpy as np

from visfuse_cli.maths.homography import apply, depth, entry_jacobian, invert, jacobian
from visfuse_cli.maths.speed import KMH
from visfuse_cli.records import Array, GroundMap

SPEED_KMH, DURATION_S = 50.0, 1.0


def speed_error(ground: GroundMap, pixels: Array, sigma_px: float) -> Array:
    """Standard deviation (N,) km/h of a speed of 50 km/h measured over one second around pixels (N, 2).

    Carries the homography's covariance, with the correlation of the two ends, and `sigma_px` of pixel noise at each;
    the worst of four directions counts. The way slides along its direction to stay in the picture. NaN above the
    horizon.
    """
    H, way = ground.ground_from_image, SPEED_KMH / KMH * DURATION_S
    out = np.full(len(pixels), np.nan)
    seen = depth(H, pixels) * ground.ground_sign > 1e-9
    middle: Array = apply(H, pixels[seen])
    worst = np.full(len(middle), np.nan)
    with np.errstate(all="ignore"):  # what lies behind the camera becomes NaN
        for angle in np.arange(4) * np.pi / 4:
            along: Array = np.array([np.cos(angle), np.sin(angle)])
            first, last = _in_picture(ground, pixels[seen], middle, along)
            slack = last - first - way
            begin = np.where(slack > 0, np.clip(-way / 2, first, last - way), first + slack / 2)
            ends = [middle + share[:, None] * along for share in (begin, begin + way)]
            worst = np.fmax(worst, _way_error(ground, ends[0], ends[1], along, sigma_px))
    out[seen] = worst / DURATION_S * KMH
    return out


def _in_picture(ground: GroundMap, pixels: Array, middle: Array, along: Array) -> tuple[Array, Array]:
    """How far (m) one can go from pixels (N, 2), their ground points middle (N, 2), back and forth along a direction
    before leaving the picture; without an image size, as far as one likes."""
    if ground.image_size is None:
        return np.full(len(pixels), -np.inf), np.full(len(pixels), np.inf)
    H, corner = ground.ground_from_image, np.array(ground.image_size) - 1.0
    step = np.linalg.solve(jacobian(H, pixels), np.broadcast_to(along[:, None], (len(pixels), 2, 1)))[:, :, 0]
    step = step / np.linalg.norm(step, axis=1, keepdims=True)
    sides = np.stack([-pixels / step, (corner - pixels) / step])  # px to the picture's borders
    ranges = []
    for reach, sign in ((sides.min(axis=0).max(axis=1), -1), (sides.max(axis=0).min(axis=1), 1)):
        border = pixels + sign * np.maximum(sign * reach, 0)[:, None] * step
        visible = depth(H, border) * ground.ground_sign > 0
        ranges.append(np.where(visible, (apply(H, border) - middle) @ along, sign * np.inf))
    return ranges[0], ranges[1]


def _way_error(ground: GroundMap, start: Array, end: Array, along: Array, sigma_px: float) -> Array:
    """Standard deviation (N,) m of the way between ground points (N, 2); NaN where an end cannot be seen."""
    H = ground.ground_from_image
    ends = [apply(invert(H), point) for point in (start, end)]
    visible = np.all([depth(H, pixel) * ground.ground_sign > 0 for pixel in ends], axis=0)
    pull = np.einsum("d,ndh->nh", along, entry_jacobian(H, ends[1]) - entry_jacobian(H, ends[0]))
    variance = np.einsum("nh,hk,nk->n", pull, ground.cov, pull)
    for pixel in ends:
        variance = variance + sigma_px**2 * np.sum(np.einsum("d,ndp->np", along, jacobian(H, pixel)) ** 2, axis=1)
    return np.asarray(np.where(visible, np.sqrt(np.clip(variance, 0, None)), np.nan))
