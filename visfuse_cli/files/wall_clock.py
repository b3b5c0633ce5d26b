"""When a recording began, by the clock on the wall: from its name where a pattern says how, else from its container."""

from __future__ import annotations

from datetime import UTC, datetime, tzinfo
from pathlib import Path
from zoneinfo import ZoneInfo

from visfuse_cli.errors import InputError


def began(path: Path, pattern: str | None, zone: str, recorded: datetime | None) -> datetime | None:
    """The aware time of a clip's first frame, None where nobody knows it.

    `pattern` (strptime) describes the file's name without its ending and wins over the container's `recorded` time;
    a name without an offset of its own is in `zone`. Raises InputError where a name does not fit the pattern.
    """
    if pattern is None:
        return recorded
    try:
        moment = datetime.strptime(path.stem, pattern)
    except ValueError as problem:
        raise InputError(
            f"{path}: the name '{path.stem}' does not fit clock.pattern '{pattern}'; "
            "it describes the whole name without its ending, like cam1_%Y%m%d-%H%M%S"
        ) from problem
    return (moment if moment.tzinfo else moment.replace(tzinfo=known_zone(zone))).astimezone(UTC)


def known_zone(name: str) -> tzinfo:
    """The time zone of an IANA name; raises ValueError where there is none."""
    try:
        return ZoneInfo(name)
    except (KeyError, ValueError, OSError) as problem:
        raise ValueError(f"'{name}' is no time zone; give an IANA name like Europe/Vienna or UTC") from problem
