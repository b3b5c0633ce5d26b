"""lanes.yaml: lanes as polygons in metres, in the form in which a configuration takes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import Field, ValidationError

from visfuse_cli.config import Section, parse_yaml, read_text
from visfuse_cli.errors import InputError, OutputError
from visfuse_cli.files.atomic import write_text
from visfuse_cli.maths.polygons import Polygon, surrounding

HEAD = """\
# Lanes as polygons of ground points [X, Y] in metres; the first is lane 1. Edit the corners, keep the order.
# Used again by --set lanes_file=THIS_FILE, by --config THIS_FILE, or as the key `lanes` of another configuration.
"""


class _Lanes(Section):
    lanes: tuple[Polygon, ...] = Field(min_length=1)


def read_lanes(path: Path) -> tuple[Polygon, ...] | None:
    """The lanes of a file, None where there is none yet.

    Raises InputError where it holds no lanes, OutputError where it is missing and could not be written either.
    """
    if not path.exists():
        if not path.parent.is_dir():
            raise OutputError(f"{path}: there is no folder {path.parent} in which found lanes could be kept")
        return None
    data, _ = parse_yaml(read_text(path, "the lanes", InputError), str(path), InputError)
    try:
        lanes = _Lanes.model_validate(data).lanes
        return tuple(surrounding(lane, f"lane {number}") for number, lane in enumerate(lanes, start=1))
    except ValidationError as problem:
        first = problem.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        raise InputError(
            f"{path}: {place}: {first['msg'].lower()}; it needs the key lanes: [[[X, Y], [X, Y], [X, Y], ...], ...]"
        ) from problem
    except ValueError as problem:
        raise InputError(f"{path}: {problem}") from problem


def write_lanes(path: Path, lanes: Sequence[Polygon]) -> None:
    """Write lanes; raises OutputError."""
    rows = [f"  - [{', '.join(f'[{x}, {y}]' for x, y in lane)}]  # lane {n}" for n, lane in enumerate(lanes, 1)]
    write_text(path, "\n".join([HEAD + "lanes:", *rows]) + "\n")
