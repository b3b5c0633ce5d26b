"""The calibration of several cameras: one TOML for all (Anipose, Pose2Sim, Caliscope), or one OpenCV file a camera."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.files.folders import list_files
from visfuse_cli.files.homography import COEFFICIENTS, is_camera_matrix
from visfuse_cli.files.lens_files import LONGEST, NAMES, Size, lens_of, read_calibration_text, read_matrices
from visfuse_cli.records import Array, Lens, View

LARGEST = 1e9  # of any unit: what is beyond it was not measured
FILE = "calibration.toml"
KEYS = ("size", "matrix", "distortions", "rotation", "translation")
POSES = (("R", "T"), ("rvec", "tvec"), ("rotation", "translation"), ("R", "t"))
FARTHEST = 2000.0  # m from the first camera: beyond, the translations are millimetres
ORTHONORMAL = 1e-3
OPENCV_SUFFIXES = frozenset({".yaml", ".yml", ".xml"})


def read_views(scene: Path) -> tuple[list[View], list[Path]]:
    """The cameras of a scene and the files that say so; raises InputError naming camera and key that are wrong."""
    toml = scene / FILE
    if toml.exists():
        views, files = _toml(toml), [toml]
    else:
        views, files = _opencv(scene)
    _check(views, files[0] if len(files) == 1 else scene)
    return views, files


def _toml(path: Path) -> list[View]:
    text = read_calibration_text(path)
    try:
        tables = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as problem:
        raise InputError(f"{path}: not valid TOML: {' '.join(str(problem).split())[:120]}") from problem
    cameras = {key: table for key, table in tables.items() if isinstance(table, dict) and key != "metadata"}
    if not cameras:
        raise InputError(f"{path}: has no table for a camera; each has name, {', '.join(KEYS)}")
    return [
        _view(f"{path}, [{key}]", key, table)
        for key, table in cameras.items()
        if table.get("ignore") is not True  # Caliscope's mark of a camera left out
    ]


def _view(where: str, key: str, table: Mapping[str, Any]) -> View:
    missing = [name for name in KEYS if name not in table]
    if missing:
        raise InputError(f"{where}: {', '.join(missing)} missing; a camera has name, {', '.join(KEYS)}")
    if table.get("fisheye"):
        raise InputError(f"{where}: fisheye lenses are not read; undistort the footage to a pinhole first")
    name = table.get("name", key)
    if not isinstance(name, str) or not name or "/" in name or "\0" in name or name[0] == ".":
        raise InputError(f"{where}, name: {name!r} cannot be the name of a file")
    K = _numbers(where, table, "matrix", (3, 3))
    if not is_camera_matrix(K):
        raise InputError(f"{where}, matrix: is not a camera matrix [fx 0 cx; 0 fy cy; 0 0 1]")
    D = _numbers(where, table, "distortions", None)
    if len(D) not in COEFFICIENTS:
        raise InputError(f"{where}, distortions: {len(D)} numbers; OpenCV has {', '.join(map(str, COEFFICIENTS))}")
    size = _numbers(where, table, "size", (2,))
    if not np.all((size >= 1) & (size <= LONGEST) & (size == np.floor(size))):
        raise InputError(f"{where}, size: {size[0]:g}x{size[1]:g} is no picture's size in whole pixels [w, h]")
    R = cv2.Rodrigues(_numbers(where, table, "rotation", (3,)))[0]
    return View(name, Lens(K, D), (int(size[0]), int(size[1])), R, _numbers(where, table, "translation", (3,)))


def _numbers(where: str, table: Mapping[str, Any], key: str, shape: tuple[int, ...] | None) -> Array:
    try:
        value = np.array(table[key], dtype=float)
    except (TypeError, ValueError):
        value = np.full(1, np.nan)
    if value.size and 1 in value.shape and shape is not None and len(shape) == 1:
        value = value.ravel()
    if (shape is not None and value.shape != shape) or (shape is None and value.ndim != 1):
        wanted = "a list" if shape is None else "x".join(map(str, shape))
        raise InputError(f"{where}, {key}: must be {wanted} of numbers")
    if not np.isfinite(value).all():
        raise InputError(f"{where}, {key}: holds what is no finite number")
    if value.size and np.abs(value).max() > LARGEST:
        raise InputError(f"{where}, {key}: holds a number beyond {LARGEST:g}")
    return value


def _opencv(scene: Path) -> tuple[list[View], list[Path]]:
    files = [path for path in list_files(scene, OPENCV_SUFFIXES) if path.stem not in ("init", "path")]
    if not files:
        raise InputError(f"{scene}: has no calibration; expected {FILE}, or an OpenCV file <camera>.yaml a camera")
    return [_opencv_view(path) for path in files], files


def _opencv_view(path: Path) -> View:
    names = {name for group in (*NAMES, *POSES) for name in group}
    matrices, size = read_matrices(path, sorted(names))
    lens = next((pair for pair in NAMES if all(name in matrices for name in pair)), None)
    pose = next((pair for pair in POSES if all(name in matrices for name in pair)), None)
    if lens is None or pose is None:
        raise InputError(
            f"{path}: a camera's file has camera_matrix, distortion_coefficients, image_width, image_height, "
            "R (3x3 or Rodrigues) and T (world to camera, metres)"
        )
    if size is None:
        raise InputError(f"{path}: has no image_width and image_height")
    R, t = matrices[pose[0]], matrices[pose[1]].ravel()
    if R.size == 3 and (np.abs(R) <= LARGEST).all():
        R = cv2.Rodrigues(R.reshape(3, 1))[0]
    if not _is_rotation(R):
        raise InputError(f"{path}: {pose[0]} is no rotation: 3x3 with R R^T = 1 and determinant 1, or Rodrigues' three")
    if t.size != 3 or not (np.abs(t) <= LARGEST).all():
        raise InputError(f"{path}: {pose[1]} must be three finite numbers, metres, x_camera = R x_world + T")
    U, _, Vt = np.linalg.svd(R)
    return View(path.stem, lens_of(path, matrices, *lens), _sized(size), U @ Vt, t)


def _sized(size: Size) -> Size:
    return int(size[0]), int(size[1])


def _is_rotation(R: Array) -> bool:
    if R.shape != (3, 3) or not np.isfinite(R).all():
        return False
    return bool(np.abs(R @ R.T - np.eye(3)).max() < ORTHONORMAL and np.linalg.det(R) > 0)


def _check(views: list[View], where: Path) -> None:
    if len(views) < 2:
        raise InputError(f"{where}: {len(views)} camera; fusing needs two or more")
    names = [view.name for view in views]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{where}: two cameras are called '{twice}'; give each a name of its own")
    away = [float(np.linalg.norm(view.centre - views[0].centre)) for view in views]
    if max(away) > FARTHEST:
        far = names[int(np.argmax(away))]
        raise InputError(
            f"{where}: camera '{far}' is {max(away):g} m from '{names[0]}'; "
            "translation must be in metres (not millimetres)"
        )
    if max(away) < 1e-6:
        raise InputError(f"{where}: all cameras stand in the same place; depth cannot be seen from one place")
