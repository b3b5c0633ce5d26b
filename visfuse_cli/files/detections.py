"""External detections: MOTChallenge rows, one box a line."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.records import Array

COLUMNS = "frame,id,x,y,w,h,score"


def read_mot(path: Path) -> dict[int, Array]:
    """Boxes [x, y, w, h, score] (n, 5) px by 0-based frame from `frame,id,x,y,w,h,score,...` rows with frames from 1.

    Raises InputError with line and column for a row that is not such a box.
    """
    boxes: dict[int, list[list[float]]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for line, row in enumerate(csv.reader(file), start=1):
                if not row or not "".join(row).strip() or row[0].lstrip().startswith("#"):
                    continue
                frame, box = _row(row, f"{path}, line {line}")
                boxes.setdefault(frame, []).append(box)
    except (UnicodeDecodeError, csv.Error) as problem:
        raise InputError(f"{path}: not a text file of MOTChallenge rows ({COLUMNS})") from problem
    except OSError as problem:
        raise InputError(f"{path}: cannot read detections: {problem.strerror or problem}") from problem
    return {frame: np.array(rows) for frame, rows in boxes.items()}


def _row(row: list[str], where: str) -> tuple[int, list[float]]:
    names = COLUMNS.split(",")
    if len(row) < 6:
        raise InputError(f"{where}: {len(row)} columns; a MOTChallenge row has {COLUMNS}")
    values = []
    for name, text in zip(names, row, strict=False):
        try:
            value = float(text)
        except ValueError:
            raise InputError(f"{where}, column {name}: '{text.strip()[:40]}' is not a number") from None
        if not math.isfinite(value):
            raise InputError(f"{where}, column {name}: {text.strip()} is not finite")
        values.append(value)
    frame, _, x, y, w, h = values[:6]
    score = values[6] if len(values) > 6 else 1.0
    if frame < 1 or frame != int(frame):
        raise InputError(f"{where}, column frame: {row[0].strip()} is not a whole number from 1 on")
    if w <= 0 or h <= 0:
        raise InputError(f"{where}: a box of {w:g} x {h:g} px; width and height must be positive")
    return int(frame) - 1, [x, y, w, h, score]
