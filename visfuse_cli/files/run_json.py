"""run.json: what ran, on what, with which settings and versions, and how it went."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from visfuse_cli import __version__
from visfuse_cli.files.atomic import write_json
from visfuse_cli.records import TimeAudit

SCHEMA = "visfuse.run/1"


def write_run_json(
    path: str | Path,
    *,
    command: str,
    argv: Sequence[str],
    config: Mapping[str, Any],
    inputs: Sequence[Mapping[str, Any]],
    seed: int,
    started: datetime,
    audits: Mapping[str, TimeAudit],
    warnings: Sequence[str],
    counts: Mapping[str, int],
    stages: Mapping[str, float],
    stopped_by: int | None = None,
    extra: Mapping[str, Any] | None = None,
) -> None:
    """Write run.json.

    `config` is the resolved configuration in plain types, `inputs` what `files.video.describe` says of each input,
    `audits` by clip or view, `stages` seconds by name, `stopped_by` the signal that cut the run short, `extra` the
    command's own entries. Raises OutputError where it cannot be written, ValueError on NaN.
    """
    document = {
        "schema": SCHEMA,
        "version": __version__,
        "command": command,
        "command_line": list(argv),
        "seed": seed,
        "started": _utc(started),
        "finished": _utc(datetime.now(UTC)),
        "stopped_by": stopped_by,
        "config": dict(config),
        "inputs": [dict(entry) for entry in inputs],
        "time_audit": {name: asdict(audit) for name, audit in audits.items()},
        "warnings": list(warnings),
        "counts": dict(sorted(counts.items())),
        "seconds_per_stage": {name: round(seconds, 3) for name, seconds in stages.items()},
        "versions": {
            "python": platform.python_version(),
            "platform": f"{sys.platform} {platform.machine()}",
            "numpy": np.__version__,
            "opencv": cv2.__version__,
            "av": av.__version__,
        },
    }
    write_json(path, document | dict(extra or {}))


def _utc(moment: datetime) -> str:
    return moment.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
