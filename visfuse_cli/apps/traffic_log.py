"""`visfuse speed --log`: each recording's vehicles go to the traffic log, once; `--new-only` takes what is new."""

from __future__ import annotations

import csv
import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from visfuse_cli import report
from visfuse_cli.commands import speed
from visfuse_cli.errors import InputError, UsageError, VisfuseError
from visfuse_cli.files.folders import IMAGE_SUFFIXES, describe, is_clip_folder, is_folder, list_clips, list_files
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.traffic_log import LoggedClip, TrafficLog
from visfuse_cli.records import RunRequest, RunResult

UNCHANGED_S = 60.0  # a clip that is still being written changes


def run(request: RunRequest, log: Path, new_only: bool = False) -> RunResult:
    """Measure, and add each recording to the log; with `new_only`, each clip of a folder that the log does not hold.

    Lanes that are found are kept beside the log, so that a number stays with its lane. Raises what `speed` raises, and
    UsageError where `new_only` is asked of anything but a folder of clips.
    """
    if not request.config.lanes and request.config.lanes_file is None:
        kept = request.config.model_copy(update={"lanes_file": log.with_suffix(".lanes.yaml")})
        request = replace(request, config=kept)
    if new_only:
        return _run_new(request, log)
    with TrafficLog(log) as held:  # a log that cannot be written is told before hours of work
        return _measure(request, held, _settings(request))


def _measure(request: RunRequest, log: TrafficLog, settings: str) -> RunResult:
    """Measure, write the page, and only then log: what a kill leaves out of the log is done again as a whole."""
    result = speed.run(request)
    if request.report:
        report.write([request.out])
    if result.stopped_by is None:
        _append(request.out, log, settings)
    return result


def _run_new(request: RunRequest, log: Path) -> RunResult:
    if not is_folder(request.input):
        raise UsageError(f"--new-only: {request.input} is one recording; give the folder that new clips arrive in")
    if not is_clip_folder(request.input) and list_files(request.input, IMAGE_SUFFIXES):
        raise UsageError(f"--new-only: {request.input} holds images, which are one recording; give a folder of clips")
    settings, done = _settings(request), list[RunResult]()
    failed: list[Exception] = []
    waiting = 0
    with TrafficLog(log) as held, RunFolder(request.out, shared=True):
        clips = list_clips(request.input)
        for clip in clips:
            if _changed_s_ago(clip) < UNCHANGED_S:
                waiting += 1
                continue
            try:
                if held.holds(held.digest(clip), settings):
                    continue
                done.append(_measure(_own(request, clip, clips), held, settings))
            except Exception as problem:
                if isinstance(problem, VisfuseError) and not isinstance(problem, InputError):
                    raise
                failed.append(problem)  # neither a bad clip nor a defect keeps the clips behind it from the log
                continue
            if done[-1].stopped_by is not None:
                break
    if failed:
        raise _first(failed)
    return RunResult(
        request.out,
        _summary(done, waiting) | {"log": str(log), "out": str(request.out)},
        tuple(warning for result in done for warning in result.warnings),
        next((result.stopped_by for result in done if result.stopped_by is not None), None),
    )


def _changed_s_ago(clip: Path) -> float:
    """Seconds since a clip was last written to; by the entry's own time where the content's lies in the future."""
    try:
        now, found = time.time(), clip.stat()
    except FileNotFoundError:  # taken away since the folder was listed
        return 0.0
    return now - (found.st_mtime if found.st_mtime <= now else found.st_ctime)


def _own(request: RunRequest, clip: Path, clips: Sequence[Path]) -> RunRequest:
    """The request for one clip, to a folder of its name; with its ending where another clip has the same stem."""
    twins = sum(other.stem == clip.stem for other in clips) > 1
    return replace(request, input=clip, out=request.out / (clip.name if twins else clip.stem), overwrite=True)


def _first(failed: Sequence[Exception]) -> Exception:
    """What to say of clips that failed: a defect before a bad clip."""
    defect = next((problem for problem in failed if not isinstance(problem, VisfuseError)), None)
    if defect is not None:
        return defect
    others = f"; {len(failed) - 1} more like it" if len(failed) > 1 else ""
    return InputError(f"{failed[0]}{others}; the other clips are in the log")


def _summary(done: Sequence[RunResult], waiting: int) -> dict[str, Any]:
    totals = {name: sum(result.summary[name] for result in done) for name in ("vehicles", "rejected")}
    return {"clips": len(done), **totals, "still_changing": waiting}


def _settings(request: RunRequest) -> str:
    """The hash of all that the speeds of a clip depend on, but for the clip."""
    used: dict[str, Any] = {
        "config": request.config.model_dump(mode="json", exclude={"lanes_file", "display"}),
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
        shown = name.encode("utf-8", "backslashreplace").decode()  # as the tables have it
        if name in document["began_utc"]:
            clip = LoggedClip(
                sha256=entry["sha256"],
                settings=settings,
                name=shown,
                began_utc=document["began_utc"][name],
                duration_s=document["time_audit"][name]["duration_s"],
                frames=document["time_audit"][name]["frames"],
                version=document["version"],
            )
            log.add(clip, [row for row in rows if row["clip"] == shown])


def text(result: RunResult) -> str:
    """The summary for people."""
    if "clips" not in result.summary:
        return speed.text(result)
    summary = result.summary
    return (
        f"{'new clips':<12} {summary['clips']}\n{'vehicles':<12} {summary['vehicles']}\n"
        f"{'rejected':<12} {summary['rejected']}\n{'log':<12} {summary['log']}"
    )
