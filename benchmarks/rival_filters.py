"""One step of the filters of FilterPy and Stone Soup, as functions without arguments, for `filters.py`."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from visfuse_cli.maths import imm

Step = Callable[[], Any]
Constants = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # F, Qs of three models, H, R


def filterpy(
    constants: Constants, people: tuple[np.ndarray, np.ndarray], steps: int, particles: int
) -> dict[str, Step]:
    """Kalman, IMM, smoother over `steps`, and resampling by FilterPy; raises ImportError without it."""
    from filterpy.kalman import IMMEstimator, KalmanFilter
    from filterpy.monte_carlo import systematic_resample

    F, Qs, _, R = constants

    def single(F: np.ndarray, Q: np.ndarray) -> Any:
        size = len(F)
        own = KalmanFilter(dim_x=size, dim_z=3)
        own.F, own.H, own.R, own.Q = F, np.eye(3, size), R, Q
        own.x, own.P = np.zeros(size), 0.1 * np.eye(size)
        return own

    def interacting(Fs: Sequence[np.ndarray], Qs: np.ndarray) -> Step:
        r = len(Qs)
        bank = IMMEstimator(
            [single(F, Q) for F, Q in zip(Fs, Qs, strict=True)], [1 / r] * r, np.exp(imm.transition(r, 0.95))
        )

        def step() -> None:
            bank.predict()
            bank.update(z)

        return step

    z = np.full(3, 0.1)
    alone = single(F, Qs[1])
    means, covs = single(F, Qs[1]).batch_filter(np.full((steps, 3), 0.1))[:2]
    weights = np.random.default_rng(0).dirichlet(np.ones(particles))

    def kalman() -> None:
        alone.predict()
        alone.update(z)

    return {
        "Kalman, 6 states": kalman,
        "IMM, 3 models": interacting([F] * 3, Qs),
        "IMM, 4 models": interacting(*people),
        "smoother, 50 steps": lambda: alone.rts_smoother(means, covs),
        "resampling": lambda: systematic_resample(weights),
    }


def stone_soup(constants: Constants, dt: float, steps: int, particles: int) -> dict[str, Step]:
    """Kalman, EKF of a turning target, smoother, and resampling by Stone Soup; raises ImportError without it."""
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.models.transition.nonlinear import ConstantTurn
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor, KalmanPredictor
    from stonesoup.resampler.particle import SystematicResampler
    from stonesoup.smoother.kalman import KalmanSmoother
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState, ParticleState, StateVector, StateVectors
    from stonesoup.types.track import Track
    from stonesoup.updater.kalman import ExtendedKalmanUpdater, KalmanUpdater

    start, apart = datetime.datetime(2026, 1, 1), datetime.timedelta(seconds=dt)
    linear = CombinedLinearGaussianTransitionModel([ConstantVelocity(1.0)] * 3)
    turning = ConstantTurn(linear_noise_coeffs=np.ones(2), turn_noise_coeff=0.1)

    def stepper(predictor: Any, updater: Any, mean: np.ndarray) -> Callable[..., Any]:
        states = [GaussianState(mean[:, None], 0.1 * np.eye(len(mean)), timestamp=start)]
        size = len(updater.measurement_model.mapping)

        def step() -> Any:  # on from the state before: it remembers what it has predicted once
            t = states[-1].timestamp + apart
            seen = Detection(StateVector(np.full(size, 0.1)), timestamp=t, measurement_model=updater.measurement_model)
            states[0] = updater.update(SingleHypothesis(predictor.predict(states[-1], timestamp=t), seen))
            return states[0]

        return step

    seen_3d, seen_2d = LinearGaussian(6, (0, 2, 4), constants[3]), LinearGaussian(5, (0, 2), constants[3][:2, :2])
    kalman = stepper(KalmanPredictor(linear), KalmanUpdater(seen_3d), np.zeros(6))
    extended = stepper(
        ExtendedKalmanPredictor(turning), ExtendedKalmanUpdater(seen_2d), np.array([0, 8.0, 0, 1.0, 0.1])
    )
    track = Track([kalman() for _ in range(steps)])
    log_weights = np.log(np.random.default_rng(0).dirichlet(np.ones(particles)))
    cloud = ParticleState(StateVectors(np.zeros((6, particles))), log_weight=log_weights)
    return {
        "Kalman, 6 states": kalman,
        "EKF, constant speed": extended,
        "smoother, 50 steps": lambda: KalmanSmoother(linear).smooth(track),
        "resampling": lambda: SystematicResampler().resample(cloud),
    }
