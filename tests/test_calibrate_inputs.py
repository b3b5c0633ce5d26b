"""The files around a calibration: tables, lenses and H.json, strict and with their place in every complaint."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from visfuse_cli.errors import InputError
from visfuse_cli.files import homography as homography_files
from visfuse_cli.files.calibration_input import read_gaze, read_lines, read_points
from visfuse_cli.files.lens_files import read_lens
from visfuse_cli.records import GroundMap, Lens
from visfuse_cli.vision.lens import distort_points, undistort_points

K = np.array([[800.0, 0, 640], [0, 810, 360], [0, 0, 1]])
D = np.array([-0.28, 0.09, 0.001, -0.0005, 0.0])


def table(tmp_path: Path, content: str | bytes) -> Path:
    path = tmp_path / "table.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_points_lines_and_gaze_are_read(tmp_path: Path):
    image, world = read_points(table(tmp_path, "u,v,X,Y\n1,2,3,4\n5,6,7,-8.5e1\n"))
    np.testing.assert_array_equal(image, [[1, 2], [5, 6]])
    np.testing.assert_array_equal(world, [[3, 4], [7, -85]])
    image, world = read_lines(table(tmp_path, "u1,v1,u2,v2,X1,Y1,X2,Y2\n1,2,3,4,5,6,7,8\n"))
    np.testing.assert_array_equal(np.hstack([image, world]), [[1, 2, 3, 4, 5, 6, 7, 8]])
    angles, world = read_gaze(table(tmp_path, "elevation,vergence,X,Y\n-0.1,0.2,3,4\n"))
    np.testing.assert_array_equal(np.hstack([angles, world]), [[-0.1, 0.2, 3, 4]])


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbfu,v,X,Y\r\n1,2,3,4\r\n",
        b"# surveyed by hand\n\nu,v,X,Y\n\n# first\n1,2,3,4\n\n",
        b"name, Y , X,v,u\nkerb,4,3, 2 ,1\n",
        b'"u","v","X","Y"\n"1","2","3","4"',
        b"u,v,X,Y\n1.,2e0,+3,0.4e1\n",
    ],
    ids=["bom-crlf", "comments", "other-order", "quoted", "number-forms"],
)
def test_ways_to_write_the_same_table(tmp_path: Path, content: bytes):
    image, world = read_points(table(tmp_path, content))
    np.testing.assert_array_equal(np.hstack([image, world]), [[1, 2, 3, 4]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty; a table of u,v,X,Y is needed"),
        (b"# nothing\n\n", "is empty"),
        (b"u,v,X,Y\n", "has a header and no rows"),
        (b"u,v,X\n1,2,3\n", "line 1: column Y is missing"),
        (b"1,2,3,4\n5,6,7,8\n", "line 1: column u is missing; the header is u,v,X,Y"),
        (b"u,v,X,Y,u\n1,2,3,4,5\n", "line 1: column u is given twice"),
        (b"# c\nu,v,X,Y\n1,2,3,4\n\n1,2,three,4\n", "line 5, column X: 'three' is not a number"),
        (b"u,v,X,Y\n1,2,,4\n", "line 2, column X: '' is not a number"),
        (b"u,v,X,Y\n1,2,1_0,4\n", "line 2, column X: '1_0' is not a number"),
        (b"u,v,X,Y\n1,nan,3,4\n", "line 2, column v: nan is not a finite number"),
        (b"u,v,X,Y\n1,2,3,-inf\n", "line 2, column Y: -inf is not a finite number"),
        (b"u,v,X,Y\n1,2,3,1e999\n", "line 2, column Y: 1e999 is not a finite number"),
        (b"u,v,X,Y\n1,2,3,1e300\n", "line 2, column Y: 1e300 is beyond"),
        (b"u,v,X,Y\n1,2,3\n", "line 2: 3 columns where the header has 4"),
        (b"u;v;X;Y\n1;2;3;4\n", "column u is missing"),
        (b"\x89PNG\r\n\x1a\n\x00\xff\xfe", "not a text file"),
        (b"u,v,X,Y\n\x00,2,3,4\n", "not a text file"),
        (b"x" * 1_000_001, "larger than"),
    ],
)
def test_bad_tables_are_refused_with_their_place(tmp_path: Path, content: bytes, message: str):
    path = table(tmp_path, content)
    with pytest.raises(InputError) as refusal:
        read_points(path)
    assert message in str(refusal.value)
    assert str(refusal.value).startswith(str(path))
    assert "\n" not in str(refusal.value)


def test_degrees_for_radians_are_noticed(tmp_path: Path):
    with pytest.raises(InputError, match=r"line 3, column vergence: 30 rad does not look forward; degrees\?"):
        read_gaze(table(tmp_path, "elevation,vergence,X,Y\n0,0,1,2\n0,30,1,2\n"))


@pytest.mark.parametrize("name", ["absent.csv", "."])
def test_unreadable_tables(tmp_path: Path, name: str):
    with pytest.raises(InputError, match="cannot be read"):
        read_points(tmp_path / name)


def storage(tmp_path: Path, **nodes: Any) -> Path:
    path = tmp_path / "calibration.yaml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in nodes.items():
        file.write(name, value)
    file.release()
    return path


@pytest.mark.parametrize("names", [("M1", "D1"), ("camera_matrix", "distortion_coefficients")])
def test_lens_files_of_opencv(tmp_path: Path, names: tuple[str, str]):
    lens, size = read_lens(storage(tmp_path, **dict(zip(names, (K, D[None]), strict=True))))
    np.testing.assert_array_equal(lens.K, K)
    np.testing.assert_array_equal(lens.D, D)
    assert size is None


def test_lens_files_may_name_the_size(tmp_path: Path):
    assert read_lens(storage(tmp_path, M1=K, D1=D, image_width=1280, image_height=720))[1] == (1280, 720)
    assert read_lens(storage(tmp_path, M1=K, D1=D, image_size=np.array([1280.0, 720.0])))[1] == (1280, 720)
    path = tmp_path / "calibration.yaml"
    path.write_text(path.read_text().split("image_size")[0] + "image_size: [ 640, 480 ]\n")
    assert read_lens(path)[1] == (640, 480)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not an OpenCV calibration file"),
        ("fx: 800\n", "not an OpenCV calibration file"),
        ("%YAML:1.0\n---\nfx: 800\n", "has neither M1 and D1 nor camera_matrix"),
        ("%YAML:1.0\n---\nM1: [1,2\n", "not a readable OpenCV calibration file"),
        ("%YAML:1.0\n---\nM1: 5\nD1: [ 0., 0., 0., 0. ]\n", "M1 is not a camera matrix"),
        ("%YAML:1.0\n---\nM1: abc\nD1: def\n", "M1 is not a camera matrix"),
    ],
)
def test_bad_lens_files(tmp_path: Path, content: str, message: str):
    path = tmp_path / "calibration.yaml"
    path.write_text(content)
    with pytest.raises(InputError, match=message):
        read_lens(path)


def test_lens_files_with_bad_numbers(tmp_path: Path):
    with pytest.raises(InputError, match="D1 must be 4, 5, 8, 12, 14 finite coefficients"):
        read_lens(storage(tmp_path, M1=K, D1=D[:3]))
    with pytest.raises(InputError, match="M1 is not a camera matrix"):
        read_lens(storage(tmp_path, M1=-K, D1=D))
    with pytest.raises(InputError, match="cannot be read"):
        read_lens(tmp_path / "absent.yaml")


def test_distortion_there_and_back():
    points = np.array([[640.0, 360], [20, 20], [1270, 700], [300, 600]])
    straight = undistort_points(points, Lens(K, D))
    np.testing.assert_allclose(distort_points(straight, Lens(K, D)), points, atol=1e-6)
    assert np.abs(straight[1] - points[1]).max() > 30
    np.testing.assert_allclose(undistort_points(points, Lens(K, np.zeros(5))), points, atol=1e-9)


def ground_map() -> GroundMap:
    return GroundMap(
        ground_from_image=np.array([[1.0, 0.1, -700], [0.05, -0.3, 100], [0.0, -0.02, 1]]),
        cov=np.diag([1e-4] * 8 + [0.0]),
        ground_sign=-1,
        input="pixel",
        image_size=(1280, 720),
        lens=Lens(K, D),
        rms_m=0.05,
        rms_px=0.8,
        residuals=({"index": 0, "error_m": 0.1, "error_px": 1.0, "leave_one_out_m": None, "used": True},),
        source="points.csv",
    )


def test_h_json_there_and_back(tmp_path: Path):
    path = tmp_path / "H.json"
    for ground in (ground_map(), replace(ground_map(), lens=None, image_size=None, input="gaze", residuals=())):
        homography_files.write(path, ground)
        back = homography_files.read(path)
        np.testing.assert_array_equal(back.ground_from_image, ground.ground_from_image)
        np.testing.assert_array_equal(back.cov, ground.cov)
        assert (back.lens is None) == (ground.lens is None)
        for name in ("ground_sign", "input", "image_size", "rms_m", "rms_px", "residuals", "source"):
            assert getattr(back, name) == getattr(ground, name), name


def test_h_json_has_the_keys_of_the_contract(tmp_path: Path):
    homography_files.write(tmp_path / "H.json", ground_map())
    document = json.loads((tmp_path / "H.json").read_text())
    assert list(document) == [
        "schema", "input", "image_size", "lens", "H", "ground_sign", "covariance", "rms_m", "rms_px", "residuals",
        "source",
    ]  # fmt: skip
    assert document["schema"] == "visfuse.homography/1"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": "visfuse.homography/2"}, '"schema" must be "visfuse.homography/1"'),
        ({"H": None}, '"H" is missing'),
        ({"H": [[1, 0], [0, 1]]}, '"H" must be 3x3'),
        ({"H": [[1, 0, 0], [0, 1], [0, 0, 1]]}, '"H" must be 3x3'),
        ({"H": [[1, 0, 0], [0, float("nan"), 0], [0, 0, 1]]}, '"H" must be 3x3'),
        ({"H": [[1, 2, 3], [2, 4, 6], [0, 0, 1]]}, '"H" is singular'),
        ({"H": [[10**400, 0, 0], [0, 1, 0], [0, 0, 1]]}, '"H" must be 3x3'),
        ({"covariance": [[1.0]]}, '"covariance" must be 9x9'),
        ({"covariance": (-np.eye(9)).tolist()}, '"covariance" is no covariance'),
        ({"ground_sign": 0}, '"ground_sign" is 0; it must be 1 or -1'),
        ({"input": "metres"}, '"input" is .metres.'),
        ({"image_size": [1280]}, '"image_size" must be'),
        ({"image_size": [1280, -1]}, '"image_size" must be'),
        ({"lens": 3}, '"lens" must be'),
        ({"lens": {"K": K.tolist()}}, '"D" is missing'),
        ({"lens": {"K": K.tolist(), "D": [1, 2]}}, '"lens.D" must be'),
        ({"lens": {"K": (-K).tolist(), "D": D.tolist()}}, '"lens.K" is not a camera matrix'),
        ({"rms_m": "small"}, '"rms_m" must be'),
        ({"residuals": 5}, '"residuals" must be'),
    ],
)
def test_bad_h_json_is_refused_by_key(tmp_path: Path, change: dict[str, Any], message: str):
    path = tmp_path / "H.json"
    homography_files.write(path, ground_map())
    document = json.loads(path.read_text()) | change
    path.write_text(json.dumps({k: v for k, v in document.items() if v is not None or k in ("lens", "image_size")}))
    with pytest.raises(InputError, match=message):
        homography_files.read(path)


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff\xfe", b"1" * 5000, b"[" * 100_000])
def test_what_is_no_h_json_at_all(tmp_path: Path, content: bytes):
    path = tmp_path / "H.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"not JSON|not a homography") as refusal:
        homography_files.read(path)
    assert "\n" not in str(refusal.value)


def test_nothing_unwritable_in_h_json(tmp_path: Path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        homography_files.write(tmp_path / "H.json", replace(ground_map(), rms_m=float("nan")))
    assert list(tmp_path.iterdir()) == []
