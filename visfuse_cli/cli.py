"""The command line: thin, lazy in its imports, and the one place that catches errors."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import traceback
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from visfuse_cli import __version__
from visfuse_cli.errors import UsageError, VisfuseError

if TYPE_CHECKING:
    from visfuse_cli.config import Section
    from visfuse_cli.records import RunResult

app = typer.Typer(
    name="visfuse",
    help="Recorded footage and sensor logs in, trustworthy 3D tracks and speeds out.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
config_app = typer.Typer(help="Show, check or describe the configuration of a command.", no_args_is_help=True)
app.add_typer(config_app, name="config", rich_help_panel=None)

ConfigOption = Annotated[
    str | None, typer.Option("--config", metavar="FILE", help="A YAML file, or the name of a shipped configuration.")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override one key, a.b.c=VALUE; repeatable.")
]
OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace the results of an earlier run in DIR.")]
NoVideoOption = Annotated[bool, typer.Option("--no-video", help="Write no annotated video.")]
NoReportOption = Annotated[bool, typer.Option("--no-report", help="Write no report.html.")]
StartOption = Annotated[float | None, typer.Option("--start", metavar="S", help="Begin at this second of the footage.")]
EndOption = Annotated[float | None, typer.Option("--end", metavar="S", help="End at this second of the footage.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Seed of everything random.")]
NoProgressOption = Annotated[bool, typer.Option("--no-progress", help="Show no progress bar.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the summary as one JSON object.")]
QuietOption = Annotated[bool, typer.Option("-q", "--quiet", help="Print nothing but errors.")]

CONFIGURED = {  # command -> where its configuration model is
    "calibrate-homography": ("visfuse_cli.commands.calibrate_homography", "CalibrateConfig"),
    "speed": ("visfuse_cli.commands.speed", "SpeedConfig"),
    "track-imm": ("visfuse_cli.commands.track_imm", "ImmConfig"),
    "track-stereo-pf": ("visfuse_cli.commands.track_stereo_pf", "StereoConfig"),
    "fuse-cameras": ("visfuse_cli.commands.fuse_cameras", "FuseConfig"),
}
BY = ("hour", "day", "weekday", "lane", "direction")
FORMS = ("table", "csv", "json", "parquet")
_quiet = False
_verbose = False


def _version(value: bool) -> None:
    if value:
        typer.echo(f"visfuse {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    quiet: QuietOption = False,
    verbose: Annotated[bool, typer.Option("-v", "--verbose", help="Print the time that each stage took.")] = False,
) -> None:
    global _quiet, _verbose
    _quiet, _verbose = quiet, verbose


@app.command("calibrate-homography")
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
    image: Annotated[
        Path | None, typer.Option("--image", metavar="F", help="A frame or clip: draws the picture beside H.json.")
    ] = None,
    size: Annotated[
        str | None, typer.Option("--size", metavar="WxH", help="Image size where there is no --image.")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option("--camera", metavar="F", help="Lens: calibration.yaml with M1 and D1.")
    ] = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace H.json.")] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Image (or pan-tilt angles) to ground plane, from points or lines.

    Example: visfuse calibrate-homography --points points.csv --image clip.mp4 --out H.json
    """
    from visfuse_cli.commands import calibrate_homography as command
    from visfuse_cli.records import RunRequest

    sources = {"points": points, "lines": lines, "gaze": gaze}
    given = [name for name, path in sources.items() if path is not None]
    if len(given) != 1:
        raise UsageError(f"give exactly one of --points, --lines and --gaze, not {len(given)}")
    request = RunRequest(
        command="calibrate-homography",
        input=next(path for path in sources.values() if path is not None),
        out=out,
        config=_load("calibrate-homography", config, set_),
        options=sources | {"image": image, "size": _size(size), "camera": camera},
        overwrite=overwrite,
        argv=tuple(sys.argv),
    )
    _report(command.run(request), as_json, quiet, command.text)


@app.command("speed")
def speed(
    input_: Annotated[Path, typer.Argument(metavar="INPUT", help="A video, a folder of images, or a folder of clips.")],
    homography: Annotated[
        Path, typer.Option("--homography", metavar="H.json", help="Written by calibrate-homography.")
    ],
    out: OutOption,
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
    config: ConfigOption = None,
    set_: SetOption = None,
    overwrite: OverwriteOption = False,
    no_video: NoVideoOption = False,
    no_report: NoReportOption = False,
    start: StartOption = None,
    end: EndOption = None,
    seed: SeedOption = 0,
    no_progress: NoProgressOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Speed of every vehicle (or person) before one fixed camera, with a 95 % interval.

    Example: visfuse speed clip.mp4 --homography H.json --out run
    """
    from visfuse_cli.commands import speed as command
    from visfuse_cli.records import RunRequest

    request = RunRequest(
        command="speed",
        input=input_,
        out=out,
        config=_load("speed", config, set_),
        options={"homography": homography, "detections": detections},
        overwrite=overwrite,
        video=not no_video,
        report=not no_report,
        start=start,
        end=end,
        seed=seed,
        progress=not (no_progress or quiet or _quiet),
        argv=tuple(sys.argv),
    )
    if log is not None:
        from visfuse_cli.apps import traffic_log

        _report(traffic_log.run(request, log, new_only), as_json, quiet, traffic_log.text)
    elif new_only:
        raise UsageError("--new-only needs --log: the log is what tells which clips are new")
    else:
        _report(_with_page(command.run(request), request.report), as_json, quiet, command.text)


@app.command("report")
def report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders that tracking commands wrote.")],
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
    if not (quiet or _quiet):
        typer.echo(f"{'report':<12} {page}")


@app.command("evaluate")
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
    from visfuse_cli.errors import UsageError
    from visfuse_cli.evaluate.run import evaluate as judge
    from visfuse_cli.evaluate.run import text

    if truth is not None and reference is not None:
        raise UsageError("--truth and --reference: give one of them")
    if not gate > 0:
        raise UsageError(f"--gate {gate:g}: must be above zero, metres")
    found = judge(run, truth, reference, gate, plane)
    if as_json:
        typer.echo(json.dumps(found, allow_nan=False))
    elif not (quiet or _quiet):
        typer.echo(text(found))


@app.command("summary")
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
) -> None:
    """What a traffic log says: counts, mean, 50th and 85th percentile with intervals, pace, share above a limit.

    Example: visfuse summary site.sqlite --by hour --limit 50
    """
    from visfuse_cli.apps import summary as command

    if by not in (None, *BY):
        raise UsageError(f"--by {by}: one of {', '.join(BY)}")
    if form not in FORMS:
        raise UsageError(f"--format {form}: one of {', '.join(FORMS)}")
    if form == "parquet" and out is None:
        raise UsageError("--format parquet is no text; name a file with --out")
    found = command.summarise(log, by, since, until, limit, zone)  # type: ignore[arg-type]
    if form == "parquet" and out is not None:
        command.write_parquet(found, out)
    elif out is not None:
        from visfuse_cli.files.atomic import write_text

        write_text(out, command.as_text(found, form) + "\n")  # type: ignore[arg-type]
    else:
        typer.echo(command.as_text(found, form))  # type: ignore[arg-type]


@app.command("fuse-cameras")
def fuse_cameras(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE", help="A folder: calibration.toml, and footage or boxes of each camera.")
    ],
    out: OutOption,
    estimate_offsets: Annotated[
        bool, typer.Option("--estimate-offsets", help="Find out from the footage how late each camera is.")
    ] = False,
    config: ConfigOption = None,
    set_: SetOption = None,
    overwrite: OverwriteOption = False,
    no_video: NoVideoOption = False,
    no_report: NoReportOption = False,
    start: StartOption = None,
    end: EndOption = None,
    seed: SeedOption = 0,
    no_progress: NoProgressOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """People before several calibrated cameras, in 3D, by closed-loop fusion.

    Example: visfuse fuse-cameras scene --out run
    """
    from visfuse_cli.commands import fuse_cameras as command
    from visfuse_cli.records import RunRequest

    request = RunRequest(
        command="fuse-cameras",
        input=scene,
        out=out,
        config=_load("fuse-cameras", config, set_),
        options={"estimate_offsets": estimate_offsets},
        overwrite=overwrite,
        video=not no_video,
        report=not no_report,
        start=start,
        end=end,
        seed=seed,
        progress=not (no_progress or quiet or _quiet),
        argv=tuple(sys.argv),
    )
    _report(_with_page(command.run(request), request.report), as_json, quiet, command.text)


@app.command("track-stereo-pf")
def track_stereo_pf(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE", help="A folder: left.*, right.*, calibration.yaml; init.yaml, path.yaml.")
    ],
    out: OutOption,
    config: ConfigOption = None,
    set_: SetOption = None,
    overwrite: OverwriteOption = False,
    no_video: NoVideoOption = False,
    no_report: NoReportOption = False,
    start: StartOption = None,
    end: EndOption = None,
    seed: SeedOption = 0,
    no_progress: NoProgressOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Speed of vehicles that face a static stereo pair, by a particle filter along their path.

    Example: visfuse track-stereo-pf scene --out run
    """
    from visfuse_cli.commands import track_stereo_pf as command
    from visfuse_cli.records import RunRequest

    request = RunRequest(
        command="track-stereo-pf",
        input=scene,
        out=out,
        config=_load("track-stereo-pf", config, set_),
        overwrite=overwrite,
        video=not no_video,
        report=not no_report,
        start=start,
        end=end,
        seed=seed,
        progress=not (no_progress or quiet or _quiet),
        argv=tuple(sys.argv),
    )
    _report(_with_page(command.run(request), request.report), as_json, quiet, command.text)


@app.command("track-imm")
def track_imm(
    scene: Annotated[
        Path,
        typer.Argument(metavar="SCENE", help="A folder: left.*, right.*, calibration.yaml, sensors.csv; init.yaml."),
    ],
    out: OutOption,
    config: ConfigOption = None,
    set_: SetOption = None,
    overwrite: OverwriteOption = False,
    no_video: NoVideoOption = False,
    no_report: NoReportOption = False,
    start: StartOption = None,
    end: EndOption = None,
    seed: SeedOption = 0,
    no_progress: NoProgressOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """What moves before a moving stereo camera, in 3D, by interacting motion models.

    Example: visfuse track-imm scene --out run
    """
    from visfuse_cli.commands import track_imm as command
    from visfuse_cli.records import RunRequest

    request = RunRequest(
        command="track-imm",
        input=scene,
        out=out,
        config=_load("track-imm", config, set_),
        overwrite=overwrite,
        video=not no_video,
        report=not no_report,
        start=start,
        end=end,
        seed=seed,
        progress=not (no_progress or quiet or _quiet),
        argv=tuple(sys.argv),
    )
    _report(_with_page(command.run(request), request.report), as_json, quiet, command.text)


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

    result = command.run(out, overwrite=overwrite, progress=not (no_progress or quiet or _quiet), argv=tuple(sys.argv))
    _report(_with_page(result, True), as_json, quiet, command.text)


@config_app.command("show")
def config_show(
    command: Annotated[str, typer.Argument(metavar="COMMAND")],
    file: Annotated[str | None, typer.Argument(metavar="[FILE]")] = None,
    set_: SetOption = None,
) -> None:
    """Print the complete configuration a command would run with."""
    from visfuse_cli.config import dump

    typer.echo(dump(_load(command, file, set_)), nl=False)


@config_app.command("check")
def config_check(
    command: Annotated[str, typer.Argument(metavar="COMMAND")],
    file: Annotated[str, typer.Argument(metavar="FILE")],
    set_: SetOption = None,
) -> None:
    """Check a configuration file without running anything."""
    _load(command, file, set_)
    if not _quiet:
        typer.echo(f"{file}: good for {command}")


@config_app.command("schema")
def config_schema(command: Annotated[str, typer.Argument(metavar="COMMAND")]) -> None:
    """Print the JSON schema of a command's configuration."""
    from visfuse_cli.config import schema

    typer.echo(schema(_model(command)))


def _model(command: str) -> type[Section]:
    """The configuration model of a command."""
    if command in CONFIGURED:
        module, name = CONFIGURED[command]
        model: type[Section] = getattr(import_module(module), name)
        return model
    from visfuse_cli.config import nearest

    known = ", ".join(CONFIGURED)
    raise UsageError(f"no command '{command}' with a configuration{nearest(command, CONFIGURED)}; known: {known}")


def _load(command: str, name: str | None, overrides: list[str] | None) -> Any:
    from visfuse_cli.config import load

    return load(_model(command), name, overrides or ())


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise UsageError(f"--size {text}: write it as WIDTHxHEIGHT, like 1280x720")
    return int(width), int(height)


def _with_page(result: RunResult, wanted: bool) -> RunResult:
    """The result, with report.html in its folder if it is wanted."""
    if wanted:
        from visfuse_cli.report import write

        write([result.out])
    return result


def _report(result: RunResult, as_json: bool, quiet: bool, text: Any) -> None:
    """Print the summary, and leave by the signal that cut the run short, if one did."""
    quiet = quiet or _quiet
    if not quiet:
        for warning in result.warnings:
            typer.echo(f"visfuse: warning: {warning}", err=True)
    if _verbose:
        for stage, seconds in result.stages.items():
            typer.echo(f"visfuse: {stage}: {seconds:.2f} s", err=True)
    if as_json:
        typer.echo(json.dumps(result.summary, allow_nan=False))
    elif not quiet:
        typer.echo(text(result))
    if result.stopped_by is not None:
        raise typer.Exit(128 + result.stopped_by)


def _fail(message: str, code: int) -> NoReturn:
    # A path may hold bytes that no terminal can show.
    line = " ".join(str(message).split()).encode("utf-8", "backslashreplace").decode()
    print(f"visfuse: {line}", file=sys.stderr)
    sys.exit(code)


def main() -> None:
    """Run the command line; every expected failure ends as one line on stderr and its exit code."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # small matrices only; one thread keeps sums in one order
    try:
        code = app(standalone_mode=False)
    except VisfuseError as problem:
        _fail(str(problem), problem.exit_code)
    except typer.Exit as leaving:
        sys.exit(leaving.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted", 130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except Exception as problem:
        usage = getattr(problem, "format_message", None)  # click's own errors: the command line is wrong
        if usage is not None:
            _fail(usage(), getattr(problem, "exit_code", 2))
        _fail(f"internal error: {type(problem).__name__}: {problem}; traceback in {_log(problem)}", 1)
    sys.exit(code if isinstance(code, int) else 0)


def _log(problem: BaseException) -> Path:
    """Keep the traceback of a defect in a file of its own."""
    handle, name = tempfile.mkstemp(prefix="visfuse-", suffix=".log")
    with os.fdopen(handle, "w", encoding="utf-8") as log:
        log.write(f"visfuse {__version__}: {' '.join(sys.argv)}\n")
        traceback.print_exception(problem, file=log)
    return Path(name)
