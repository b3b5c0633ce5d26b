"""The recipe of docs/stereo-calibration.md, run as it is printed, on rendered pictures of a chessboard."""

import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

from visfuse_cli.files.stereo_calibration import read_rig

PAGE = Path(__file__).parents[1] / "docs" / "stereo-calibration.md"
K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
R = cv2.Rodrigues(np.array([0.01, 0.02, -0.005]))[0]
T = np.array([-0.12, 0.002, 0.001])


def board(turn, shift):
    """Left and right pictures (480, 640) of a board of 10 x 7 squares of 25 mm."""
    squares = np.kron(np.indices((7, 10)).sum(axis=0) % 2, np.ones((40, 40))) * 190 + 30
    sheet = np.pad(squares, 40, constant_values=235).astype(np.uint8)
    turned = cv2.Rodrigues(np.array(turn))[0]
    metres = np.diag([0.025 / 40, 0.025 / 40, 1]) @ np.array([[1, 0, -80 + 0.5], [0, 1, -80 + 0.5], [0, 0, 1.0]])
    views = []
    for rotation, move in ((np.eye(3), np.zeros(3)), (R, T)):
        place = np.column_stack([(rotation @ turned)[:, :2], rotation @ np.array(shift) + move])
        H = K @ place @ metres
        views.append(cv2.warpPerspective(sheet, H, (640, 480), flags=cv2.INTER_AREA, borderValue=120))
    return views


def test_the_recipe_gives_a_calibration_that_is_read(tmp_path):
    poses = np.random.default_rng(4)
    for k in range(10):
        turn = poses.uniform(-0.5, 0.5, 3)
        place = [poses.uniform(-0.12, 0), poses.uniform(-0.1, -0.02), poses.uniform(0.45, 0.65)]
        for view, picture in zip(("left", "right"), board(turn, place), strict=True):
            cv2.imwrite(str(tmp_path / f"{view}-{k:02}.png"), picture)
    script = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)[1]
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    rig = read_rig(tmp_path / "calibration.yaml")
    assert abs(rig.baseline - np.linalg.norm(T)) < 0.001
    assert abs(rig.left.K[0, 0] - 600) < 6
    assert np.degrees(np.linalg.norm(cv2.Rodrigues(rig.R @ R.T)[0])) < 0.2
