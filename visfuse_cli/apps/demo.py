"""`visfuse demo`: the shipped sample through calibration and speed, so that a newcomer sees every output."""

from __future__ import annotations

from contextlib import ExitStack
from importlib import resources
from pathlib import Path

from visfuse_cli.commands import calibrate_homography, speed
from visfuse_cli.config import load
from visfuse_cli.errors import OutputError
from visfuse_cli.records import RunRequest, RunResult

SAMPLE = "visfuse_cli.apps.sample"


def run(out: Path, *, overwrite: bool = False, progress: bool = True, argv: tuple[str, ...] = ()) -> RunResult:
    """Calibrate from the sample's surveyed points and measure its vehicles; results in out/H.json and out/run.

    Raises OutputError when `out` cannot be written or holds results already.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise OutputError(f"{out}: cannot create the folder: {problem.strerror}") from problem
    with ExitStack() as stack:
        sample = resources.files(SAMPLE)
        clip, points = (stack.enter_context(resources.as_file(sample / name)) for name in ("clip.mp4", "points.csv"))
        homography = out / "H.json"
        calibrate_homography.run(
            RunRequest(
                command="calibrate-homography",
                input=points,
                out=homography,
                config=load(calibrate_homography.CalibrateConfig),
                options={"points": points, "image": clip, "size": None, "camera": None},
                overwrite=overwrite,
                argv=argv,
            )
        )
        return speed.run(
            RunRequest(
                command="speed",
                input=clip,
                out=out / "run",
                config=load(speed.SpeedConfig),
                options={"homography": homography, "detections": None},
                overwrite=overwrite,
                progress=progress,
                argv=argv,
            )
        )


def text(result: RunResult) -> str:
    """The summary for people, with where to look."""
    return (
        f"{speed.text(result)}\n\n"
        f"calibration  {result.out.parent / 'H.json'} (picture: H.png)\n"
        f"video        {result.out / 'annotated.mp4'}\n"
        f"table        {result.out / 'speeds.csv'}\n"
        f"report       {result.out / 'report.html'}"
    )
