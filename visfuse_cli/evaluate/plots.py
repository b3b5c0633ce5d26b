"""The picture of an evaluation: one panel a question."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import chi2

from visfuse_cli.files.atomic import replacing
from visfuse_cli.maths.consistency import BAND
from visfuse_cli.records import Array

Drawing = Callable[[Axes], None]
Z95 = 1.959963984540054
BLUE, RED, GREY = "#2f6f9f", "#b03030", "#888888"
MOST_LINES = 40  # tracks in one panel: more cannot be told apart


def write(path: Path, drawings: Sequence[Drawing]) -> None:
    """Draw the panels side by side, the same bytes for the same figures; raises OutputError."""
    figure = Figure(figsize=(5.2 * len(drawings), 3.8), layout="constrained")
    for axes, drawing in zip(figure.subplots(1, len(drawings), squeeze=False)[0], drawings, strict=True):
        drawing(axes)
    with replacing(path) as file:
        figure.savefig(file, format="png", dpi=110, metadata={"Software": None})


def nothing(why: str) -> Drawing:
    """A panel that says why it is empty."""

    def draw(axes: Axes) -> None:
        axes.set_axis_off()
        axes.text(0.5, 0.5, why, ha="center", va="center", color=GREY)

    return draw


def innovations(ratio: Array, freedom: Array) -> Drawing:
    """Each track's normalised innovations (k,) a degree of freedom (k,) with their band."""
    if not len(ratio):
        return nothing("the tracks carry no innovations")

    def draw(axes: Axes) -> None:
        order = np.argsort(freedom)
        n = freedom[order]
        low, high = (chi2.ppf(p, n) / n for p in ((1 - BAND) / 2, (1 + BAND) / 2))
        axes.fill_between(n, low, high, color=BLUE, alpha=0.2, linewidth=0, label=f"{BAND:.1%} band")
        axes.plot(n, ratio[order], ".", color=BLUE)
        axes.axhline(1, color=GREY, linewidth=0.8)
        axes.set(xlabel="measured numbers of a track", ylabel="NIS / degree of freedom", ylim=(0, None))
        axes.set_title("are the innovations as large as stated?", fontsize=9)
        axes.legend(frameon=False, fontsize=8)

    return draw


def errors(frame: Array, off: Array, identity: Array) -> Drawing:
    """Position error (n,) m over the frames (n,), track by track."""

    def draw(axes: Axes) -> None:
        for each in np.unique(identity)[:MOST_LINES]:
            mine = np.flatnonzero(identity == each)
            mine = mine[np.argsort(frame[mine], kind="stable")]
            axes.plot(frame[mine], off[mine], linewidth=1)
        axes.set(xlabel="frame", ylabel="position error (m)", ylim=(0, None))
        axes.set_title(f"position: RMSE {np.sqrt(np.mean(off**2)):.3g} m", fontsize=9)

    return draw


def normalised(nees: Array, size: int) -> Drawing:
    """Normalised errors squared (n,) of `size` numbers beside their chi-square density."""

    def draw(axes: Axes) -> None:
        top = float(chi2.ppf(0.9999, size))
        axes.hist(np.minimum(nees, top), bins=40, range=(0, top), density=True, color=BLUE, alpha=0.6)
        x = np.linspace(0.02, top, 300)
        axes.plot(x, chi2.pdf(x, size), color=RED, label=f"chi-square, {size}")
        axes.set(xlabel="NEES of positions (beyond: last bar)", ylabel="density", ylim=(0, 2.2 / size))
        axes.set_title("are the errors as large as stated?", fontsize=9)
        axes.legend(frameon=False, fontsize=8)

    return draw


def speeds(true: Array, mine: Array) -> Drawing:
    """Our speeds (n,) over the true ones (n,), m/s."""

    def draw(axes: Axes) -> None:
        axes.plot(true, mine, ".", markersize=2, color=BLUE, alpha=0.4)
        ends = [min(true.min(), mine.min()), max(true.max(), mine.max())]
        axes.plot(ends, ends, color=GREY, linewidth=0.8)
        axes.set(xlabel="true speed (m/s)", ylabel="ours (m/s)")
        axes.set_title(f"speed: bias {np.mean(mine - true):.3g} m/s", fontsize=9)

    return draw


def agreement(pairs: Array) -> Drawing:
    """Differences of paired speeds (k, 2) km/h over their means, bias and limits of agreement (Bland and Altman)."""
    if not len(pairs):
        return nothing("no reading has a track")

    def draw(axes: Axes) -> None:
        off = pairs[:, 1] - pairs[:, 0]
        axes.plot(pairs.mean(axis=1), off, "o", markersize=4, color=BLUE)
        axes.axhline(off.mean(), color=RED, label=f"bias {off.mean():.2f}")
        if len(off) > 1:
            for side in (-Z95, Z95):
                limit = off.mean() + side * off.std(ddof=1)
                axes.axhline(limit, color=RED, linestyle="--", label=f"limit {limit:.2f}")
        axes.set(xlabel="mean of both (km/h)", ylabel="ours less the reference (km/h)")
        axes.set_title("agreement with the reference", fontsize=9)
        axes.legend(frameon=False, fontsize=8)

    return draw
