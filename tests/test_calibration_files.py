"""Calibration files in and out: what is accepted, and what every refusal says; the lens model both ways."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from visfuse_cli.errors import InputError
from visfuse_cli.files import homography as homography_files
from visfuse_cli.files.calibration_input import read_gaze, read_lines, read_points
from visfuse_cli.files.lens_files import read_lens
from visfuse_cli.maths.homography_fit import fit_points
from visfuse_cli.records import GroundMap, Lens
from visfuse_cli.vision.lens import distort_points, undistort_points

pytestmark = pytest.mark.geometry

ROWS = "u,v,X,Y\n1,2,3,4\n5,6,7,8\n"
K = np.array([[900.0, 0, 640], [0, 910, 360], [0, 0, 1]])
YAML = """%YAML:1.0
---
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 900., 0., 640., 0., 910., 360., 0., 0., 1. ]
D1: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.3, 0.1, 0., 0., 0. ]
"""
SIZED = YAML.replace("---\n", "---\nimage_width: 1280\nimage_height: 720\n")


@pytest.mark.parametrize(
    "text",
    [
        ROWS,
        "\ufeff" + ROWS,
        ROWS.replace("\n", "\r\n"),
        ROWS.rstrip("\n"),
        " u , v,X ,Y\n\n# a comment, with a comma\n 1 ,2, 3,4\n  # more\n5,6,7,8\n\n",
        "name,Y,X,v,u\na,4,3,2,1\nb,8,7,6,5\n",
        '"u","v","X","Y"\n"1","2","3","4"\n5.0,+6,.7e1,8.\n',
    ],
)
def test_points_are_read(tmp_path: Path, text: str):
    path = tmp_path / "points.csv"
    path.write_text(text, encoding="utf-8", newline="")
    image, world = read_points(path)
    np.testing.assert_array_equal(np.hstack([image, world]), [[1, 2, 3, 4], [5, 6, 7, 8]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("# nothing\n\n", "is empty"),
        ("u,v,X,Y\n", "has a header and no rows"),
        ("u,v,X\n1,2,3\n", "line 1: column Y is missing; the header is u,v,X,Y"),
        ("1,2,3,4\n5,6,7,8\n", "line 1: column u is missing"),
        ("\nu;v;X;Y\n1;2;3;4\n", "line 2: column u is missing"),
        ("u,u,v,X,Y\n1,1,2,3,4\n", "line 1: column u is given twice"),
        (ROWS.replace("5", "nan"), "line 3, column u: nan is not a finite number"),
        (ROWS.replace("8", "-inf"), "line 3, column Y: -inf is not a finite number"),
        (ROWS.replace("5", "1e400"), "line 3, column u: 1e400 is not a finite number"),
        (ROWS.replace("5", "1e12"), "line 3, column u: 1e12 is beyond 1e\\+09"),
        (ROWS.replace("6", "six"), "line 3, column v: 'six' is not a number"),
        (ROWS.replace("6", ""), "line 3, column v: '' is not a number"),
        (ROWS.replace("6", "0x6"), "line 3, column v: '0x6' is not a number"),
        (ROWS.replace("6", "1_0"), "line 3, column v: '1_0' is not a number"),
        (ROWS + "1,2,3\n", "line 4: 3 columns where the header has 4"),
        (ROWS + "\n1,2,3,4,5\n", "line 5: 5 columns where the header has 4"),
        (ROWS + 'a"\n', "line 4: 1 columns where the header has 4"),
        ("u,v,X,Y\n" + "1" * 200_000 + ",2,3,4\n", "line 2: field larger than field limit"),
        (ROWS + "\0", "not a text file"),
        (ROWS * 60_000, "larger than 1000000 bytes"),
    ],
)
def test_points_are_refused_by_line_and_column(tmp_path: Path, text: str, message: str):
    path = tmp_path / "points.csv"
    path.write_text(text, encoding="utf-8", newline="")
    with pytest.raises(InputError, match=message) as refusal:
        read_points(path)
    assert "points.csv" in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < len(str(path)) + 160


def test_what_is_no_text_or_no_file_is_refused(tmp_path: Path):
    binary = tmp_path / "points.csv"
    binary.write_bytes(bytes(range(256)))
    for path, message in ((binary, "not a text file"), (tmp_path, "cannot be read"), (tmp_path / "no", "No such file")):
        for reader in (read_points, read_lines, read_gaze):
            with pytest.raises(InputError, match=message):
                reader(path)


def test_lines_and_gaze_are_read(tmp_path: Path):
    path = tmp_path / "table.csv"
    path.write_text("u1,v1,u2,v2,X1,Y1,X2,Y2\n1,2,3,4,5,6,7,8\n")
    image, world = read_lines(path)
    np.testing.assert_array_equal(np.hstack([image, world]), [np.arange(1, 9)])
    path.write_text("vergence,elevation,X,Y\n0.1,-0.2,3,4\n")
    angles, world = read_gaze(path)
    np.testing.assert_array_equal(np.hstack([angles, world]), [[-0.2, 0.1, 3, 4]])


def test_degrees_are_noticed(tmp_path: Path):
    path = tmp_path / "gaze.csv"
    path.write_text("elevation,vergence,X,Y\n-0.2,0.1,3,4\n-12,30,3,4\n")
    with pytest.raises(InputError, match="line 3, column elevation: -12 rad does not look forward; degrees"):
        read_gaze(path)


@pytest.fixture
def ground() -> GroundMap:
    world = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [0.3, 0.6]])
    fit = fit_points(world * [900, 500] + [100, 50], world)
    residuals = ({"index": 0, "error_m": 0.0, "error_px": 0.0, "leave_one_out_m": None, "used": True},)
    lens = Lens(K, np.array([-0.3, 0.1, 0, 0, 0]))
    return GroundMap(fit.H, fit.cov, fit.ground_sign, "pixel", (1280, 720), lens, 0.1, 0.2, residuals, "points.csv")


@pytest.mark.parametrize("bare", [False, True])
def test_a_ground_map_comes_back_as_written(tmp_path: Path, ground: GroundMap, bare: bool):
    if bare:
        ground = replace(ground, input="gaze", image_size=None, lens=None, residuals=(), source="")
    path = tmp_path / "H.json"
    homography_files.write(path, ground)
    back = homography_files.read(path)
    np.testing.assert_array_equal(back.ground_from_image, ground.ground_from_image)
    np.testing.assert_allclose(back.cov, ground.cov, rtol=1e-15)
    for name in ("ground_sign", "input", "image_size", "rms_m", "rms_px", "residuals", "source"):
        assert getattr(back, name) == getattr(ground, name)
    if bare:
        assert back.lens is None
    else:
        np.testing.assert_array_equal(back.lens.K, ground.lens.K)
        np.testing.assert_array_equal(back.lens.D, ground.lens.D)


@pytest.mark.parametrize("prefix", ["", "\ufeff"])
def test_more_keys_and_fewer_optional_ones_are_accepted(tmp_path: Path, ground: GroundMap, prefix: str):
    path = tmp_path / "H.json"
    homography_files.write(path, ground)
    document = json.loads(path.read_text())
    for key in ("residuals", "source", "lens", "image_size"):
        del document[key]
    path.write_text(prefix + json.dumps(document | {"note": "surveyed by hand"}), encoding="utf-8")
    back = homography_files.read(path)
    assert (back.residuals, back.source, back.lens, back.image_size) == ((), "", None, None)


NAN, EYE = float("nan"), np.eye(3).tolist()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": "visfuse.homography/2"}, '"schema" must be "visfuse.homography/1"'),
        ({"H": [[1, 2], [3]]}, '"H" must be 3x3 finite numbers'),
        ({"H": [[NAN] * 3] * 3}, '"H" must be 3x3 finite numbers'),
        ({"H": [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]]}, '"H" must be 3x3 finite numbers'),
        ({"H": [[10**400, 0, 0], [0, 1, 0], [0, 0, 1]]}, '"H" must be 3x3 finite numbers'),
        ({"H": [[1, 2, 3], [2, 4, 6], [0, 0, 1]]}, '"H" is singular'),
        ({"H": [[0, 0, 0]] * 3}, '"H" is singular'),
        ({"covariance": [[0] * 8] * 8}, '"covariance" must be 9x9 finite numbers'),
        ({"covariance": (-np.eye(9)).tolist()}, '"covariance" is no covariance'),
        ({"covariance": np.triu(np.ones((9, 9))).tolist()}, '"covariance" is no covariance'),
        ({"image_size": [1280]}, '"image_size" must be'),
        ({"image_size": [1280.5, 720]}, '"image_size" must be'),
        ({"image_size": [0, 720]}, '"image_size" must be'),
        ({"image_size": [True, True]}, '"image_size" must be'),
        ({"image_size": "1280x720"}, '"image_size" must be'),
        ({"input": "angles"}, '"input" is \'angles\'; it must be "pixel" or "gaze"'),
        ({"ground_sign": 0}, '"ground_sign" is 0; it must be 1 or -1'),
        ({"ground_sign": True}, '"ground_sign" is True; it must be 1 or -1'),
        ({"lens": []}, '"lens" must be'),
        ({"lens": {"D": [0] * 4}}, '"K" is missing'),
        ({"lens": {"K": EYE, "D": [0]}}, '"lens.D" must be a list of 4, 5, 8, 12, 14 coefficients'),
        ({"lens": {"K": [[1, 5, 0], [0, 1, 0], [0, 0, 1]], "D": [0] * 4}}, '"lens.K" is not a camera matrix'),
        ({"rms_m": None}, '"rms_m" must be a finite number'),
        ({"residuals": "none"}, '"residuals" must be a list of objects'),
    ],
)
def test_a_wrong_ground_map_is_refused_by_key(tmp_path: Path, ground: GroundMap, change: dict, message: str):
    path = tmp_path / "H.json"
    homography_files.write(path, ground)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=message) as refusal:
        homography_files.read(path)
    assert str(refusal.value).startswith(str(path))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("key", ["schema", "input", "H", "ground_sign", "covariance", "rms_m", "rms_px"])
def test_a_missing_key_is_named(tmp_path: Path, ground: GroundMap, key: str):
    path = tmp_path / "H.json"
    homography_files.write(path, ground)
    document = json.loads(path.read_text())
    del document[key]
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=f'"{key}"'):
        homography_files.read(path)


@pytest.mark.parametrize("data", [b"", b"{", b"[" * 100_000, bytes(range(256)), b"1" * 10_000])
def test_what_is_not_json_is_refused(tmp_path: Path, data: bytes):
    path = tmp_path / "H.json"
    path.write_bytes(data)
    with pytest.raises(InputError, match="not JSON"):
        homography_files.read(path)


def test_a_folder_is_no_homography(tmp_path: Path):
    for path in (tmp_path, tmp_path / "H.json"):
        with pytest.raises(InputError, match="cannot read the homography"):
            homography_files.read(path)


def _plain(matrix: np.ndarray) -> dict:
    rows, cols = matrix.shape
    return {"type_id": "opencv-matrix", "rows": rows, "cols": cols, "dt": "d", "data": matrix.ravel().tolist()}


@pytest.mark.parametrize(
    ("text", "size"),
    [
        (YAML, None),
        ("\ufeff" + YAML, None),
        (YAML.replace("\n", "\r\n"), None),
        (SIZED, (1280, 720)),
        (SIZED.replace("M1", "camera_matrix").replace("D1", "distortion_coefficients"), (1280, 720)),
        (YAML.replace("---\n", "---\nimage_size: [1280, 720]\n"), (1280, 720)),
        (json.dumps({"M1": _plain(K), "D1": _plain(np.array([[-0.3, 0.1, 0, 0, 0]]))}), None),
    ],
)
def test_a_lens_is_read(tmp_path: Path, text: str, size: tuple[int, int] | None):
    path = tmp_path / "calibration.yaml"
    path.write_text(text, encoding="utf-8", newline="")
    lens, found = read_lens(path)
    np.testing.assert_array_equal(lens.K, K)
    np.testing.assert_array_equal(lens.D, [-0.3, 0.1, 0, 0, 0])
    assert found == size


def test_a_lens_that_opencv_wrote_is_read(tmp_path: Path):
    cv2 = pytest.importorskip("cv2")
    for suffix in ("yaml", "xml", "json"):
        path = tmp_path / f"calibration.{suffix}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", 1280)
        storage.write("image_height", 720)
        storage.write("M1", K)
        storage.write("D1", np.array([[-0.3, 0.1, 0, 0, 0]]))
        storage.release()
        lens, size = read_lens(path)
        np.testing.assert_array_equal(lens.K, K)
        np.testing.assert_array_equal(lens.D, [-0.3, 0.1, 0, 0, 0])
        assert size == (1280, 720)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not an OpenCV calibration file"),
        ("M1: 3\n", "not an OpenCV calibration file"),
        ("%YAML:1.0\n---\n}}}{{{: [ [ [", "not a readable OpenCV calibration file"),
        ("%YAML:1.0\n", "has neither M1 and D1 nor camera_matrix"),
        ("%YAML:1.0\n---\n- 1\n- 2\n", "not a readable OpenCV calibration file"),
        ('<?xml version="1.0"?>\n<opencv_storage>\n<M1', "not a readable OpenCV calibration file"),
        ('{"M1": 3', "not a readable OpenCV calibration file"),
        (YAML[:200], "not a readable OpenCV calibration file"),
        (YAML.replace("rows: 3", "rows: 300000000"), "not a readable OpenCV calibration file"),
        (YAML.replace("rows: 3", "rows: -3"), "not a readable OpenCV calibration file"),
        (YAML.replace("dt: d", "dt: Q"), "not a readable OpenCV calibration file"),
        (YAML.replace("900.", "abc"), "not a readable OpenCV calibration file"),
        (YAML.replace("D1", "D"), "has neither M1 and D1"),
        ("%YAML:1.0\n---\nM1: 3\nD1: 4\n", "M1 is not a camera matrix"),
        (YAML.replace("900.", ".Nan"), "M1 is not a camera matrix"),
        (YAML.replace("900.", "0."), "M1 is not a camera matrix"),
        (YAML.replace("900., 0.", "900., 5."), "M1 is not a camera matrix"),
        (YAML.replace("cols: 5", "cols: 3").replace("0., 0., 0. ]", "0. ]"), "D1 must be 4, 5, 8, 12, 14 finite"),
        (YAML.replace("-0.3", ".Inf"), "D1 must be 4, 5, 8, 12, 14 finite"),
        (SIZED.replace("1280", "0"), "the image size 0x720 is none"),
        (SIZED.replace("1280", ".Inf"), "the image size infx720 is none"),
        (SIZED.replace("1280", '"wide"'), "the image size nanx720 is none"),
        (SIZED.replace("1280", "1280.5"), "the image size 1280.5x720 is none"),
    ],
)
def test_a_wrong_lens_is_refused(tmp_path: Path, text: str, message: str):
    path = tmp_path / "calibration.yaml"
    path.write_text(text, encoding="utf-8", newline="")
    with pytest.raises(InputError, match=message) as refusal:
        read_lens(path)
    assert str(refusal.value).startswith(str(path))
    assert "\n" not in str(refusal.value)


def test_a_lens_file_that_is_no_text_is_refused(tmp_path: Path):
    path = tmp_path / "calibration.yaml"
    path.write_bytes(bytes(range(256)))
    for wrong, message in ((path, "not text"), (tmp_path, "cannot be read"), (tmp_path / "no.yaml", "No such file")):
        with pytest.raises(InputError, match=message):
            read_lens(wrong)


@pytest.mark.parametrize(
    "coefficients",
    [
        [0, 0, 0, 0],
        [-0.3, 0.1, 0.001, -0.001],
        [-0.35, 0.15, 0, 0, -0.02],
        [0.1, -0.2, 0, 0, 0.1, 0.01, 0.02, 0.01],
        [-0.2, 0.05, 0, 0, 0, 0, 0, 0, 0.01, 0, -0.01, 0],
        [-0.2, 0.05, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.02, -0.03],
        [0.5, 0.3, 0, 0],
        [1.2, 2.0, 0, 0],
    ],
    ids=["none", "barrel", "k3", "rational", "prism", "tilted", "pincushion", "strong pincushion"],
)
def test_distortion_goes_both_ways(coefficients: list[float]):
    lens = Lens(K, np.array(coefficients, dtype=float))
    footage = np.random.default_rng(0).uniform([0, 0], [1280, 720], (200, 2))
    np.testing.assert_allclose(distort_points(undistort_points(footage, lens), lens), footage, atol=1e-8)
    np.testing.assert_allclose(undistort_points(distort_points(footage, lens), lens), footage, atol=1e-6)


def test_pixels_beyond_the_lens_models_reach_stay_finite():
    lens = Lens(K, np.array([-0.45, 0.25, 0, 0, -0.08]))
    straight = undistort_points(np.array([[0.0, 0.0], [640.0, 360.0], [1e5, -1e5]]), lens)
    assert np.isfinite(straight).all()
    np.testing.assert_allclose(straight[1], [640, 360], atol=1e-9)


def test_no_points_are_no_trouble():
    lens = Lens(K, np.array([-0.3, 0.1, 0, 0, 0]))
    assert undistort_points(np.empty((0, 2)), lens).shape == distort_points(np.empty((0, 2)), lens).shape == (0, 2)
