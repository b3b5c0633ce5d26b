"""The report's figures as SVG text, the same bytes for the same run."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from visfuse_cli.maths.percentiles import pace, percentile
from visfuse_cli.records import Array
from visfuse_cli.report.folder import TrackView

Z95 = 1.96
PACE_KMH = 16.09344  # ten miles an hour
MOST_LINES = 40  # tracks in one figure: more cannot be told apart
MOST_POINTS = 400  # of one track


def histogram(speeds: Array, factor: float, units: str) -> str:
    """Speeds (n,) km/h with 50th and 85th percentile and pace, in other units by `factor`."""
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.add_subplot()
    shown = speeds * factor
    axes.hist(shown, bins=max(5, min(30, round(np.sqrt(len(shown)) * 2))), color="#5b8db8", edgecolor="white")
    for share, colour in ((0.5, "#222222"), (0.85, "#b03030")):
        value = percentile(shown, share)[0]
        axes.axvline(value, color=colour, label=f"{100 * share:.0f} %: {value:.1f} {units}")
    low, held = pace(speeds, PACE_KMH)
    axes.axvspan(low * factor, (low + PACE_KMH) * factor, color="#e8c468", alpha=0.35, zorder=0)
    axes.plot([], [], color="#e8c468", alpha=0.6, linewidth=8, label=f"pace: {100 * held:.0f} % of the vehicles")
    axes.set(xlabel=f"speed ({units})", ylabel="vehicles")
    axes.legend(frameon=False, fontsize=8)
    return _svg(figure)


def speeds(tracks: Sequence[TrackView], factor: float, units: str) -> str:
    """Speed over time of each track with its 95 % band; factor from m/s."""
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.add_subplot()
    for track in tracks[:MOST_LINES]:
        each = max(1, len(track.t) // MOST_POINTS)
        t, speed = track.t[::each], track.speed[::each] * factor
        band = Z95 * track.speed_sigma[::each] * factor
        (line,) = axes.plot(t, speed, linewidth=1.2)
        axes.fill_between(t, speed - band, speed + band, color=line.get_color(), alpha=0.18, linewidth=0)
        axes.annotate(str(track.id), (t[-1], speed[-1]), fontsize=7, color=line.get_color())
    axes.set(xlabel="t (s)", ylabel=f"speed ({units})")
    top = np.concatenate([track.speed for track in tracks[:MOST_LINES]]) * factor
    axes.set_ylim(0, float(np.nanpercentile(top, 99.5)) * 1.25 + 1e-3)
    return _svg(figure)


def models(tracks: Sequence[TrackView]) -> list[tuple[int, str]]:
    """Probability of each motion model over time, a figure a track, of those that have several."""
    figures = []
    for track in [track for track in tracks if len(track.models) > 1][:6]:
        figure = Figure(figsize=(6.4, 2.2), layout="constrained")
        axes = figure.add_subplot()
        axes.stackplot(track.t, *track.models.values(), labels=list(track.models))
        axes.set(xlabel="t (s)", ylabel="probability", ylim=(0, 1))
        axes.legend(frameon=False, fontsize=8, ncols=len(track.models), loc="upper center", bbox_to_anchor=(0.5, 1.25))
        figures.append((track.id, _svg(figure)))
    return figures


def _svg(figure: Figure) -> str:
    out = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "visfuse", "svg.fonttype": "none"}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    return text[text.index("<svg") :]
