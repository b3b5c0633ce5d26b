"""`visfuse calibrate-homography --pick`: points or lines clicked on a frame, on a page that this machine alone sees."""

from __future__ import annotations

import sys

from visfuse_cli.apps.picker.desk import Desk
from visfuse_cli.apps.picker.server import Server
from visfuse_cli.commands import calibrate_homography
from visfuse_cli.pipeline import Run
from visfuse_cli.records import RunRequest, RunResult

PATIENCE_S = 0.2  # between two looks at whether a signal came


def run(request: RunRequest, port: int = 0) -> RunResult:
    """Serve the page until it saves or a signal comes; raises InputError, OutputError before anything is served."""
    desk = Desk(request)
    with Run() as waiting, Server(desk, port) as server:
        print(f"visfuse: open {server.address} in a browser; Ctrl-C ends without saving", file=sys.stderr, flush=True)
        while not desk.done.wait(PATIENCE_S) and waiting.stopped_by is None:
            pass
    if desk.result is not None:
        return desk.result
    return RunResult(request.out, {}, stopped_by=waiting.stopped_by)


def text(result: RunResult) -> str:
    """The summary for people."""
    if not result.summary:
        return "nothing was saved"
    return f"{calibrate_homography.text(result)}\npicked       {result.summary['picked']}"
