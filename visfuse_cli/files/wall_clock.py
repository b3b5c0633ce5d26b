"""When a recording began, by the clock on the wall: from its name where a pattern says how, else from its container."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from zoneinfo import ZoneInfo

from visfuse_cli.errors import InputError

EXAMPLE = "like cam1_%Y%m%d-%H%M%S"
SAMPLE = datetime(2021, 11, 23, 21, 45, 37, tzinfo=UTC)  # every field of it differs from what strptime assumes
CLOCK_AGREES = timedelta(minutes=20)  # how far a container's time may be off and still tell which hour is meant


def began(path: Path, pattern: str | None, zone: str, recorded: datetime | None) -> tuple[datetime | None, str]:
    """The time (UTC) of a clip's first frame, None where nobody knows it, and what is doubtful about it, or nothing.

    `pattern` (strptime) describes the file's name without its ending and wins over the container's `recorded` time;
    a name without an offset of its own is in `zone`. Where clocks are put back an hour happens twice: `recorded`
    tells which is meant, else it is the first. Raises InputError where a name does not fit the pattern.
    """
    if pattern is None:
        return recorded, ""
    try:
        moment = datetime.strptime(path.stem, pattern)
        if moment.tzinfo is not None:
            return moment.astimezone(UTC), ""
        first, second = (moment.replace(tzinfo=known_zone(zone), fold=fold).astimezone(UTC) for fold in (0, 1))
    except (ValueError, OverflowError) as problem:
        raise InputError(
            f"{path}: the name '{path.stem}' does not fit clock.pattern '{pattern}'; "
            f"it describes the whole name without its ending, {EXAMPLE}"
        ) from problem
    if first == second:
        return first, ""
    clock = f"{path.name}: {moment:%Y-%m-%d %H:%M} in {zone}"
    if first > second:
        return first, f"{clock} never was, clocks were put forward; is the camera's clock in another zone?"
    for candidate in (first, second):
        if recorded is not None and abs(recorded - candidate) < CLOCK_AGREES:
            return candidate, ""
    return first, f"{clock} was twice, clocks were put back; taken as the first; name clips in UTC to be sure"


def check_pattern(pattern: str) -> None:
    """Raises ValueError where a strptime pattern is none, or does not tell day and hour."""
    try:
        told = datetime.strptime(SAMPLE.strftime(pattern), pattern)
    except (ValueError, re.error) as problem:
        raise ValueError(f"'{pattern}' is no time pattern: {problem}; write it {EXAMPLE}") from problem
    if told.replace(minute=0, second=0, microsecond=0, tzinfo=UTC) != SAMPLE.replace(minute=0, second=0):
        raise ValueError(f"'{pattern}' does not tell year, month, day and hour; write it {EXAMPLE}")


def known_zone(name: str) -> tzinfo:
    """The time zone of an IANA name; raises ValueError where there is none."""
    try:
        return ZoneInfo(name)
    except (KeyError, ValueError, OSError) as problem:
        raise ValueError(f"'{name}' is no time zone; give an IANA name like Europe/Vienna or UTC") from problem
