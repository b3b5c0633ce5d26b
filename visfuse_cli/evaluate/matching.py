"""Whose state is whose: matched frame by frame, and how often an identity changed or was lost on the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from visfuse_cli.records import Array

Rows = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Points:
    """Places (n, d) m at instants (n,), each of somebody (n,)."""

    instant: Rows
    id: Array
    place: Array


@dataclass(frozen=True, slots=True)
class Matches:
    """Rows (k, 2) of run and truth that belong together, identity changes, and gaps in what true ones were given."""

    pairs: Rows
    switches: int
    fragments: int


def matched(run: Points, truth: Points, gate: float) -> Matches:
    """Match states within a gate (m): who was matched before stays so, the rest go by least distance."""
    pairs: list[tuple[int, int]] = []
    switches = fragments = 0
    held: dict[float, float] = {}
    lost: set[float] = set()
    for true, mine in _by_instant(truth.instant, run.instant):
        apart = np.linalg.norm(run.place[mine][:, None] - truth.place[true][None], axis=-1)
        kept = np.array([[held.get(float(truth.id[j])) == run.id[i] for j in true] for i in mine], dtype=bool)
        near = apart < gate
        cost = np.where(near, apart - gate * kept.reshape(apart.shape), 1e6)
        seen = set()
        for i, j in zip(*linear_sum_assignment(cost), strict=True):
            if not near[i, j]:
                continue
            who = float(truth.id[true[j]])
            switches += int(who in held and held[who] != run.id[mine[i]])
            fragments += int(who in lost)
            held[who] = float(run.id[mine[i]])
            seen.add(who)
            pairs.append((int(mine[i]), int(true[j])))
        present = {float(truth.id[j]) for j in true}
        lost = (lost - seen) | {who for who in present - seen if who in held}
    return Matches(np.array(pairs, dtype=np.intp).reshape(-1, 2), switches, fragments)


def _by_instant(first: Rows, second: Rows) -> list[tuple[Rows, Rows]]:
    """Rows of both at every instant of the first."""
    order, other = np.argsort(first, kind="stable"), np.argsort(second, kind="stable")
    each = np.unique(first)
    bounds = np.searchsorted(first[order], np.append(each, each[-1] + 1)) if len(each) else [0]
    low, high = (np.searchsorted(second[other], each, side=side) for side in ("left", "right"))
    return [(order[bounds[k] : bounds[k + 1]], other[low[k] : high[k]]) for k in range(len(each))]


def identities(run: Points, truth: Points, gate: float) -> dict[str, Any]:
    """MOTA, IDF1 and HOTA by the package trackeval, where it is installed (the extra `evaluate`)."""
    try:
        from trackeval.metrics import CLEAR, HOTA, Identity
    except ImportError:
        return {"identities": "MOTA, IDF1 and HOTA are not computed: install visfuse-cli[evaluate]"}
    true_ids, mine_ids = np.unique(truth.id), np.unique(run.id)
    instants = _by_instant(truth.instant, run.instant)
    data: dict[str, Any] = {
        "num_gt_ids": len(true_ids),
        "num_tracker_ids": len(mine_ids),
        "num_gt_dets": len(truth.place),
        "num_tracker_dets": sum(len(mine) for _, mine in instants),
        "num_timesteps": len(instants),
        "gt_ids": [np.searchsorted(true_ids, truth.id[true]) for true, _ in instants],
        "tracker_ids": [np.searchsorted(mine_ids, run.id[mine]) for _, mine in instants],
        "similarity_scores": [
            # half at the gate, as the overlap of two boxes that are the same thing
            np.clip(1 - np.linalg.norm(truth.place[true][:, None] - run.place[mine][None], axis=-1) / (2 * gate), 0, 1)
            for true, mine in instants
        ],
    }
    clear, identity = (metric({"PRINT_CONFIG": False}).eval_sequence(data) for metric in (CLEAR, Identity))
    return {
        "mota": float(clear["MOTA"]),
        "idf1": float(identity["IDF1"]),
        "hota": float(np.mean(HOTA().eval_sequence(data)["HOTA"])),
    }
