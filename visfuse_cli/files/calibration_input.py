"""points.csv, lines.csv and gaze.csv: read strictly, with line and column in every complaint."""

from __future__ import annotations

import csv
import io
import math
import re
from pathlib import Path

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.files.atomic import write_text
from visfuse_cli.records import Array

LARGEST = 1_000_000  # bytes; a survey is small, and rubbish is not read to its end
BEYOND = 1e9  # no pixel and no metre on Earth is that far
POINT_COLUMNS = ("u", "v", "X", "Y")
LINE_COLUMNS = ("u1", "v1", "u2", "v2", "X1", "Y1", "X2", "Y2")
NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?(nan|inf|infinity)", re.IGNORECASE)


def read_points(path: Path) -> tuple[Array, Array]:
    """Image points (N, 2) px and ground points (N, 2) m of `u,v,X,Y`; raises InputError."""
    table = _read(path, POINT_COLUMNS)
    return table[:, :2], table[:, 2:]


def read_lines(path: Path) -> tuple[Array, Array]:
    """Image lines (N, 4) px and ground lines (N, 4) m of `u1,v1,u2,v2,X1,Y1,X2,Y2`; raises InputError."""
    table = _read(path, LINE_COLUMNS)
    return table[:, :4], table[:, 4:]


def read_gaze(path: Path) -> tuple[Array, Array]:
    """Elevation and vergence (N, 2) rad and ground points (N, 2) m of `elevation,vergence,X,Y`; raises InputError."""
    table = _read(path, ("elevation", "vergence", "X", "Y"), angles=2)
    return table[:, :2], table[:, 2:]


def write_survey(path: Path, columns: tuple[str, ...], table: Array) -> None:
    """Write points or lines (N, len(columns)) so that they are read back to the last digit; raises OutputError."""
    rows = [",".join(repr(value) for value in row) for row in table.tolist()]
    write_text(path, "\n".join([",".join(columns), *rows]) + "\n")


def _read(path: Path, names: tuple[str, ...], angles: int = 0) -> Array:
    """The named columns (N, len(names)) of a CSV file, the first `angles` of them directions that look forward."""
    wanted = ",".join(names)
    reader = csv.reader(io.StringIO(_text(path, wanted), newline=""))
    try:
        lines = [
            (reader.line_num, [cell.strip() for cell in row])
            for row in reader
            if any(cell.strip() for cell in row) and not row[0].lstrip().startswith("#")
        ]
    except csv.Error as problem:
        raise InputError(f"{path}, line {reader.line_num}: {problem}; a table of {wanted} is needed") from problem
    if not lines:
        raise InputError(f"{path}: is empty; a table of {wanted} is needed")
    first, header = lines[0]
    for name in names:
        if header.count(name) != 1:
            trouble = "is missing" if name not in header else "is given twice"
            raise InputError(f"{path}, line {first}: column {name} {trouble}; the header is {wanted}")
    if len(lines) == 1:
        raise InputError(f"{path}: has a header and no rows; a table of {wanted} is needed")
    limits = dict.fromkeys(names[:angles], math.pi / 2)
    return np.array([_numbers(row, header, names, limits, f"{path}, line {number}") for number, row in lines[1:]])


def _text(path: Path, wanted: str) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST + 1)
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror or problem}") from problem
    if len(data) > LARGEST:
        raise InputError(f"{path}: larger than {LARGEST} bytes; not a table of {wanted}")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise InputError(f"{path}: not a text file; a table of {wanted} is needed") from problem
    if "\0" in text:
        raise InputError(f"{path}: not a text file; a table of {wanted} is needed")
    return text


def _numbers(
    row: list[str], header: list[str], names: tuple[str, ...], limits: dict[str, float], where: str
) -> list[float]:
    if len(row) != len(header):
        raise InputError(f"{where}: {len(row)} columns where the header has {len(header)}")
    values = []
    for name in names:
        cell = row[header.index(name)]
        if not NUMBER.fullmatch(cell):
            raise InputError(f"{where}, column {name}: {cell[:40]!r} is not a number")
        value = float(cell)
        if not math.isfinite(value):
            raise InputError(f"{where}, column {name}: {cell[:40]} is not a finite number")
        if abs(value) >= limits.get(name, BEYOND):
            reason = "rad does not look forward; degrees?" if name in limits else f"is beyond {BEYOND:g}"
            raise InputError(f"{where}, column {name}: {cell[:40]} {reason}")
        values.append(value)
    return values
