"""What a finished track was: its size, its smoothed path and what the calibration adds to the doubt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import homography
from visfuse_cli.maths.cameras import project
from visfuse_cli.maths.gaussian import symmetrise
from visfuse_cli.records import Array, Gaussian, GroundCamera
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking import measure, sills
from visfuse_cli.tracking.dynamics import Dynamics, Step
from visfuse_cli.tracking.refilter import filter_again, nis_of, settled_poses
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.targets import Track
from visfuse_cli.vision.wireframe import Outlines

CLEARANCE = 0.003  # of a way: how much further away than it is a vehicle may be seen to stand
SILL_DOUBT_M = 0.10  # the same above the ground, in shadow


@dataclass(frozen=True, slots=True)
class Path:
    """A finished track over T frames, on the ground plane, metres and seconds.

    planar: (T, 4) X, Y, X', Y' with (T, 4, 4) covariance, calibration included; pose_cov: the same without it;
    calibration: (T, 4, 9) d planar / d homography entries; pixel: (T, 2, 2) d ground / d image; size_pull: (T, 2, 3)
    d position / d size of the fitted boxes, which differs where a box is partly out of view.
    """

    id: int
    class_name: str
    frame: np.ndarray
    t: Array
    measured: np.ndarray
    planar: Gaussian
    pose_cov: Array
    heading: Array
    size: Array
    size_sigma: Array
    size_pull: Array
    size_z: float  # how many deviations the size lies from its class, all three together
    calibration: Array
    pixel: Array
    nis: Array
    nis_dof: int  # numbers in a measurement
    noise: float  # times as much as was expected of the outlines
    refused: int
    likeness: float  # mean share of the outline that was found, of what could be
    support: float  # the same, of all of it: what is hidden, out of the picture or amidst others counts
    apart: float  # mean share of the outline that does not lie in the midst of paint
    paint: float  # mean share of the area that was paint, neither shadow nor as the empty road is
    clearance: float  # deviation of a way, as a share of it, for where a vehicle meets the ground
    misfit_px: float
    ended_by: str
    ahead: Array  # (T, 2) m: where it was expected a latency later, from what was known then


@dataclass(frozen=True, slots=True)
class _Settled:
    """What a track was found to be: see `Path`; `steps` are those of its filter, `belief` its states (T, n)."""

    class_name: str
    size: Array
    size_sigma: Array
    size_pull: Array
    misfit_px: float
    steps: list[Step]
    measured: NDArray[np.bool_]
    noise: float
    belief: Gaussian


def conclude(
    tracks: Sequence[Track],
    camera: GroundCamera,
    settings: TrackerSettings,
    dynamics: Dynamics,
    fall: Array | None = None,
) -> list[Path]:
    """Settle each track's size, fit every frame again with it, and smooth; with `smooth` off, keep the causal states.

    Shadows fall `fall` (2,) m for a metre of height, where that is known. A few tracks together take little longer than
    one.
    """
    if settings.smooth:
        found = _settled(tracks, camera, settings, dynamics, fall)
    else:
        found = _as_they_were(tracks)
    return [_path(track, of, camera, settings, dynamics) for track, of in zip(tracks, found, strict=True)]


def _path(track: Track, of: _Settled, camera: GroundCamera, settings: TrackerSettings, dynamics: Dynamics) -> Path:
    samples, belief = track.samples, of.belief
    planar, J = dynamics.planar(belief.mean)
    pose_cov = symmetrise(J @ belief.cov @ np.swapaxes(J, -1, -2))
    calibration, pixel = _calibration(camera, planar)
    cov = symmetrise(pose_cov + calibration @ camera.ground.cov @ np.swapaxes(calibration, -1, -2))
    return Path(
        id=track.id,
        class_name=of.class_name,
        frame=np.array([s.frame for s in samples]),
        t=np.array([s.t for s in samples]),
        measured=of.measured,
        planar=Gaussian(planar, cov),
        pose_cov=pose_cov,
        heading=dynamics.heading(belief.mean),
        size=of.size,
        size_sigma=of.size_sigma,
        size_pull=of.size_pull,
        size_z=_size_z(of.size, of.class_name, settings),
        calibration=calibration,
        pixel=pixel,
        nis=nis_of(of.steps),
        nis_dof=len(dynamics.H),
        noise=of.noise,
        refused=track.refused,
        likeness=_mean([s.border for s in samples if s.measured]),
        support=float(np.mean([s.outline.tangent or s.outline.valid.mean() for s in samples if s.measured])),
        apart=_mean([s.apart for s in samples if s.measured]),
        paint=_mean([s.paint for s in samples if s.measured]),
        clearance=_clearance(_mean([s.shaded for s in samples if s.measured]), camera),
        misfit_px=of.misfit_px,
        ended_by=track.ended_by,
        ahead=_ahead(of.steps, dynamics, settings.latency, float(of.size[0])),
    )


def _as_they_were(tracks: Sequence[Track]) -> list[_Settled]:
    """What was known of each track in each of its frames."""
    found = []
    for track in tracks:
        means, covs = (np.stack([getattr(step.posterior, name) for step in track.steps]) for name in ("mean", "cov"))
        seen = np.array([sample.measured for sample in track.samples])
        of = track.prior_class.name, track.size, track.size_sigma, np.zeros((len(seen), 2, 3)), np.nan
        found.append(_Settled(*of, track.steps, seen, 1.0, Gaussian(means, covs)))
    return found


def _settled(
    tracks: Sequence[Track], camera: GroundCamera, settings: TrackerSettings, dynamics: Dynamics, fall: Array | None
) -> list[_Settled]:
    """What all of each track says of it."""
    fitted = [_fitted(track, camera, settings, dynamics, fall) for track in tracks]
    poses = [
        settled_poses(track.samples, track.steps, fit, pose, sized.size, dynamics)
        for track, (sized, pose, fit) in zip(tracks, fitted, strict=True)
    ]
    found = []
    for track, (sized, _, fit), again in zip(tracks, fitted, filter_again(poses, settings, dynamics), strict=True):
        seen = np.array([sample.measured for sample in track.samples])
        pull = fit.cov[:, :2, 3:] @ np.linalg.inv(fit.cov[:, 3:, 3:])
        of = sized.prior.name, sized.size, sized.size_sigma, pull, float(np.median(fit.rms[seen]))
        belief = dynamics_tools.smooth(dynamics, again.steps)
        found.append(_Settled(*of, again.steps, again.trusted, again.noise, belief))
    return found


def _fitted(
    track: Track, camera: GroundCamera, settings: TrackerSettings, dynamics: Dynamics, fall: Array | None
) -> tuple[measure.Sized, Array, measure.BoxFit]:
    """A track's class and size, its poses (T, 3) as they are smoothed with what was known, and boxes fitted anew."""
    heading = dynamics.heading(dynamics_tools.smooth(dynamics, track.steps).mean)
    rough = np.stack([step.posterior.mean for step in track.steps])
    pose = np.column_stack([rough[:, :2], heading])
    outlines = Outlines.stack([sample.outline for sample in track.samples])
    used = np.array([sample.measured for sample in track.samples])
    outlines = sills.on_the_ground(outlines, used, camera, pose, track.size, fall)
    classes = settings.target.classes
    sized = measure.classify(camera, outlines[used], pose[used], classes, settings.pose, measure.pooled_size)[0]
    return sized, pose, measure.fit_poses(camera, outlines, pose, sized.size, np.full(3, 0.01), settings.pose)


def _ahead(steps: list[Step], dynamics: Dynamics, latency: float, length: float) -> Array:
    """Positions (T, 2) m that the causal states foretell `latency` s later (Bradshaw 1997, sec. 6)."""
    if latency == 0:
        return np.stack([dynamics.planar(step.posterior.mean)[0][:2] for step in steps])
    every = np.ones(len(steps))
    foretold = dynamics_tools.predict(dynamics, steps, latency * every, length * every)
    return np.stack([dynamics.planar(prediction.prior.mean)[0][:2] for prediction in foretold])


def _size_z(size: Array, class_name: str, settings: TrackerSettings) -> float:
    prior = next(c for c in settings.target.classes if c.name == class_name)
    mean, sigma = measure.prior_arrays(prior)
    return float(np.linalg.norm((size - mean) / sigma))


def _clearance(shaded: float, camera: GroundCamera) -> float:
    """Tyres and the dark beneath hide the ground, and where it lies in shadow (a share of the outline) sills may be
    taken for it: what ends above the ground seems to be further away, and to go faster."""
    return float(np.hypot(CLEARANCE, shaded * SILL_DOUBT_M / camera.centre[2]))


def _mean(shares: list[float]) -> float:
    """The mean of what could be seen; 1 where nothing could."""
    known = np.array(shares)[np.isfinite(shares)]
    return float(known.mean()) if len(known) else 1.0


def _calibration(camera: GroundCamera, planar: Array) -> tuple[Array, Array]:
    """d (position, velocity) / d homography entries (T, 4, 9) and d ground / d image (T, 2, 2)."""
    H = camera.ground.ground_from_image
    ahead = 0.1  # s: the velocity's share is the difference of two positions this far apart

    def image_of(position: Array) -> Array:
        pixels, _ = project(camera, np.column_stack([position, np.zeros(len(position))]))
        return np.nan_to_num(pixels)

    here = image_of(planar[:, :2])
    there = image_of(planar[:, :2] + planar[:, 2:] * ahead)
    at = homography.entry_jacobian(H, here)
    rate = (homography.entry_jacobian(H, there) - at) / ahead
    return np.concatenate([at, rate], axis=1), homography.jacobian(H, here)
