"""What a finished track was: its size, its smoothed path and what the calibration adds to the doubt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from visfuse_cli.maths import homography
from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.cameras import project
from visfuse_cli.maths.gaussian import mahalanobis, symmetrise
from visfuse_cli.maths.smoothing import rauch_tung_striebel
from visfuse_cli.records import Array, Gaussian, GroundCamera
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking import measure
from visfuse_cli.tracking.dynamics import Dynamics, Step
from visfuse_cli.tracking.ground import Sample, Track
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.vision.wireframe import Outlines


@dataclass(frozen=True, slots=True)
class Path:
    """A finished track over T frames, on the ground plane, metres and seconds.

    planar: (T, 4) X, Y, X', Y' with (T, 4, 4) covariance, calibration included; pose_cov: the same without it;
    calibration: (T, 4, 9) d planar / d homography entries; pixel: (T, 2, 2) d ground / d image.
    """

    id: int
    class_name: str
    frame: np.ndarray
    t: Array
    measured: np.ndarray
    whole: np.ndarray  # measured with the whole outline in view
    planar: Gaussian
    pose_cov: Array
    heading: Array
    size: Array
    calibration: Array
    pixel: Array
    nis: Array
    refused: int
    misfit_px: float
    ended_by: str


def conclude(track: Track, camera: GroundCamera, settings: TrackerSettings, dynamics: Dynamics) -> Path:
    """Settle a track's size, fit every frame again with it, and smooth; with `smooth` off, take the causal filter's word."""
    samples, steps, size, misfit = track.samples, track.steps, track.size, np.nan
    nis = _nis(steps)
    class_name = track.prior_class.name
    if settings.smooth:
        heading = dynamics.heading(_smooth(steps, dynamics).mean)
        rough = np.stack([step.posterior.mean for step in steps])
        pose = np.column_stack([rough[:, :2], heading])
        outlines = Outlines(np.stack([s.support for s in samples]), np.stack([s.valid for s in samples]))
        used = np.array([s.measured for s in samples])
        prior, size, _, _ = measure.classify(
            camera,
            Outlines(outlines.support[used], outlines.valid[used]),
            pose[used],
            settings.target.classes,
            settings.pose,
        )
        class_name = prior.name
        fit = measure.fit_poses(camera, outlines, pose, size, np.full(3, 0.01), settings.pose)
        misfit = float(np.median(fit.rms[used]))
        steps = _filter_again(samples, steps, fit, pose, size, settings, dynamics)
        nis = _nis(steps)
        belief: Gaussian = _smooth(steps, dynamics)
    else:
        belief = Gaussian(np.stack([s.posterior.mean for s in steps]), np.stack([s.posterior.cov for s in steps]))
    planar, J = dynamics.planar(belief.mean)
    pose_cov = symmetrise(J @ belief.cov @ np.swapaxes(J, -1, -2))
    calibration, pixel = _calibration(camera, planar)
    cov = symmetrise(pose_cov + calibration @ camera.ground.cov @ np.swapaxes(calibration, -1, -2))
    measured = np.array([step.innovation is not None for step in steps])
    measured[0] = True
    return Path(
        id=track.id,
        class_name=class_name,
        frame=np.array([s.frame for s in samples]),
        t=np.array([s.t for s in samples]),
        measured=measured,
        whole=measured & np.array([s.whole for s in samples]),
        planar=Gaussian(planar, cov),
        pose_cov=pose_cov,
        heading=dynamics.heading(belief.mean),
        size=size,
        calibration=calibration,
        pixel=pixel,
        nis=nis,
        refused=track.refused,
        misfit_px=misfit,
        ended_by=track.ended_by,
    )


def _nis(steps: list[Step]) -> Array:
    return np.array([float(step.innovation.nis) for step in steps if step.innovation is not None])


def _smooth(steps: list[Step], dynamics: Dynamics) -> Gaussian:
    filtered = Gaussian(np.stack([s.posterior.mean for s in steps]), np.stack([s.posterior.cov for s in steps]))
    predicted = Gaussian(np.stack([s.prior.mean for s in steps]), np.stack([s.prior.cov for s in steps]))
    return rauch_tung_striebel(filtered, predicted, np.stack([s.F for s in steps]), dynamics.angles_x)


def _filter_again(
    samples: list[Sample],
    steps: list[Step],
    fit: measure.BoxFit,
    pose: Array,
    size: Array,
    settings: TrackerSettings,
    dynamics: Dynamics,
) -> list[Step]:
    """Filter the settled poses; a second time with the noise that the innovations of the whole track speak of."""
    measured = [
        dynamics.measured(*measure.measurement(fit, k, pose[k])) if samples[k].measured and fit.ok[k] else None
        for k in range(len(samples))
    ]
    scale = 1.0
    for _ in range(2 if settings.filter.adapt_noise else 1):
        steps = _filter(samples, steps[0], measured, scale, float(size[0]), settings, dynamics)
        nis = _nis(steps)
        if len(nis) >= 5:
            scale *= float(np.clip(np.mean(nis) / len(dynamics.H), 0.2, 25.0))
    return steps


def _filter(
    samples: list[Sample],
    first: Step,
    measured: list[tuple[Array, Array] | None],
    scale: float,
    length: float,
    settings: TrackerSettings,
    dynamics: Dynamics,
) -> list[Step]:
    gate = gate_size(len(dynamics.H), settings.pose.gate)
    steps = [_begin(first, measured[0], scale, dynamics)]
    for k in range(1, len(samples)):
        dt = np.array([samples[k].t - samples[k - 1].t])
        expected = dynamics_tools.predict(dynamics, [steps[-1].posterior], dt, np.array([length]))[0]
        step = dynamics_tools.coast(expected, steps[-1].memory)
        now = measured[k]
        if now is not None:
            z, R = now[0], now[1] * scale
            gamma = dynamics_tools.residual(dynamics, z, expected.prior.mean)
            H = dynamics.H
            if mahalanobis(gamma, H @ expected.prior.cov @ H.T + R) < gate:
                step = dynamics_tools.take(dynamics, expected, z, R, step.memory)
        steps.append(step)
    return steps


def _begin(first: Step, measured: tuple[Array, Array] | None, scale: float, dynamics: Dynamics) -> Step:
    """The first state again, from the settled pose; its velocity is what the causal filter began with."""
    start = first.posterior
    if measured is not None:
        z, R = measured
        gain_free = dynamics.H.T @ dynamics.H
        mean = start.mean + dynamics.H.T @ dynamics_tools.residual(dynamics, z, start.mean)
        keep = np.eye(len(start.mean)) - gain_free
        cov = keep @ start.cov @ keep + dynamics.H.T @ (R * scale) @ dynamics.H
        start = Gaussian(mean, symmetrise(cov))
    return Step(start, start, first.F, None, None)


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
