"""`visfuse speed --log`: each recording's vehicles go to the traffic log, once; `--new-only` takes what is new."""

from __future__ import annotations

import csv
import hashlib
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from visfuse_cli import report
from visfuse_cli.commands import speed
from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files.folders import describe, is_folder, list_clips
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.traffic_log import LoggedClip, TrafficLog
from visfuse_cli.records import RunRequest, RunResult

UNCHANGED_S = 60.0  # a clip that is still being written changes


def run(request: RunRequest, log: Path, new_only: bool = False) -> RunResult:
    """Measure, and add each recording to the log; with `new_only`, each clip of a folder that the log does not hold.

    Raises what `speed` raises, and UsageError where `new_only` is asked of anything but a folder of clips.
    """
    if new_only:
        return _run_new(request, log)
    with TrafficLog(log) as held:  # a log that cannot be written is told before hours of work
        result = speed.run(request)
        if result.stopped_by is None:
            _append(request.out, held, _settings(request))
    if request.report:
        report.write([request.out])
    return result


def _run_new(request: RunRequest, log: Path) -> RunResult:
    settings, warnings, done = _settings(request), list[str](), list[RunResult]()
    unreadable: list[str] = []
    waiting = 0
    if not is_folder(request.input):
        raise UsageError(f"--new-only: {request.input} is one recording; give the folder that new clips arrive in")
    with TrafficLog(log) as held, RunFolder(request.out, shared=True):
        for clip in list_clips(request.input):
            if time.time() - clip.stat().st_mtime < UNCHANGED_S:
                waiting += 1
                continue
            if held.holds(describe(clip)["sha256"], settings):
                continue
            own = replace(request, input=clip, out=request.out / clip.stem, overwrite=True)
            try:
                done.append(speed.run(own))
            except InputError as problem:
                unreadable.append(str(problem))
                continue
            warnings += done[-1].warnings
            if done[-1].stopped_by is not None:
                break
            _append(own.out, held, settings)
            if request.report:
                report.write([own.out])
    if unreadable:
        others = f"; {len(unreadable) - 1} more like it" if len(unreadable) > 1 else ""
        raise InputError(f"{unreadable[0]}{others}; the other clips are in the log")
    summary = {
        "clips": len(done),
        "vehicles": sum(result.summary["vehicles"] for result in done),
        "rejected": sum(result.summary["rejected"] for result in done),
        "still_changing": waiting,
        "log": str(log),
        "out": str(request.out),
    }
    stopped = next((result.stopped_by for result in done if result.stopped_by is not None), None)
    return RunResult(request.out, summary, tuple(warnings), stopped)


def _settings(request: RunRequest) -> str:
    """The hash of all that the speeds of a clip depend on, but for the clip."""
    used: dict[str, Any] = {
        "config": request.config.model_dump(mode="json"),
        "homography": describe(request.options["homography"])["sha256"],
        "start": request.start,
        "end": request.end,
        "seed": request.seed,
    }
    if request.options.get("detections") is not None:
        used["detections"] = describe(request.options["detections"])["sha256"]
    return hashlib.sha256(json.dumps(used, sort_keys=True).encode()).hexdigest()


def _append(folder: Path, log: TrafficLog, settings: str) -> None:
    """Add a finished run to the log from what it wrote."""
    document = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    with open(folder / "speeds.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for entry in document["inputs"]:
        name = Path(entry["path"]).name
        if name in document["began_utc"]:
            clip = LoggedClip(
                sha256=entry["sha256"],
                settings=settings,
                name=name,
                began_utc=document["began_utc"][name],
                duration_s=document["time_audit"][name]["duration_s"],
                frames=document["time_audit"][name]["frames"],
                version=document["version"],
            )
            log.add(clip, [row for row in rows if row["clip"] == name])


def text(result: RunResult) -> str:
    """The summary for people."""
    if "clips" not in result.summary:
        return speed.text(result)
    summary = result.summary
    return (
        f"{'new clips':<12} {summary['clips']}\n{'vehicles':<12} {summary['vehicles']}\n"
        f"{'rejected':<12} {summary['rejected']}\n{'log':<12} {summary['log']}"
    )
