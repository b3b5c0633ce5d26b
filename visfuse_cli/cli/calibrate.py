"""`visfuse calibrate-homography`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from visfuse_cli.cli.app import app, tell
from visfuse_cli.cli.configure import load_config
from visfuse_cli.cli.options import ConfigOption, JsonOption, QuietOption, SetOption
from visfuse_cli.errors import UsageError


@app.command("calibrate-homography", short_help="Image or gaze angles to ground plane, from a survey.")
def calibrate_homography(
    out: Annotated[Path, typer.Option("--out", metavar="H.json", help="The homography to write.")],
    points: Annotated[
        Path | None, typer.Option("--points", metavar="F", help="CSV u,v,X,Y: four or more points.")
    ] = None,
    lines: Annotated[
        Path | None, typer.Option("--lines", metavar="F", help="CSV u1,v1,u2,v2,X1,Y1,X2,Y2: four or more lines.")
    ] = None,
    gaze: Annotated[
        Path | None, typer.Option("--gaze", metavar="F", help="CSV elevation,vergence,X,Y: pan-tilt angles (rad).")
    ] = None,
    pick: Annotated[
        Path | None,
        typer.Option("--pick", metavar="CLIP", help="Click points or lines on a frame, on a page in your browser."),
    ] = None,
    image: Annotated[
        Path | None, typer.Option("--image", metavar="F", help="A frame or clip: draws the picture beside H.json.")
    ] = None,
    size: Annotated[
        str | None, typer.Option("--size", metavar="WxH", help="Image size where there is no --image.")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option("--camera", metavar="F", help="Lens: calibration.yaml with M1 and D1.")
    ] = None,
    crs: Annotated[
        str | None, typer.Option("--crs", metavar="EPSG:N", help="Coordinate reference of X (east) and Y (north).")
    ] = None,
    origin: Annotated[
        str | None, typer.Option("--origin", metavar="E,N", help="What was taken off X and Y; with --crs.")
    ] = None,
    port: Annotated[
        int, typer.Option("--port", metavar="N", min=0, max=65535, help="Of the page of --pick; 0: any free one.")
    ] = 0,
    config: ConfigOption = None,
    set_: SetOption = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace H.json.")] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Image (or pan-tilt angles) to ground plane, from points or lines.

    Example: visfuse calibrate-homography --points points.csv --image clip.mp4 --out H.json

    Example: visfuse calibrate-homography --pick clip.mp4 --out H.json
    """
    from visfuse_cli.commands import calibrate_homography as command
    from visfuse_cli.files.ground_reference import parse_reference
    from visfuse_cli.records import RunRequest

    sources = {"points": points, "lines": lines, "gaze": gaze, "pick": pick}
    given = [name for name, path in sources.items() if path is not None]
    if len(given) != 1:
        raise UsageError(f"give exactly one of --points, --lines, --gaze and --pick, not {len(given)}")
    if pick is not None and (image or size):
        raise UsageError("--pick shows its own clip: --image and --size go with --points, --lines and --gaze")
    request = RunRequest(
        command="calibrate-homography",
        input=next(path for path in sources.values() if path is not None),
        out=out,
        config=load_config("calibrate-homography", config, set_),
        options=sources
        | {"image": image, "size": _size(size), "camera": camera, "reference": parse_reference(crs, origin)},
        overwrite=overwrite,
        argv=tuple(sys.argv),
    )
    if pick is not None:
        from visfuse_cli.apps import picker

        tell(picker.run(request, port), picker.text, as_json, quiet)
    else:
        tell(command.run(request), command.text, as_json, quiet)


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise UsageError(f"--size {text}: write it as WIDTHxHEIGHT, like 1280x720")
    return int(width), int(height)
