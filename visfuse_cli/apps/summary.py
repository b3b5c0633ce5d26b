"""`visfuse summary`: what a traffic log says about speeds, by hour, day, weekday, lane or direction."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import Any, Literal

import numpy as np

from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files.traffic_log import read
from visfuse_cli.files.wall_clock import known_zone
from visfuse_cli.maths.percentiles import pace, percentile

Span = tuple[datetime, datetime]
By = Literal["hour", "day", "weekday", "lane", "direction"]
PACE_KMH = 16.09344  # ten miles an hour, as traffic engineers use it
SECTOR = 45.0  # degrees
GAP_S = 2.0  # between two recordings that is worth a line
COLUMNS = tuple(
    "group vehicles mean_kmh p50_kmh p50_low_kmh p50_high_kmh p85_kmh p85_low_kmh p85_high_kmh "
    "pace_from_kmh pace_to_kmh share_in_pace share_above_limit".split()
)


def summarise(
    log: Path, by: By | None, since: str | None, until: str | None, limit_kmh: float | None, zone: str
) -> dict[str, Any]:
    """Groups of vehicles with their figures, all of them first, and what time the recordings cover.

    `since` and `until` are ISO 8601, in `zone` where they name none; where times are asked for, recordings without
    one are left out. Raises InputError where the log cannot be read
    or names no times that are asked for, UsageError where an option makes no sense.
    """
    try:
        place = known_zone(zone)
    except ValueError as problem:
        raise UsageError(f"--zone: {problem}") from problem
    begin, end = (_moment(text, place, option) for text, option in ((since, "--since"), (until, "--until")))
    if begin and end and begin >= end:
        raise UsageError(f"--since {since} is not before --until {until}")
    clips, vehicles = read(log)
    if begin or end or by in ("hour", "day", "weekday"):
        if clips and all(clip["began_utc"] is None for clip in clips):
            raise InputError(f"{log}: no recording has a time of day; log them with clock.pattern set")
        vehicles = [row for row in vehicles if row["time_utc"] and _within(row["time_utc"], begin, end)]
    groups = [_figures("all", vehicles, limit_kmh)]
    if by is not None:
        key = _keys(place)[by]
        names = sorted({key(row) for row in vehicles})
        groups += [_figures(label, [row for row in vehicles if key(row)[1] == label], limit_kmh) for _, label in names]
    return {
        "by": by,
        "limit_kmh": limit_kmh,
        "groups": groups,
        "coverage": _coverage(clips, begin, end),
    }


def _moment(text: str | None, place: tzinfo, option: str) -> datetime | None:
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
        return (moment if moment.tzinfo else moment.replace(tzinfo=place)).astimezone(UTC)
    except (ValueError, OverflowError) as problem:
        raise UsageError(f"{option} {text}: not a time; write it like 2026-03-01 or 2026-03-01T06:30") from problem


def _within(time_utc: str, begin: datetime | None, end: datetime | None) -> bool:
    moment = datetime.fromisoformat(time_utc)
    return (begin is None or moment >= begin) and (end is None or moment < end)


def _keys(place: tzinfo) -> dict[str, Callable[[dict[str, Any]], tuple[Any, str]]]:
    """How to group: row -> what groups are ordered by, and their name."""

    def local(row: dict[str, Any]) -> datetime:
        return datetime.fromisoformat(row["time_utc"]).astimezone(place)

    def sector(row: dict[str, Any]) -> int:
        return round(row["direction"] / SECTOR) % round(360 / SECTOR)

    return {
        "hour": lambda row: (local(row).hour, f"{local(row).hour:02d}:00"),
        "day": lambda row: (local(row).date().isoformat(),) * 2,
        "weekday": lambda row: (local(row).weekday(), local(row).strftime("%A")),
        "lane": lambda row: (row["lane"] or 0, "unknown" if row["lane"] is None else str(row["lane"])),
        "direction": lambda row: (sector(row), f"{sector(row) * SECTOR:.0f} deg"),
    }


def _figures(name: str, vehicles: Sequence[dict[str, Any]], limit_kmh: float | None) -> dict[str, Any]:
    speeds = np.array([row["speed_kmh"] for row in vehicles])
    figures: dict[str, Any] = dict.fromkeys(COLUMNS) | {"group": name, "vehicles": len(speeds)}
    if not len(speeds):
        return figures
    low, share = pace(speeds, PACE_KMH)
    numbers: dict[str, float | None] = {"mean_kmh": float(speeds.mean()), "pace_from_kmh": low}
    numbers |= {"pace_to_kmh": low + PACE_KMH, "share_in_pace": share}
    for p in (50, 85):
        names = (f"p{p}_kmh", f"p{p}_low_kmh", f"p{p}_high_kmh")
        numbers |= dict(zip(names, percentile(speeds, p / 100), strict=True))
    if limit_kmh is not None:
        numbers["share_above_limit"] = float(np.mean(speeds > limit_kmh))
    return figures | {key: None if value is None else round(value, 3) for key, value in numbers.items()}


def _coverage(clips: Sequence[dict[str, Any]], begin: datetime | None, end: datetime | None) -> dict[str, Any]:
    """Recordings between two times, hours in them, and the gaps between those whose time of day is known."""
    timed = [clip for clip in clips if clip["began_utc"] is not None]
    spans = sorted(span for clip in timed if (span := _cut(_span(clip), begin, end)) is not None)
    untimed = [clip["duration_s"] for clip in clips if clip["began_utc"] is None]
    free = 0.0 if begin or end else sum(untimed)
    gaps, reached = [], begin or (spans[0][0] if spans else None)
    for start, finish in [*spans, *([(end, end)] if end else [])]:
        if reached is not None and (start - reached).total_seconds() > GAP_S:
            gaps.append({"from_utc": _iso(reached), "to_utc": _iso(start)})
        reached = finish if reached is None else max(reached, finish)
    return {
        "recordings": len(spans) + (0 if begin or end else len(untimed)),
        "without_time": len(untimed),
        "hours": round((sum((finish - start).total_seconds() for start, finish in spans) + free) / 3600, 4),
        "from_utc": _iso(spans[0][0]) if spans else None,
        "to_utc": _iso(max(finish for _, finish in spans)) if spans else None,
        "gaps": gaps,
    }


def _span(clip: dict[str, Any]) -> Span:
    start = datetime.fromisoformat(clip["began_utc"])
    return start, start + timedelta(seconds=clip["duration_s"])


def _cut(span: Span, begin: datetime | None, end: datetime | None) -> Span | None:
    """What of a span lies between two times."""
    start, finish = max(span[0], begin or span[0]), min(span[1], end or span[1])
    return (start, finish) if start <= finish else None


def _iso(moment: datetime) -> str:
    return moment.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def as_text(summary: dict[str, Any], form: Literal["table", "csv", "json"]) -> str:
    """The summary as it is printed."""
    if form == "json":
        return json.dumps(summary, indent=2, allow_nan=False)
    if form == "csv":
        out = io.StringIO()
        table = csv.DictWriter(out, COLUMNS, restval="", lineterminator="\n")
        table.writeheader()
        table.writerows(summary["groups"])
        return out.getvalue().rstrip("\n")
    return _table(summary)


def _table(summary: dict[str, Any]) -> str:
    head = ("", "vehicles", "mean", "50 % [95 % interval]", "85 % [95 % interval]", "pace (share)")
    rows = [head + ((f"> {summary['limit_kmh']:g}",) if summary["limit_kmh"] is not None else ())]
    for group in summary["groups"]:
        row = [group["group"], str(group["vehicles"])]
        if group["vehicles"]:
            row += [f"{group['mean_kmh']:.1f}", *(_interval(group, p) for p in (50, 85))]
            row += [f"{group['pace_from_kmh']:.0f}-{group['pace_to_kmh']:.0f} ({100 * group['share_in_pace']:.0f} %)"]
            if summary["limit_kmh"] is not None:
                row.append(f"{100 * group['share_above_limit']:.1f} %")
        rows.append(tuple(row + [""] * (len(rows[0]) - len(row))))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [f"{row[0]:<{widths[0]}}  " + "  ".join(map(str.rjust, row[1:], widths[1:])) for row in rows]
    cover = summary["coverage"]
    untimed = f"; {cover['without_time']} without a time of day" if cover["without_time"] else ""
    lines.append(f"\n{cover['recordings']} recordings, {cover['hours']:.2f} h{untimed}; speeds in km/h")
    if cover["from_utc"]:
        lines.append(f"{cover['from_utc']} to {cover['to_utc']}, {len(cover['gaps'])} gaps")
        lines += [f"  gap {gap['from_utc']} to {gap['to_utc']}" for gap in cover["gaps"][:10]]
    return "\n".join(lines)


def _interval(group: dict[str, Any], p: int) -> str:
    low, high = (group[f"p{p}_{end}_kmh"] for end in ("low", "high"))
    ends = "-".join("?" if value is None else f"{value:.1f}" for value in (low, high))
    return f"{group[f'p{p}_kmh']:.1f} [{ends}]"
