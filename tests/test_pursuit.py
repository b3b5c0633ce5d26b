"""Who is followed, lost, away, known again and forgotten, and which of two targets is one too many."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from samples.head import room
from visfuse_cli.gazing import conclude, find
from visfuse_cli.gazing.target import BELIEVED, SEEN
from visfuse_cli.maths.kept import Rows
from visfuse_cli.moving.pursuit import Pursuit
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.moving.tracker import TWINS_S, Tracker
from visfuse_cli.records import Gaussian, GivenTarget, Lens, StereoRig

SIZE = (100, 80)


@dataclass(eq=False)
class Thing:
    id: int
    box: np.ndarray | None
    depth: float = 5.0
    given: bool = False
    last_seen: float = 0.0
    measured: bool = True
    ended_by: str = ""
    size: np.ndarray = field(default_factory=lambda: np.ones(2))
    colours: np.ndarray = field(default_factory=lambda: np.zeros(3))
    earlier: object = None
    hidden: float = 0.0


class Things(Pursuit):
    unbegun = "is a ghost"

    def _expect(self, target, view):
        return target

    def _seek(self, target, view, where, hidden):
        target.hidden, target.measured = hidden, hidden < 0.2

    def _named(self, identity, given, view):
        return None if given.speed else Thing(identity, np.array([10.0, 10, 8, 8]), given=True, last_seen=view.t)

    def _again(self, target, view, found):
        return np.zeros((4, 2)) if found == target.id else None


def things(*followed, **life):
    own = Things(ImmConfig(life={"max_coast_s": 1.0, "memory_s": 5.0} | life), SIZE, [])
    own._followed = list(followed)
    return own


def at(x, w=10.0):
    return np.array([x, 20.0, w, 20.0])


def test_what_stands_behind_a_nearer_one_is_hidden_and_hides_nobody_itself():
    near, behind, third = Thing(1, at(10), 3.0), Thing(2, at(14), 4.0), Thing(3, at(19), 5.0)
    things(third, behind, near)._follow(SimpleNamespace(frame=0, t=0.0))
    assert (near.hidden, behind.hidden) == (0.0, pytest.approx(0.6))
    assert third.hidden == pytest.approx(0.1)  # by the nearest alone: where the second is, is a guess


def test_who_is_lost_or_leaves_is_remembered_for_a_time():
    lost, left, stays = (
        Thing(1, at(10), last_seen=0.0),
        Thing(2, at(97), last_seen=2.0),
        Thing(3, at(40), last_seen=2.0),
    )
    own = things(lost, left, stays)
    own._part(2.0)
    assert (lost.ended_by, left.ended_by, stays.ended_by) == ("lost", "left", "")
    assert own._followed == [stays]
    assert own._forgotten(4.9) == []
    assert own._forgotten(5.5) == [lost]
    assert own._gone == [left]
    assert set(map(id, own.finish())) == {id(left), id(stays)}
    assert stays.ended_by == "end of footage"


def test_who_comes_back_keeps_its_number_its_size_and_its_looks():
    old = Thing(7, at(10), size=np.array([0.5, 1.7]), colours=np.full(3, 9.0), ended_by="left")
    own = things()
    own._gone, own._next_id = [old], 8
    view = SimpleNamespace(frame=9, t=3.0)
    assert own._known(view, 5) == (None, None)
    found, quad = own._known(view, 7)
    assert found is old
    assert quad.shape == (4, 2)
    new = Thing(old.id, at(30))
    own._take(new, old)
    assert own._followed == [new]
    assert own._gone == []
    assert (new.id, own._next_id) == (7, 8)
    assert new.earlier is old
    np.testing.assert_array_equal(new.size, old.size)
    np.testing.assert_array_equal(new.colours, old.colours)
    own._take(Thing(8, at(50)), None)
    assert own._next_id == 9


def test_named_targets_are_alone_unless_one_is_away_and_what_fails_is_told():
    quad = np.zeros((4, 2))
    given = [GivenTarget(0, quad, None, None), GivenTarget(0, quad, None, 3.0), GivenTarget(50, quad, None, None)]
    own = Things(ImmConfig(), SIZE, given)
    own._begin_given(SimpleNamespace(frame=0, t=0.0))
    assert [each.id for each in own._followed] == [1]
    assert own.missed == ["target 2 of init.yaml is a ghost at frame 0"]
    assert not own._wanted(0.1)
    assert own._wanted(0.6)  # it was not seen for a while
    own.finish()
    assert own.missed[1] == "target 3 of init.yaml begins at frame 50, which the footage does not have"


def test_two_targets_in_one_place_that_go_alike_are_one_and_the_older_stays():
    scene = room(0)
    lens = Lens(scene.K, np.zeros(5))
    tracker = Tracker(StereoRig(lens, lens, *scene.right_from_left, None), ImmConfig(), scene.size, [], None)

    def follow(x, vx):
        mean = np.array([x, 0, 4, vx, 0, 0, *np.zeros(6)])
        return SimpleNamespace(box=at(100 * x + 30), belief=Gaussian(mean, np.eye(12)), alone_at=0.0, given=False)

    older, twin, walker = follow(0.0, 0.5), follow(0.05, 0.5), follow(0.05, -0.5)
    tracker._followed = [older, twin, walker]
    assert not any(tracker._twin(each, TWINS_S / 2) for each in tracker._followed)  # one may pass the other
    assert [tracker._twin(each, 1.1 * TWINS_S) for each in tracker._followed] == [False, True, False]
    twin.given = True
    assert not tracker._twin(twin, 2 * TWINS_S)


def test_what_was_first_seen_in_part_gives_way_to_the_whole():
    held = np.array([10.0, 30, 30, 50])
    assert find._outgrows(np.array([9.0, 10, 31, 52]), held, find.WIDER)
    assert not find._outgrows(np.array([9.0, 29, 31, 52]), held, find.WIDER)  # as large as it
    assert not find._outgrows(np.array([9.0, 10, 61, 52]), held, find.WIDER)  # two side by side
    assert not find._outgrows(np.array([22.0, 10, 42, 52]), held, find.WIDER)  # somebody else


def test_what_the_side_of_the_picture_cut_off_may_turn_out_far_wider():
    cut, free = (np.array([[x, 30.0], [x + 16, 30], [x + 16, 90], [x, 90]]) for x in (10, 40))
    assert find.may_be_wider(cut, 100) == find.may_be_wider(100 - cut, 100) == find.UNCUT
    assert find.may_be_wider(free, 100) == find.WIDER
    part, whole = np.array([10.0, 30, 26, 90]), np.array([2.0, 30, 30, 92])
    assert find._outgrows(whole, part, find.UNCUT)
    assert not find._outgrows(whole, part, find.WIDER)


def test_a_gaze_that_passes_the_half_turn_is_predicted_as_any_other():
    t = np.arange(0, 4, 0.04)
    places = np.column_stack([1.5 * (t - 2), np.full_like(t, -10.0)])  # behind, from one side to the other
    later = places + 0.2 * np.array([1.5, 0.0])
    target = SimpleNamespace(
        config=SimpleNamespace(latency=0.2),
        seen=Rows(SEEN),
        believed=Rows(BELIEVED),
        head=SimpleNamespace(centre=np.array([0.0, 0.0, 4.0])),
        height=0.9,
    )
    for k, now in enumerate(t):
        target.seen.append(k, now, np.zeros(4), [*places[k], 1.5, 0.0])
        target.believed.append(np.nan, later[k])
    plane, ground = conclude.prediction_errors(target)
    assert ground < 1e-5
    assert ground < plane < 5e-3
