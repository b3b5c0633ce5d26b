"""The calibration of a stereo pair: OpenCV's own format and KITTI's."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.files.homography import is_camera_matrix
from visfuse_cli.files.lens_files import Size, lens_of, read_calibration_text, read_matrices
from visfuse_cli.records import Array, Lens, StereoRig

FILES = (
    "calibration.yaml",
    "calibration.yml",
    "calibration.xml",
    "calibration.txt",
    "calib.txt",
    "calib_cam_to_cam.txt",
)
NAMES = ("M1", "D1", "M2", "D2", "R", "T")
# KITTI numbers its cameras: grey 0 and 1, colour 2 and 3; object labels belong to the colour pair.
KITTI_PAIRS = (("P2", "P3"), ("P0", "P1"), ("P_rect_02", "P_rect_03"), ("P_rect_00", "P_rect_01"))
SHORTEST, LONGEST = 1e-4, 1e3  # m: a baseline outside is in other units, or none
ORTHONORMAL = 1e-3  # calibration files carry few digits now and then


def read_rig(path: Path) -> StereoRig:
    """The stereo pair of an OpenCV FileStorage with M1 D1 M2 D2 R T (x2 = R x1 + T, m), or of a KITTI calib file.

    A KITTI file's projections belong to its rectified footage. Raises InputError naming the key that is wrong.
    """
    text = read_calibration_text(path)
    rig = _opencv(path) if text.startswith(("%YAML", "<?xml", "{")) else _kitti(path, text)
    if not SHORTEST <= rig.baseline <= LONGEST:
        raise InputError(
            f"{path}: the cameras are {rig.baseline:g} m apart; T is in metres, {SHORTEST:g} to {LONGEST:g} long"
        )
    return rig


def _opencv(path: Path) -> StereoRig:
    matrices, size = read_matrices(path, NAMES)
    missing = [name for name in NAMES if name not in matrices]
    if missing:
        raise InputError(f"{path}: {', '.join(missing)} missing; a stereo calibration has {' '.join(NAMES)}")
    R, T = matrices["R"], matrices["T"]
    if R.size == 3 and np.isfinite(R).all():
        import cv2

        R = cv2.Rodrigues(R.reshape(3, 1))[0]
    if not _is_rotation(R):
        raise InputError(f"{path}: R is no rotation: a 3x3 matrix with R R^T = 1 and determinant 1, x2 = R x1 + T")
    if T.size != 3 or not np.isfinite(T).all():
        raise InputError(f"{path}: T must be three finite numbers, metres, x2 = R x1 + T")
    left, right = (lens_of(path, matrices, f"M{k}", f"D{k}") for k in (1, 2))
    U, _, Vt = np.linalg.svd(R)
    return StereoRig(left, right, U @ Vt, T.ravel(), size)


def _is_rotation(R: Array) -> bool:
    if R.shape != (3, 3) or not np.isfinite(R).all():
        return False
    return bool(np.abs(R @ R.T - np.eye(3)).max() < ORTHONORMAL and np.linalg.det(R) > 0)


def _kitti(path: Path, text: str) -> StereoRig:
    rows = _kitti_rows(path, text)
    pair = next((pair for pair in KITTI_PAIRS if all(name in rows for name in pair)), None)
    if pair is None:
        raise InputError(
            f"{path}: neither an OpenCV calibration (begins with %YAML:1.0) nor KITTI's (lines P0: and P1:)"
        )
    lenses, centres = [], []
    for name in pair:
        values = rows[name]
        P = values.reshape(3, 4) if values.size == 12 else np.full((3, 4), np.nan)
        if not is_camera_matrix(P[:, :3]) or not np.isfinite(P).all():
            raise InputError(f"{path}: {name} is not a projection: 12 numbers, rows [fx 0 cx tx; 0 fy cy ty; 0 0 1 tz]")
        lenses.append(Lens(P[:, :3], np.zeros(5)))
        centres.append(np.linalg.solve(P[:, :3], P[:, 3]))
    return StereoRig(lenses[0], lenses[1], np.eye(3), centres[1] - centres[0], _kitti_size(rows, pair[0]))


def _kitti_rows(path: Path, text: str) -> dict[str, Array]:
    rows = {}
    for number, line in enumerate(text.splitlines(), start=1):
        name, colon, values = line.partition(":")
        if not colon or not name.startswith(("P", "S_rect")):
            continue
        try:
            rows[name.strip()] = np.array([float(value) for value in values.split()])
        except ValueError as problem:
            raise InputError(f"{path}, line {number}: {name} holds something that is no number") from problem
    return rows


def _kitti_size(rows: dict[str, Array], name: str) -> Size | None:
    size = rows.get(name.replace("P_rect", "S_rect"))
    return (int(size[0]), int(size[1])) if name.startswith("P_rect") and size is not None and size.size == 2 else None
