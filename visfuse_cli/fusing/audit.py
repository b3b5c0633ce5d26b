"""What the footage says of each camera: is it where the calibration puts it, is its clock that of the others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.estimate import Sights
from visfuse_cli.maths.gaussian import times
from visfuse_cli.maths.multiview import project
from visfuse_cli.records import Array, Gaussian

LEAST = 40  # sightings of a camera that make a finding
FIRST, OFTEN = 150, 40  # clear sights a camera before cameras are first judged, and from then on each time
FAR_M = 0.25  # m from which on a camera is said to stand elsewhere
BLIND = 0.5  # share of clear sights without use from which on it is
LATE_S = 0.06  # s from which on a clock is said to be off
SURE = 6.0  # deviations
FARTHEST_M = 1.5  # m: what is farther off is somebody else


@dataclass(frozen=True, slots=True)
class Finding:
    """How a camera's sightings differ from where all cameras together expect people.

    `shift` (2,) px (m at the person: `shift_m`), `late` (s) with its deviation, and the `unused` share of clear sights
    at which the camera did not see, or was not believed.
    """

    sightings: int
    shift: Array
    shift_m: float
    late: float
    late_sigma: float
    unused: float


class Audit:
    """Sums, camera by camera, over all sightings: residual = shift + late * velocity in the picture."""

    def __init__(self, cameras: int) -> None:
        self._A, self._b = np.zeros((cameras, 3, 3)), np.zeros((cameras, 3))
        self._square, self._n = np.zeros(cameras), np.zeros(cameras, dtype=int)
        self._scale = np.zeros(cameras)
        self._due = FIRST * cameras
        self._clear, self._used = np.zeros(cameras, dtype=int), np.zeros(cameras, dtype=int)

    def take(self, sights: Sights, P: Array, prior: Gaussian) -> None:
        """Take in one instant's sightings (M), believed or not, beside the predictions (T, 6)."""
        if not len(sights):
            return
        pixels, J = project(P[sights.camera], prior.mean[sights.owner, :3])
        scale = np.sqrt(np.einsum("mab,mab->m", J, J) / 2)  # px per m
        off, moved = (sights.z - pixels) / scale[:, None], times(J, prior.mean[sights.owner, 3:]) / scale[:, None]
        with np.errstate(invalid="ignore"):
            good = np.linalg.norm(off, axis=1) < FARTHEST_M
        for axis in (0, 1):
            X = np.zeros((len(sights), 3))
            X[:, axis], X[:, 2] = 1.0, moved[:, axis]
            np.add.at(self._A, sights.camera[good], X[good, :, None] * X[good, None, :])
            np.add.at(self._b, sights.camera[good], X[good] * off[good, axis, None])
            np.add.at(self._square, sights.camera[good], off[good, axis] ** 2)
        np.add.at(self._n, sights.camera[good], 1)
        np.add.at(self._scale, sights.camera[good], scale[good])

    def sights(self, clear: NDArray[np.bool_], used: NDArray[np.bool_]) -> None:
        """Take in who could be seen (T, C), and whom the cameras were believed to see (T, C)."""
        self._clear += np.count_nonzero(clear, axis=0)
        self._used += np.count_nonzero(clear & used, axis=0)

    def due(self) -> bool:
        """Whether enough was taken in since it was last said so to look at the findings again."""
        if self._clear.sum() < self._due:
            return False
        self._due = int(self._clear.sum()) + OFTEN * len(self._n)
        return True

    def findings(self, zoom: Array) -> list[Finding]:
        """What was found of each camera; `zoom` (C,) pixels of the footage per pixel that was measured in."""
        found = []
        for c, n in enumerate(self._n):
            unused = 1 - self._used[c] / self._clear[c] if self._clear[c] else 0.0
            if n < LEAST:
                found.append(Finding(int(n), np.zeros(2), 0.0, 0.0, np.inf, float(unused)))
                continue
            A = self._A[c] + np.diag([0, 0, 1e-6])
            solution = np.linalg.solve(A, self._b[c])
            left = max(self._square[c] - solution @ self._b[c], 0.0) / max(2 * n - 3, 1)
            sigma = float(np.sqrt(left * np.linalg.inv(A)[2, 2]))
            shift = solution[:2] * self._scale[c] * zoom[c] / n
            found.append(
                Finding(int(n), shift, float(np.linalg.norm(solution[:2])), float(solution[2]), sigma, float(unused))
            )
        return found


def misfits(findings: list[Finding]) -> list[int]:
    """The cameras that do not stand where the calibration says, beside two others or more that do."""
    known = np.array([each.sightings >= LEAST for each in findings])
    found = []
    for c, each in enumerate(findings):
        others = np.flatnonzero(known & (np.arange(len(findings)) != c))
        if len(others) < 2:
            continue
        usual = float(np.median([findings[o].shift_m for o in others]))
        blind = float(np.median([findings[o].unused for o in others]))
        if (known[c] and each.shift_m > max(FAR_M, 4 * usual)) or each.unused > max(BLIND, 2.5 * blind):
            found.append(c)
    return found


def complaints(names: list[str], findings: list[Finding], interval_s: float) -> list[str]:
    """What to warn of: cameras that do not stand where the calibration says, or whose clock is off."""
    late = np.array([each.late for each in findings])
    known = np.array([each.sightings >= LEAST for each in findings])
    said, wrong = [], misfits(findings)
    for c, each in enumerate(findings):
        others = known & (np.arange(len(names)) != c) & ~np.isin(np.arange(len(names)), wrong)
        if c in wrong:
            said.append(
                f"camera '{names[c]}' does not fit the others: people stand {np.linalg.norm(each.shift):.0f} px "
                f"({each.shift_m:.2f} m) from where its calibration puts them, and {each.unused:.0%} of its clear "
                "sights were of no use; was it moved, or calibrated at another size?"
            )
            continue
        if np.count_nonzero(others) < 2:
            continue
        behind = each.late - float(np.median(late[others]))
        if known[c] and abs(behind) > max(LATE_S, 0.6 * interval_s) and abs(behind) > SURE * each.late_sigma:
            said.append(
                f"camera '{names[c]}' is about {abs(behind):.2f} s or more {'late' if behind > 0 else 'early'}; "
                "--estimate-offsets finds out, fusion.offsets sets it"
            )
    return said
