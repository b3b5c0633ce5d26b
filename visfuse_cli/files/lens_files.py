"""The lens of one camera from a calibration file in OpenCV's own format."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.files.homography import COEFFICIENTS, is_camera_matrix
from visfuse_cli.records import Array, Lens

NAMES = (("M1", "D1"), ("camera_matrix", "distortion_coefficients"), ("K", "D"))
LARGEST = 10_000_000  # bytes: calibration files with all their board corners stay below
LONGEST = 1_000_000  # px
Size = tuple[int, int]


def read_lens(path: Path) -> tuple[Lens, Size | None]:
    """Lens and image size (None where the file names none) of an OpenCV FileStorage; raises InputError.

    Takes M1 and D1 (stereo sample), or camera_matrix and distortion_coefficients (calibration sample).
    """
    matrices, size = read_matrices(path, [name for pair in NAMES for name in pair])
    found = next((pair for pair in NAMES if all(name in matrices for name in pair)), None)
    if found is None:
        raise InputError(f"{path}: has neither M1 and D1 nor camera_matrix and distortion_coefficients")
    return lens_of(path, matrices, *found), size


def read_matrices(path: Path, names: Iterable[str]) -> tuple[dict[str, Array], Size | None]:
    """Those of the named matrices that an OpenCV FileStorage holds, and the image size; raises InputError."""
    text = read_calibration_text(path)
    if not text.startswith(("%YAML", "<?xml", "{")):
        raise InputError(f"{path}: not an OpenCV calibration file; it begins with %YAML:1.0")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = {name: storage.getNode(name) for name in names}
        matrices = {name: _matrix(node) for name, node in nodes.items() if not node.empty()}
        sides = _sides(storage)
    except (cv2.error, SystemError, TypeError, ValueError) as problem:
        raise InputError(f"{path}: not a readable OpenCV calibration file") from problem
    return matrices, _size(path, sides)


def lens_of(path: Path, matrices: Mapping[str, Array], camera_matrix: str, distortion: str) -> Lens:
    """The lens from two of a file's matrices by name; raises InputError naming the one that is none."""
    K, D = matrices[camera_matrix], matrices[distortion]
    if not is_camera_matrix(K):
        raise InputError(f"{path}: {camera_matrix} is not a camera matrix [fx 0 cx; 0 fy cy; 0 0 1]")
    if D.size not in COEFFICIENTS or not np.isfinite(D).all():
        known = ", ".join(map(str, COEFFICIENTS))
        raise InputError(f"{path}: {distortion} must be {known} finite coefficients")
    return Lens(K, D.ravel())


def read_calibration_text(path: Path) -> str:
    """A calibration file's text; raises InputError where it is missing, too large or no text."""
    try:
        with path.open("rb") as file:
            text = file.read(LARGEST + 1).decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise InputError(f"{path}: not a calibration file: not text") from problem
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror or problem}") from problem
    if len(text) > LARGEST:
        raise InputError(f"{path}: larger than {LARGEST} bytes; not a calibration file")
    return text


def _matrix(node: Any) -> np.ndarray:
    """A matrix node, or a plain list of numbers; empty for anything else."""
    if node.isSeq():
        return np.array([node.at(k).real() for k in range(node.size())])
    value = node.mat() if node.isMap() else None
    return np.zeros((0, 0)) if value is None else np.asarray(value, dtype=float)


def _sides(storage: Any) -> list[float]:
    """Width and height as the file has them, or nothing; NaN for what is no number."""
    sides = [storage.getNode(name) for name in ("image_width", "image_height")]
    if not any(side.empty() for side in sides):
        return [side.real() if side.isInt() or side.isReal() else math.nan for side in sides]
    pair: list[float] = _matrix(storage.getNode("image_size")).ravel().tolist()
    return pair if len(pair) == 2 else []


def _size(path: Path, sides: list[float]) -> Size | None:
    if not all(1 <= side <= LONGEST and side == int(side) for side in sides):
        width, height = sides
        raise InputError(f"{path}: the image size {width:g}x{height:g} is none; whole pixels are needed")
    return (int(sides[0]), int(sides[1])) if sides else None
