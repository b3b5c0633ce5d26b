"""sensors.csv of a moving camera, in the four forms that a scene may have."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.records import Array

LARGEST = 1e9  # of any unit: what is beyond it was not measured
FORMS = {
    "volts": ("t", "u1", "u2"),
    "wheels": ("t", "v1", "v2"),
    "gaze": ("t", "elevation", "vergence"),
    "pose": ("t", "x", "z", "theta"),
}
GAP_S = 1.0
GAP_RATIO = 5.0


@dataclass(frozen=True, slots=True)
class Sensors:
    """Samples over time: `form` one of volts, wheels, gaze, pose; columns by name, each (n,); warnings."""

    form: str
    columns: dict[str, Array]
    warnings: tuple[str, ...]

    @property
    def t(self) -> Array:
        """s."""
        return self.columns["t"]


def read_sensors(path: Path) -> Sensors:
    """Read sensors.csv; raises InputError naming line and column of what is wrong."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row and "".join(row).strip()]
    except (UnicodeDecodeError, csv.Error) as problem:
        raise InputError(f"{path}: not a text table of sensor samples") from problem
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror or problem}") from problem
    if not rows:
        raise InputError(f"{path}: is empty; the first line names the columns, as {','.join(FORMS['wheels'])}")
    names = [name.strip() for name in rows[0]]
    form = next((form for form, wanted in FORMS.items() if all(name in names for name in wanted)), None)
    if form is None:
        known = "; or ".join(",".join(wanted) for wanted in FORMS.values())
        raise InputError(f"{path}, line 1: columns {','.join(names)[:80]} are none of: {known}[,y,pitch]")
    if len(set(names)) < len(names):
        raise InputError(f"{path}, line 1: a column is given twice")
    values = _values(path, rows, names)
    if len(values) < 2:
        raise InputError(f"{path}: {len(values)} sample; two or more are needed to know a motion")
    columns = {name: values[:, k] for k, name in enumerate(names)}
    back = np.flatnonzero(np.diff(columns["t"]) <= 0)
    if len(back):
        k = int(back[0])
        raise InputError(
            f"{path}, line {k + 3}, column t: {columns['t'][k + 1]:g} does not come after {columns['t'][k]:g}; "
            "times must rise"
        )
    return Sensors(form, columns, _gaps(path, columns["t"]))


def _values(path: Path, rows: list[list[str]], names: list[str]) -> Array:
    values = []
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(names):
            raise InputError(f"{path}, line {number}: {len(row)} columns where the first line names {len(names)}")
        numbers = []
        for name, text in zip(names, row, strict=True):
            try:
                value = float(text)
            except ValueError:
                raise InputError(
                    f"{path}, line {number}, column {name}: '{text.strip()[:40]}' is not a number"
                ) from None
            if not np.isfinite(value):
                raise InputError(f"{path}, line {number}, column {name}: {text.strip()} is not finite")
            if abs(value) > LARGEST:
                raise InputError(f"{path}, line {number}, column {name}: {text.strip()} is beyond {LARGEST:g}")
            numbers.append(value)
        values.append(numbers)
    return np.array(values, dtype=float).reshape(-1, len(names))


def _gaps(path: Path, t: Array) -> tuple[str, ...]:
    dt = np.diff(t)
    long = np.flatnonzero((dt > GAP_S) & (dt > GAP_RATIO * np.median(dt)))
    if not len(long):
        return ()
    k = int(long[np.argmax(dt[long])])
    return (
        f"{path}: {len(long)} gap{'s' if len(long) > 1 else ''} in the samples, the longest {dt[k]:.1f} s "
        f"after t = {t[k]:g}; the motion is interpolated there",
    )
