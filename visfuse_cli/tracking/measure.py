"""From outlines to a pose on the ground: class, size and measurement of one thing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, GroundCamera
from visfuse_cli.tracking.settings import PoseSettings, SizePrior
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.wireframe import BoxFit, Outlines

SLIM, SLIM_M = 0.5, 1.0  # of its length, and m: what is less wide is slim
FEW = 4.0  # times as much as the best that all outlines of a thing tell at most: they share their errors
AGREED = 5  # rounds of weighing them
LEAST_SIGMA = 0.02  # m: no size is known better
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


def measurements(fit: BoxFit, predicted: Array, heading_sigma: float = HEADING_SIGMA) -> tuple[Array, Array]:
    """Poses (N, 3) and covariances (N, 3, 3) that N outlines alone support: the prior of the headings, which was that
    of the `predicted` poses (N, 3), is divided out."""
    pose, cov = fit.pose.copy(), fit.cov[:, :3, :3].copy()
    information = np.maximum(1 / cov[:, 2, 2] - 1 / heading_sigma**2, 1e-2)
    shift = (pose[:, 2] - predicted[:, 2]) / (cov[:, 2, 2] * information)
    pose[:, 2] = predicted[:, 2] + np.clip(shift, -0.6, 0.6)
    cov[:, 2, :2] = cov[:, :2, 2] = 0
    cov[:, 2, 2] = 1 / information
    return pose, cov


def looks_right(fit: BoxFit, outlines: Outlines) -> NDArray[np.bool_]:
    """Which (N,) of the fitted boxes look like their outlines."""
    return np.asarray(fit.rms < np.maximum(6.0, 0.15 * outlines.width))


CommonSize = Callable[[BoxFit, Array, Array], tuple[Array, Array]]  # fits, prior size and its deviation -> these of all


@dataclass(frozen=True, slots=True)
class Sized:
    """Outlines of one thing seen as a member of a class: its size (3,) and deviation (3,), the fit, the misfit."""

    prior: SizePrior
    size: Array
    size_sigma: Array
    fit: BoxFit
    cost: float


def classify(
    camera: GroundCamera,
    outlines: Outlines,
    pose: Array,
    classes: tuple[SizePrior, ...],
    settings: PoseSettings,
    common_size: CommonSize,
) -> list[Sized]:
    """N outlines of one thing as a member of each class, the class that explains them best first.

    The frames of one track share their errors, so that they count as few independent ones. What the outlines do not
    tell speaks for no class: a narrow one gains nothing where the size is not seen.
    """
    tried = []
    for prior in classes:
        mean, sigma = prior_arrays(prior)
        fit = fit_poses(camera, outlines, pose, mean, sigma, settings, 0.12)
        size, size_sigma = common_size(fit[fit.ok], mean, sigma) if fit.ok.any() else (mean, sigma)
        relative = fit.rms / noise_of(outlines, settings)
        misfit = float(np.median(relative[fit.ok])) if fit.ok.any() else np.inf
        cost = 4 * misfit**2 + float(np.sum(((size - mean) / sigma) ** 2 + 2 * np.log(sigma / size_sigma)))
        tried.append(Sized(prior, size, size_sigma, fit, cost))
    return sorted(tried, key=lambda sized: sized.cost)


def believed(tried: list[Sized]) -> tuple[Array, Array]:
    """Size (3,) and deviation (3,) of a thing that is a member of each class as likely as that explains it."""
    cost = np.array([each.cost for each in tried])
    share = np.exp(-(cost - cost.min()) / 2)
    share /= share.sum()
    size, sigma = (np.array([getattr(each, name) for each in tried]) for name in ("size", "size_sigma"))
    mean = share @ size
    return mean, np.sqrt(share @ (sigma**2 + (size - mean) ** 2))


def median_size(fit: BoxFit, mean: Array, sigma: Array) -> tuple[Array, Array]:
    """One size (3,) and its deviation (3,) for the fits of a thing that is new: their median, which a few wrong ones do
    not move, weighted by what each adds to the prior size and its deviation (3,)."""
    gain = np.clip(1 / np.diagonal(fit.cov[:, 3:, 3:], axis1=1, axis2=2) - 1 / sigma**2, 0, None)
    size, spread = mean.copy(), sigma.copy()
    for k in np.flatnonzero(gain.sum(axis=0) > 0):
        order = np.argsort(fit.size[:, k])
        total = np.cumsum(gain[order, k])
        size[k] = fit.size[order[min(np.searchsorted(total, total[-1] / 2), len(order) - 1)], k]
        information = min(total[-1], gain[:, k].max() * FEW)
        spread[k] = max(LEAST_SIGMA, (information + 1 / sigma[k] ** 2) ** -0.5)
    return np.maximum(size, 0.2), spread


def pooled_size(fit: BoxFit, mean: Array, sigma: Array) -> tuple[Array, Array]:
    """One size (3,) and its deviation (3,) for all fits of a thing, whose outlines together outweigh the prior size and
    its deviation (3,); those that agree least with the others count least."""
    information, pull = told_of_size(fit, mean, sigma)
    size, spread, weight = mean, sigma, np.ones(len(pull))
    worth = np.einsum("nii,i->n", information, sigma**2)
    for _ in range(AGREED):
        few = weight * min(1.0, FEW * worth.max() / max(float(worth @ weight), 1e-9))
        cov = np.linalg.inv(np.diag(sigma**-2.0) + np.einsum("n,nij->ij", few, information))
        size = mean + cov @ (few @ pull)
        spread = np.sqrt(np.diagonal(cov))
        off = pull - information @ (size - mean)
        weight = 1 / (1 + np.einsum("ni,nij,nj->n", off, fit.cov[:, 3:, 3:], off) / 3)
    return np.maximum(size, 0.2), np.maximum(spread, LEAST_SIGMA)


def told_of_size(fit: BoxFit, size: Array, sigma: Array) -> tuple[Array, Array]:
    """What N outlines alone say about a size of deviation `sigma`, one (3,) or each its own (N, 3): information
    (N, 3, 3), and that times how far off it is (N, 3). Length and height of what is seen from behind are told together.
    """
    posterior = np.linalg.inv(fit.cov[:, 3:, 3:])
    pull = (posterior @ (fit.size - size)[..., None])[..., 0]
    return np.asarray(posterior - np.eye(3) * sigma[..., None] ** -2.0, dtype=float), np.asarray(pull, dtype=float)
