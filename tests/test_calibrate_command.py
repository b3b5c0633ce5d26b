"""`calibrate-homography` from its request to its files, and drawn lines that find their edge."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.cameras import ground_points, image_from_ground
from visfuse_cli.commands.calibrate_homography import CalibrateConfig, run, text
from visfuse_cli.errors import InputError, OutputError, UsageError
from visfuse_cli.files import homography as homography_files
from visfuse_cli.maths import gaze
from visfuse_cli.maths.homography import apply
from visfuse_cli.records import GroundMap, Lens, RunRequest, RunResult
from visfuse_cli.vision import calibration_picture
from visfuse_cli.vision.lens import distort_points
from visfuse_cli.vision.line_tracing import snap

DATA = Path(__file__).parents[2] / "shared" / "data"
TRUE = image_from_ground()
COURT = np.array([[-5.0, 12, -5, 40], [5, 12, 5, 40], [-5, 14, 5, 14], [-5, 26, 5, 26]])
PAINT = 0.15  # m, half a line's width


def calibrate(out: Path, config: dict[str, Any] | None = None, overwrite: bool = False, **options: Any) -> RunResult:
    keys = ("points", "lines", "gaze", "image", "size", "camera")
    source = next(options[key] for key in keys[:3] if key in options)
    request = RunRequest(
        command="calibrate-homography",
        input=source,
        out=out,
        config=CalibrateConfig.model_validate(config or {}),
        options=dict.fromkeys(keys) | options,
        overwrite=overwrite,
    )
    return run(request)


def csv(path: Path, header: str, *columns: np.ndarray) -> Path:
    np.savetxt(path, np.hstack(columns), delimiter=",", header=header, comments="", fmt="%.12g")
    return path


def points(tmp_path: Path, n: int = 10, move: tuple[int, list[float]] | None = None) -> Path:
    world = ground_points(np.random.default_rng(0), n)
    image = apply(TRUE, world)
    if move is not None:
        image[move[0]] += move[1]
    return csv(tmp_path / "points.csv", "u,v,X,Y", image, world)


def court(size: tuple[int, int] = (1280, 720)) -> np.ndarray:
    """The painted court as the camera sees it, every pixel the mean of 16 rays, with some noise."""
    v, u = np.mgrid[0 : size[1], 0 : size[0]].astype(float)
    shade, ground_from_image = np.zeros(u.shape), np.linalg.inv(TRUE)
    for du, dv in np.ndindex(4, 4):
        ground = apply(ground_from_image, np.column_stack([(u + du / 4 - 0.375).ravel(), (v + dv / 4 - 0.375).ravel()]))
        on = np.zeros(len(ground), dtype=bool)
        for line in COURT:
            way = line[2:] - line[:2]
            along = way / np.hypot(*way)
            at, off = (ground - line[:2]) @ along, (ground - line[:2]) @ [-along[1], along[0]]
            on |= (np.abs(off) < PAINT) & (at > 0) & (at < np.hypot(*way))
        shade += on.reshape(u.shape)
    picture = 80 + 150 * shade[:, :, None] / 16 + np.random.default_rng(0).normal(0, 3, (*u.shape, 3))
    return np.clip(picture, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def court_picture() -> np.ndarray:
    return court()


def edges() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One painted edge of each line: on the ground (n, 4), in the image (n, 4), and the image's outward normal."""
    way = COURT[:, 2:] - COURT[:, :2]
    normal = np.column_stack([-way[:, 1], way[:, 0]]) / np.linalg.norm(way, axis=1)[:, None]
    world = COURT + PAINT * np.hstack([normal, normal])
    start, step = world[:, :2], world[:, 2:] - world[:, :2]
    image = np.hstack([apply(TRUE, start + share * step) for share in (0.1, 0.8)])
    middle = np.hstack([apply(TRUE, COURT[:, :2] + share * way) for share in (0.1, 0.8)])
    along = image[:, 2:] - image[:, :2]
    outward = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    outward *= np.sign(np.sum((image - middle)[:, :2] * outward, axis=1))[:, None]
    return world, image, outward


def rough(image: np.ndarray, outward: np.ndarray) -> np.ndarray:
    off = np.random.default_rng(3).uniform(0, 4, (len(image), 2))
    return image + np.hstack([off[:, :1] * outward, off[:, 1:] * outward])


def test_drawn_lines_find_their_edge(court_picture: np.ndarray):
    _, image, outward = edges()
    snapped, found = snap(court_picture, rough(image, outward), 8.0)
    assert found.all()
    off = np.einsum("nki,ni->nk", (snapped - image).reshape(-1, 2, 2), outward)
    assert np.abs(off).max() < 0.2


def test_a_line_without_an_edge_stays(court_picture: np.ndarray):
    stray = np.array([[100.0, 650, 180, 690]])
    snapped, found = snap(court_picture, stray, 8.0)
    assert not found.any()
    np.testing.assert_array_equal(snapped, stray)


def test_lines_snapped_in_a_picture_give_the_camera_back(tmp_path: Path, court_picture: np.ndarray):
    cv2.imwrite(str(tmp_path / "frame.png"), court_picture)
    world, image, outward = edges()
    stray = [100.0, 650, 180, 690]
    header = "u1,v1,u2,v2,X1,Y1,X2,Y2"
    drawn = np.vstack([rough(image, outward), stray])
    stray_world = apply(np.linalg.inv(TRUE), np.reshape(stray, (2, 2))).reshape(1, 4)
    lines = csv(tmp_path / "lines.csv", header, drawn, np.vstack([world, stray_world]))
    config = {"snap": {"enabled": True}}
    result = calibrate(tmp_path / "H.json", config, lines=lines, image=tmp_path / "frame.png")
    assert "line 5 has no edge under it and stays as drawn" in result.warnings
    ground = homography_files.read(tmp_path / "H.json")
    spots = np.array([[0.0, 16.0], [-4.0, 30.0], [4.0, 20.0]])
    np.testing.assert_allclose(apply(ground.ground_from_image, apply(TRUE, spots)), spots, atol=0.06)
    with pytest.raises(UsageError, match="needs --image"):
        calibrate(tmp_path / "H2.json", config, lines=lines)


def test_points_without_a_picture(tmp_path: Path):
    result = calibrate(tmp_path / "H.json", points=points(tmp_path), size=(1280, 720))
    ground = homography_files.read(tmp_path / "H.json")
    assert ground.image_size == (1280, 720)
    assert (ground.input, ground.source, ground.lens) == ("pixel", "points.csv", None)
    assert [row["index"] for row in ground.residuals] == list(range(10))
    assert result.summary["n"] == result.summary["used"] == 10
    assert result.summary["rms_m"] < 1e-6
    assert 0 < result.summary["speed_sigma_kmh"] < 10
    assert result.warnings == ()
    assert "used         10 of 10" in text(result)
    json.dumps(result.summary, allow_nan=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["H.json", "points.csv"]


def test_four_points_leave_one_out_is_null(tmp_path: Path):
    result = calibrate(tmp_path / "H.json", points=points(tmp_path, 4))
    assert all(row["leave_one_out_m"] is None for row in json.loads((tmp_path / "H.json").read_text())["residuals"])
    assert result.summary["leave_one_out_worst_m"] is None
    assert any("4 points leave little" in warning for warning in result.warnings)


def test_a_wrong_point_is_named_and_dropped_when_asked(tmp_path: Path):
    wrong = points(tmp_path, move=(4, [40.0, 60.0]))
    kept = calibrate(tmp_path / "all.json", points=wrong)
    assert kept.summary["used"] == 10
    assert any("leaving out point 5 moves it by" in warning for warning in kept.warnings)
    dropped = calibrate(tmp_path / "robust.json", {"robust": {"enabled": True}}, points=wrong)
    assert dropped.summary["dropped"] == [5]
    assert dropped.summary["rms_px"] < 1e-6
    assert any(warning.startswith("point 5 disagrees with the others by") for warning in dropped.warnings)
    assert "dropped 5" in text(dropped)
    assert json.loads((tmp_path / "robust.json").read_text())["residuals"][4]["used"] is False


def test_gaze_angles_of_rendered_points(tmp_path: Path):
    """The pan-tilt head stands where the camera does; its frontal plane is the camera's, turned round."""
    head = image_from_ground(focal=1.0, principal=(0.0, 0.0))
    world = ground_points(np.random.default_rng(0), 9)
    for order in gaze.ORDERS:
        angles = np.column_stack(gaze.angles(-apply(head, world), order))
        path = csv(tmp_path / "gaze.csv", "elevation,vergence,X,Y", angles, world)
        result = calibrate(tmp_path / "H.json", {"gaze": {"order": order}}, overwrite=True, gaze=path)
        ground = homography_files.read(tmp_path / "H.json")
        assert ground.input == "gaze"
        np.testing.assert_allclose(apply(ground.ground_from_image, -apply(head, world)), world, atol=1e-8)
        assert "mrad" in text(result)


def lens_file(path: Path, size: tuple[int, int] = (1280, 720)) -> tuple[Path, Lens]:
    lens = Lens(np.array([[1000.0, 0, 639.5], [0, 1000, 359.5], [0, 0, 1]]), np.array([-0.2, 0.05, 0, 0, 0]))
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in {"M1": lens.K, "D1": lens.D, "image_width": size[0], "image_height": size[1]}.items():
        file.write(name, value)
    file.release()
    return path, lens


def test_a_lens_is_taken_out(tmp_path: Path):
    camera, lens = lens_file(tmp_path / "calibration.yaml")
    world = ground_points(np.random.default_rng(0), 10)
    path = csv(tmp_path / "points.csv", "u,v,X,Y", distort_points(apply(TRUE, world), lens), world)
    result = calibrate(tmp_path / "H.json", points=path, camera=camera)
    ground = homography_files.read(tmp_path / "H.json")
    assert result.summary["rms_px"] < 1e-4
    assert ground.image_size == (1280, 720)
    assert ground.lens is not None
    np.testing.assert_allclose(ground.lens.D, lens.D)


def test_sizes_that_disagree_are_both_named(tmp_path: Path):
    camera, _ = lens_file(tmp_path / "calibration.yaml", (640, 480))
    with pytest.raises(InputError, match=r"--size is 1280x720, but --camera .* says 640x480"):
        calibrate(tmp_path / "H.json", points=points(tmp_path), size=(1280, 720), camera=camera)
    cv2.imwrite(str(tmp_path / "frame.png"), np.zeros((90, 160, 3), np.uint8))
    with pytest.raises(InputError, match=r"--image .* is 160x90, but --size says 1280x720"):
        calibrate(tmp_path / "H.json", points=points(tmp_path), size=(1280, 720), image=tmp_path / "frame.png")
    assert not (tmp_path / "H.json").exists()


def test_points_outside_of_the_image_are_named(tmp_path: Path):
    result = calibrate(tmp_path / "H.json", points=points(tmp_path), size=(640, 720))
    assert any("lies outside the 640x720 image" in warning for warning in result.warnings)


def test_survey_coordinates_far_from_their_origin_are_warned_of(tmp_path: Path):
    world = ground_points(np.random.default_rng(0), 10)
    path = csv(tmp_path / "points.csv", "u,v,X,Y", apply(TRUE, world), world + [431000.0, 5812000.0])
    result = calibrate(tmp_path / "H.json", points=path)
    assert homography_files.read(tmp_path / "H.json").ground_from_image[2, 2] == 1
    assert any("subtract a constant from X and Y" in warning for warning in result.warnings)


def test_outputs_that_would_hurt_are_refused(tmp_path: Path):
    source = points(tmp_path)
    frame = tmp_path / "frame.png"
    cv2.imwrite(str(frame), np.zeros((720, 1280, 3), np.uint8))
    with pytest.raises(OutputError, match="is an input and would be overwritten"):
        calibrate(tmp_path / "frame.json", overwrite=True, points=source, image=frame)
    with pytest.raises(OutputError, match="is an input and would be overwritten"):
        calibrate(source, overwrite=True, points=source)
    with pytest.raises(OutputError, match=r"ends in \.json"):
        calibrate(tmp_path / "H.png", points=source, image=frame)
    with pytest.raises(OutputError, match="no such folder"):
        calibrate(tmp_path / "absent" / "H.json", points=source)
    with pytest.raises(OutputError, match="is a folder"):
        calibrate(tmp_path, points=source)
    calibrate(tmp_path / "H.json", points=source)
    with pytest.raises(OutputError, match="exists; give --overwrite"):
        calibrate(tmp_path / "H.json", points=source)


def test_a_refusal_names_the_file(tmp_path: Path):
    path = tmp_path / "points.csv"
    path.write_text("u,v,X,Y\n0,0,0,0\n10,0,1,0\n20,0,2,0\n5,9,1,1\n")
    with pytest.raises(InputError, match=r"points\.csv: all points but one lie on one line in the image"):
        calibrate(tmp_path / "H.json", points=path)
    broken = tmp_path / "frame.png"
    broken.write_bytes(b"\x89PNG\r\n\x1a\n" + b"rubbish" * 20)
    with pytest.raises(InputError, match=r"frame\.png"):
        calibrate(tmp_path / "H.json", points=points(tmp_path), image=broken)


def picture(height: int, ground: GroundMap, used: np.ndarray) -> np.ndarray:
    world = ground_points(np.random.default_rng(0), len(used))
    scale = height / 720
    frame = np.full((height, round(1280 * scale), 3), 100, np.uint8)
    return calibration_picture.draw(frame, ground, scale * apply(TRUE, world), world, used, 1.0)


@pytest.mark.parametrize("height", [360, 720, 2160])
def test_the_picture_at_all_sizes(tmp_path: Path, height: int):
    calibrate(tmp_path / "H.json", points=points(tmp_path))
    ground = homography_files.read(tmp_path / "H.json")
    scale = np.diag([720 / height, 720 / height, 1])
    resized = GroundMap(
        ground.ground_from_image @ scale, np.kron(np.eye(3), scale) @ ground.cov @ np.kron(np.eye(3), scale),
        ground.ground_sign, "pixel", None, None, 0.0, 0.0,
    )  # fmt: skip
    drawn = picture(height, resized, np.ones(10, dtype=bool))
    assert drawn.shape == (height, round(1280 * height / 720), 3)
    trusted = 0.64 * 100 + 0.36 * np.array([70, 190, 40])
    green = np.all(np.abs(drawn[-height // 8 :] - trusted) < 3, axis=2)
    assert green.mean() > 0.3, "near ground can be trusted, and the colours say so"
    crossed = picture(height, resized, np.arange(10) != 3)
    redder = crossed[:, :, 2].astype(int) - drawn[:, :, 2], crossed[:, :, 1].astype(int) - drawn[:, :, 1]
    assert np.sum((redder[0] > 30) & (redder[1] < 30)) > 10, "a dropped point is red"


def test_above_the_horizon_the_picture_is_dark(tmp_path: Path):
    camera = image_from_ground(pitch=0.05)
    world = ground_points(np.random.default_rng(0), 10)
    path = csv(tmp_path / "points.csv", "u,v,X,Y", apply(camera, world), world)
    cv2.imwrite(str(tmp_path / "frame.png"), np.full((720, 1280, 3), 100, np.uint8))
    calibrate(tmp_path / "H.json", points=path, image=tmp_path / "frame.png")
    drawn = cv2.imread(str(tmp_path / "H.png"))
    horizon = 359.5 - 1000 * np.tan(0.05)
    assert (drawn[30 : int(horizon) - 5, 900:] == 45).all()
    assert not (drawn[int(horizon) + 5 :, 900:] == 45).all(axis=2).any()


@pytest.mark.parametrize("name", ["speed-arterial", "speed-junction", "speed-pedestrians"])
def test_real_surveys(tmp_path: Path, name: str):
    folder = DATA / name
    if not (folder / "points.csv").is_file():
        pytest.skip("the footage is not here")
    result = calibrate(tmp_path / "H.json", points=folder / "points.csv", image=folder / "clip.mp4")
    assert result.summary["rms_m"] < 0.5
    assert (tmp_path / "H.png").is_file()
    if name == "speed-junction":
        assert sum("leaving out point" in warning for warning in result.warnings) == 2
    else:
        assert result.warnings == ()
