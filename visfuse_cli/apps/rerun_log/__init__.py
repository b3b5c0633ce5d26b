"""`--rerun FILE.rrd`: a finished run for the Rerun viewer: frames, boxes, tracks, covariances, cameras."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from visfuse_cli.errors import OutputError, UsageError
from visfuse_cli.records import RunRequest, RunResult


def check(request: RunRequest, path: Path) -> None:
    """Raise UsageError or OutputError, before the run, where there would be no file after it."""
    if find_spec("rerun") is None:
        raise UsageError("--rerun needs rerun-sdk: pip install 'visfuse-cli[rerun]'")
    if path.suffix != ".rrd":
        raise UsageError(f"--rerun {path}: give it a name that ends in .rrd")
    if path.is_dir() or not (path.parent.is_dir() or path.parent.resolve() == request.out.resolve()):
        raise OutputError(f"{path}: {'is a folder' if path.is_dir() else f'there is no folder {path.parent}'}")
    if path.exists() and not request.overwrite:
        raise OutputError(f"{path}: exists; give --overwrite or another name")


def write(request: RunRequest, result: RunResult, path: Path) -> None:
    """Write what a run left in its folder, with its footage, for the viewer; raises InputError, OutputError."""
    from visfuse_cli.apps.rerun_log.scenes import scene_of
    from visfuse_cli.apps.rerun_log.write import record

    record(scene_of(request, result.out), result.out, path)
