"""Settled poses of several tracks are filtered in step: to each the same as if it had been alone."""

import numpy as np
import pytest

from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking.refilter import Poses, filter_again
from visfuse_cli.tracking.settings import FilterSettings, TargetSettings, TrackerSettings


def poses(dynamics, seed, frames):
    """A vehicle on a bend, measured in most of its frames, once far off, and with a noise of its own."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / 25
    heading = 0.3 * seed + 0.2 * t
    way = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0) * (5 + 2 * seed) / 25
    seen = np.column_stack([way, heading]) + rng.normal(0, 0.1, (frames, 3)) * [1 + seed, 1, 0.2]
    seen[frames // 2, 0] += 4
    noise = np.diag([0.1, 0.1, 0.02]) ** 2
    measured = [dynamics.measured(z, noise) if k % 7 else None for k, z in enumerate(seen)]
    velocity = (way[10] - way[0]) / (t[10] - t[0])
    return Poses(t, measured, dynamics.begin(seen[0], velocity), 4.0 + seed)


@pytest.mark.parametrize("motion", ["bicycle", "constant-velocity"])
@pytest.mark.parametrize("kind", ["fading", "ekf", "cuf", "fading-cuf", "imm"])
def test_tracks_in_step_are_filtered_as_each_alone(kind, motion):
    settings = TrackerSettings(filter=FilterSettings(kind=kind), target=TargetSettings(motion=motion))
    dynamics = dynamics_tools.for_target(settings.target, settings.filter)
    tracks = [poses(dynamics, seed, frames) for seed, frames in ((0, 40), (1, 25), (2, 33))]
    for together, track in zip(filter_again(tracks, settings, dynamics), tracks, strict=True):
        (alone,) = filter_again([track], settings, dynamics)
        assert len(together.steps) == len(track.t)
        assert together.trusted.tolist() == alone.trusted.tolist()
        assert 0 < together.trusted.sum() < len(track.t)
        assert together.noise == pytest.approx(alone.noise, rel=1e-6)
        for ours, theirs in zip(together.steps, alone.steps, strict=True):
            np.testing.assert_allclose(ours.posterior.mean, theirs.posterior.mean, rtol=1e-6, atol=1e-8)
            np.testing.assert_allclose(ours.posterior.cov, theirs.posterior.cov, rtol=1e-5, atol=1e-9)
        ours, theirs = (dynamics_tools.smooth(dynamics, each.steps).mean for each in (together, alone))
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["fading", "ekf"])
def test_a_track_that_began_on_something_else_finds_its_vehicle(kind):
    settings = TrackerSettings(filter=FilterSettings(kind=kind))
    dynamics = dynamics_tools.for_target(settings.target, settings.filter)
    t, rng = np.arange(110) / 25, np.random.default_rng(4)
    vehicle = np.column_stack([18 * t, np.zeros(110), np.zeros(110)]) + rng.normal(0, 0.05, (110, 3)) * [1, 1, 0.2]
    elsewhere = vehicle + np.where(t[:, None] < 1.2, [-9.0, 2.5, 0.0], 0.0)
    noise = np.diag([0.05, 0.05, 0.02]) ** 2
    start = dynamics.begin(elsewhere[0], np.array([18.0, 0.0]))
    (found,) = filter_again(
        [Poses(t, [dynamics.measured(z, noise) for z in elsewhere], start, 4.4)], settings, dynamics
    )
    assert found.trusted[-60:].all()
    smoothed = dynamics_tools.smooth(dynamics, found.steps).mean
    np.testing.assert_allclose(smoothed[-50:, :2], np.column_stack([18 * t, 0 * t])[-50:], atol=0.15)


@pytest.mark.parametrize("kind", ["fading", "imm"])
def test_measurements_of_several_targets_are_taken_in_as_one_by_one(kind):
    target = TargetSettings()
    dynamics = dynamics_tools.for_target(target, FilterSettings(kind=kind))
    for count in (1, 2, 3, 4):  # as many as there are models, and others
        tracks = [poses(dynamics, seed, 20) for seed in range(count)]
        before = [dynamics_tools.first(dynamics, track.start) for track in tracks]
        ahead = dynamics_tools.predict(dynamics, before, np.full(count, 0.04), np.full(count, 4.0))
        z, R = (np.array([track.measured[1][k] for track in tracks]) for k in (0, 1))
        for k, step in enumerate(dynamics_tools.take_each(dynamics, ahead, z, R)):
            alone = dynamics_tools.take(dynamics, ahead[k], z[k], R[k])
            np.testing.assert_allclose(step.posterior.mean, alone.posterior.mean, rtol=1e-9, atol=1e-10)
            np.testing.assert_allclose(step.posterior.cov, alone.posterior.cov, rtol=1e-9, atol=1e-12)
