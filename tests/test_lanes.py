"""Lanes: found from where vehicles drive, kept in a file, and given to those that keep to one."""

import subprocess
import sys

import numpy as np
import pytest

from samples.files import write_scene
from samples.road import free_flow
from samples.score import rows
from visfuse_cli.commands.speed import SpeedConfig
from visfuse_cli.config import load
from visfuse_cli.errors import InputError, OutputError
from visfuse_cli.files.lanes_file import read_lanes, write_lanes
from visfuse_cli.tracking.lanes import LaneSettings, Way, find_lanes, lane_of, thinned

SQUARES = (((0.0, 0.0), (3.5, 0.0), (3.5, 50.0), (0.0, 50.0)), ((3.5, 0.0), (7.0, 0.0), (7.0, 50.0), (3.5, 50.0)))


def road(s, offset, bend=0.0):
    """Positions (n, 2) along s m of a road that bends to the left, `offset` m to the right of its middle."""
    angle = bend * s
    middle = np.column_stack([np.where(bend, (1 - np.cos(angle)) / -(bend or 1), 0), np.sin(angle) / (bend or 1)])
    middle = middle if bend else np.column_stack([np.zeros_like(s), s])
    return middle + np.reshape(offset, (-1, 1)) * np.column_stack([np.cos(angle), np.sin(angle)])


def traffic(bend=0.0, per_lane=6, seed=1, turn=0.0):
    rng = np.random.default_rng(seed)
    lanes, ways = [], []
    for number, (middle, back) in enumerate([(-5.2, True), (-1.75, True), (1.75, False), (5.2, False)]):
        for _ in range(per_lane):
            s = np.linspace(rng.uniform(0, 8), rng.uniform(50, 60), 40)
            way = road(s, middle + rng.normal(0, 0.25) + 0.1 * np.sin(s / 9 + rng.uniform(0, 6)), bend)
            c, sn = np.cos(turn), np.sin(turn)
            way = way @ np.array([[c, sn], [-sn, c]]) + [844000, 5673100]
            ways.append(thinned(way[::-1] if back else way))
            lanes.append(number + 1)
    return ways, lanes


@pytest.mark.parametrize("bend", [0.0, 0.006])
@pytest.mark.parametrize("turn", [0.0, 2.3])
def test_lanes_are_found_and_numbered_from_the_left_of_the_picture(bend, turn):
    ways, truth = traffic(bend, turn=turn)
    c, s = np.cos(turn), np.sin(turn)
    found = find_lanes(ways, LaneSettings(), lambda p: (p - [844000, 5673100]) @ np.array([[c, -s], [s, c]]))
    assert len(found) == 4
    assert [lane_of(way, found) for way in ways] == truth
    again = find_lanes(ways[::-1], LaneSettings(), lambda p: (p - [844000, 5673100]) @ np.array([[c, -s], [s, c]]))
    assert [lane_of(way, again) for way in ways] == truth


def test_few_vehicles_tell_of_no_lane():
    ways, _ = traffic(per_lane=1)
    assert find_lanes(ways, LaneSettings(), lambda p: p) == ()
    assert find_lanes([], LaneSettings(vehicles=2), lambda p: p) == ()


def test_a_lane_is_that_of_most_of_the_way_and_none_on_the_line():
    s = np.linspace(0, 50, 40)

    def driven(x):
        return thinned(np.column_stack([np.broadcast_to(x, s.shape), s]))

    assert lane_of(driven(1.7), SQUARES) == 1
    assert lane_of(driven(5.0), SQUARES) == 2
    assert lane_of(driven(9.0), SQUARES) is None
    assert lane_of(driven(np.where(s < 38, 1.7, 5.0)), SQUARES) == 1  # changes late
    assert lane_of(driven(1.5 + s / 12.5), SQUARES) is None  # changes halfway
    assert lane_of(driven(3.5 + 0.3 * np.sin(s)), SQUARES) is None  # straddles
    assert lane_of(Way(driven(1.7).position * [1, 9]), SQUARES) == 1  # a lane may be short
    assert lane_of(driven(1.7), ()) is None


def test_a_file_of_lanes_is_read_as_it_was_written(tmp_path):
    write_lanes(tmp_path / "lanes.yaml", SQUARES)
    assert read_lanes(tmp_path / "lanes.yaml") == SQUARES
    assert read_lanes(tmp_path / "later.yaml") is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "key lanes"),
        ("lanes: []", "lanes"),
        ("lanes: [[[0, 0], [1, 1]]]", "lane 1 has 2 corners"),
        ("lanes: [[[0, 0], [1, 1], [2, 2]]]", "one line"),
        ("lanes: [[[0, 0], [1, x], [2, 2]]]", "lanes.0.1.1"),
        ("lanes: {", "not valid YAML"),
        ("paths: []", "key lanes"),
    ],
)
def test_what_holds_no_lanes_is_refused(tmp_path, text, message):
    (tmp_path / "lanes.yaml").write_text(text)
    with pytest.raises(InputError, match=message):
        read_lanes(tmp_path / "lanes.yaml")


def test_a_file_that_could_never_be_written_is_told_at_once(tmp_path):
    with pytest.raises(OutputError, match="no folder"):
        read_lanes(tmp_path / "nowhere" / "lanes.yaml")


def test_lanes_are_found_once_and_used_again(tmp_path):
    write_scene(free_flow(4, 6, size=(640, 360)), tmp_path)

    def visfuse(*args):
        done = subprocess.run([sys.executable, "-m", "visfuse_cli", *map(str, args)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done

    visfuse("calibrate-homography", "--points", tmp_path / "points.csv", "--out", tmp_path / "H.json")
    site = tmp_path / "site.yaml"
    options = ("speed", tmp_path / "clip.mp4", "--homography", tmp_path / "H.json", "--no-report", "--set")
    few = ("--set", "lane_finding.vehicles=5", "--set", "lane_finding.least_vehicles=2")
    visfuse(*options, f"lanes_file={site}", *few, "--no-video", "--out", tmp_path / "first")
    first = rows(tmp_path / "first" / "speeds.csv")
    assert {row["lane"] for row in first} - {""}
    assert site.read_bytes() == (tmp_path / "first" / "lanes.yaml").read_bytes()
    visfuse(*options, f"lanes_file={site}", "--end", "1", "--out", tmp_path / "second")
    assert site.read_bytes() == (tmp_path / "second" / "lanes.yaml").read_bytes()
    assert load(SpeedConfig, str(site)).lanes == read_lanes(site)
