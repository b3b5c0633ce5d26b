"""What a finished track was: its size, its smoothed path and what the calibration adds to the doubt."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import homography
from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.cameras import project
from visfuse_cli.maths.gaussian import mahalanobis, symmetrise
from visfuse_cli.records import Array, Gaussian, GroundCamera
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking import measure
from visfuse_cli.tracking.dynamics import Dynamics, Step
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.targets import Sample, Track
from visfuse_cli.vision.wireframe import Outlines

START_DOUBT = 5.0  # times the deviations a new track begins with
SETTLING = 12  # measurements until that doubt is gone
START_S, LEAST_START = 1.5, 5  # s, and measurements, from which the start is estimated


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
    misfit_px: float
    ended_by: str
    ahead: Array  # (T, 2) m: where it was expected a latency later, from what was known then


def conclude(track: Track, camera: GroundCamera, settings: TrackerSettings, dynamics: Dynamics) -> Path:
    """Settle a track's size, fit every frame again with it, and smooth; with `smooth` off, keep the causal states."""
    samples, steps, misfit, noise = track.samples, track.steps, np.nan, 1.0
    size, size_sigma, size_pull = track.size, track.size_sigma, np.zeros((len(samples), 2, 3))
    nis = _nis(steps)
    class_name = track.prior_class.name
    measured = np.array([s.measured for s in samples])
    if settings.smooth:
        heading = dynamics.heading(dynamics_tools.smooth(dynamics, steps).mean)
        rough = np.stack([step.posterior.mean for step in steps])
        pose = np.column_stack([rough[:, :2], heading])
        outlines = Outlines.stack([s.outline for s in samples])
        used = measured
        sized = measure.classify(camera, outlines[used], pose[used], settings.target.classes, settings.pose)[0]
        class_name, size, size_sigma = sized.prior.name, sized.size, sized.size_sigma
        fit = measure.fit_poses(camera, outlines, pose, size, np.full(3, 0.01), settings.pose)
        size_pull = fit.cov[:, :2, 3:] @ np.linalg.inv(fit.cov[:, 3:, 3:])
        misfit = float(np.median(fit.rms[used]))
        steps, measured, noise = _filter_again(samples, steps, fit, pose, size, settings, dynamics)
        nis = _nis(steps)
        belief = dynamics_tools.smooth(dynamics, steps)
    else:
        belief = Gaussian(np.stack([s.posterior.mean for s in steps]), np.stack([s.posterior.cov for s in steps]))
    planar, J = dynamics.planar(belief.mean)
    pose_cov = symmetrise(J @ belief.cov @ np.swapaxes(J, -1, -2))
    calibration, pixel = _calibration(camera, planar)
    cov = symmetrise(pose_cov + calibration @ camera.ground.cov @ np.swapaxes(calibration, -1, -2))
    return Path(
        id=track.id,
        class_name=class_name,
        frame=np.array([s.frame for s in samples]),
        t=np.array([s.t for s in samples]),
        measured=measured,
        planar=Gaussian(planar, cov),
        pose_cov=pose_cov,
        heading=dynamics.heading(belief.mean),
        size=size,
        size_sigma=size_sigma,
        size_pull=size_pull,
        size_z=_size_z(size, class_name, settings),
        calibration=calibration,
        pixel=pixel,
        nis=nis,
        nis_dof=len(dynamics.H),
        noise=noise,
        refused=track.refused,
        likeness=float(np.nanmean([s.border for s in samples if s.measured])),
        support=float(np.mean([s.outline.tangent or s.outline.valid.mean() for s in samples if s.measured])),
        misfit_px=misfit,
        ended_by=track.ended_by,
        ahead=_ahead(steps, dynamics, settings.latency, float(size[0])),
    )


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


def _nis(steps: list[Step]) -> Array:
    return np.array([float(step.innovation.nis) for step in steps if step.innovation is not None])


def _filter_again(
    samples: list[Sample],
    steps: list[Step],
    fit: measure.BoxFit,
    pose: Array,
    size: Array,
    settings: TrackerSettings,
    dynamics: Dynamics,
) -> tuple[list[Step], NDArray[np.bool_], float]:
    """Filter the settled poses; a second time with the noise that the innovations of the whole track speak of.

    Returns that noise too, as a share of what was expected.
    """
    measured = [
        dynamics.measured(*measure.measurement(fit, k, pose[k])) if samples[k].measured and fit.ok[k] else None
        for k in range(len(samples))
    ]
    scale, start = 1.0, _start(samples, measured, pose, dynamics) or steps[0].posterior
    for _ in range(2 if settings.filter.adapt_noise else 1):
        steps, trusted = _filter(samples, start, measured, scale, float(size[0]), settings, dynamics)
        nis = _nis(steps)
        if len(nis) >= 5:
            scale *= float(np.clip(np.mean(nis) / len(dynamics.H), 0.2, 25.0))
    return steps, trusted, scale


def _start(
    samples: list[Sample], measured: list[tuple[Array, Array] | None], pose: Array, dynamics: Dynamics
) -> Gaussian | None:
    """Where and how fast a track began, by medians over its first measurements: what enters is badly seen at first."""
    t = np.array([sample.t for sample in samples])
    used = np.array([z is not None for z in measured]) & (t - t[0] <= START_S)
    if np.count_nonzero(used) < LEAST_START:
        return None
    elapsed = t[used] - t[0]
    position = np.array([z[0][:2] for z, chosen in zip(measured, used, strict=True) if z is not None and chosen])
    i, j = np.triu_indices(len(elapsed), 1)
    velocity = np.median((position[j] - position[i]) / (elapsed[j] - elapsed[i])[:, None], axis=0)
    begin = np.median(position - elapsed[:, None] * velocity, axis=0)
    heading = np.arctan2(np.median(np.sin(pose[used, 2])), np.median(np.cos(pose[used, 2])))
    return dynamics.begin(np.append(begin, heading), velocity)


def _filter(
    samples: list[Sample],
    start: Gaussian,
    measured: list[tuple[Array, Array] | None],
    scale: float,
    length: float,
    settings: TrackerSettings,
    dynamics: Dynamics,
) -> tuple[list[Step], NDArray[np.bool_]]:
    """One pass over settled poses, and which of them lay inside the gate; it begins knowing nearly nothing."""
    gate = gate_size(len(dynamics.H), settings.pose.gate)
    H = dynamics.H
    steps = [dynamics_tools.first(dynamics, Gaussian(start.mean, start.cov * START_DOUBT**2))]
    trusted = np.zeros(len(samples), dtype=bool)
    count = 0
    for k, now in enumerate(measured):
        dt = np.array([samples[k].t - samples[k - 1].t if k else 0.0])
        # The record of residuals begins when the belief has settled: the first doubt is no sign of a manoeuvre.
        before = steps[-1] if count > SETTLING else replace(steps[-1], memory=None)
        expected = dynamics_tools.predict(dynamics, [before], dt, np.array([length]))[0]
        step = dynamics_tools.coast(expected)
        if now is not None:
            z, R = now[0], now[1] * scale
            gamma = dynamics_tools.residual(dynamics, z, expected.prior.mean)
            nis = float(mahalanobis(gamma, H @ expected.prior.cov @ H.T + R))
            # Outside the gate a measurement counts less the further off it is: a bad start is left behind in the end.
            step = dynamics_tools.take(dynamics, expected, z, R * max(1.0, nis / gate) ** 2)
            trusted[k] = nis < gate
            count += 1
        steps.append(step)
    return steps[1:], trusted


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
