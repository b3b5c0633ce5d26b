"""Boxes that count by how likely they are whose, against the mixture they stand for, and where two people pass."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from samples.detector import passing, write_boxes
from tests.test_gaussian import covariance
from visfuse_cli.fusing.shares import _as_one
from visfuse_cli.maths import gaussian, joint_association
from visfuse_cli.records import Gaussian


def test_the_one_measurement_does_what_all_boxes_do_by_their_shares():
    rng = np.random.default_rng(4)
    H = np.eye(2, 4)
    for _ in range(30):
        prior = Gaussian(rng.normal(size=4), covariance(rng, 4))
        R, share = covariance(rng, 2), 0.9 * rng.dirichlet(np.ones(4))
        spread = prior.cov[:2, :2]
        z = prior.mean[:2] + 0.3 * rng.normal(size=(4, 2)) @ np.linalg.cholesky(spread + R).T
        whole = joint_association.update(
            Gaussian(prior.mean[None], prior.cov[None]), z, H, R, np.append(share, 1 - share.sum())[None]
        )
        residual, noise = _as_one(z - prior.mean[:2], R, spread, share)
        one, _ = gaussian.update(prior, residual, H, noise)
        np.testing.assert_allclose(one.mean, whole.mean[0], atol=1e-9)
        np.testing.assert_allclose(one.cov, whole.cov[0], atol=1e-9)


def test_where_people_pass_each_other_shares_keep_them_apart(tmp_path):
    scene = tmp_path / "scene"
    write_boxes(passing(0), scene, fps=5, missed=0.3, false=2.0)
    lost = {way: _lost_by(scene, tmp_path / way, way) for way in ("one-to-one", "jpda")}
    assert lost["jpda"] < 0.15
    assert lost["jpda"] < lost["one-to-one"] / 2  # which takes one for the other here


def _lost_by(scene: Path, out: Path, way: str) -> float:
    """How far (m) the tracks come from whom they followed at first, at most."""
    command = [sys.executable, "-m", "visfuse_cli", "fuse-cameras", str(scene), "--out", str(out), "--no-report", "-q"]
    told = ["video.fps=5", f"sight.association={way}", "sight.detected=0.7", "sight.false_boxes=2"]
    subprocess.run([*command, *[part for each in told for part in ("--set", each)]], check=True, timeout=120)
    with open(scene / "truth.csv", newline="", encoding="utf-8") as file:
        truth = {(int(r["frame"]), r["id"]): np.array([float(r["x"]), float(r["y"])]) for r in csv.DictReader(file)}
    worst = 0.0
    for track in json.loads((out / "tracks.json").read_text(encoding="utf-8"))["tracks"]:
        places = {state["frame"]: np.array(state["position"][:2]) for state in track["states"]}
        begin = min(places)
        who = min(("1", "2"), key=lambda k: float(np.linalg.norm(truth[begin, k] - places[begin])))
        worst = max(worst, *(float(np.linalg.norm(place - truth[f, who])) for f, place in places.items()))
    return worst
