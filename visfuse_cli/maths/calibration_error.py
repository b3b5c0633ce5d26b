"""What a calibration promises: the speed error to expect at each place of the image."""

from __future__ import annotations

import numpy as np

from visfuse_cli.maths.homography import apply, depth, entry_jacobian, jacobian
from visfuse_cli.records import Array, GroundMap

SPEED_KMH, DURATION_S = 50.0, 1.0


def speed_error(ground: GroundMap, pixels: Array, sigma_px: float) -> Array:
    """Standard deviation (N,) km/h of a speed of 50 km/h measured over one second around pixels (N, 2).

    Carries the homography's covariance, with the correlation of the two ends, and `sigma_px` of pixel noise at each;
    the worst of eight directions counts. NaN above the horizon.
    """
    H = ground.ground_from_image
    out = np.full(len(pixels), np.nan)
    seen = depth(H, pixels) * ground.ground_sign > 1e-9
    middle: Array = apply(H, pixels[seen])
    worst = np.zeros(len(middle))
    image_from_ground: Array = np.asarray(np.linalg.inv(H))
    way = SPEED_KMH / 3.6 * DURATION_S
    for angle in np.arange(4) * np.pi / 4:
        along: Array = np.array([np.cos(angle), np.sin(angle)])
        half = np.asarray(way / 2 * along)
        ends = [apply(image_from_ground, middle - half), apply(image_from_ground, middle + half)]
        # an end beyond the horizon leaves no measurement in this direction
        visible = np.all([depth(H, end) * ground.ground_sign > 0 for end in ends], axis=0)
        pull = np.einsum("d,ndh->nh", along, entry_jacobian(H, ends[1]) - entry_jacobian(H, ends[0]))
        variance = np.einsum("nh,hk,nk->n", pull, ground.cov, pull)
        for end in ends:
            variance = variance + sigma_px**2 * np.sum(np.einsum("d,ndp->np", along, jacobian(H, end)) ** 2, axis=1)
        worst = np.maximum(worst, np.where(visible, np.sqrt(np.clip(variance, 0, None)), 0))
    out[seen] = np.where(worst > 0, worst, np.nan) / DURATION_S * 3.6
    return out
