"""H.json: the ground map as a file, strictly checked on reading."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.files.atomic import write_json
from visfuse_cli.records import Array, GroundMap, GroundReference, Lens

SCHEMA = "visfuse.homography/1"
LARGEST = 1e15  # m a pixel, times pixels
COEFFICIENTS = (4, 5, 8, 12, 14)  # lengths of OpenCV's distortion


def write(path: Path, ground: GroundMap) -> None:
    """Write H.json; raises OutputError where it cannot be written."""
    lens = None if ground.lens is None else {"K": ground.lens.K.tolist(), "D": ground.lens.D.tolist()}
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "input": ground.input,
        "image_size": None if ground.image_size is None else list(ground.image_size),
        "lens": lens,
        "H": ground.ground_from_image.tolist(),
        "ground_sign": ground.ground_sign,
        "covariance": ground.cov.tolist(),
        "rms_m": ground.rms_m,
        "rms_px": ground.rms_px,
        "residuals": list(ground.residuals),
        "source": ground.source,
    }
    if ground.reference is not None:
        document["crs"] = asdict(ground.reference)
    write_json(path, document)


def is_camera_matrix(K: Array) -> bool:
    """Whether K is [fx 0 cx; 0 fy cy; 0 0 1]; OpenCV's lens model ignores every other entry without a word."""
    if K.shape != (3, 3) or not np.isfinite(K).all():
        return False
    return bool(K[0, 0] > 0 and K[1, 1] > 0 and K[2, 2] == 1 and not np.any(K[[0, 1, 2, 2], [1, 0, 0, 1]]))


def read(path: Path) -> GroundMap:
    """Read H.json; raises InputError naming the key that is missing or wrong."""
    try:
        document = json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as problem:
        raise InputError(f"{path}: cannot read the homography: {problem.strerror or problem}") from problem
    except (ValueError, RecursionError) as problem:  # not UTF-8, not JSON, or a number of thousands of digits
        raise InputError(f"{path}: not JSON; give the H.json that calibrate-homography wrote") from problem
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise InputError(f'{path}: not a homography: "schema" must be "{SCHEMA}"')
    H = _array(path, document, "H", (3, 3))
    if H.any() and not 0.1 < np.abs(H).max() < LARGEST:
        raise InputError(f'{path}: "H" must be scaled to H[2][2] = 1; calibrate again')
    if np.linalg.cond(H / np.maximum(np.linalg.norm(H, axis=1, keepdims=True), 1e-300)) > 1e12:
        raise InputError(f'{path}: "H" is singular; calibrate again')
    kind = _get(path, document, "input")
    if kind not in ("pixel", "gaze"):
        raise InputError(f'{path}: "input" is {kind!r}; it must be "pixel" or "gaze"')
    sign = _get(path, document, "ground_sign")
    if isinstance(sign, bool) or sign not in (1, -1):
        raise InputError(f'{path}: "ground_sign" is {sign!r}; it must be 1 or -1')
    return GroundMap(
        ground_from_image=H,
        cov=_covariance(path, document),
        ground_sign=int(sign),
        input=kind,
        image_size=_size(path, document),
        lens=_lens(path, document),
        rms_m=_spread(path, document, "rms_m"),
        rms_px=_spread(path, document, "rms_px"),
        residuals=_residuals(path, document),
        source=str(document.get("source") or ""),
        reference=_reference(path, document),
    )


def _get(path: Path, document: dict[str, Any], key: str) -> Any:
    if key not in document:
        raise InputError(f'{path}: "{key}" is missing; calibrate again')
    return document[key]


def _array(path: Path, document: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
    value = _get(path, document, key)
    try:
        array = np.array(value)
        array = array.astype(float) if array.dtype.kind in "iuf" else np.array(np.nan)  # "1" and true are not
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        wanted = "x".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
        raise InputError(f'{path}: "{key}" must be {wanted}')
    return array


def _spread(path: Path, document: dict[str, Any], key: str) -> float:
    value = float(_array(path, document, key, ()))
    if value < 0:
        raise InputError(f'{path}: "{key}" is {value:g}; a residual is not negative')
    return value


def _covariance(path: Path, document: dict[str, Any]) -> Array:
    cov = _array(path, document, "covariance", (9, 9))
    scale = np.sqrt(np.maximum(np.diag(cov), 0))
    scale[scale == 0] = 1.0
    relative = cov / np.outer(scale, scale)
    if np.abs(relative - relative.T).max() > 1e-6 or np.linalg.eigvalsh((relative + relative.T) / 2).min() < -1e-6:
        raise InputError(f'{path}: "covariance" is no covariance: not symmetric or not positive')
    return (cov + cov.T) / 2


def _size(path: Path, document: dict[str, Any]) -> tuple[int, int] | None:
    value = document.get("image_size")
    if value is None:
        return None
    if not (isinstance(value, list) and len(value) == 2 and all(type(v) is int and v > 0 for v in value)):
        raise InputError(f'{path}: "image_size" must be [width, height] in pixels, or null')
    return value[0], value[1]


def _lens(path: Path, document: dict[str, Any]) -> Lens | None:
    value = document.get("lens")
    if value is None:
        return None
    if not isinstance(value, dict):
        raise InputError(f'{path}: "lens" must be {{"K": 3x3, "D": coefficients}}, or null')
    K = _array(path, value, "K", (3, 3))
    if not is_camera_matrix(K):
        raise InputError(f'{path}: "lens.K" is not a camera matrix [fx 0 cx; 0 fy cy; 0 0 1]')
    coefficients = _get(path, value, "D")
    count = len(coefficients) if isinstance(coefficients, list) else 0
    if count not in COEFFICIENTS:
        raise InputError(f'{path}: "lens.D" must be a list of {", ".join(map(str, COEFFICIENTS))} coefficients')
    return Lens(K, _array(path, value, "D", (count,)))


def _reference(path: Path, document: dict[str, Any]) -> GroundReference | None:
    value = document.get("crs")
    if value is None:
        return None
    if not (isinstance(value, dict) and isinstance(value.get("code"), str)):
        raise InputError(f'{path}: "crs" must be {{"code": "EPSG:...", "origin": [E, N]}}, or null')
    easting, northing = _array(path, value, "origin", (2,)).tolist()
    return GroundReference(value["code"], (easting, northing))


def _residuals(path: Path, document: dict[str, Any]) -> tuple[dict[str, Any], ...]:
    value = document.get("residuals") or []
    if not (isinstance(value, list) and all(isinstance(row, dict) for row in value)):
        raise InputError(f'{path}: "residuals" must be a list of objects')
    return tuple(value)
