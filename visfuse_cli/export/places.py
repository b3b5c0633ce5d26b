"""Tracks on the map: GeoJSON in WGS 84, GeoPackage in the calibration's own coordinate reference."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.export.tracks import Tracks
from visfuse_cli.files.atomic import failing_as_output, replacing_path
from visfuse_cli.records import Array

DIGITS = 8  # of a degree: a millimetre


def geojson(tracks: Tracks) -> str:
    """A FeatureCollection (RFC 7946), one LineString a track with the time of each vertex; raises as `placed` does."""
    code, lines = placed(tracks)
    pyproj = _library("pyproj")
    try:
        to_wgs84 = pyproj.Transformer.from_crs(code, "EPSG:4326", always_xy=True)
    except pyproj.exceptions.CRSError as problem:
        raise InputError(f"{tracks.folder / 'run.json'}: no coordinate reference '{code}' is known") from problem
    features = []
    for track, line in zip(tracks.tracks, lines, strict=True):
        places = np.column_stack(to_wgs84.transform(line[:, 0], line[:, 1]))
        if not np.isfinite(places).all():
            raise InputError(f"{tracks.folder / 'run.json'}: the origin lies nowhere in {code}")
        degrees = np.round(places, DIGITS).tolist()
        kind, coordinates = ("LineString", degrees) if len(degrees) > 1 else ("Point", degrees[0])
        times = [state["t"] for state in track["states"]]
        features.append(
            {
                "type": "Feature",
                "id": track["id"],
                "geometry": {"type": kind, "coordinates": coordinates},
                "properties": _properties(track) | {"times": times},
            }
        )
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False, ensure_ascii=False)


def geopackage(tracks: Tracks, path: Path) -> None:
    """A GeoPackage with the layers `tracks` (lines) and `states` (points); raises as `placed` does, and OutputError."""
    code, lines = placed(tracks)
    shapely, raw = _library("shapely"), _library("pyogrio.raw")
    tracked = [_properties(track) for track in tracks.tracks]
    doubled = [line if len(line) > 1 else np.repeat(line, 2, axis=0) for line in lines]  # a line has two ends
    stated = [
        {"track_id": track["id"], "clip": track.get("clip")}
        | {name: state[name] for name in ("frame", "t", "speed", "speed_sigma", "measured")}
        for track in tracks.tracks
        for state in track["states"]
    ]
    points = np.concatenate(lines) if lines else np.empty((0, 2))
    layers = {
        "tracks": ("LineString", [shapely.LineString(line) for line in doubled], tracked),
        "states": ("Point", list(shapely.points(points)), stated),
    }
    with replacing_path(path) as partial, failing_as_output(path):
        base = partial.with_suffix(".gpkg")  # GDAL insists on the ending
        try:
            for number, (name, (kind, shapes, rows)) in enumerate(layers.items()):
                fields = list(rows[0]) if rows else []
                raw.write(
                    str(base),
                    geometry=np.array(shapely.to_wkb(shapes), dtype=object),
                    field_data=[_column([row[field] for row in rows]) for field in fields],
                    fields=fields,
                    geometry_type=kind,
                    crs=code,
                    layer=name,
                    driver="GPKG",
                    append=number > 0,
                )
            base.replace(partial)
        except RuntimeError as problem:  # GDAL's refusals; what it names is the partial file
            raise OSError(str(problem).replace(str(base), str(path))) from problem
        finally:
            base.unlink(missing_ok=True)


def _column(values: list[Any]) -> np.ndarray:
    """Values as GDAL takes them: numbers with NaN where one is unknown, else texts with None."""
    if any(isinstance(value, str) for value in values):
        return np.array(values, dtype=object)
    if all(isinstance(value, bool | int) for value in values):
        return np.array(values)
    return np.array([np.nan if value is None else value for value in values], dtype=float)


def placed(tracks: Tracks) -> tuple[str, list[Array]]:
    """The coordinate reference, and each track's eastings and northings (T, 2) m.

    Raises InputError where the run was calibrated without one, or is not on a ground plane.
    """
    crs = tracks.run.get("crs")
    if not isinstance(crs, dict) or tracks.frame_of_reference != "ground":
        raise InputError(
            f"{tracks.folder}: the run has no place on earth; calibrate-homography --crs EPSG:... --origin E,N gives it"
        )
    try:
        code, origin = str(crs["code"]), np.array(crs["origin"], dtype=float).reshape(2)
    except (KeyError, TypeError, ValueError) as problem:
        raise InputError(f'{tracks.folder / "run.json"}: "crs" needs "code" and "origin"') from problem
    return code, [origin + np.array([state["position"][:2] for state in t["states"]]) for t in tracks.tracks]


def _properties(track: dict[str, Any]) -> dict[str, Any]:
    summary, (low, high) = track["summary"], track["summary"].get("speed_ci95", (None, None))
    return {
        "track_id": track["id"],
        "clip": track.get("clip"),
        "class": track.get("class"),
        "rejected": summary.get("rejected"),
        "t_start": summary["t_start"],
        "t_end": summary["t_end"],
        "speed": summary["speed"],
        "speed_low": low,
        "speed_high": high,
    }


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as problem:
        raise UsageError(f"this format needs {name.split('.')[0]}: pip install 'visfuse-cli[geo]'") from problem
