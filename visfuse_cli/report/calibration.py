"""A calibration on the page: H.json, and the picture beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.files import homography
from visfuse_cli.maths.calibration_error import DURATION_S, SPEED_KMH, speed_error
from visfuse_cli.records import GroundMap

DIGITS = {"error_px": 2, "error_m": 3, "leave_one_out_m": 2}


def section(path: Path) -> dict[str, Any]:
    """What the template shows of a calibration; raises InputError where it is none."""
    ground = homography.read(path)
    picture = path.with_suffix(".png")
    return {
        "name": path.name,
        "calibrated": True,
        "source": ground.source,
        "figures": _figures(ground),
        "picture": picture if picture.is_file() else None,
        "residuals": [_residual(row) for row in ground.residuals],
    }


def _figures(ground: GroundMap) -> list[tuple[str, str]]:
    unit, scale = ("px", 1.0) if ground.input == "pixel" else ("mrad", 1000.0)
    used = sum(bool(row.get("used")) for row in ground.residuals)
    found = [("used", f"{used} of {len(ground.residuals)}"), ("residual (rms)", f"{ground.rms_m:.3f} m")]
    found.append((f"in the {'picture' if unit == 'px' else 'angles'}", f"{ground.rms_px * scale:.2f} {unit}"))
    if ground.image_size is not None and ground.input == "pixel":
        wide, high = ground.image_size
        middle = np.array([[wide / 2 - 0.5, high * 0.7]])
        error = float(speed_error(ground, middle, 1.0)[0])
        if np.isfinite(error):
            head = f"{SPEED_KMH:g} km/h over {DURATION_S:g} s, below the middle"
            found.append((head, f"+-{1.96 * error:.1f} km/h (95 %)"))
    return found


def _residual(row: dict[str, Any]) -> list[str]:
    number = row.get("index")
    cells = [str(number + 1) if isinstance(number, int) else "-"]
    for key, digits in DIGITS.items():
        value = row.get(key)
        cells.append(f"{value:.{digits}f}" if isinstance(value, int | float) else "")
    return [*cells, "yes" if row.get("used") else "dropped"]
