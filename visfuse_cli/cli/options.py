"""Options that several commands share, each written once."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

ConfigOption = Annotated[
    str | None, typer.Option("--config", metavar="FILE", help="A YAML file, or the name of a shipped configuration.")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override one key, a.b.c=VALUE; repeatable.")
]
OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace the results of an earlier run in DIR.")]
NoProgressOption = Annotated[bool, typer.Option("--no-progress", help="Show no progress bar.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the summary as one JSON object.")]
QuietOption = Annotated[bool, typer.Option("-q", "--quiet", help="Print nothing but errors.")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracking:
    """The options of every tracking command."""

    out: OutOption
    config: ConfigOption = None
    set_: SetOption = None
    overwrite: OverwriteOption = False
    no_video: Annotated[bool, typer.Option("--no-video", help="Write no annotated video.")] = False
    no_report: Annotated[bool, typer.Option("--no-report", help="Write no report.html.")] = False
    rerun: Annotated[
        Path | None, typer.Option("--rerun", metavar="FILE.rrd", help="Also write the run for the Rerun viewer.")
    ] = None
    start: Annotated[
        float | None, typer.Option("--start", metavar="S", help="Begin at this second of the footage.")
    ] = None
    end: Annotated[float | None, typer.Option("--end", metavar="S", help="End at this second of the footage.")] = None
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of everything random.")] = 0
    no_progress: NoProgressOption = False
    as_json: JsonOption = False
    quiet: QuietOption = False


def takes_tracking(command: Callable[..., None]) -> Callable[..., None]:
    """The command with every field of `Tracking` as an option of its own, in place of its argument `shared`."""
    own, shared = (inspect.signature(each, eval_str=True) for each in (command, Tracking))

    @functools.wraps(command)
    def run(**given: object) -> None:
        command(shared=Tracking(**{name: given.pop(name) for name in shared.parameters}), **given)  # type: ignore[arg-type]

    parameters = [each for each in own.parameters.values() if each.name != "shared"] + [*shared.parameters.values()]
    keyed = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]
    run.__signature__ = own.replace(parameters=keyed)  # type: ignore[attr-defined]
    return run
