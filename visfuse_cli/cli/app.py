"""The typer app, what all of it shares, and how a finished run is told."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from visfuse_cli import __version__
from visfuse_cli.cli.options import QuietOption

if TYPE_CHECKING:
    from visfuse_cli.records import RunResult

app = typer.Typer(
    name="visfuse",
    help="Recorded footage and sensor logs in, trustworthy 3D tracks and speeds out.",
    epilog="visfuse COMMAND --help shows an example of each; visfuse demo is a first run.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


@dataclass
class Voice:
    """How much the command line says, as its options before the command ask for."""

    quiet: bool = False
    verbose: bool = False


voice = Voice()


def _version(value: bool) -> None:
    if value:
        typer.echo(f"visfuse {__version__}")
        raise typer.Exit


@app.callback()
def _before(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    quiet: QuietOption = False,
    verbose: Annotated[bool, typer.Option("-v", "--verbose", help="Print the time that each stage took.")] = False,
) -> None:
    voice.quiet, voice.verbose = quiet, verbose


def tell(result: RunResult, text: Callable[[RunResult], str], as_json: bool, quiet: bool) -> None:
    """Print the summary, and leave by the signal that cut the run short, if one did."""
    quiet = quiet or voice.quiet
    if not quiet:
        for warning in result.warnings:
            typer.echo(f"visfuse: warning: {warning}", err=True)
    if voice.verbose:
        for stage, seconds in result.stages.items():
            typer.echo(f"visfuse: {stage}: {seconds:.2f} s", err=True)
    if as_json:
        typer.echo(json.dumps(result.summary, allow_nan=False))
    elif not quiet:
        typer.echo(text(result))
    if result.stopped_by is not None:
        raise typer.Exit(128 + result.stopped_by)
