"""`visfuse export`: from a run folder or a traffic log to the form that is asked for."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from visfuse_cli.errors import InputError, OutputError, UsageError
from visfuse_cli.export import boxes, places, tracks
from visfuse_cli.files import traffic_log
from visfuse_cli.files.atomic import write_text
from visfuse_cli.files.parquet import write_parquet

FORMS = ("csv", "json", "parquet", "mot", "geojson", "gpkg")
LOG_FORMS = ("csv", "json", "parquet")
BINARY = ("parquet", "gpkg")


def export(
    source: Path,
    form: str,
    out: Path | None,
    *,
    rejected: bool = False,
    view: str | None = None,
    clip: str | None = None,
    overwrite: bool = False,
) -> str | None:
    """Write `source` in a form to `out`, or return it as text; raises a VisfuseError that says what does not go.

    `rejected` takes in the tracks that were discarded; `view` and `clip` choose the boxes of the form `mot`.
    """
    if form not in FORMS:
        raise UsageError(f"--format {form}: one of {', '.join(FORMS)}")
    if form in BINARY and out is None:
        raise UsageError(f"--format {form} is no text; name a file with --out")
    if form != "mot" and (view or clip):
        raise UsageError("--view and --clip go with --format mot; the other forms hold all of them")
    if not source.exists():
        raise InputError(f"{source}: there is no such run folder or traffic log")
    if out is not None and out.exists() and not overwrite:
        raise OutputError(f"{out}: exists; give --overwrite or another name")
    text = _run(source, form, out, rejected, view, clip) if source.is_dir() else _log(source, form, out)
    if text is None or out is None:
        return text
    write_text(out, text + "\n" if text else "")
    return None


def _run(source: Path, form: str, out: Path | None, rejected: bool, view: str | None, clip: str | None) -> str | None:
    found = tracks.read(source, rejected)
    if form == "mot":
        return boxes.mot(found, view, clip)
    if form == "geojson":
        return places.geojson(found)
    if form == "gpkg" and out is not None:
        places.geopackage(found, out)
        return None
    return _table(form, out, tracks.columns(found), list(tracks.table(found)))


def _log(source: Path, form: str, out: Path | None) -> str | None:
    """The vehicles of a traffic log by clip, t_start and track_id; nothing in it tells when they were added."""
    if form not in LOG_FORMS:
        raise UsageError(f"--format {form}: a traffic log holds no tracks; one of {', '.join(LOG_FORMS)}")
    _, vehicles = traffic_log.read(source)
    rows = [{"clip": row["clip_name"]} | {name: row[name] for name in traffic_log.FIELDS} for row in vehicles]
    return _table(form, out, ("clip", *traffic_log.FIELDS), rows)


def _table(form: str, out: Path | None, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> str | None:
    if form == "parquet" and out is not None:
        write_parquet(out, columns, rows)
        return None
    if form == "json":
        return json.dumps([{name: row.get(name) for name in columns} for row in rows], allow_nan=False)
    return _csv(columns, rows)


def _csv(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    table = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue().rstrip("\n")
