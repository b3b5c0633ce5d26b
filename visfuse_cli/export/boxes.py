"""Boxes of one view of one recording as MOTChallenge rows."""

from __future__ import annotations

from visfuse_cli.errors import UsageError
from visfuse_cli.export.tracks import Tracks

UNKNOWN = "-1"


def mot(tracks: Tracks, view: str | None, clip: str | None) -> str:
    """Rows `frame,id,x,y,w,h,1,X,Y,Z` by frame and id: frames from 1, pixels from 0 as `speed --detections` reads them.

    X, Y, Z are metres (-1 for the Z of a ground plane). Raises UsageError where several views or clips are there and
    none is chosen, or the chosen one is not there.
    """
    view = _chosen("--view", view, tracks.views)
    clip = _chosen("--clip", clip, tracks.clips)
    rows = []
    for track in tracks.tracks:
        for state in track["states"] if track.get("clip", "") == clip else ():
            if view in state.get("box", {}):
                x, y, w, h = state["box"][view]
                place = [*(f"{value:.4f}" for value in state["position"]), UNKNOWN][:3]
                box = f"{x:.3f},{y:.3f},{w:.3f},{h:.3f}"
                rows.append((state["frame"] + 1, track["id"], f"{box},1,{','.join(place)}"))
    return "\n".join(f"{frame},{identity},{rest}" for frame, identity, rest in sorted(rows))


def _chosen(option: str, name: str | None, known: list[str]) -> str:
    if name is None and len(known) <= 1:
        return known[0] if known else ""
    if name is None or name not in known:
        said = "give one" if name is None else f"{name}: there is none of this name"
        raise UsageError(f"{option}: {said} of {', '.join(known) or 'none'}")
    return name
