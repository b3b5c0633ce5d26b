"""`visfuse batch`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from visfuse_cli.cli.app import app, voice
from visfuse_cli.cli.options import JsonOption, NoProgressOption, QuietOption


@app.command("batch", short_help="Any mix of commands over many recordings.")
def batch(
    manifest: Annotated[Path, typer.Argument(metavar="MANIFEST.yaml", help="What to run on which recordings.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results, one below it an item.")],
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, max=1024, help="Processes of this machine; default: one a core.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Of a Dask cluster, like tcp://host:8786.")
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option("--threads", min=1, max=1024, help="Threads a worker; default: the cores, shared out."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on in DIR: what is finished is not done again.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Begin anew in DIR.")] = False,
    keep_going: Annotated[bool, typer.Option("--keep-going", help="Do the other items after one has failed.")] = False,
    no_progress: NoProgressOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Many recordings, any mix of commands, on several processes or a cluster; a table says what became of each.

    Example: visfuse batch manifest.yaml --out runs --workers 4 --keep-going
    """
    from visfuse_cli.apps.batch import run as command

    quiet = quiet or voice.quiet
    done = command.run(
        manifest,
        out,
        workers=workers,
        threads=threads,
        scheduler=scheduler,
        resume=resume,
        overwrite=overwrite,
        keep_going=keep_going,
        progress=not (no_progress or quiet) and sys.stderr.isatty(),
        argv=tuple(sys.argv),
    )
    if as_json:
        typer.echo(json.dumps(command.summary(done), allow_nan=False))
    elif not quiet:
        typer.echo(command.text(done))
    if done.failed:
        first = done.failed[0]
        more = f"; {len(done.failed) - 1} more" if len(done.failed) > 1 else ""
        typer.echo(f"visfuse: {first['name']}: {first['message']}{more}; see {out / command.TABLE}", err=True)
    raise typer.Exit(done.exit_code)
