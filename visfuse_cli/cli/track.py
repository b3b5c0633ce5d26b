"""The four tracking commands, and the demo."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from visfuse_cli.cli.app import app, tell, voice
from visfuse_cli.cli.configure import load_config
from visfuse_cli.cli.options import (
    JsonOption,
    NoProgressOption,
    OverwriteOption,
    QuietOption,
    Tracking,
    takes_tracking,
)
from visfuse_cli.errors import UsageError

if TYPE_CHECKING:
    from visfuse_cli.records import RunRequest, RunResult


def _request(command: str, input_: Path, shared: Tracking, **options: Any) -> RunRequest:
    from visfuse_cli.records import RunRequest

    return RunRequest(
        command=command,
        input=input_,
        out=shared.out,
        config=load_config(command, shared.config, shared.set_),
        options=options,
        overwrite=shared.overwrite,
        video=not shared.no_video,
        report=not shared.no_report,
        start=shared.start,
        end=shared.end,
        seed=shared.seed,
        progress=not (shared.no_progress or shared.quiet or voice.quiet),
        argv=tuple(sys.argv),
    )


def _finish(command: Any, request: RunRequest, shared: Tracking) -> None:
    """Run, write the report and the recording where they are wanted, and tell."""
    if shared.rerun is None:
        result = command.run(request)
    else:
        from visfuse_cli.apps import rerun_log

        rerun_log.check(request, shared.rerun)
        result = command.run(request)
        if result.stopped_by is None:
            rerun_log.write(request, result, shared.rerun)
    tell(_with_page(result) if request.report else result, command.text, shared.as_json, shared.quiet)


def _with_page(result: RunResult) -> RunResult:
    from visfuse_cli.report import write

    write([result.out])
    return result


@app.command("speed", short_help="Speed of every vehicle before one fixed camera.")
@takes_tracking
def speed(
    input_: Annotated[Path, typer.Argument(metavar="INPUT", help="A video, a folder of images, or a folder of clips.")],
    homography: Annotated[
        Path, typer.Option("--homography", metavar="H.json", help="Written by calibrate-homography.")
    ],
    shared: Tracking,
    detections: Annotated[
        Path | None,
        typer.Option("--detections", metavar="F", help="MOTChallenge boxes instead of background subtraction."),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option("--log", metavar="F.sqlite", help="Add each recording's vehicles to this traffic log."),
    ] = None,
    new_only: Annotated[
        bool, typer.Option("--new-only", help="Of a folder, only clips that the log does not hold; to DIR/<clip>/.")
    ] = False,
) -> None:
    """Speed of every vehicle (or person) before one fixed camera, with a 95 % interval.

    Example: visfuse speed clip.mp4 --homography H.json --out run
    """
    from visfuse_cli.commands import speed as command

    request = _request("speed", input_, shared, homography=homography, detections=detections)
    if log is not None and shared.rerun is not None:
        raise UsageError("--rerun goes with a run of its own, without --log")
    if log is not None:
        from visfuse_cli.apps import traffic_log

        tell(traffic_log.run(request, log, new_only), traffic_log.text, shared.as_json, shared.quiet)
    elif new_only:
        raise UsageError("--new-only needs --log: the log is what tells which clips are new")
    else:
        _finish(command, request, shared)


@app.command("fuse-cameras", short_help="People before several calibrated cameras, in 3D.")
@takes_tracking
def fuse_cameras(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE", help="A folder: calibration.toml, and footage or boxes of each camera.")
    ],
    shared: Tracking,
    estimate_offsets: Annotated[
        bool, typer.Option("--estimate-offsets", help="Find out from the footage how late each camera is.")
    ] = False,
) -> None:
    """People before several calibrated cameras, in 3D, by closed-loop fusion.

    Example: visfuse fuse-cameras scene --out run
    """
    from visfuse_cli.commands import fuse_cameras as command

    _finish(command, _request("fuse-cameras", scene, shared, estimate_offsets=estimate_offsets), shared)


@app.command("track-stereo-pf", short_help="Speed of vehicles that face a static stereo pair.")
@takes_tracking
def track_stereo_pf(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE", help="A folder: left.*, right.*, calibration.yaml; init.yaml, path.yaml.")
    ],
    shared: Tracking,
) -> None:
    """Speed of vehicles that face a static stereo pair, by a particle filter along their path.

    Example: visfuse track-stereo-pf scene --out run
    """
    from visfuse_cli.commands import track_stereo_pf as command

    _finish(command, _request("track-stereo-pf", scene, shared), shared)


@app.command("track-imm", short_help="What moves before a moving stereo camera, in 3D.")
@takes_tracking
def track_imm(
    scene: Annotated[
        Path,
        typer.Argument(metavar="SCENE", help="A folder: left.*, right.*, calibration.yaml, sensors.csv; init.yaml."),
    ],
    shared: Tracking,
    homography: Annotated[
        Path | None,
        typer.Option("--homography", metavar="H.json", help="Of a pan-tilt head; else homography.json of the scene."),
    ] = None,
) -> None:
    """What moves before a moving stereo camera, in 3D, or on the ground before a pan-tilt head.

    Example: visfuse track-imm scene --out run
    """
    from visfuse_cli.commands import track_imm as command

    _finish(command, _request("track-imm", scene, shared, homography=homography), shared)


@app.command("demo")
def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")] = Path("visfuse-demo"),
    overwrite: OverwriteOption = False,
    no_progress: NoProgressOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """The shipped sample through calibration and speed.

    Example: visfuse demo --out visfuse-demo
    """
    from visfuse_cli.apps import demo as command

    result = command.run(
        out, overwrite=overwrite, progress=not (no_progress or quiet or voice.quiet), argv=tuple(sys.argv)
    )
    tell(_with_page(result), command.text, as_json, quiet)
