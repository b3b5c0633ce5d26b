"""What the page sends: marks in the picture and what is known of them on the ground, strictly checked."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from visfuse_cli.config import Section
from visfuse_cli.errors import InputError
from visfuse_cli.maths import layout
from visfuse_cli.records import Array

MOST = 500  # marks on one sheet
Number = Annotated[float, Field(gt=-1e9, lt=1e9)]
Length = Annotated[float, Field(gt=0, lt=1e6)]
Pair = tuple[Annotated[int, Field(ge=1, le=MOST)], Annotated[int, Field(ge=1, le=MOST)], Length]


class Typed(Section):
    """The metres are typed for each mark."""

    kind: Literal["typed"] = "typed"


class Dashes(Section):
    """Ends of lane dashes, line by line."""

    kind: Literal["dashes"]
    width: Length
    period: Length
    dash: Annotated[float, Field(ge=0, lt=1e6)] = 0.0  # 0: one end of each


class Rectangle(Section):
    """The first four points are the corners of a rectangle; what follows is typed."""

    kind: Literal["rectangle"]
    width: Length
    length: Length


class Distances(Section):
    """Distances between points, by their numbers from 1."""

    kind: Literal["distances"]
    pairs: Annotated[list[Pair], Field(max_length=5000)]


class Sheet(Section):
    """The marks of one frame; `world` holds null where nothing was typed yet, `lines` the lane line of each mark."""

    t: Annotated[float, Field(ge=0, lt=1e7)] = 0.0
    noun: Literal["point", "line"]
    marks: Annotated[list[list[Number]], Field(max_length=MOST)]
    world: Annotated[list[list[Number] | None], Field(max_length=MOST)]
    lines: Annotated[list[Annotated[int, Field(ge=0, le=MOST)]], Field(max_length=MOST)]
    pattern: Annotated[Typed | Dashes | Rectangle | Distances, Field(discriminator="kind")] = Typed()

    @model_validator(mode="after")
    def _of_one_length(self) -> Sheet:
        wide = 2 if self.noun == "point" else 4
        if not len(self.marks) == len(self.world) == len(self.lines):
            raise ValueError("needs as many marks as world entries and line numbers")
        if any(len(row) != wide for row in [*self.marks, *(row for row in self.world if row is not None)]):
            raise ValueError(f"a {self.noun} needs {wide} numbers")
        return self


def on_the_ground(sheet: Sheet) -> tuple[Array, Array]:
    """Marks (N, 2 or 4) px and their world (N, 2 or 4) m, to the digits that are saved.

    Raises InputError where the metres of a mark are not known yet, or a pattern does not fit.
    """
    wide = 2 if sheet.noun == "point" else 4
    if (count := len(sheet.marks)) < 4:
        raise InputError(f"a homography needs four {sheet.noun}s or more, not {count}")
    marks = np.array(sheet.marks, dtype=float)
    rows: list[list[float] | None] = list(sheet.world)
    if not isinstance(sheet.pattern, Typed):
        if sheet.noun == "line":
            raise InputError("patterns are for points; type the metres of lines")
        known = _patterned(sheet, marks)
        rows[: len(known)] = known.tolist()
    for number, row in enumerate(rows, 1):
        if row is None:
            raise InputError(f"{sheet.noun} {number} has no metres yet")
    return np.round(marks, 3), np.round(np.array(rows, dtype=float).reshape(-1, wide), 4)


def _patterned(sheet: Sheet, marks: Array) -> Array:
    pattern, n = sheet.pattern, len(marks)
    if isinstance(pattern, Dashes):
        return layout.dashes(np.array(sheet.lines, dtype=np.intp), pattern.width, pattern.period, pattern.dash)
    if isinstance(pattern, Rectangle):
        return layout.rectangle(pattern.width, pattern.length)
    assert isinstance(pattern, Distances)
    ends = np.array([pair[:2] for pair in pattern.pairs], dtype=np.intp).reshape(-1, 2) - 1
    if ends.size and (ends.max() >= n or np.any(ends[:, 0] == ends[:, 1])):
        raise InputError(f"a distance lies between two different points, numbered 1 to {n}")
    return layout.from_distances(ends, np.array([pair[2] for pair in pattern.pairs]), marks)[0]
