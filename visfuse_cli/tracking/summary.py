"""The summary of a run of `visfuse speed`: as data, and for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.records import RunResult, TimeAudit
from visfuse_cli.tracking.annotate import UNITS


def summarised(
    speeds: Sequence[float], rejected: int, units: str, frames: int, audits: Mapping[str, TimeAudit], out: Path
) -> dict[str, Any]:
    """What a run found: speeds (n,) m/s of its vehicles and the rest, as one JSON object."""
    shown = np.array(speeds) * UNITS[units]
    return {
        "vehicles": len(speeds),
        "rejected": rejected,
        "units": units,
        "median": round(float(np.median(shown)), 2) if len(shown) else None,
        "percentile_85": round(float(np.percentile(shown, 85)), 2) if len(shown) else None,
        "frames": frames,
        "time_audit": {
            name: {
                "frames": audit.frames,
                "duration_s": round(audit.duration_s, 3),
                "dropped": audit.dropped,
                "irregular": audit.irregular,
                "duplicated": audit.duplicated,
                "lost": audit.lost,
            }
            for name, audit in audits.items()
        },
        "out": str(out),
    }


def text(result: RunResult) -> str:
    """The summary for people."""
    summary = result.summary
    lines = [f"{'vehicles':<12} {summary['vehicles']}"]
    if summary["vehicles"]:
        lines += [
            f"{'median':<12} {summary['median']:.1f} {summary['units']}",
            f"{'85th perc.':<12} {summary['percentile_85']:.1f} {summary['units']}",
        ]
    lines.append(f"{'rejected':<12} {summary['rejected']} (reasons in rejected.csv)")
    for name, audit in summary["time_audit"].items():
        lines.append(
            f"{'times':<12} {name}: {audit['frames']} frames over {audit['duration_s']:.2f} s, "
            f"{audit['dropped']} dropped, {audit['irregular']} irregular, "
            f"{audit['duplicated']} duplicated, {audit['lost']} lost"
        )
    lines.append(f"{'results':<12} {summary['out']}")
    return "\n".join(lines)
