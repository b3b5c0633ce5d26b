"""`visfuse config`, and where each command's configuration model is."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any

import typer

from visfuse_cli.cli.app import app, voice
from visfuse_cli.cli.options import SetOption
from visfuse_cli.errors import UsageError

if TYPE_CHECKING:
    from visfuse_cli.config import Section

config_app = typer.Typer(help="Show, check or describe a command's configuration.", no_args_is_help=True)
app.add_typer(config_app, name="config", rich_help_panel=None)

CONFIGURED = {  # command -> where its configuration model is
    "calibrate-homography": ("visfuse_cli.commands.calibrate_homography", "CalibrateConfig"),
    "speed": ("visfuse_cli.commands.speed", "SpeedConfig"),
    "track-imm": ("visfuse_cli.commands.track_imm", "ImmConfig"),
    "track-stereo-pf": ("visfuse_cli.commands.track_stereo_pf", "StereoConfig"),
    "fuse-cameras": ("visfuse_cli.commands.fuse_cameras", "FuseConfig"),
}


def model_of(command: str) -> type[Section]:
    """The configuration model of a command."""
    if command in CONFIGURED:
        module, name = CONFIGURED[command]
        model: type[Section] = getattr(import_module(module), name)
        return model
    from visfuse_cli.config import nearest

    known = ", ".join(CONFIGURED)
    raise UsageError(f"no command '{command}' with a configuration{nearest(command, CONFIGURED)}; known: {known}")


def load_config(command: str, name: str | None, overrides: list[str] | None) -> Any:
    """The configuration a command runs with, from `--config` and `--set`."""
    from visfuse_cli.config import load

    return load(model_of(command), name, overrides or ())


@config_app.command("show")
def show(
    command: Annotated[str, typer.Argument(metavar="COMMAND", help="Like speed.")],
    file: Annotated[str | None, typer.Argument(metavar="[FILE]", help="A YAML file, or a shipped name.")] = None,
    set_: SetOption = None,
) -> None:
    """Print the complete configuration a command would run with, each key explained.

    Example: visfuse config show speed > my.yaml
    """
    from visfuse_cli.config import dump

    typer.echo(dump(load_config(command, file, set_)), nl=False)


@config_app.command("check")
def check(
    command: Annotated[str, typer.Argument(metavar="COMMAND", help="Like speed.")],
    file: Annotated[str, typer.Argument(metavar="FILE", help="A YAML file, or a shipped name.")],
    set_: SetOption = None,
) -> None:
    """Check a configuration file without running anything, and tell which keys differ from the defaults.

    Example: visfuse config check speed my.yaml
    """
    from visfuse_cli.config import changed

    config = load_config(command, file, set_)
    if not voice.quiet:
        keys = changed(config)
        typer.echo(f"{file}: good for {command}; {', '.join(keys) if keys else 'all as by default'}")


@config_app.command("schema")
def schema(command: Annotated[str, typer.Argument(metavar="COMMAND", help="Like speed.")]) -> None:
    """Print the JSON schema of a command's configuration, with which editors check and complete it.

    Example: visfuse config schema speed > speed.schema.json
    """
    from visfuse_cli.config import schema as schema_of

    typer.echo(schema_of(model_of(command)))
