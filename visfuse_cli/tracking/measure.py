"""From outlines to a pose on the ground: class, size and measurement of one thing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, GroundCamera
from visfuse_cli.tracking.settings import PoseSettings, SizePrior
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.wireframe import BoxFit, Outlines

SLIM, SLIM_M = 0.5, 1.0  # of its length, and m: what is less wide is slim
HEADING_SIGMA = 0.25  # rad: prior of a fit around the predicted heading, taken out of the measurement again
POSITION_SIGMA = 5.0  # m: keeps a half-hidden box from wandering off, without weight in an ordinary fit


def is_slim(size: Array) -> NDArray[np.bool_]:
    """Which (...) of the sizes (..., 3) m are long and narrow, like windows and gaps between vehicles."""
    return np.asarray((size[..., 1] < SLIM * size[..., 0]) & (size[..., 1] < SLIM_M))


def prior_arrays(prior: SizePrior) -> tuple[Array, Array]:
    """Mean (3,) and deviation (3,) of length, width, height in metres."""
    pairs = np.array([prior.length, prior.width, prior.height])
    return pairs[:, 0], pairs[:, 1]


def fit_poses(
    camera: GroundCamera,
    outlines: Outlines,
    pose: Array,
    size: Array,
    size_sigma: Array,
    settings: PoseSettings,
    heading_sigma: float = HEADING_SIGMA,
) -> BoxFit:
    """Fit boxes around predicted poses (N, 3) with beliefs of their size (3,) or (N, 3)."""
    count = len(pose)
    pose_sigma = np.tile([POSITION_SIGMA, POSITION_SIGMA, heading_sigma], (count, 1))
    size, size_sigma = (np.broadcast_to(a, (count, 3)) for a in (size, size_sigma))
    return wireframe.fit(camera, outlines, pose, pose_sigma, size, size_sigma, noise_of(outlines, settings))


def noise_of(outlines: Outlines, settings: PoseSettings) -> Array:
    """Noise (N,) px of the rows of N outlines."""
    return np.asarray(settings.sigma_px + settings.sigma_share * outlines.width)


def measurement(fit: BoxFit, index: int, predicted: Array, heading_sigma: float = HEADING_SIGMA) -> tuple[Array, Array]:
    """Pose (3,) and covariance (3, 3) that the outline alone supports: the heading's prior is divided out."""
    pose, cov = fit.pose[index].copy(), fit.cov[index, :3, :3].copy()
    information = max(1 / cov[2, 2] - 1 / heading_sigma**2, 1e-2)
    shift = (pose[2] - predicted[2]) / (cov[2, 2] * information)
    pose[2] = predicted[2] + np.clip(shift, -0.6, 0.6)
    cov[2, :2] = cov[:2, 2] = 0
    cov[2, 2] = 1 / information
    return pose, cov


def looks_right(fit: BoxFit, outlines: Outlines) -> NDArray[np.bool_]:
    """Which (N,) of the fitted boxes look like their outlines."""
    return np.asarray(fit.rms < np.maximum(6.0, 0.15 * outlines.width))


@dataclass(frozen=True, slots=True)
class Sized:
    """Outlines of one thing seen as a member of a class: its size (3,) and deviation (3,), the fit, the misfit."""

    prior: SizePrior
    size: Array
    size_sigma: Array
    fit: BoxFit
    cost: float


def classify(
    camera: GroundCamera, outlines: Outlines, pose: Array, classes: tuple[SizePrior, ...], settings: PoseSettings
) -> list[Sized]:
    """N outlines of one thing as a member of each class, the class that explains them best first.

    The frames of one track share their errors, so that they count as few independent ones.
    """
    tried = []
    for prior in classes:
        mean, sigma = prior_arrays(prior)
        fit = fit_poses(camera, outlines, pose, mean, sigma, settings, 0.12)
        size, size_sigma = common_size(fit, mean, sigma)
        relative = fit.rms / noise_of(outlines, settings)
        misfit = float(np.median(relative[fit.ok])) if fit.ok.any() else np.inf
        cost = 4 * misfit**2 + float(np.sum(((size - mean) / sigma) ** 2 + 2 * np.log(sigma)))
        tried.append(Sized(prior, size, size_sigma, fit, cost))
    return sorted(tried, key=lambda sized: sized.cost)


def common_size(fit: BoxFit, mean: Array, sigma: Array) -> tuple[Array, Array]:
    """One size (3,) for all fits of a thing: the median weighted by what each fit adds to the prior."""
    if not fit.ok.any():
        return mean, sigma
    variance = np.diagonal(fit.cov[fit.ok, 3:, 3:], axis1=1, axis2=2)
    gain = np.clip(1 / variance - 1 / sigma**2, 0, None)
    sizes = fit.size[fit.ok]
    size, spread = mean.copy(), sigma.copy()
    for k in range(3):
        total = gain[:, k].sum()
        if total <= 0:
            continue
        # A fit's size is pulled to the prior; without the pull it is what the outline alone says.
        alone = mean[k] + (sizes[:, k] - mean[k]) / np.clip(gain[:, k] * variance[:, k], 0.05, 1)
        order = np.argsort(alone)
        middle = np.searchsorted(np.cumsum(gain[order, k]), total / 2)
        outline_says = alone[order[min(middle, len(order) - 1)]]
        information = min(total, gain[:, k].max() * 4)
        size[k] = (outline_says * information + mean[k] / sigma[k] ** 2) / (information + 1 / sigma[k] ** 2)
        spread[k] = max(0.02, (information + 1 / sigma[k] ** 2) ** -0.5)
    return np.maximum(size, 0.2), spread
