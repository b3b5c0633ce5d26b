"""One step of the filters of FilterPy and Stone Soup, as functions without arguments, for `filters.py`."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from typing import Any

import numpy as np

from visfuse_cli.maths import imm

Step = Callable[[], Any]
Constants = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # F, Qs of three models, H, R


def filterpy(constants: Constants, steps: int, particles: int) -> dict[str, Step]:
    """Kalman, IMM, smoother over `steps`, and resampling by FilterPy; raises ImportError without it."""
    from filterpy.kalman import IMMEstimator, KalmanFilter
    from filterpy.monte_carlo import systematic_resample

    F, Qs, H, R = constants

    def single(Q: np.ndarray) -> Any:
        own = KalmanFilter(dim_x=6, dim_z=3)
        own.F, own.H, own.R, own.Q = F, H, R, Q
        own.x, own.P = np.zeros(6), 0.1 * np.eye(6)
        return own

    z = np.full(3, 0.1)
    alone, bank = single(Qs[1]), IMMEstimator([single(Q) for Q in Qs], [1 / 3] * 3, np.exp(imm.transition(3, 0.95)))
    means, covs = single(Qs[1]).batch_filter(np.full((steps, 3), 0.1))[:2]
    weights = np.random.default_rng(0).dirichlet(np.ones(particles))

    def kalman() -> None:
        alone.predict()
        alone.update(z)

    def interacting() -> None:
        bank.predict()
        bank.update(z)

    return {
        "Kalman, 6 states": kalman,
        "IMM, 3 models": interacting,
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
