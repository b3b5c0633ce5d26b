"""`--crs` and `--origin`: where on earth the ground plane lies, checked by pyproj (the extra `geo`)."""

from __future__ import annotations

import math
import re

from visfuse_cli.errors import UsageError
from visfuse_cli.records import GroundReference


def parse_reference(crs: str | None, origin: str | None) -> GroundReference | None:
    """An EPSG code and `E,N` of the ground's origin (0,0 where it is not given); raises UsageError."""
    if crs is None:
        if origin is not None:
            raise UsageError("--origin needs --crs: numbers alone are no place on earth")
        return None
    code = crs.strip().upper()
    if not re.fullmatch(r"EPSG:[0-9]{1,7}", code):
        raise UsageError(f"--crs {crs}: write it as EPSG:NUMBER, like EPSG:25833")
    _check(code)
    return GroundReference(code, _origin(origin))


def _check(code: str) -> None:
    """Metres to the east and the north, or it is refused."""
    try:
        import pyproj
    except ImportError as problem:
        raise UsageError("--crs needs pyproj: pip install 'visfuse-cli[geo]'") from problem
    try:
        found = pyproj.CRS.from_user_input(code)
    except pyproj.exceptions.CRSError as problem:
        raise UsageError(f"--crs {code}: there is no such coordinate reference") from problem
    units = {axis.unit_name for axis in found.axis_info[:2]}
    if not found.is_projected or units != {"metre"}:
        said = "is in degrees" if found.is_geographic else f"is in {', '.join(sorted(units)) or 'no plane'}"
        raise UsageError(f"--crs {code} ({found.name}) {said}; give a projected one in metres, like a UTM zone's")


def _origin(text: str | None) -> tuple[float, float]:
    if text is None:
        return 0.0, 0.0
    try:
        easting, northing = (float(part) for part in text.split(","))
    except ValueError as problem:
        raise UsageError(f"--origin {text}: write it as E,N, metres, like 844000,5673100") from problem
    if not (math.isfinite(easting) and math.isfinite(northing)):
        raise UsageError(f"--origin {text}: two finite numbers, metres")
    return easting, northing
