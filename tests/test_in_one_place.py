"""Of two tracks that stand in one place one is no vehicle: who is kept, who is put out, and what the files say then."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.tracking.association import footprint_overlap, shared_footprint
from visfuse_cli.tracking.places import Places, Stand

CAR = np.array([4.2, 1.8, 1.5])
SURE = SimpleNamespace(speed=10.0, noise=0.1)


def path(identity, aside=0.0, frames=range(100), ahead=0.0, apart=1.0):
    """A car along X at 10 m/s and 25 fps."""
    frame = np.array(frames)
    mean = np.column_stack([0.4 * frame + ahead, np.full(len(frame), aside), np.full(len(frame), 10.0), 0 * frame])
    known = np.ones(len(frame), dtype=bool)
    planar = SimpleNamespace(mean=mean)
    return SimpleNamespace(
        id=identity, frame=frame, t=frame / 25, planar=planar, heading=0.0 * frame, size=CAR, measured=known,
        support=0.9, apart=apart, paint=0.9, size_z=1.0,
    )  # fmt: skip


def test_the_one_for_which_less_speaks_is_kept_out_or_put_out():
    places = Places()
    assert places.take(path(1), SURE) == (None, [])
    assert places.take(path(2, ahead=1.0, apart=0.9), SURE) == (1, [])
    assert places.take(path(3, ahead=0.5, frames=range(150)), SURE) == (None, [1])
    assert places.take(path(4, ahead=1.0), SURE) == (3, [])


def test_one_that_is_kept_out_puts_out_nobody():
    places = Places()
    places.take(path(1, ahead=-2.1, apart=0.8), SURE)
    places.take(path(2, ahead=2.1), SURE)
    assert places.take(path(3, apart=0.9), SURE) == (2, [])
    assert places.take(path(4, ahead=-3.0, apart=0.85), SURE) == (None, [1])


@pytest.mark.parametrize(
    "other",
    [
        path(2, aside=3.0),
        path(2, aside=-1.9),
        path(2, ahead=5.0),
        path(2, frames=range(101, 200)),
        path(2, frames=range(97, 200)),
    ],
    ids=["next lane", "close beside", "behind", "later", "three frames"],
)
def test_neighbours_live_side_by_side(other):
    places = Places()
    places.take(path(1), SURE)
    assert places.take(other, SURE) == (None, [])


def test_a_brief_crossing_is_no_reason():
    a, b = path(1), path(2, aside=8.0)
    b.planar.mean[:, 1] = np.linspace(8, -8, 100)  # through the other one's way
    places = Places()
    places.take(a, SURE)
    assert places.take(b, SURE) == (None, [])


def test_what_nothing_can_meet_any_more_is_forgotten():
    places = Places()
    places.take(path(1), SURE)
    places.forget(99)
    assert places.take(path(2, apart=0.9), SURE) == (1, [])
    places.forget(100)
    assert places.take(path(3, apart=0.9), SURE) == (None, [])


def test_predictions_are_no_stand():
    seen = path(1)
    seen.measured[10:] = False
    assert list(Stand.of(seen, SURE).frame) == list(range(10))


def test_footprints_each_are_the_pairs_of_all():
    rng = np.random.default_rng(1)
    pose, other = rng.normal(0, 2, (6, 3)), rng.normal(0, 2, (6, 3))
    size, others = rng.uniform(1, 6, (6, 3)), rng.uniform(1, 6, (6, 3))
    every = footprint_overlap(pose, size, other, others)
    assert every.shape == (6, 6)
    np.testing.assert_array_equal(shared_footprint(pose, size, other, others), every.diagonal())
    np.testing.assert_array_equal(footprint_overlap(other, others, pose, size), every.T)


def test_a_summary_may_be_amended_and_the_states_stay(tmp_path):
    with TrackSpool(tmp_path, "speed", 0, "ground") as spool:
        for identity in (2, 1):
            states = [{"t": 0.5 * identity, "covariance": [[1.0]]}]
            spool.add({"id": identity, "summary": {"speed": 3.0, "rejected": None}, "states": states})
        spool.amend(2, rejected="in the place of track 1")
        spool.add({"id": 3, "summary": {"rejected": None}, "states": []})
        assert spool.read(2)["summary"] == {"speed": 3.0, "rejected": "in the place of track 1"}
    tracks = json.loads((tmp_path / "tracks.json").read_text())["tracks"]
    assert [track["id"] for track in tracks] == [1, 2, 3]
    assert [track["summary"]["rejected"] for track in tracks] == [None, "in the place of track 1", None]
    assert tracks[1]["states"] == [{"t": 1.0, "covariance": [[1.0]]}]
