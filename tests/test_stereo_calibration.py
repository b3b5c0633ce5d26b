"""Scene folders and the calibration of a stereo pair: what is accepted, and what every refusal says."""

from pathlib import Path

import numpy as np
import pytest

from visfuse_cli.errors import InputError
from visfuse_cli.files import scene
from visfuse_cli.files.stereo_calibration import read_rig

pytestmark = pytest.mark.geometry


def _matrix(name: str, values: list[float], cols: int) -> str:
    rows = len(values) // cols
    data = ", ".join(map(str, values)).replace("nan", ".Nan")
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [{data}]\n"


MATRICES = {
    "M1": ([700.0, 0, 640, 0, 710, 360, 0, 0, 1], 3),
    "D1": ([-0.3, 0.1, 0, 0, 0], 5),
    "M2": ([705.0, 0, 630, 0, 706, 350, 0, 0, 1], 3),
    "D2": ([-0.2, 0.1, 0, 0, 0], 5),
    "R": ([0.8, 0.0, 0.6, 0, 1, 0, -0.6, 0, 0.8], 3),
    "T": ([-0.5, 0.01, 0.02], 1),
}
KITTI = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -350 0 700 180 0 0 0 1 0\nTr: 1 2 3\n"


def _opencv(**changed: tuple[list[float], int] | None) -> str:
    entries = {name: value for name, value in (MATRICES | changed).items() if value is not None}
    return "%YAML:1.0\n---\n" + "".join(_matrix(name, *value) for name, value in entries.items())


def _write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "calibration.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_opencv_rig_is_read(tmp_path: Path):
    rig = read_rig(_write(tmp_path, _opencv()))
    np.testing.assert_allclose(rig.R, np.reshape(MATRICES["R"][0], (3, 3)), atol=1e-12)
    np.testing.assert_array_equal(rig.T, MATRICES["T"][0])
    np.testing.assert_array_equal(rig.right.K, np.reshape(MATRICES["M2"][0], (3, 3)))
    assert rig.image_size is None
    assert rig.baseline == pytest.approx(np.linalg.norm(MATRICES["T"][0]))


def test_rotation_vector_is_read(tmp_path: Path):
    rig = read_rig(_write(tmp_path, _opencv(R=([0, np.pi / 2, 0], 1))))
    np.testing.assert_allclose(rig.R, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "baseline", "size"),
    [
        (KITTI, 0.5, None),
        (
            KITTI + "P2: 800 0 600 40 0 800 180 0 0 0 1 0\nP3: 800 0 600 -360 0 800 180 0 0 0 1 0\n",
            0.5,
            None,
        ),
        (
            "S_rect_02: 1242 375\nP_rect_02: 800 0 600 40 0 800 180 0 0 0 1 0\n"
            "P_rect_03: 800 0 600 -360 0 800 180 0 0 0 1 0\n",
            0.5,
            (1242, 375),
        ),
    ],
)
def test_kitti_rig_is_read(tmp_path: Path, text: str, baseline: float, size: tuple[int, int] | None):
    rig = read_rig(_write(tmp_path, text))
    np.testing.assert_allclose(rig.T, [-baseline, 0, 0])
    np.testing.assert_array_equal(rig.R, np.eye(3))
    assert rig.image_size == size


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (_opencv(T=None), "T missing; a stereo calibration has M1 D1 M2 D2 R T"),
        (_opencv(T=([0, 0, 0], 1)), "the cameras are 0 m apart; T is in metres"),
        (_opencv(T=([np.nan, 0, 0], 1)), "T must be three finite numbers"),
        (_opencv(R=([1, 0, 0, 0, 1, 0, 0, 0, -1], 3)), "R is no rotation"),
        (_opencv(R=([2, 0, 0, 0, 1, 0, 0, 0, 1], 3)), "R is no rotation"),
        (_opencv(M2=([0, 0, 640, 0, 710, 360, 0, 0, 1], 3)), "M2 is not a camera matrix"),
        (_opencv(D2=([0, 0, 0], 3)), "D2 must be"),
        ("hello: world\n", "neither an OpenCV calibration"),
        (KITTI.replace("-350", "x"), "line 2: P1 holds something that is no number"),
        (KITTI.replace("P1: 700", "P1: 700 1"), "P1 is not a projection"),
        ("%YAML:1.0\n---\nM1: [", "not a readable OpenCV calibration file|missing"),
    ],
)
def test_a_wrong_rig_is_refused(tmp_path: Path, text: str, message: str):
    with pytest.raises(InputError, match=message):
        read_rig(_write(tmp_path, text))


def test_views_are_found_by_name(tmp_path: Path):
    (tmp_path / "left.mp4").write_bytes(b"x")
    (tmp_path / "right").mkdir()
    (tmp_path / "left.txt").write_text("no view")
    assert scene.view(tmp_path, "left").name == "left.mp4"
    assert scene.view(tmp_path, "right").name == "right"
    assert scene.find_view(tmp_path, "third") is None
    with pytest.raises(InputError, match=r"has no view 'third': neither a video third\.\* nor an image folder third/"):
        scene.view(tmp_path, "third")
    (tmp_path / "left").mkdir()
    with pytest.raises(InputError, match=r"view 'left' is there twice, as left and left\.mp4; keep one"):
        scene.view(tmp_path, "left")


def test_scene_files_are_found_in_order(tmp_path: Path):
    with pytest.raises(InputError, match=r"has no calibration; expected calibration\.yaml or calib\.txt"):
        scene.file(tmp_path, ("calibration.yaml", "calib.txt"), "calibration")
    (tmp_path / "calib.txt").write_text("")
    assert scene.file(tmp_path, ("calibration.yaml", "calib.txt"), "calibration").name == "calib.txt"
    with pytest.raises(InputError, match="not a scene folder"):
        scene.check_scene(tmp_path / "calib.txt")
