"""`visfuse batch`: what is left of a manifest goes to the workers; the table of results grows as items end."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from visfuse_cli.apps.batch import cluster, work
from visfuse_cli.apps.batch.manifest import Item, read_manifest
from visfuse_cli.apps.batch.work import Outcome
from visfuse_cli.errors import OutputError, UsageError
from visfuse_cli.files.atomic import write_text
from visfuse_cli.files.runfolder import LOCK, RunFolder
from visfuse_cli.pipeline import Run

TABLE = "results.csv"
COLUMNS = ("name", "command", "input", "status", "code", "seconds", "warnings", "message")
WORST_FIRST = (1, 4, 75, 3, 2)


@dataclass(frozen=True, slots=True)
class Batch:
    """What became of a manifest."""

    out: Path
    rows: list[dict[str, Any]]
    stopped_by: int | None

    @property
    def failed(self) -> list[dict[str, Any]]:
        """The rows of items that failed."""
        return [row for row in self.rows if row["code"]]

    @property
    def exit_code(self) -> int:
        """0 where every item is done, else the gravest of the items' own codes."""
        if self.stopped_by is not None:
            return 128 + self.stopped_by
        codes = {row["code"] for row in self.failed}
        return next((code for code in WORST_FIRST if code in codes), 0)


def run(
    manifest: Path,
    out: Path,
    *,
    workers: int | None = None,
    threads: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    keep_going: bool = False,
    progress: bool = False,
    argv: tuple[str, ...] = (),
) -> Batch:
    """Run every item that no earlier batch has finished; raises a VisfuseError before any where it cannot begin."""
    if workers is not None and scheduler is not None:
        raise UsageError("--workers and --scheduler: give one of them; a scheduler has workers of its own")
    if resume and overwrite:
        raise UsageError("--resume and --overwrite: give one of them")
    cores = len(os.sched_getaffinity(0))
    count = workers or cores
    items = read_manifest(manifest, Path(os.path.abspath(out)), argv)  # a worker may stand in another folder
    with RunFolder(out, shared=True) as folder, Run() as run_:
        _enter(folder, items, resume, overwrite)
        found = {item.name: Outcome(item.name, "left", None) for item in items}
        if resume:
            found |= {item.name: outcome for item in items if (outcome := work.kept(item)) is not None}
        todo = [item for item in items if found[item.name].status == "left"]
        _write(folder, items, found)
        if todo:
            bar = tqdm(
                total=len(items), initial=len(items) - len(todo), unit=" items", disable=not progress, leave=False
            )
            with cluster.connected(min(count, len(todo)), scheduler) as client, bar:
                share = threads or max(1, cores // count)
                stopped = lambda: run_.stopped_by is not None  # noqa: E731
                for outcome in cluster.outcomes(client, todo, share, keep_going, stopped):
                    found[outcome.name] = outcome
                    _write(folder, items, found)
                    bar.update()
        return Batch(out, [_row(item, found[item.name]) for item in items], run_.stopped_by)


def _enter(folder: Path, items: Sequence[Item], resume: bool, overwrite: bool) -> None:
    """An empty folder, one to go on in, or one to begin anew in."""
    if overwrite:
        for item in items:
            work.forget(item)
    elif not resume and any(path.name != LOCK for path in folder.iterdir()):
        raise OutputError(f"{folder}: is not empty; --resume goes on where a batch stopped, --overwrite begins anew")


def _row(item: Item, outcome: Outcome) -> dict[str, Any]:
    values = {name: getattr(outcome, name) for name in ("name", "status", "code", "seconds", "warnings", "message")}
    return values | {"command": item.request.command, "input": item.input}


def _write(folder: Path, items: Sequence[Item], found: dict[str, Outcome]) -> None:
    rows = [_row(item, found[item.name]) for item in items]
    write_text(folder / TABLE, as_csv(rows))


def as_csv(rows: Sequence[dict[str, Any]]) -> str:
    """The table of results as text."""
    text = io.StringIO()
    table = csv.DictWriter(text, COLUMNS, restval="", lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue()


def summary(batch: Batch) -> dict[str, Any]:
    """The results as one JSON object."""
    counts = {status: sum(row["status"] == status for row in batch.rows) for status in ("done", "kept", "left")}
    return {**counts, "failed": len(batch.failed), "out": str(batch.out), "items": batch.rows}


def text(batch: Batch) -> str:
    """The results for people."""
    width = max(len(row["name"]) for row in batch.rows)
    lines = [
        f"{row['name']:<{width}}  {row['status']:<6}  {row['seconds']:8.1f} s  {row['message']}" for row in batch.rows
    ]
    counts = ", ".join(f"{count} {name}" for name, count in list(summary(batch).items())[:4] if count)
    return "\n".join([*(line.rstrip() for line in lines), f"{counts}; {batch.out / TABLE}"])
