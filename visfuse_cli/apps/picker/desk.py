"""What the page may ask for: a frame, a snap, a fit with its worth, and to save. No path ever comes from it."""

from __future__ import annotations

import math
import threading
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from pydantic import Field

from visfuse_cli.apps.picker.sheet import Number, Sheet, on_the_ground
from visfuse_cli.commands import calibrate_homography as command
from visfuse_cli.config import Section, validate
from visfuse_cli.errors import InputError, OutputError
from visfuse_cli.files.calibration_input import LINE_COLUMNS, POINT_COLUMNS, read_lines, read_points, write_survey
from visfuse_cli.files.lens_files import read_lens
from visfuse_cli.files.stills import Stills
from visfuse_cli.records import Array, GroundMap, Image, Lens, RunRequest, RunResult
from visfuse_cli.vision.calibration_picture import error_field, grid_lines, to_image
from visfuse_cli.vision.corners import snap_line, snap_point

CELLS = 60  # of the error map across the picture
SUFFIXES = {"point": ".points.csv", "line": ".lines.csv"}


class Snap(Section):
    """A mark to be moved onto what is under it in the frame at `t`."""

    t: Annotated[float, Field(ge=0, lt=1e7)]
    mark: Annotated[list[Number], Field(min_length=2, max_length=4)]
    radius: Annotated[float, Field(gt=0, le=100)]


class Desk:
    """One calibration in the making; `done` is set when it was saved, `result` is what `run` then returns.

    Raises InputError for footage or a lens that cannot be read, OutputError where nothing could be saved.
    """

    def __init__(self, request: RunRequest) -> None:
        self.request, self.done = request, threading.Event()
        self.result: RunResult | None = None
        self._saved = {noun: request.out.with_suffix(suffix) for noun, suffix in SUFFIXES.items()}
        command.check_output(request, (request.out.with_suffix(".png"), *self._saved.values()))
        camera = request.options.get("camera")
        lens, lens_size = read_lens(camera) if camera else (None, None)
        self._lens: Lens | None = lens
        self._stills = Stills(request.input)
        self._frame = self._stills.at(0.0)
        self._lock = threading.Lock()  # one decoder, one frame
        if lens_size not in (None, self._stills.size):
            raise InputError(f"{request.input} is {_by(self._stills.size)}, but {camera} says {_by(lens_size)}")

    def about(self) -> dict[str, Any]:
        """What the page needs to know at its start, with what an earlier session saved where --overwrite is given."""
        return {
            "name": self.request.input.name,
            "size": self._stills.size,
            "duration": self._stills.duration,
            "interval": self._stills.interval,
            "out": self.request.out.name,
            "before": self._before(),
        }

    def _before(self) -> dict[str, Any] | None:
        for noun, read in (("point", read_points), ("line", read_lines)):
            if self._saved[noun].is_file():
                marks, world = read(self._saved[noun])
                return {"noun": noun, "marks": marks.tolist(), "world": world.tolist()}
        return None

    def frame(self, t: float) -> tuple[float, bytes]:
        """The frame that is shown at `t` (s): its own time, and the picture as PNG."""
        when, image = self._at(t)
        return when, cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()

    def _at(self, t: float) -> tuple[float, Image]:
        if not (math.isfinite(t) and t >= 0):
            raise InputError(f"a frame's time is 0 s or later, not {t}")
        with self._lock:
            if not self._frame[0] <= t < self._frame[0] + self._stills.interval / 2:
                self._frame = self._stills.at(t)
            return self._frame

    def snap(self, asked: dict[str, Any]) -> dict[str, Any]:
        """Where a roughly picked point or drawn line belongs."""
        wanted = validate(Snap, asked, "snap")
        move = snap_point if len(wanted.mark) == 2 else snap_line
        found = move(self._at(wanted.t)[1], np.array(wanted.mark), wanted.radius)
        return {"found": found is not None, "mark": wanted.mark if found is None else found.tolist()}

    def fit(self, asked: dict[str, Any]) -> dict[str, Any]:
        """The homography through a sheet, and how far to trust it; where there is none, the reason."""
        sheet = validate(Sheet, asked, "sheet")
        answer: dict[str, Any] = {"fits": False, "world": sheet.world}
        try:
            marks, world = on_the_ground(sheet)
            answer["world"] = world.tolist()
            survey, ground = self._calibrated(sheet.noun, marks, world)
        except InputError as problem:
            return answer | {"reason": str(problem).removeprefix(f"{self._saved[sheet.noun]}: ")}
        sigma = command.speed_sigma(survey, ground, self.request.config)
        return answer | {
            "fits": True,
            "rms_m": ground.rms_m,
            "rms_px": ground.rms_px,
            "residuals": ground.residuals,
            "mapped": _numbers(to_image(ground, world.reshape(-1, 2)).reshape(marks.shape)),
            "expect_kmh": None if sigma is None else 1.96 * sigma,
            "warnings": [*survey.warnings, *command.doubts(survey, self._stills.size, self.request.config)],
            "grid": self._grid(ground, world),
            "errors": self._errors(ground),
        }

    def _calibrated(self, noun: str, marks: Array, world: Array) -> tuple[command.Survey, GroundMap]:
        path = self._saved[noun]
        through = command.from_points if noun == "point" else command.from_lines
        survey = through(marks, world, self.request.config, self._lens, path)
        return survey, command.ground_map(self.request, survey, self._stills.size, self._lens, path.name)

    def _grid(self, ground: GroundMap, world: Array) -> list[dict[str, Any]]:
        return [
            {"axis": axis, "metres": metres, "pieces": [np.round(piece[::4], 1).tolist() for piece in pieces]}
            for axis, metres, pieces in grid_lines(ground, world.reshape(-1, 2), self._stills.size)
            if pieces
        ]

    def _errors(self, ground: GroundMap) -> dict[str, Any]:
        step = max(1, self._stills.size[0] // CELLS)
        field = error_field(ground, self._stills.size, step, self.request.config.noise.sigma_px)
        return {"step": step, "kmh": _numbers(np.round(field, 2))}

    def save(self, asked: dict[str, Any]) -> dict[str, Any]:
        """Write the marks, H.json and its picture, and end."""
        sheet = validate(Sheet, asked, "sheet")
        marks, world = on_the_ground(sheet)
        survey, ground = self._calibrated(sheet.noun, marks, world)
        columns = POINT_COLUMNS if sheet.noun == "point" else LINE_COLUMNS
        saved = self._saved[sheet.noun]
        write_survey(saved, columns, np.hstack([marks, world]))
        self._forget(next(path for path in self._saved.values() if path != saved))
        result = command.write(self.request, survey, ground, self._at(sheet.t)[1])
        result.summary["picked"] = str(saved)
        self.result = result
        return {"text": command.text(result), "warnings": result.warnings}

    def _forget(self, path: Path) -> None:
        """Take away what an earlier session picked of the other kind: it does not belong to this H.json."""
        try:
            path.unlink(missing_ok=True)
        except OSError as problem:
            raise OutputError(f"{path}: cannot be removed: {problem.strerror or problem}") from problem


def _numbers(values: Array) -> list[Any]:
    """Nested lists, None for what is not finite."""
    nested = values.astype(object)
    nested[~np.isfinite(values)] = None
    return list(nested.tolist())


def _by(size: tuple[int, int] | None) -> str:
    return "unknown" if size is None else f"{size[0]}x{size[1]}"
