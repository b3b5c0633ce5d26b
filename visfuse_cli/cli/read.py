"""Commands that read what runs have written: report, evaluate, summary."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from visfuse_cli.cli.app import app, voice
from visfuse_cli.cli.options import JsonOption, QuietOption
from visfuse_cli.errors import UsageError

BY = ("hour", "day", "weekday", "lane", "direction")
FORMS = ("table", "csv", "json", "parquet")


@app.command("report", short_help="One HTML page about one or several runs.")
def report(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Folders that tracking commands wrote, and H.json of calibrations."),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="The page; default: report.html in the one RUN.")
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """One HTML page about one or several runs: video, map, tables, figures; it opens from disk, without a network.

    Example: visfuse report run
    """
    from visfuse_cli.report import write

    page = write(runs, out)
    if not (quiet or voice.quiet):
        typer.echo(f"{'report':<12} {page}")


@app.command("evaluate", short_help="Errors and consistency of a run, against a reference.")
def evaluate(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that a tracking command wrote.")],
    truth: Annotated[
        Path | None, typer.Option("--truth", metavar="FILE", help="truth.csv: frame,t,id,x,y,z,vx,vy,vz.")
    ] = None,
    reference: Annotated[
        Path | None, typer.Option("--reference", metavar="FILE", help="radar.csv: t,speed_kmh[,direction,lane].")
    ] = None,
    gate: Annotated[
        float, typer.Option("--gate", metavar="M", help="Metres within which a state is a true one's.")
    ] = 1.0,
    plane: Annotated[bool, typer.Option("--plane", help="Compare positions on the ground only.")] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Errors, coverage, consistency and identities of a run, against truth or a radar, or by itself.

    Example: visfuse evaluate run --truth truth.csv --gate 0.5
    """
    from visfuse_cli.evaluate.run import evaluate as judge
    from visfuse_cli.evaluate.text import text

    if truth is not None and reference is not None:
        raise UsageError("--truth and --reference: give one of them")
    if not 0 < gate < math.inf:
        raise UsageError(f"--gate {gate:g}: must be above zero, metres")
    found, warnings = judge(run, truth, reference, gate, plane)
    for warning in warnings:
        typer.echo(f"visfuse: warning: {warning}", err=True)
    if as_json:
        typer.echo(json.dumps(found, allow_nan=False))
    elif not (quiet or voice.quiet):
        typer.echo(text(found))


@app.command("summary", short_help="What a traffic log says: percentiles, pace, counts.")
def summary(
    log: Annotated[Path, typer.Argument(metavar="F.sqlite", help="A traffic log, written by speed --log.")],
    by: Annotated[
        str | None, typer.Option("--by", metavar="WHAT", help="hour, day, weekday, lane or direction.")
    ] = None,
    since: Annotated[
        str | None, typer.Option("--since", metavar="TIME", help="ISO 8601; vehicles from then on.")
    ] = None,
    until: Annotated[
        str | None, typer.Option("--until", metavar="TIME", help="ISO 8601; vehicles before then.")
    ] = None,
    limit: Annotated[
        float | None, typer.Option("--limit", metavar="KMH", min=0, help="Share of vehicles above this speed, km/h.")
    ] = None,
    zone: Annotated[str, typer.Option("--zone", help="Time zone of hours and days, like Europe/Vienna.")] = "UTC",
    form: Annotated[str, typer.Option("--format", metavar="FORM", help="table, csv, json or parquet.")] = "table",
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="To a file instead of the screen.")] = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """What a traffic log says: counts, mean, 50th and 85th percentile with intervals, pace, share above a limit.

    Example: visfuse summary site.sqlite --by hour --limit 50
    """
    from visfuse_cli.apps import summary as command

    if by not in (None, *BY):
        raise UsageError(f"--by {by}: one of {', '.join(BY)}")
    if as_json:
        form = "json"
    if form not in FORMS:
        raise UsageError(f"--format {form}: one of {', '.join(FORMS)}")
    if form == "parquet" and out is None:
        raise UsageError("--format parquet is no text; name a file with --out")
    found = command.summarise(log, by, since, until, limit, zone)  # type: ignore[arg-type]
    if form == "parquet" and out is not None:
        from visfuse_cli.files.parquet import write_parquet

        write_parquet(out, command.COLUMNS, found["groups"])
    elif out is not None:
        from visfuse_cli.files.atomic import write_text

        write_text(out, command.as_text(found, form) + "\n")  # type: ignore[arg-type]
    elif form != "table" or not (quiet or voice.quiet):
        typer.echo(command.as_text(found, form))  # type: ignore[arg-type]


@app.command("export", short_help="Tracks of a run, or a log's vehicles, as other files.")
def export(
    source: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or a traffic log.")],
    form: Annotated[
        str, typer.Option("--format", metavar="FORM", help="csv, json, parquet, mot, geojson or gpkg.")
    ] = "csv",
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="To a file instead of the screen.")] = None,
    rejected: Annotated[bool, typer.Option("--rejected", help="The tracks that were rejected, too.")] = False,
    view: Annotated[str | None, typer.Option("--view", metavar="NAME", help="mot: boxes of this view.")] = None,
    clip: Annotated[str | None, typer.Option("--clip", metavar="NAME", help="mot: boxes of this clip.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Tracks of a run, or vehicles of a traffic log, for other programs.

    Example: visfuse export run --format mot --out tracks.txt
    """
    from visfuse_cli.export.run import export as write

    text = write(source, form, out, rejected=rejected, view=view, clip=clip, overwrite=overwrite)
    if text is not None:
        typer.echo(text)
    elif not (quiet or voice.quiet):
        typer.echo(f"{form:<12} {out}")
