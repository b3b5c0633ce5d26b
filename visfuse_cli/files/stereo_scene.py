"""What a stereo scene says of its targets and their path: init.yaml and path.yaml, in footage pixels or metres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.config import parse_yaml, read_text
from visfuse_cli.errors import InputError
from visfuse_cli.records import Array, GivenTarget

MOST = 10_000  # points of a path
FARTHEST_PX = 1e5


@dataclass(frozen=True, slots=True)
class GivenPath:
    """A path named by hand: its images left (n, 2) and right (m, 2) px, or its points (n, 3) m."""

    left: Array | None
    right: Array | None
    points: Array | None


def read_init(path: Path) -> list[GivenTarget]:
    """The targets of init.yaml; raises InputError naming the entry that is wrong."""
    document = _mapping(path, ("targets",))
    targets = document.get("targets")
    if not isinstance(targets, list) or not targets:
        raise InputError(f"{path}: targets must be a list: [{{frame: 0, left: BOX or QUAD, right: QUAD, speed: 15.0}}]")
    return [_target(f"{path}, targets[{k}]", entry) for k, entry in enumerate(targets)]


def _target(where: str, entry: Any) -> GivenTarget:
    if not isinstance(entry, dict):
        raise InputError(f"{where}: must be a mapping with frame, left and, where known, right and speed")
    unknown = [key for key in entry if key not in ("frame", "left", "right", "speed")]
    if unknown:
        raise InputError(f"{where}: unknown key '{unknown[0]}'; known here: frame, left, right, speed")
    frame = entry.get("frame", 0)
    if not isinstance(frame, int) or isinstance(frame, bool) or frame < 0:
        raise InputError(f"{where}, frame: {frame!r} is no frame's number; they count from 0")
    if "left" not in entry:
        raise InputError(f"{where}: left is missing: a box [x, y, w, h] or four corners")
    speed = entry.get("speed")
    if speed is not None and (isinstance(speed, bool) or not isinstance(speed, int | float) or not abs(speed) < 1000):
        raise InputError(f"{where}, speed: {speed!r} is no speed in m/s")
    right = entry.get("right")
    return GivenTarget(
        frame,
        _quad(f"{where}, left", entry["left"]),
        None if right is None else _quad(f"{where}, right", right),
        None if speed is None else float(speed),
    )


def _quad(where: str, value: Any) -> Array:
    """Four corners (4, 2) of a box [x, y, w, h] or a quad, clockwise from the top left."""
    numbers = _numbers(where, value)
    if numbers.shape == (4,):
        x, y, w, h = numbers
        if w < 4 or h < 4:
            raise InputError(f"{where}: a box of {w:g} x {h:g} px; width and height must be 4 px or more")
        return np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])
    if numbers.shape != (4, 2):
        raise InputError(f"{where}: must be a box [x, y, w, h] or four corners [[u, v], ...], clockwise from top left")
    edge = np.roll(numbers, -1, axis=0) - numbers
    turn = edge[:, 0] * np.roll(edge[:, 1], -1) - edge[:, 1] * np.roll(edge[:, 0], -1)
    if not np.all(turn > 0):
        raise InputError(f"{where}: the corners do not run clockwise from the top left around a convex patch")
    if np.linalg.norm(edge, axis=1).min() < 4:
        raise InputError(f"{where}: a side is shorter than 4 px")
    return numbers


def read_path(path: Path) -> GivenPath:
    """The path of path.yaml; raises InputError naming the entry that is wrong."""
    document = _mapping(path, ("left", "right", "points"))
    if ("points" in document) == ("left" in document or "right" in document):
        raise InputError(f"{path}: give either left and right, [[u, v], ...] px each, or points, [[X, Y, Z], ...] m")
    if "points" in document:
        return GivenPath(None, None, _line(f"{path}, points", document["points"], 3))
    missing = [view for view in ("left", "right") if view not in document]
    if missing:
        raise InputError(f"{path}: {missing[0]} is missing; the path is needed in both views")
    left, right = (_line(f"{path}, {view}", document[view], 2) for view in ("left", "right"))
    if (len(left) == 2) != (len(right) == 2):
        raise InputError(f"{path}: left has {len(left)} points and right {len(right)}; two in both, or more in both")
    return GivenPath(left, right, None)


def _line(where: str, value: Any, size: int) -> Array:
    numbers = _numbers(where, value)
    if numbers.ndim != 2 or numbers.shape[1] != size or not 2 <= len(numbers) <= MOST:
        raise InputError(f"{where}: must be two or more points of {size} numbers each")
    if np.linalg.norm(np.diff(numbers, axis=0), axis=1).min() < 1e-6:
        raise InputError(f"{where}: the same point twice in a row")
    return numbers


def _numbers(where: str, value: Any) -> Array:
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"{where}: must be numbers, each row as long as the others") from None
    if not np.isfinite(numbers).all() or np.abs(numbers).max(initial=0.0) > FARTHEST_PX:
        raise InputError(f"{where}: holds a number that is not finite, or beyond reason")
    return numbers


def _mapping(path: Path, known: tuple[str, ...]) -> Mapping[str, Any]:
    document, _ = parse_yaml(read_text(path, "the file", InputError), str(path), InputError)
    if not isinstance(document, dict):
        raise InputError(f"{path}: must hold {' or '.join(known)}")
    unknown = [key for key in document if key not in known]
    if unknown:
        raise InputError(f"{path}: unknown key '{unknown[0]}'; known here: {', '.join(known)}")
    return document
