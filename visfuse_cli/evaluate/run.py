"""`visfuse evaluate`: errors, coverage, consistency, identities; a table, a picture, and evaluation.json in RUN."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.evaluate import plots
from visfuse_cli.evaluate.agreement import against_radar
from visfuse_cli.evaluate.errors import of_mean_speeds, of_states
from visfuse_cli.evaluate.matching import Points, Rows, identities, matched
from visfuse_cli.evaluate.tables import Estimates, Table, read_radar, read_run, read_truth
from visfuse_cli.files.atomic import write_json
from visfuse_cli.maths.consistency import innovations
from visfuse_cli.records import Array


def evaluate(
    folder: Path, truth: Path | None, reference: Path | None, gate: float, plane: bool
) -> tuple[dict[str, Any], list[str]]:
    """Compare a run with truth (positions) or a reference (speeds), or judge it by itself; what is found, and warnings.

    gate: m, within which a state belongs to a true one; plane: on the ground only. Writes evaluation.json and
    evaluation.png. Raises InputError where a file cannot be read, OutputError where the result cannot be written.
    """
    run = read_run(folder)
    warnings: list[str] = []
    found: dict[str, Any] = {
        "schema": "visfuse.evaluation/1",
        "run": str(folder),
        "consistency": innovations([track["summary"] for track in run.tracks]),
    }
    drawings = [plots.innovations(*_each_nis(run))]
    if truth is not None:
        found["truth"] = str(truth)
        told, drawn = _against_truth(run, truth, gate, plane, warnings)
        found |= told
        drawings += drawn
    if reference is not None:
        radar = read_radar(reference)
        if len(set(run.clip)) > 1 and not any(radar.clip):
            raise InputError(f"{reference}: the run is of several clips; a column clip says which one a reading is of")
        found["reference"] = str(reference)
        found["speeds"], pairs = against_radar(run, radar)
        drawings.append(plots.agreement(pairs))
    write_json(folder / "evaluation.json", found)
    plots.write(folder / "evaluation.png", drawings)
    return found, warnings


def _each_nis(run: Estimates) -> tuple[Array, Array]:
    """Normalised innovations a degree of freedom (k,), and how many degrees of freedom (k,), track by track."""
    told = [
        (s["nis_mean"] / s["nis_dof"], s["n_frames"] * s["nis_dof"])
        for s in (track["summary"] for track in run.tracks)
        if s.get("nis_mean") and s.get("nis_dof") and s.get("n_frames")
    ]
    ratio, freedom = np.array(told, dtype=float).reshape(-1, 2).T
    return ratio, freedom


def _against_truth(
    run: Estimates, path: Path, gate: float, plane: bool, warnings: list[str]
) -> tuple[dict[str, Any], list[plots.Drawing]]:
    truth = read_truth(path)
    axes = _compared(run, truth, path, plane, warnings)
    place, velocity = (_onto(truth.stack(names), axes) for names in (("x", "y", "z"), ("vx", "vy", "vz")))
    mine, true = _instants(run, truth, path)
    if len(mine) and not np.isin(true, mine).any():
        warnings.append(f"{path}: no frame of it has a state of the run; is it this run's?")
    ours = Points(mine, run.id, run.position @ axes.T)
    theirs = Points(true, truth.columns["id"], place)
    matches = matched(ours, theirs, gate)
    false = int(np.count_nonzero(np.isin(mine, true))) - len(matches.pairs)
    missed = len(place) - len(matches.pairs)
    result: dict[str, Any] = {
        "gate_m": gate,
        "dimensions": len(axes),
        "true_states": len(place),
        "matched": len(matches.pairs),
        "missed": missed,
        "false": false,
        "switches": matches.switches,
        "fragments": matches.fragments,
        "moda": 1 - (missed + false) / len(place),
    }
    drawings: list[plots.Drawing] = []
    if len(matches.pairs):
        errors, drawings = of_states(run, axes, place, velocity, matches.pairs)
        result |= errors | of_mean_speeds(run, truth, matches.pairs)
    return result | identities(ours, theirs, gate), drawings or [plots.nothing("no state of the run was matched")]


def _compared(run: Estimates, truth: Table, path: Path, plane: bool, warnings: list[str]) -> Array:
    """The axes (d, dims of truth) that run and truth are compared on; raises InputError where they are not known."""
    dims = run.position.shape[1]
    known = np.isfinite(truth.stack(("z",))[:, 0])
    if dims == 2:
        return run.axes
    axes = run.axes if plane else np.eye(3)
    needs_z = bool(np.any(axes[:, 2]))
    if not known.any() and not plane and not np.any(run.axes[:, 2]):
        warnings.append(f"{path}: column z is empty; compared on the ground only")
        return run.axes
    if needs_z and not known.all():
        line = truth.line[np.flatnonzero(~known)[0]]
        why = "on the ground too the run is compared along z" if plane else "the run is in 3D; --plane: on the ground"
        raise InputError(f"{path}, line {line}, column z: is empty; {why}")
    return axes


def _onto(values: Array, axes: Array) -> Array:
    """Truth (n, 3) on the axes (d, dims); what no axis needs may be unknown."""
    values = np.where(np.any(axes != 0, axis=0), values[:, : axes.shape[1]], 0.0)
    return np.asarray(values @ axes.T)


def _instants(run: Estimates, truth: Table, path: Path) -> tuple[Rows, Rows]:
    """Clip and frame of every row of the run and of the truth as one number."""
    told = set(truth.clip.tolist()) - {""}
    if not told and len(set(run.clip.tolist())) > 1:
        raise InputError(f"{path}: the run is of several clips; a column clip says which one a row is of")
    frames = np.concatenate([run.frame, truth.columns["frame"]])
    clips = np.concatenate([run.clip, truth.clip]) if told and any(run.clip) else np.zeros(len(frames), dtype=np.str_)
    _, clip = np.unique(clips, return_inverse=True)
    _, instant = np.unique(np.column_stack([clip, frames]), axis=0, return_inverse=True)
    instant = instant.ravel()
    return instant[: len(run.frame)], instant[len(run.frame) :]
