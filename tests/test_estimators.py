"""Every filter against its own statistics, and the papers' experiments at the size of a test."""

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks import bradshaw, jia, lou, pursuit
from benchmarks import real_trajectories as real
from tests.test_fusion import simulate
from visfuse_cli.maths import course, covariance_updating, fading, gaussian, imm, motion
from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.records import Gaussian
from visfuse_cli.tracking.settings import FilterSettings

RUNS, STEPS, DT = 200, 40, 0.1
SPARE = (0.2, 0.1)


def linear(F, Q):
    return lambda x, cov: (gaussian.times(F, x), F, Q)


def by_course(kind, speed, turn):
    return lambda x, cov: (
        *course.advance(x, np.array(DT), kind),
        course.noise(x, np.array(DT), kind, speed, turn, SPARE),
    )


COURSE_START = np.array([0, 0, 6.0, 2.9, 0.3, 0.3])
COURSE_SPREAD = np.array([0.2, 0.2, 0.3, 0.05, *np.sqrt(SPARE)])
FILTERS = {
    "drifting point": (linear(motion.drifting_point(DT), motion.drifting_point_noise(DT, 0.3, 0.25)), 4, ()),
    "constant velocity": (linear(motion.constant_velocity(DT), motion.constant_velocity_noise(DT, 0.5)), 4, ()),
    "constant acceleration": (
        linear(motion.constant_acceleration(DT), motion.constant_acceleration_noise(DT, 0.5)),
        6,
        (),
    ),
    "periodic": (linear(motion.periodic(DT, 1.5), motion.periodic_noise(DT, 1.5, 0.2, 0.05)), 6, ()),
    "CSD": (by_course(course.CSD, 0.05, 0.01), 6, (3,)),
    "CS": (by_course(course.CS, 0.05, 0.05), 6, (3,)),
    "CD": (by_course(course.CD, 0.1, 0.01), 6, (3,)),
    "bicycle": (
        lambda x, cov: (*motion.bicycle(x, DT, 2.5), motion.bicycle_noise(x, DT, 2.5, 1.0, 0.1)),
        5,
        (3,),
    ),
    "covariance updating": (lambda x, cov: covariance_updating.advance(x, cov, DT, 2.5, 0.1, 0.5), 6, (3,)),
}


@pytest.mark.parametrize("name", [*FILTERS, "fading bicycle", "fading covariance updating"])
def test_errors_are_as_large_as_the_filter_says(name):
    fades, name = name.startswith("fading"), name.removeprefix("fading ")
    advance, size, angles = FILTERS[name]
    rng = np.random.default_rng(5)
    start, spread = np.zeros(size), np.full(size, 0.5)
    if name in ("covariance updating", "bicycle"):
        start, spread = np.array([0, 0, 8.0, 3.0, 0.1, 0.3])[:size], np.array([0.2, 0.2, 0.5, 0.05, 0.05, 0.3])[:size]
    elif angles:
        start, spread = COURSE_START, COURSE_SPREAD
    H = np.eye(size)[[0, 1, 3]] if angles else np.eye(2, size)
    sigma = np.array([0.1, 0.1, 0.03])[: len(H)]
    P = np.broadcast_to(np.diag(spread**2), (RUNS, size, size))
    x = start + spread * rng.normal(size=(RUNS, size))
    belief = Gaussian(np.broadcast_to(start, (RUNS, size)), P)
    nees, nis, memory = [], [], None
    for _ in range(STEPS):
        moved, _, Q = advance(x, np.zeros((size, size)))
        values, vectors = np.linalg.eigh(np.broadcast_to(Q, (RUNS, size, size)))
        root = vectors * np.sqrt(np.clip(values, 0, None))[:, None]
        x = moved + gaussian.times(root, rng.normal(size=(RUNS, size)))
        mean, F, Q = advance(belief.mean, belief.cov)
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        residual = gaussian.times(H, x - mean) + sigma * rng.normal(size=(RUNS, len(H)))
        if angles:
            residual = wrap_at(residual, (2,))
        if fades:
            memory = memory or fading.start(ahead, H, np.diag(sigma**2))
            step = fading.update(ahead, Q, residual, H, np.diag(sigma**2), memory)
            belief, innovation, memory = step.posterior, step.innovation, step.state
        else:
            belief, innovation = gaussian.update(ahead, residual, H, np.diag(sigma**2))
        nees.append(gaussian.mahalanobis(wrap_at(belief.mean - x, angles), belief.cov))
        nis.append(innovation.nis)
    for k in (STEPS // 2, STEPS - 1):
        low, high = chi2.ppf([0.0005, 0.9995], size * RUNS) / RUNS
        assert low < nees[k].mean() < high
    low, high = chi2.ppf([0.0005, 0.9995], len(H) * RUNS * STEPS) / (RUNS * STEPS)
    # The factor only ever widens the prediction, also where nothing is amiss.
    assert (0.95 if fades else 1) * low < np.mean(nis) < high


@pytest.mark.parametrize("name", [name for name in FILTERS if name != "covariance updating"])
def test_every_motion_works_alone_in_a_batch_and_among_others(name):
    advance, size, angles = FILTERS[name]
    rng = np.random.default_rng(8)
    start = COURSE_START[:size] if angles else np.zeros(size)
    mean = start + 0.1 * rng.normal(size=(4, size))
    batch = Gaussian(mean, np.tile(0.1 * np.eye(size), (4, 1, 1)))
    H, R = np.eye(2, size), 0.04 * np.eye(2)
    z = mean[:, :2] + 0.2

    def stepped(belief, z):
        following, F, Q = advance(belief.mean, belief.cov)
        ahead = Gaussian(following, gaussian.propagate(belief.cov, F, Q))
        return gaussian.update(ahead, z - following[..., :2], H, R)[0]

    together = stepped(batch, z)
    step = imm.predict(imm.start(batch, 2), imm.transition(2, 0.9), lambda x: advance(x, None), angles)
    step, _ = imm.update(step, z[:, None] - step.predicted.mean[..., :2], H, R)
    copies = imm.combined(step.filtered, angles)
    for k in range(4):
        one = stepped(Gaussian(batch.mean[k], batch.cov[k]), z[k])
        for many in (together, copies):
            np.testing.assert_allclose(many.mean[k], one.mean, atol=1e-10)
            np.testing.assert_allclose(many.cov[k], one.cov, atol=1e-10)


def test_bicycles_that_drive_calmly_and_hard_interact():
    rng = np.random.default_rng(9)
    agile = np.array([0.3, 3.0])
    p = np.exp(imm.transition(2, 0.95))
    H, R = motion.BICYCLE_MEASUREMENT, np.diag([0.01, 0.01, 0.001])

    def advance(x):
        mean, F = motion.bicycle(x, DT, 2.5)
        return mean, F, motion.bicycle_noise(x, DT, 2.5, agile, 0.1 * agile)

    x = np.array([0, 0, 8.0, 3.0, 0]) + 0.1 * rng.normal(size=(RUNS, 5))
    prior = Gaussian(np.tile([0, 0, 8.0, 3.0, 0], (RUNS, 1)), np.tile(0.01 * np.eye(5), (RUNS, 1, 1)))
    bank, mode, nees = imm.start(prior, 2), rng.integers(0, 2, RUNS), []
    for _ in range(STEPS):
        mode = np.where(rng.uniform(size=RUNS) < p[mode, mode], mode, 1 - mode)
        moved, _, Q = advance(np.stack([x, x], axis=1))
        values, vectors = np.linalg.eigh(Q[np.arange(RUNS), mode])
        x = moved[:, 0] + gaussian.times(vectors * np.sqrt(np.clip(values, 0, None))[:, None], rng.normal(size=x.shape))
        z = x[:, [0, 1, 3]] + rng.normal(size=(RUNS, 3)) * np.sqrt(np.diag(R))
        step = imm.predict(bank, np.log(p), advance, (3,))
        bank = imm.update(step, wrap_at(z[:, None] - step.predicted.mean[..., [0, 1, 3]], (2,)), H, R)[0].filtered
        belief = imm.combined(bank, (3,))
        nees.append(gaussian.mahalanobis(wrap_at(belief.mean - x, (3,)), belief.cov).mean())
    low, high = chi2.ppf([0.0005, 0.9995], 5 * RUNS) / RUNS
    assert low < nees[STEPS // 2] < high
    assert low < nees[-1] < high
    assert np.mean(np.exp(bank.log_mu)[np.arange(RUNS), mode]) > 0.6


def test_the_closed_loops_errors_are_as_large_as_it_says():
    found = simulate(["closed-loop", "central"], runs=RUNS, steps=20)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * RUNS) / RUNS
    assert low < found["closed-loop"][1] < high
    assert found["closed-loop"][0] < 1.02 * found["central"][0]


def test_interacting_models_know_their_error_where_a_target_changes_its_motion():
    rng = np.random.default_rng(6)
    F = motion.constant_velocity(DT)
    Qs = np.stack([motion.constant_velocity_noise(DT, q) for q in (0.02, 4.0)])
    p = np.exp(imm.transition(2, 0.95))
    H, R = np.eye(2, 4), 0.01 * np.eye(2)
    x = 0.5 * rng.normal(size=(RUNS, 4))
    prior = Gaussian(np.zeros((RUNS, 4)), np.broadcast_to(0.25 * np.eye(4), (RUNS, 4, 4)))
    bank, mode = imm.start(prior, 2), rng.integers(0, 2, RUNS)
    roots = np.linalg.cholesky(Qs)
    steps, truth, held = [], [], []
    for _ in range(STEPS):
        mode = np.where(rng.uniform(size=RUNS) < p[mode, mode], mode, 1 - mode)
        x = gaussian.times(F, x) + gaussian.times(roots[mode], rng.normal(size=(RUNS, 4)))
        z = x[:, :2] + 0.1 * rng.normal(size=(RUNS, 2))
        step = imm.predict(bank, np.log(p), lambda x: (gaussian.times(F, x), np.stack([F, F]), Qs))
        step, _ = imm.update(step, z[:, None] - step.predicted.mean[..., :2], H, R)
        bank = step.filtered
        steps.append(step)
        truth.append(x)
        held.append(mode)
    low, high = chi2.ppf([0.0005, 0.9995], 4 * RUNS) / RUNS
    smooth = imm.smooth(steps, np.log(p))
    for banks in ([step.filtered for step in steps], smooth):
        for k in (STEPS // 2, STEPS - 5):
            belief = imm.combined(banks[k])
            assert low < gaussian.mahalanobis(belief.mean - truth[k], belief.cov).mean() < high
    causal = np.mean([np.exp(s.filtered.log_mu)[np.arange(RUNS), m] for s, m in zip(steps, held, strict=True)])
    later = np.mean([np.exp(b.log_mu)[np.arange(RUNS), m] for b, m in zip(smooth, held, strict=True)])
    assert later > causal + 0.02 > 0.6


def test_the_smoothed_rate_tells_when_a_turn_begins(capsys):
    bradshaw.rounded_square(20)
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("smoothed rate"))
    _, _, median, within_4, within_10, _, spurious, rate, _ = row.split()
    assert float(median) <= 2
    assert float(within_4.rstrip("%")) > 95
    assert float(within_10.rstrip("%")) == 100
    assert float(spurious) < 0.5
    assert float(rate) == pytest.approx(np.pi / 4, rel=0.05)


def test_the_ground_predicts_the_gaze_better_than_its_angles_do():
    plane = min(pursuit._gaze_error(pursuit.pursuer_2d(q), 2.7, 0.15, 1, 4) for q in (0.03, 0.3, 3))
    world = pursuit._gaze_error(pursuit.pursuer_3d(0.1), 2.7, 0.15, 1, 4)
    assert world < 0.55 * plane


@pytest.mark.parametrize("sigma", [0.03, 0.1])
def test_interacting_models_beat_each_alone_where_a_walk_turns(sigma):
    kinds = ("imm", "drifting", "cv", "ca", "periodic")
    turning = {kind: jia._walk(kind, True, sigma, 0.01, 10) for kind in kinds}
    straight = {kind: jia._walk(kind, False, sigma, 0.01, 10) for kind in ("imm", "cv")}
    for kind in kinds[1:]:
        assert turning["imm"][0] < turning[kind][0]
        assert turning["imm"][1] < turning[kind][1]
    assert straight["imm"][0] < 1.15 * straight["cv"][0]
    loose = {kind: jia._walk(kind, True, sigma, 1.0, 10)[0] for kind in kinds}
    assert loose["imm"] < 1.1 * min(loose.values())


def test_the_fading_factor_halves_the_heading_error_of_a_hard_manoeuvre():
    sigmas = (0.2, 0.02, 1.0)
    path = lou.drives()
    for name in ("fig 4", "fig 6"):
        error = {kind: lou._drive_errors(path[name], kind, sigmas, 40) for kind in lou.CARS}
        assert error["fading"][0] < 0.5 * error["ekf"][0]
        assert error["fading-cuf"][0] < 0.5 * error["cuf"][0]
        assert error["fading-cuf"][1] < error["fading"][1]
        assert error["fading-cuf"][1] < error["cuf"][1]
    smooth = {kind: lou._drive_errors(path["smooth"], kind, sigmas, 200) for kind in ("ekf", "fading")}
    assert smooth["fading"][0] < 1.08 * smooth["ekf"][0]
    assert smooth["fading"][1] < 1.05 * smooth["ekf"][1]


@pytest.mark.skipif(not real.DATA.is_dir(), reason="the recorded trajectories are not beside this checkout")
@pytest.mark.parametrize("group", ["cars", "cart"])
def test_the_default_filter_sees_a_second_ahead_better_than_constant_velocity(group):
    tracks = list(real.read(real.DATA, group, "others"))
    ours = real.errors(tracks, 0.1, group, FilterSettings())
    furthest = real.errors(tracks, 0.1, group, FilterSettings(kind="imm"))
    plain = real.plain_errors(tracks, 0.1, real.PLAIN_Q[group])
    assert furthest[3] < ours[3] < plain[3]
    assert furthest[3] < 0.9 * plain[3]
