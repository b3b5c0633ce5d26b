"""`visfuse evaluate`: errors, coverage, consistency, identities; a table, and evaluation.json in the run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from visfuse_cli.evaluate.tables import TRUTH, Estimates, read_run, read_table
from visfuse_cli.files.atomic import write_json
from visfuse_cli.maths.consistency import innovations, verdict
from visfuse_cli.records import Array

Z95 = 1.959963984540054
NEAR_S = 2.0  # s between a vehicle and the reading of a radar that may be of it


def evaluate(folder: Path, truth: Path | None, reference: Path | None, gate: float, plane: bool) -> dict[str, Any]:
    """Compare a run with truth (positions) or a reference (speeds), or judge it by itself; writes evaluation.json.

    gate: m, within which a state belongs to a true one; plane: positions without their third coordinate. Raises
    InputError where a file cannot be read, OutputError where the result cannot be written.
    """
    run = read_run(folder)
    found: dict[str, Any] = {
        "schema": "visfuse.evaluation/1",
        "run": str(folder),
        "consistency": innovations(run.summaries),
    }
    if truth is not None:
        found["truth"] = str(truth)
        found |= _against_truth(run, read_table(truth, TRUTH[:5], TRUTH[5:]), gate, plane)
    if reference is not None:
        found["reference"] = str(reference)
        found["speeds"] = _against_radar(run, read_table(reference, ("t", "speed_kmh")))
    write_json(folder / "evaluation.json", found)
    return found


def _against_truth(run: Estimates, truth: dict[str, Array], gate: float, plane: bool) -> dict[str, Any]:
    size = 2 if plane or run.position.shape[1] == 2 else 3
    columns = ("x", "y", "z")[:size]
    place = np.column_stack([truth.get(name, np.full(len(truth["x"]), np.nan)) for name in columns])
    speed = np.column_stack([truth.get(f"v{name}", np.full(len(truth["x"]), np.nan)) for name in columns])
    pairs, switches = _matched(run, truth, place, gate, size)
    frames = np.isin(run.frame, truth["frame"])
    result: dict[str, Any] = {
        "gate_m": gate,
        "dimensions": size,
        "true_states": len(place),
        "matched": len(pairs),
        "missed": len(place) - len(pairs),
        "false": int(np.count_nonzero(frames)) - len(pairs),
        "switches": switches,
        "moda": 1 - (len(place) - len(pairs) + int(np.count_nonzero(frames)) - len(pairs)) / len(place),
    }
    if len(pairs):
        mine, true = pairs.T
        off = run.position[mine, :size] - place[true]
        result["position_m"] = _errors(np.linalg.norm(off, axis=1)) | {"bias": off.mean(axis=0).tolist()}
        moving = np.isfinite(speed[true]).all(axis=1)
        if moving.any():
            apart = run.velocity[mine[moving], :size] - speed[true[moving]]
            faster = run.speed[mine[moving]] - np.linalg.norm(speed[true[moving]], axis=1)
            inside = np.abs(faster) <= Z95 * run.speed_sigma[mine[moving]]
            result["velocity_m_s"] = _errors(np.linalg.norm(apart, axis=1)) | {"bias": apart.mean(axis=0).tolist()}
            result["speed_m_s"] = _errors(np.abs(faster)) | {"bias": float(faster.mean())}
            result["speed_interval_coverage"] = float(inside.mean())
        cov = run.covariance[mine][:, :size, :size]
        nees = np.einsum("ni,ni->n", off, np.linalg.solve(cov, off[..., None])[..., 0])
        tracks = len(np.unique(run.id[mine]))
        # The errors of one track go together: each track is one draw, not each of its states.
        result["nees"] = verdict(float(nees.mean()) / size, float(size * tracks))
    return result | _identities(run, truth, place, gate, size, frames)


def _errors(values: Array) -> dict[str, float]:
    return {
        "rmse": float(np.sqrt(np.mean(values**2))),
        "median": float(np.median(values)),
        "max": float(values.max()),
    }


def _matched(run: Estimates, truth: dict[str, Array], place: Array, gate: float, size: int) -> tuple[Array, int]:
    """Rows (n, 2) of the run and of the truth that belong together, frame by frame; and how often an identity changed.

    Who was matched before stays so within the gate; the rest go by least distance.
    """
    pairs, switches = [], 0
    held: dict[float, float] = {}
    for frame in np.unique(truth["frame"]):
        true, mine = np.flatnonzero(truth["frame"] == frame), np.flatnonzero(run.frame == frame)
        if not len(mine):
            continue
        apart = np.linalg.norm(run.position[mine][:, None, :size] - place[true][None], axis=-1)
        cost = np.where(apart < gate, apart, 1e6)
        kept = np.array([[held.get(float(truth["id"][j])) == run.id[i] for j in true] for i in mine])
        cost = np.where(kept & (apart < gate), cost - gate, cost)
        for i, j in zip(*linear_sum_assignment(cost), strict=True):
            if apart[i, j] >= gate:
                continue
            who = float(truth["id"][true[j]])
            switches += int(who in held and held[who] != run.id[mine[i]])
            held[who] = float(run.id[mine[i]])
            pairs.append((mine[i], true[j]))
    return np.array(pairs, dtype=int).reshape(-1, 2), switches


def _identities(
    run: Estimates, truth: dict[str, Array], place: Array, gate: float, size: int, frames: NDArray[np.bool_]
) -> dict[str, Any]:
    """MOTA, IDF1 and HOTA by the package trackeval, where it is installed (the extra `evaluate`)."""
    try:
        from trackeval.metrics import CLEAR, HOTA, Identity
    except ImportError:
        return {"identities": "not computed: install visfuse-cli[evaluate] for MOTA, IDF1 and HOTA"}
    true_ids, mine_ids = np.unique(truth["id"]), np.unique(run.id)
    data: dict[str, Any] = {
        "num_gt_ids": len(true_ids),
        "num_tracker_ids": len(mine_ids),
        "num_gt_dets": len(place),
        "num_tracker_dets": int(np.count_nonzero(frames)),
        "gt_ids": [],
        "tracker_ids": [],
        "similarity_scores": [],
    }
    for frame in np.unique(truth["frame"]):
        true, mine = np.flatnonzero(truth["frame"] == frame), np.flatnonzero(run.frame == frame)
        apart = np.linalg.norm(place[true][:, None] - run.position[mine][None, :, :size], axis=-1)
        data["gt_ids"].append(np.searchsorted(true_ids, truth["id"][true]))
        data["tracker_ids"].append(np.searchsorted(mine_ids, run.id[mine]))
        data["similarity_scores"].append(np.clip(1 - apart / (2 * gate), 0, 1))  # half at the gate, as an overlap
    data["num_timesteps"] = len(data["gt_ids"])
    quiet = {"PRINT_CONFIG": False}
    clear, identity = (metric(quiet).eval_sequence(data) for metric in (CLEAR, Identity))
    hota = HOTA().eval_sequence(data)
    return {
        "mota": float(clear["MOTA"]),
        "id_switches": int(clear["IDSW"]),
        "fragments": int(clear["Frag"]),
        "idf1": float(identity["IDF1"]),
        "hota": float(np.mean(hota["HOTA"])),
    }


def _against_radar(run: Estimates, radar: dict[str, Array]) -> dict[str, Any]:
    """Each reading with the track that was there: bias and limits of agreement, km/h."""
    middle = np.array([(s["t_start"] + s["t_end"]) / 2 for s in run.summaries])
    half = np.array([(s["t_end"] - s["t_start"]) / 2 for s in run.summaries])
    mine = 3.6 * np.array([s["speed"] for s in run.summaries])
    if not len(middle):
        return {"pairs": 0, "unmatched_readings": len(radar["t"]), "unmatched_tracks": 0}
    apart = np.maximum(np.abs(radar["t"][:, None] - middle) - half, 0)
    rows, columns = linear_sum_assignment(np.where(apart < NEAR_S, apart, 1e6))
    good = apart[rows, columns] < NEAR_S
    rows, columns = rows[good], columns[good]
    found: dict[str, Any] = {
        "pairs": len(rows),
        "unmatched_readings": len(radar["t"]) - len(rows),
        "unmatched_tracks": len(middle) - len(rows),
    }
    if len(rows) > 1:
        off = mine[columns] - radar["speed_kmh"][rows]
        spread = float(off.std(ddof=1))
        found["bias_kmh"] = float(off.mean())
        found["limits_of_agreement_kmh"] = [float(off.mean()) - Z95 * spread, float(off.mean()) + Z95 * spread]
    return found


def text(found: dict[str, Any]) -> str:
    """The evaluation for people: one figure a line."""
    lines = []

    def say(name: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                say(f"{name} {key}".strip(), inner)
        elif isinstance(value, list):
            lines.append(f"{name:<36} " + ", ".join(f"{v:.3f}" for v in value))
        elif value is not None:
            lines.append(f"{name:<36} {value:.4g}" if isinstance(value, float) else f"{name:<36} {value}")

    for key, value in found.items():
        if key not in ("schema", "run", "truth", "reference"):
            say(key.replace("_", " "), value)
    return "\n".join(lines)
