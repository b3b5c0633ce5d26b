"""The lens of one camera from a calibration file in OpenCV's own format."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.records import Lens

NAMES = (("M1", "D1"), ("camera_matrix", "distortion_coefficients"), ("K", "D"))
COEFFICIENTS = (4, 5, 8, 12, 14)


def read_lens(path: Path) -> tuple[Lens, tuple[int, int] | None]:
    """Lens and image size (None where the file names none) of an OpenCV FileStorage; raises InputError.

    Takes M1 and D1 (stereo sample), or camera_matrix and distortion_coefficients (calibration sample).
    """
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as problem:
        raise InputError(f"{path}: not a calibration file: not text") from problem
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror or problem}") from problem
    if not text.lstrip().startswith(("%YAML", "<?xml", "{")):
        raise InputError(f"{path}: not an OpenCV calibration file; it begins with %YAML:1.0")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        found = next((pair for pair in NAMES if all(not storage.getNode(name).empty() for name in pair)), None)
        if found is None:
            raise InputError(f"{path}: has neither M1 and D1 nor camera_matrix and distortion_coefficients")
        K, D = (np.asarray(storage.getNode(name).mat(), dtype=float) for name in found)
        sides = [storage.getNode(name) for name in ("image_width", "image_height")]
        size = None if any(side.empty() for side in sides) else (int(sides[0].real()), int(sides[1].real()))
    except (cv2.error, SystemError, TypeError, ValueError) as problem:
        raise InputError(f"{path}: not a readable OpenCV calibration file") from problem
    if K.shape != (3, 3) or not np.isfinite(K).all() or not (K[0, 0] > 0 and K[1, 1] > 0 and K[2, 2] == 1):
        raise InputError(f"{path}: {found[0]} is not a camera matrix [fx 0 cx; 0 fy cy; 0 0 1]")
    if D.size not in COEFFICIENTS or not np.isfinite(D).all():
        raise InputError(
            f"{path}: {found[1]} has {D.size} coefficients; OpenCV has {', '.join(map(str, COEFFICIENTS))}"
        )
    return Lens(K, D.ravel()), size
