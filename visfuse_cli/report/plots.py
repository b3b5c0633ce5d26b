"""The report's figures as SVG text in the page's own colours, the same bytes for the same run."""

from __future__ import annotations

import colorsys
import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from visfuse_cli.maths.percentiles import pace, percentile
from visfuse_cli.records import Array
from visfuse_cli.report.folder import TrackView
from visfuse_cli.report.tables import PACE_KMH, Shown

Z95 = 1.96
MOST_LINES = 60  # tracks in one figure
MOST_FIGURES = 24  # clips with a figure of their own
MOST_POINTS = 400  # of one track
INK = "#010203"  # stands for the colour of the page's text
MODELS = {"drifting": "#7a8ca5", "cv": "#4c9f70", "ca": "#e08e45", "periodic": "#9a6fb0"}
Curve = Callable[[TrackView], tuple[Array, Array]]  # values (T,) over time and how far their band reaches (T,)
Highest = Callable[[Sequence[TrackView]], float]  # up to where the axis goes
LAID_OUT: Any = {
    "svg.hashsalt": "visfuse",
    "svg.fonttype": "none",
    "figure.dpi": 72,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def colour_of(track_id: int) -> str:
    """The hue that a track has in its video, dark enough for paper and light enough for night."""
    red, green, blue = colorsys.hls_to_rgb((track_id * 0.61803398875) % 1.0, 0.48, 0.65)
    return f"#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}"


def _axes(height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(6.4, height), layout="constrained", facecolor="none")
    axes = figure.add_subplot()
    axes.set_facecolor("none")
    return figure, axes


def histogram(speeds: Array, units: Shown) -> str:
    """Speeds (n,) km/h with 50th and 85th percentile and pace."""
    with matplotlib.rc_context(LAID_OUT):
        figure, axes = _axes(3.2)
        shown = units.of_kmh(speeds)
        axes.hist(
            shown, bins=max(5, min(30, round(np.sqrt(len(shown)) * 2))), color="#5b8db8", edgecolor="none", rwidth=0.94
        )
        for share, colour in ((0.5, INK), (0.85, "#c94040")):
            value = percentile(shown, share)[0]
            axes.axvline(value, color=colour, label=f"{100 * share:.0f} %: {value:.1f} {units.name}")
        low, held = pace(speeds, PACE_KMH)
        axes.axvspan(units.of_kmh(low), units.of_kmh(low + PACE_KMH), color="#e8b430", alpha=0.3, zorder=0)
        axes.plot([], [], color="#e8b430", alpha=0.6, linewidth=8, label=f"pace: {100 * held:.0f} % of the vehicles")
        axes.set(xlabel=f"speed ({units.name})", ylabel="vehicles")
        axes.legend(frameon=False, fontsize=9)
        return _svg(figure)


def speeds(tracks: Sequence[TrackView], units: Shown) -> list[dict[str, Any]]:
    """Speed over time of each track with its 95 % band, a figure a clip: its name, SVG and time axis."""

    def curve(track: TrackView) -> tuple[Array, Array]:
        return track.speed * units.factor, Z95 * track.speed_sigma * units.factor

    def highest(shown: Sequence[TrackView]) -> float:
        return _highest(shown) * units.factor

    return _over_time(tracks, curve, f"speed ({units.name})", highest)


def depths(tracks: Sequence[TrackView]) -> list[dict[str, Any]]:
    """Distance along the left camera's axis (m) over time of each track, a figure a clip as of `speeds`."""

    def curve(track: TrackView) -> tuple[Array, Array]:
        return track.position[:, 2], np.zeros(len(track.t))

    def highest(shown: Sequence[TrackView]) -> float:
        return 1.1 * max(float(track.position[:, 2].max()) for track in shown)

    return _over_time(tracks, curve, "depth (m)", highest)


def _over_time(tracks: Sequence[TrackView], curve: Curve, label: str, highest: Highest) -> list[dict[str, Any]]:
    clips = sorted({track.clip for track in tracks})
    return [_clip([t for t in tracks if t.clip == clip], curve, label, highest) for clip in clips[:MOST_FIGURES]]


def _clip(tracks: list[TrackView], curve: Curve, label: str, highest: Highest) -> dict[str, Any]:
    """The figure of the tracks of one clip."""
    with matplotlib.rc_context(LAID_OUT):
        figure, axes = _axes(3.2)
        for track in tracks[:MOST_LINES]:
            each = max(1, len(track.t) // MOST_POINTS)
            t, (value, band), colour = track.t[::each], (a[::each] for a in curve(track)), colour_of(track.id)
            area = axes.fill_between(t, np.maximum(value - band, 0), value + band, color=colour, alpha=0.2, linewidth=0)
            (line,) = axes.plot(t, value, color=colour, linewidth=1.2)
            name = axes.annotate(str(track.id), (t[-1], value[-1]), fontsize=8, color=colour)
            for part in (area, line, name):
                part.set_gid(f"track-{track.id}")
        axes.set(xlabel="t (s)", ylabel=label)
        axes.set_ylim(0, highest(tracks[:MOST_LINES]))
        axes.axvline(axes.get_xlim()[0], color="#d03030", linewidth=1).set_gid("cursor")
        axes.set_xlim(axes.get_xlim())
        figure.draw_without_rendering()
        (left, _), (right, _) = axes.transData.transform([(0, 0), (1, 0)])
        begin = float(axes.get_xlim()[0])
        more = f"the first {MOST_LINES} of {len(tracks)} tracks" if len(tracks) > MOST_LINES else ""
        return {
            "clip": Path(tracks[0].clip).stem,
            "svg": _svg(figure),
            "begin": begin,
            "second": float(right - left),
            "more": more,
        }


def _highest(tracks: Sequence[TrackView]) -> float:
    """m/s that a figure must reach: nearly all speeds and most bands; what is known badly may stick out."""
    speed = np.concatenate([track.speed for track in tracks])
    edge = speed + Z95 * np.concatenate([track.speed_sigma for track in tracks])
    return 1.15 * max(float(np.nanpercentile(speed, 99)), float(np.nanpercentile(edge, 80)), 1e-3)


def models(tracks: Sequence[TrackView]) -> list[tuple[int, str]]:
    """Probability of each motion model over time, a figure a track, of the longest of those that have several."""
    several = sorted((track for track in tracks if len(track.models) > 1), key=lambda track: -len(track.t))[:6]
    figures = []
    for track in sorted(several, key=lambda track: track.id):
        with matplotlib.rc_context(LAID_OUT):
            figure, axes = _axes(2.2)
            colours = [MODELS.get(name, colour_of(k + 3)) for k, name in enumerate(track.models)]
            axes.stackplot(track.t, *track.models.values(), labels=list(track.models), colors=colours)
            axes.set(xlabel="t (s)", ylabel="probability", ylim=(0, 1))
            axes.margins(x=0)
            axes.legend(
                frameon=False, fontsize=9, ncols=len(track.models), loc="upper center", bbox_to_anchor=(0.5, 1.25)
            )
            figures.append((track.id, _svg(figure)))
    return figures


def _svg(figure: Figure) -> str:
    out = io.StringIO()
    figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    text = re.sub(r'id="(track-\d+|cursor)"', r'class="\1"', text)
    return re.sub(
        r' id="(?:figure|axes|patch|line2d|text|legend|matplotlib\.axis|xtick|ytick|\w*Collection)_\d+"', "", text
    )
