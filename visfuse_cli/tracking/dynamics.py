"""How things move on the ground, in one shape for every filter the tracker knows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visfuse_cli.maths import course, covariance_updating, fading, gaussian, imm, motion
from visfuse_cli.maths.angles import wrap, wrap_at
from visfuse_cli.maths.smoothing import rauch_tung_striebel
from visfuse_cli.records import Array, Gaussian, Innovation
from visfuse_cli.tracking.settings import FilterSettings, TargetSettings

WHEELBASE_SHARE = 0.6  # of a vehicle's length
COURSES = (course.CSD, course.CS, course.CD)  # Bradshaw 1997, sec. 4.1
QUIET = 0.2  # of the usual noise: what a motion that holds its speed still has
STRAIGHT = 0.02  # rad/s per root Hz: what one that holds its course still has
BELIEVED_SIGMA = 4.0  # a speed further from the expected one is something else's


@dataclass(frozen=True, slots=True)
class Dynamics:
    """A motion, or several that interact, ready for the tracker: states x (n,), measurements z = H x (m,).

    `angles_z` and `angles_x` are components on the circle. With `log_p` (r, r) the states that `advance` moves are
    those of r models, (N, r, n).
    """

    H: Array
    alpha: tuple[float, ...]  # weights of the fading factor (m,)
    angles_z: tuple[int, ...]
    angles_x: tuple[int, ...]
    advance: Callable[[Array, Array, Array, Array], tuple[Array, Array, Array]]  # x, P, dt, length (N, ...) -> x', F, Q
    begin: Callable[[Array, Array], Gaussian]  # pose (3,), velocity (2,) -> belief
    planar: Callable[[Array], tuple[Array, Array]]  # x (..., n) -> (X, Y, X', Y') and its Jacobian (..., 4, n)
    heading: Callable[[Array], Array]  # x (..., n) -> rad (...)
    measured: Callable[[Array, Array], tuple[Array, Array]]  # pose (..., 3), cov (..., 3, 3) -> z, R
    fades: bool  # fading factor in use
    log_p: Array | None = None


@dataclass(frozen=True, slots=True)
class Prediction:
    """Where a target is expected: prior (n,), transition F and the noise Q (n, n) in the prior; what it remembers."""

    prior: Gaussian
    F: Array
    Q: Array
    memory: fading.FadingState | None
    models: imm.Step | None = None


@dataclass(frozen=True, slots=True)
class Step:
    """One filter step of one target: prior, posterior, the transition to it, and what the measurement said (if any).

    `memory` is the fading filter's record of residuals, `models` the interacting models' own step.
    """

    prior: Gaussian
    posterior: Gaussian
    F: Array
    innovation: Innovation | None
    memory: fading.FadingState | None
    models: imm.Step | None = None


def for_target(target: TargetSettings, filter_: FilterSettings) -> Dynamics:
    """The dynamics that a configuration asks for: things that steer (Lou 2002, eq. 1) or people, and the filter."""
    steers = target.motion == "bicycle"
    if filter_.kind == "imm":
        return _interacting(filter_, steers)
    accelerates = filter_.kind in ("cuf", "fading-cuf")
    return (_bicycle if steers else _walk)(filter_, accelerates, filter_.kind.startswith("fading"))


def _bicycle(filter_: FilterSettings, accelerates: bool, fades: bool) -> Dynamics:
    straighten = filter_.straighten

    def advance(x: Array, cov: Array, dt: Array, length: Array) -> tuple[Array, Array, Array]:
        wheelbase = WHEELBASE_SHARE * length
        # Drivers steer as fast as they like at walking pace, and at speed as fast as the lateral jerk allows.
        steer = (filter_.sigma_steer**-2 + (x[..., 2] ** 2 / (filter_.sigma_corner * wheelbase)) ** 2) ** -0.5
        if accelerates:
            return covariance_updating.advance(x, cov, dt, wheelbase, steer, filter_.sigma_jerk, straighten)
        return motion.bicycle_step(x, dt, wheelbase, filter_.sigma_a, steer, straighten)

    size = 6 if accelerates else 5

    def begin(pose: Array, velocity: Array) -> Gaussian:
        speed = float(velocity @ [np.cos(pose[2]), np.sin(pose[2])])  # negative: it reverses
        mean = np.array([pose[0], pose[1], speed, pose[2], 0.0, 0.0])
        deviation = np.array([0.5, 0.5, max(1.5, 0.3 * abs(speed)), 0.2, 0.1, 1.5])
        return Gaussian(mean[:size], np.diag(deviation[:size] ** 2))

    def planar(x: Array) -> tuple[Array, Array]:
        velocity, J_velocity = motion.bicycle_velocity(x)
        J = np.zeros((*x.shape[:-1], 4, size))
        J[..., :2, :2], J[..., 2:, :5] = np.eye(2), J_velocity
        return np.concatenate([x[..., :2], velocity], axis=-1), J

    return Dynamics(
        H=np.eye(size)[[0, 1, 3]],
        alpha=fading.ALPHA,
        angles_z=(2,),
        angles_x=(3,),
        advance=advance,
        begin=begin,
        planar=planar,
        heading=lambda x: x[..., 3],
        measured=lambda pose, cov: (pose, cov),
        fades=fades,
    )


def _walk(filter_: FilterSettings, accelerates: bool, fades: bool) -> Dynamics:
    size = 6 if accelerates else 4

    def advance(x: Array, cov: Array, dt: Array, length: Array) -> tuple[Array, Array, Array]:
        if accelerates:
            F, Q = motion.constant_acceleration(dt), motion.constant_acceleration_noise(dt, filter_.sigma_jerk**2)
        else:
            F, Q = motion.constant_velocity(dt), motion.constant_velocity_noise(dt, filter_.sigma_a**2)
        return gaussian.times(F, x), F, Q

    def begin(pose: Array, velocity: Array) -> Gaussian:
        mean = np.concatenate([pose[:2], velocity, [0.0, 0.0]])
        return Gaussian(mean[:size], np.diag(np.array([0.3, 0.3, 0.8, 0.8, 0.8, 0.8])[:size] ** 2))

    return Dynamics(
        H=np.eye(2, size),
        alpha=(1.0, 1.0),
        angles_z=(),
        angles_x=(),
        advance=advance,
        begin=begin,
        planar=lambda x: (x[..., :4], np.broadcast_to(np.eye(4, size), (*x.shape[:-1], 4, size))),
        heading=lambda x: np.arctan2(x[..., 3], x[..., 2]),
        measured=lambda pose, cov: (pose[..., :2], cov[..., :2, :2]),
        fades=fades,
    )


def _interacting(filter_: FilterSettings, heading_seen: bool) -> Dynamics:
    spare = (filter_.sigma_a**2, filter_.sigma_turn**2)
    steady, straight = (QUIET * filter_.sigma_a) ** 2, STRAIGHT**2
    densities = (  # of what each motion changes in speed and in course
        (steady, straight),
        (steady, filter_.sigma_turn**2),
        (filter_.sigma_jerk**2, straight),
    )

    def advance(x: Array, cov: Array, dt: Array, length: Array) -> tuple[Array, Array, Array]:
        moved, F, Q = [], [], []
        for k, (kind, (speed, turn)) in enumerate(zip(COURSES, densities, strict=True)):
            mean, way = course.advance(x[..., k, :], dt, kind)
            moved.append(mean)
            F.append(way)
            Q.append(course.noise(x[..., k, :], dt, kind, speed, turn, spare))
        return np.stack(moved, axis=-2), np.stack(F, axis=-3), np.stack(Q, axis=-3)

    def begin(pose: Array, velocity: Array) -> Gaussian:
        theta = pose[2] if heading_seen else np.arctan2(velocity[1], velocity[0])
        speed = float(velocity @ [np.cos(theta), np.sin(theta)])
        mean = np.array([pose[0], pose[1], speed, theta, 0.0, 0.0])
        deviation = np.array([0.5, 0.5, max(1.0, 0.3 * abs(speed)), 0.2 if heading_seen else 0.5, *np.sqrt(spare)])
        return Gaussian(mean, np.diag(deviation**2))

    rows = [0, 1, 3] if heading_seen else [0, 1]
    return Dynamics(
        H=np.eye(6)[rows],
        alpha=(1.0,) * len(rows),
        angles_z=(2,) if heading_seen else (),
        angles_x=course.ANGLES,
        advance=advance,
        begin=begin,
        planar=course.observe,
        heading=lambda x: x[..., 3],
        measured=lambda pose, cov: (pose[..., : len(rows)], cov[..., : len(rows), : len(rows)]),
        fades=False,
        log_p=imm.transition(len(COURSES), filter_.stay),
    )


def first(dynamics: Dynamics, belief: Gaussian) -> Step:
    """The step a track begins with, before anything is predicted."""
    eye = np.eye(len(belief.mean))
    models = None
    if dynamics.log_p is not None:
        bank = imm.start(belief, len(dynamics.log_p))
        ways = np.broadcast_to(eye, bank.beliefs.cov.shape)
        models = imm.Step(bank.beliefs, ways, 0 * ways, bank.beliefs, bank.log_mu, bank)
    return Step(belief, belief, eye, None, None, models)


def predict(dynamics: Dynamics, steps: Sequence[Step], dt: Array, length: Array) -> list[Prediction]:
    """Advance N targets from their latest steps by dt (N,) s; length (N,) m is each target's own."""
    if dynamics.log_p is not None:
        return _predict_models(dynamics, steps, dt, length)
    before = stacked([step.posterior for step in steps])
    mean, F, Q = dynamics.advance(before.mean, before.cov, dt, length)
    cov = gaussian.propagate(before.cov, F, Q)
    return [Prediction(Gaussian(mean[k], cov[k]), F[k], Q[k], step.memory) for k, step in enumerate(steps)]


def _predict_models(dynamics: Dynamics, steps: Sequence[Step], dt: Array, length: Array) -> list[Prediction]:
    assert dynamics.log_p is not None
    banks = [step.models.filtered for step in steps if step.models is not None]
    bank = imm.Bank(stacked([each.beliefs for each in banks]), np.stack([each.log_mu for each in banks]))
    ahead = imm.predict(bank, dynamics.log_p, lambda x: dynamics.advance(x, x, dt, length), dynamics.angles_x)
    prior = imm.combined(ahead.filtered, dynamics.angles_x)
    return [
        Prediction(Gaussian(prior.mean[k], prior.cov[k]), ahead.F[k, 0], ahead.Q[k, 0], None, imm.at(ahead, k))
        for k in range(len(steps))
    ]


def pose(dynamics: Dynamics, x: Array) -> Array:
    """Place (m) and heading (rad), (3,), of a state (n,)."""
    return np.array([x[0], x[1], dynamics.heading(x)])


def coast(prediction: Prediction) -> Step:
    """The step of a target that was not measured."""
    return Step(prediction.prior, prediction.prior, prediction.F, None, prediction.memory, prediction.models)


def residual(dynamics: Dynamics, z: Array, x: Array) -> Array:
    """z - H x with angles wrapped; a box turned by half a turn is the same box."""
    difference = z - gaussian.times(dynamics.H, x)
    for index in dynamics.angles_z:
        difference[..., index] = wrap(2 * difference[..., index]) / 2
    return difference


def take(dynamics: Dynamics, prediction: Prediction, z: Array, R: Array) -> Step:
    """Take in a measurement z (..., m) of noise R (..., m, m) (Lou 2002, eqs. 5-11; Jia 2008, eqs. 27-31: models)."""
    gamma = residual(dynamics, z, prediction.prior.mean)
    if prediction.models is not None:
        each = residual(dynamics, z[..., None, :], prediction.models.predicted.mean)
        models, _ = imm.update(prediction.models, each, dynamics.H, R[..., None, :, :])
        innovation = gaussian.innovate(prediction.prior, gamma, dynamics.H, R)
        posterior = imm.combined(models.filtered, dynamics.angles_x)
        return Step(prediction.prior, posterior, prediction.F, innovation, None, models)
    memory = prediction.memory or fading.start(prediction.prior, dynamics.H, R)
    limit = fading.LIMIT if dynamics.fades else 1.0
    taken = fading.update(prediction.prior, prediction.Q, gamma, dynamics.H, R, memory, dynamics.alpha, limit=limit)
    posterior = Gaussian(wrap_at(taken.posterior.mean, dynamics.angles_x), taken.posterior.cov)
    return Step(taken.prior, posterior, prediction.F, taken.innovation, taken.state)


def take_each(dynamics: Dynamics, predictions: Sequence[Prediction], z: Array, R: Array) -> list[Step]:
    """Take in the measurements z (N, m) with noise R (N, m, m) of N targets, as `take` does of one."""
    prior = stacked([each.prior for each in predictions])
    F, Q = (np.array([getattr(each, name) for each in predictions]) for name in ("F", "Q"))
    models, memory = None, None
    if dynamics.log_p is not None:
        models = _together([each.models for each in predictions if each.models is not None])
    else:
        each_memory = [p.memory or fading.start(p.prior, dynamics.H, R[k]) for k, p in enumerate(predictions)]
        memory = fading.FadingState(np.array([each.U for each in each_memory]))
    whole = take(dynamics, Prediction(prior, F, Q, memory, models), z, R)
    return [_one(whole, k) for k in range(len(predictions))]


def _together(steps: Sequence[imm.Step]) -> imm.Step:
    """The steps of several targets as one, target first."""
    mixed, predicted, after = (
        stacked(beliefs) for beliefs in zip(*((s.mixed, s.predicted, s.filtered.beliefs) for s in steps), strict=True)
    )
    F, Q, ahead = (np.array([getattr(s, name) for s in steps]) for name in ("F", "Q", "ahead"))
    return imm.Step(mixed, F, Q, predicted, ahead, imm.Bank(after, np.array([s.filtered.log_mu for s in steps])))


def _one(step: Step, k: int) -> Step:
    """The step of the k-th of several targets."""
    prior, posterior = (Gaussian(b.mean[k], b.cov[k]) for b in (step.prior, step.posterior))
    whole = step.innovation
    said = whole and Innovation(whole.residual[k], whole.cov[k], whole.nis[k], whole.log_likelihood[k])
    memory = step.memory and fading.FadingState(step.memory.U[k])
    return Step(prior, posterior, step.F[k], said, memory, step.models and imm.at(step.models, k))


def take_speed(dynamics: Dynamics, step: Step, along: Array, speed: float, sigma: float) -> Step:
    """Take in the speed (m/s, deviation sigma) of one target along a direction (2,), unless it is beyond belief."""
    belief = step.posterior if step.models is None else step.models.filtered.beliefs
    planar, J = dynamics.planar(belief.mean)
    H = (along @ J[..., 2:, :])[..., None, :]
    residual = (speed - planar[..., 2:] @ along)[..., None]
    posterior, innovation = gaussian.update(belief, residual, H, np.array([[sigma**2]]))
    if np.min(innovation.nis) > BELIEVED_SIGMA**2:
        return step
    if step.models is None:
        return replace(step, posterior=posterior)
    log_mu = imm.weigh(step.models.filtered.log_mu, innovation.log_likelihood)
    models = step.models._replace(filtered=imm.Bank(posterior, log_mu))
    return replace(step, posterior=imm.combined(models.filtered, dynamics.angles_x), models=models)


def smooth(dynamics: Dynamics, steps: Sequence[Step]) -> Gaussian:
    """The states (T, n) of a finished track given all of it."""
    if dynamics.log_p is not None:
        banks = imm.smooth([step.models for step in steps if step.models], dynamics.log_p, dynamics.angles_x)
        return stacked([imm.combined(bank, dynamics.angles_x) for bank in banks])
    filtered, predicted = stacked([s.posterior for s in steps]), stacked([s.prior for s in steps])
    return rauch_tung_striebel(filtered, predicted, np.stack([s.F for s in steps]), dynamics.angles_x)


def stacked(beliefs: Sequence[Gaussian]) -> Gaussian:
    """N beliefs (n,) as one (N, n)."""
    return Gaussian(np.array([belief.mean for belief in beliefs]), np.array([belief.cov for belief in beliefs]))
