"""points.csv, lines.csv and gaze.csv: strict, with line and column in every complaint."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.records import Array

LARGEST = 10_000_000  # bytes; a survey is small, and rubbish is not read to its end


def read_points(path: Path) -> tuple[Array, Array]:
    """Image points (N, 2) px and ground points (N, 2) m of `u,v,X,Y`; raises InputError."""
    table = _read(path, ("u", "v", "X", "Y"))
    return table[:, :2], table[:, 2:]


def read_lines(path: Path) -> tuple[Array, Array]:
    """Image lines (N, 4) px and ground lines (N, 4) m of `u1,v1,u2,v2,X1,Y1,X2,Y2`; raises InputError."""
    table = _read(path, ("u1", "v1", "u2", "v2", "X1", "Y1", "X2", "Y2"))
    return table[:, :4], table[:, 4:]


def read_gaze(path: Path) -> tuple[Array, Array]:
    """Elevation and vergence (N, 2) rad and ground points (N, 2) m of `elevation,vergence,X,Y`; raises InputError."""
    table = _read(path, ("elevation", "vergence", "X", "Y"))
    for row, column in zip(*np.nonzero(np.abs(table[:, :2]) >= math.pi / 2), strict=True):
        name = ("elevation", "vergence")[column]
        raise InputError(f"{path}, row {row + 1}: {name} {table[row, column]:g} rad does not look forward; degrees?")
    return table[:, :2], table[:, 2:]


def _read(path: Path, names: tuple[str, ...]) -> Array:
    wanted = ",".join(names)
    try:
        if path.stat().st_size > LARGEST:
            raise InputError(f"{path}: larger than {LARGEST} bytes; not a table of {wanted}")
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [
                (number, [cell.strip() for cell in row])
                for number, row in enumerate(csv.reader(file), start=1)
                if any(cell.strip() for cell in row) and not row[0].lstrip().startswith("#")
            ]
    except (UnicodeDecodeError, csv.Error) as problem:
        raise InputError(f"{path}: not a text file; a table of {wanted} is needed") from problem
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror or problem}") from problem
    if not lines:
        raise InputError(f"{path}: is empty; a table of {wanted} is needed")
    first, header = lines[0]
    for name in names:
        if header.count(name) != 1:
            trouble = "is missing" if name not in header else "is given twice"
            raise InputError(f"{path}, line {first}: column {name} {trouble}; the header is {wanted}")
    if len(lines) == 1:
        raise InputError(f"{path}: has a header and no rows")
    places = [header.index(name) for name in names]
    return np.array([_numbers(row, header, places, f"{path}, line {number}") for number, row in lines[1:]])


def _numbers(row: list[str], header: list[str], places: list[int], where: str) -> list[float]:
    if len(row) != len(header):
        raise InputError(f"{where}: {len(row)} columns where the header has {len(header)}")
    values = []
    for place in places:
        try:
            value = float(row[place])
        except ValueError:
            raise InputError(f"{where}, column {header[place]}: '{row[place][:40]}' is not a number") from None
        if not math.isfinite(value):
            raise InputError(f"{where}, column {header[place]}: {row[place]} is not a finite number")
        values.append(value)
    return values
