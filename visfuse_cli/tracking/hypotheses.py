"""What a watched region may be: boxes of every class around it, of which the one that explains most is taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import homography
from visfuse_cli.maths.cameras import project
from visfuse_cli.records import Array, Boxes, GroundCamera, Region
from visfuse_cli.tracking import measure
from visfuse_cli.tracking.association import footprint_overlap
from visfuse_cli.tracking.evidence import Evidence, LabelEvidence, probe_each
from visfuse_cli.tracking.settings import SizePrior, TrackerSettings
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.contour import Look
from visfuse_cli.vision.wireframe import BoxFit

REACHES_PX = (24.0, 12.0, 6.0)  # how far around a hypothesis its border is looked for, coarse to fine
LARGE_PX = 160.0  # a silhouette's side: around a larger one the border is looked for as much further
BORDER_SEEN, AREA_MOVED = 0.6, 0.6  # shares of its border and its area that must be found
CLEAR = 0.4  # share of its border that must have background outside: a window of a grey car has paint
SLIM_SEEN, SLIM_CLEAR = 0.75, 0.6  # the same of what is slim: a part of a vehicle is like it
FOOT_SEEN = 0.5  # share of its border on the ground that must be found: a part of a vehicle stands on nothing
LEAST_OPEN = 0.2  # of a box in view to measure it
OPEN, SHOWN = 0.5, 0.45  # of its area that must be in view, and of all of its border that must be found
ONE_PLACE = 0.25  # of a footprint that may lie in another's
LEAST_PAINT, HOPEFUL = 0.05, 0.25  # shares of paint in, and of border found around, a box that is worth another look
PART = 0.3  # how much more of these is wanted of a box that explains next to nothing
SOLID, LARGE_M = 0.75, 3.0  # share of paint in, and length of, what may stand amidst shadows: no window is like it
SHADOW_ONLY, UNMOVED = 0.3, 0.5  # what a pixel of shadow, and one that did not move, counts against one of paint
LARGER, SHARPER, CROSSING = 0.75, 3, 3  # weight of area, of border found, of border that lies in the midst of paint
UNUSUAL = 3.0  # deviations of a size from its class
USUAL_WEIGHT = 0.1  # a third less, roughly, for a box that is two deviations from its class in one measure
HEADING_SIGMA = 0.12  # rad: the course of a region's foot


@dataclass(frozen=True, slots=True)
class Guess:
    """A box that explains what one frame shows: class, pose (3,), size (3,) and its deviation (3,).

    `gain` is how much it explains: px of paint, less px of shadow and of road.
    """

    prior: SizePrior
    pose: Array
    size: Array
    size_sigma: Array
    gain: float


def best_guess(
    camera: GroundCamera,
    settings: TrackerSettings,
    evidence: Evidence,
    region: Region,
    heading: float,
    taken: Boxes,
    convincing: bool = True,
) -> Guess | None:
    """The box that explains most of a region, free of those `taken`; None if none fits.

    Each class is tried with each of its ends aligned with the region's, and with the ends of all that moves with it,
    so that paint that is missing, a shadow or a neighbour does no harm.
    """
    boxes = (region.box, region.around)
    means = [measure.prior_arrays(prior)[0] for prior in settings.target.classes]
    starts = [np.concatenate([_aligned(camera, box, heading, mean) for box in boxes]) for mean in means]
    which, pose = np.repeat(np.arange(len(means)), [len(start) for start in starts]), np.concatenate(starts)
    if isinstance(evidence, LabelEvidence):
        painted = evidence.fill(pose, np.stack(means)[which], taken).paint > LEAST_PAINT
        which, pose = which[painted], pose[painted]
    guesses = refined(camera, settings, evidence, which, pose, region.around_area, taken, convincing)
    return max(guesses, key=lambda guess: guess.gain, default=None)


def refined(
    camera: GroundCamera,
    settings: TrackerSettings,
    evidence: Evidence,
    which: NDArray[np.intp],
    pose: Array,
    around_area: float | Array,
    taken: Boxes,
    convincing: bool = True,
) -> list[Guess]:
    """Boxes of classes `which` (N,) from poses (N, 3) fitted to what is seen: those that convince, or all that fit.

    around_area (N,) px^2 is how much moves there and wants to be explained.
    """
    classes = settings.target.classes
    priors = [measure.prior_arrays(prior) for prior in classes]
    mean, sigma = (np.stack([pair[k] for pair in priors])[which] for k in (0, 1))
    if not len(which):
        return []
    size, moving = mean, np.broadcast_to(np.asarray(around_area, dtype=float), len(pose))
    times = _times_as_far(camera, pose, size)
    for reach in REACHES_PX[:-1]:
        outlines = evidence.outlines(pose, size, reach * times, taken)
        fit = measure.fit_poses(camera, outlines, pose, mean, sigma, settings.pose, HEADING_SIGMA)
        pose, size = _moved(fit, pose, size)
        if convincing:  # most have nothing around them that could be their border, and never will convince
            hopeful = fit.ok & (outlines.tangent | (outlines.valid.mean(axis=1) > HOPEFUL))
            if not hopeful.any():
                return []
            which, pose, size, mean, sigma, moving, times = (
                each[hopeful] for each in (which, pose, size, mean, sigma, moving, times)
            )
    look = evidence.probe(pose, size, REACHES_PX[-1] * times, taken)
    fit = measure.fit_poses(camera, look.outlines, pose, mean, sigma, settings.pose, HEADING_SIGMA)
    pose, size = _moved(fit, pose, size)
    usual = np.all(np.abs(size - mean) < UNUSUAL * sigma, axis=1)
    area = area_of(camera, pose, size) * look.open
    # A window of a grey car looks like a small vehicle: what explains little of all that moves must be seen clearly.
    doubt = 1 - np.clip(area * look.moved / np.maximum(moving, 1.0), 0, 1)
    clear = (look.border > BORDER_SEEN + PART * doubt) & (look.clear > CLEAR + PART * doubt)
    clear |= (look.border > BORDER_SEEN + PART / 2) & (look.paint > SOLID) & (mean[:, 0] > LARGE_M)
    stands = (
        ~(look.foot < FOOT_SEEN)
        & (look.open > OPEN)
        & (look.outlines.tangent | (look.outlines.valid.mean(axis=1) > SHOWN))
    )
    stands &= ~np.any(footprint_overlap(pose, size, *taken) > ONE_PLACE, axis=1)
    good = fit.ok & usual & measure.looks_right(fit, look.outlines) & (look.moved > AREA_MOVED)
    good &= (clear & stands) if convincing else (look.open > LEAST_OPEN)
    good &= ~measure.is_slim(size) | ((look.border > SLIM_SEEN) & (look.clear > SLIM_CLEAR))
    gain = _gain(look, area)
    good &= gain > 0
    gain = gain * np.exp(-USUAL_WEIGHT * np.sum(((size - mean) / sigma) ** 2, axis=1))
    return [Guess(classes[which[k]], pose[k], size[k], sigma[k], float(gain[k])) for k in np.flatnonzero(good)]


def _times_as_far(camera: GroundCamera, pose: Array, size: Array) -> Array:
    """How many times (N,) REACHES_PX the border of each box may be off: what is large in the picture is off by more."""
    return np.asarray(np.maximum(1.0, np.sqrt(area_of(camera, pose, size)) / LARGE_PX))


def _moved(fit: BoxFit, pose: Array, size: Array) -> tuple[Array, Array]:
    """Poses and sizes (N, 3) after a fit, as they were where it failed."""
    return np.where(fit.ok[:, None], fit.pose, pose), np.where(fit.ok[:, None], fit.size, size)


def gains(camera: GroundCamera, frames: Sequence[Evidence], pose: Array, size: Array, taken: list[Boxes]) -> Array:
    """How much (N,) N boxes explain, each in a frame of its own, as `Guess.gain`; NaN where one is hidden."""
    look = probe_each(frames, pose, size, REACHES_PX[-1] * _times_as_far(camera, pose, size), taken)
    return _gain(look, area_of(camera, pose, size) * look.open)


def _gain(look: Look, area: Array) -> Array:
    filled = look.paint - SHADOW_ONLY * (look.moved - look.paint) - UNMOVED * (1 - look.moved)
    return area**LARGER * filled * look.likeness**SHARPER * look.apart**CROSSING


def seen(look: Look, beyond_doubt: bool) -> NDArray[np.bool_]:
    """Which (N,) of the boxes followed back are seen: beyond doubt, or as well as can be amidst others."""
    clear = (look.border + look.clear > BORDER_SEEN + CLEAR) | (look.paint > SOLID) | (not beyond_doubt)
    return np.asarray((look.border > BORDER_SEEN) & (look.moved > AREA_MOVED) & clear)


def _aligned(camera: GroundCamera, box: Array, heading: float, size: Array) -> Array:
    """Poses (6, 3) whose silhouettes share the left, middle or right and the lower or upper end of a region's box."""
    low, extent = box[:2], box[2:]
    target = np.array([[u, v] for u in (0.0, 0.5, 1.0) for v in (1.0, 0.0)])
    wanted = low + target * extent
    centre = wanted.copy()
    ground_from_image = camera.ground.ground_from_image
    pose = np.zeros((len(target), 3))
    for _ in range(3):
        pose = np.column_stack([homography.apply(ground_from_image, centre), np.full(len(target), heading)])
        pixels, _ = project(camera, wireframe.corners(pose, np.tile(size, (len(pose), 1))))
        first, last = pixels.min(axis=1), pixels.max(axis=1)
        centre = centre + wanted - (first + target * (last - first))
    return pose[np.isfinite(pose).all(axis=1)]


def area_of(camera: GroundCamera, pose: Array, size: Array) -> Array:
    """Area (N,) of each silhouette, px^2."""
    pixels, _ = project(camera, wireframe.corners(pose, size))
    ends = np.nan_to_num(pixels)[:, wireframe.EDGES]
    middle = ends.mean(axis=(1, 2))[:, None]
    a, b = ends[:, :, 0] - middle, ends[:, :, 1] - middle
    around = np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]) / 2
    return np.asarray(np.sum(around * wireframe.silhouette_edges(camera, pose, size), axis=1))
