"""A manifest to items: globs opened, overrides laid on top, everything checked before the first item runs."""

from __future__ import annotations

import glob
import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib import import_module
from pathlib import Path
from typing import Any

from visfuse_cli.apps.batch.entries import ENTRIES, INPUTS, PATHS, CalibrateEntry, Entry, Manifest, TrackingEntry
from visfuse_cli.config import Key, Section, load, nearest, parse_yaml, read_text, validate
from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files.folders import natural
from visfuse_cli.files.ground_reference import parse_reference
from visfuse_cli.records import RunRequest

LONGEST = 200  # bytes of a folder's name
CONFIGS = {
    "calibrate-homography": ("visfuse_cli.commands.calibrate_homography", "CalibrateConfig"),
    "speed": ("visfuse_cli.commands.speed", "SpeedConfig"),
    "track-imm": ("visfuse_cli.commands.track_imm", "ImmConfig"),
    "track-stereo-pf": ("visfuse_cli.commands.track_stereo_pf", "StereoConfig"),
    "fuse-cameras": ("visfuse_cli.commands.fuse_cameras", "FuseConfig"),
}


@dataclass(frozen=True, slots=True)
class Item:
    """One run of one command: its request, and the traffic log that it adds to, if any."""

    name: str
    input: str  # as the manifest has it
    request: RunRequest
    log: Path | None
    retries: int


@dataclass(frozen=True, slots=True)
class _Place:
    """Where in the manifest one item stands."""

    path: Path
    number: int
    lines: Mapping[Key, int]

    @property
    def root(self) -> Path:
        """The folder that paths are relative to, wherever a worker may stand."""
        return Path(os.path.abspath(self.path)).parent

    def __str__(self) -> str:
        line = self.lines.get(("items", self.number))
        return f"{self.path}, line {line}" if line else f"{self.path}, item {self.number + 1}"

    def origin(self, *inside: Key) -> dict[Key, str]:
        """The line of each key of an entry, from the parts of the manifest that it was laid together from."""
        found: dict[Key, str] = {}
        for start in inside:
            for key, line in self.lines.items():
                if key[: len(start)] == start and len(key) > len(start):
                    found[key[len(start) :]] = f"{self.path}, line {line}"
        return found


def read_manifest(path: Path, out: Path, argv: tuple[str, ...] = ()) -> list[Item]:
    """Every item of a manifest, results to out/<name>; raises InputError naming line and key."""
    text = read_text(path, "the manifest", InputError)
    data, lines = parse_yaml(text, str(path), InputError)
    if not isinstance(data, dict):
        raise InputError(f"{path}: a manifest is a mapping with the key `items`")
    manifest = _checked(Manifest, data, str(path), {key: f"{path}, line {line}" for key, line in lines.items()})
    known = {name for entry in ENTRIES.values() for name in entry.model_fields}
    for key in manifest.defaults:
        if key not in known:
            raise InputError(f"{path}: defaults: unknown key '{key}'{nearest(key, known)}")
    items: dict[str, Item] = {}
    for number, raw in enumerate(manifest.items):
        place = _Place(path, number, lines)
        for item in _items(raw, manifest, place, out, argv):
            if item.name in items:
                raise InputError(f"{place}: another item has the name '{item.name}' too; give one of them a `name`")
            items[item.name] = item
    return list(items.values())


def _items(raw: dict[str, Any], manifest: Manifest, place: _Place, out: Path, argv: tuple[str, ...]) -> list[Item]:
    """The items of one entry: one for each recording that its input names."""
    rest = dict(raw)
    command = rest.pop("command", None)
    if not isinstance(command, str) or command not in ENTRIES:
        hint = nearest(command, ENTRIES) if isinstance(command, str) else ""
        raise InputError(f"{place}: command: {command!r}{hint}; one of {', '.join(ENTRIES)}")
    overrides = _overrides(rest.pop("overrides", {}), place)
    retries = rest.pop("retries", manifest.retries)
    if not isinstance(retries, int) or isinstance(retries, bool) or not 0 <= retries <= 10:
        raise InputError(f"{place}: retries: {retries!r}; a number, 0 to 10")
    model = ENTRIES[command]
    base = {key: value for key, value in manifest.defaults.items() if key in model.model_fields}
    source = _source(command, base | rest, place)
    inputs = _matches(place, (base | rest)[source])
    unused = set(overrides)
    items = []
    for found in inputs:
        fitting = [pattern for pattern in overrides if fnmatchcase(found, pattern)]
        unused -= set(fitting)
        merged: dict[str, Any] = {}
        for layer in (base, rest, *(overrides[pattern] for pattern in fitting)):
            merged = _laid_over(merged, layer)
        merged[source] = found
        keys: list[Key] = [("defaults",), ("items", place.number)]
        keys += [("items", place.number, "overrides", pattern) for pattern in fitting]
        entry = _checked(model, merged, str(place), place.origin(*keys))
        name = _name(entry.name, command, found, len(inputs) > 1)
        request, log = _request(command, entry, found, place, out / name, argv)
        items.append(Item(name, found, request, log, retries))
    if unused:
        raise InputError(f"{place}: overrides: '{sorted(unused)[0]}' fits no input of this item")
    return items


def _checked(model: type[Section], data: Mapping[str, Any], where: str, origin: Mapping[Key, str]) -> Any:
    try:
        return validate(model, data, where, origin)
    except UsageError as problem:  # of the manifest, which is an input
        raise InputError(str(problem)) from problem


def _overrides(value: Any, place: _Place) -> dict[str, dict[str, Any]]:
    if not isinstance(value, dict) or not all(isinstance(keys, dict) for keys in value.values()):
        raise InputError(f"{place}: overrides: a mapping of patterns, each to keys of this item")
    for pattern, keys in value.items():
        for key in ("command", "input", "overrides", "retries", *INPUTS["calibrate-homography"]):
            if key in keys:
                raise InputError(f"{place}: overrides: '{pattern}': {key} cannot differ within one item")
    return {str(pattern): keys for pattern, keys in value.items()}


def _laid_over(base: dict[str, Any], layer: dict[str, Any]) -> dict[str, Any]:
    """Later keys win; those of `set` are laid together."""
    merged = base | layer
    if isinstance(base.get("set"), dict) and isinstance(layer.get("set"), dict):
        merged["set"] = base["set"] | layer["set"]
    return merged


def _source(command: str, keys: Mapping[str, Any], place: _Place) -> str:
    """The key that names an item's input."""
    names = INPUTS.get(command, ("input",))
    given = [name for name in names if keys.get(name) is not None]
    if len(given) != 1:
        raise InputError(f"{place}: {command} needs {'exactly one of ' * (len(names) > 1)}{', '.join(names)}")
    if not isinstance(keys[given[0]], str) or not keys[given[0]] or "\0" in keys[given[0]]:
        raise InputError(f"{place}: {given[0]}: a path or a glob, relative to the manifest")
    return given[0]


def _matches(place: _Place, pattern: str) -> list[str]:
    """The paths, as the manifest would write them, that an input stands for, in natural order."""
    root = place.root
    if (root / pattern).exists():
        return [pattern]
    if not glob.has_magic(pattern):
        raise InputError(f"{place}: {pattern}: there is no such file or folder beside the manifest ({root})")
    found = glob.glob(pattern, root_dir=root, recursive=True)
    if not found:
        raise InputError(f"{place}: {pattern}: fits no file or folder beside the manifest ({root})")
    return sorted(found, key=natural)


def _name(wanted: str | None, command: str, found: str, several: bool) -> str:
    """The name of an item: what the manifest calls it, else its command and where its input lies."""
    parts = [part for part in Path(found).with_suffix("").parts if part not in ("..", "/")]
    words = [wanted or command, *parts] if several or wanted is None else [wanted]
    name = re.sub(r"[^\w.-]", "_", "-".join(words))
    return name if len(name.encode()) <= LONGEST else f"{name[:40]}-{hashlib.sha256(name.encode()).hexdigest()[:12]}"


def _request(
    command: str, entry: Entry, found: str, place: _Place, out: Path, argv: tuple[str, ...]
) -> tuple[RunRequest, Path | None]:
    root = place.root
    options: dict[str, Any] = {name: _path(place, root, name, entry, found) for name in PATHS if hasattr(entry, name)}
    common: dict[str, Any] = {"command": command, "config": _config(command, entry, place), "overwrite": True}
    common |= {"progress": False, "argv": argv, "input": root / found}
    if isinstance(entry, CalibrateEntry):
        try:
            options["reference"] = parse_reference(entry.crs, entry.origin)
        except UsageError as problem:
            raise InputError(f"{place}: {problem}") from problem
        width, _, height = (entry.size or "").lower().partition("x")
        options["size"] = (int(width), int(height)) if entry.size else None
        options |= {name: root / found for name in INPUTS[command] if getattr(entry, name) is not None}
        return RunRequest(out=out / "H.json", options=options, **common), None
    assert isinstance(entry, TrackingEntry)
    if hasattr(entry, "estimate_offsets"):
        options["estimate_offsets"] = entry.estimate_offsets
    log = getattr(entry, "log", None)
    own: dict[str, Any] = {
        "video": entry.video,
        "report": entry.report,
        "start": entry.start,
        "end": entry.end,
        "seed": entry.seed,
    }
    return RunRequest(out=out, options=options, **common, **own), root / log if log else None


def _path(place: _Place, root: Path, name: str, entry: Entry, found: str) -> Path | None:
    value: str | None = getattr(entry, name)
    if value is None:
        return None
    path = root / _filled(value, found)
    if "\0" in value or not path.exists():
        raise InputError(f"{place}: {name}: {path}: there is no such file; paths are relative to the manifest")
    return path


def _filled(text: str, found: str) -> str:
    """A path with the input's {stem} and {parent} put in."""
    return text.replace("{stem}", Path(found).stem).replace("{parent}", str(Path(found).parent))


def _config(command: str, entry: Entry, place: _Place) -> Any:
    module, model = CONFIGS[command]
    name = entry.config
    if name is not None and (Path(name).suffix or "/" in name or (place.root / name).is_file()):
        name = str(place.root / name)
    try:
        overrides = [f"{key}={json.dumps(value)}" for key, value in entry.set.items()]
        return load(getattr(import_module(module), model), name, overrides)
    except UsageError as problem:
        raise InputError(
            f"{place}: {str(problem).replace('--set ', 'set ').replace('--config ', 'config ')}"
        ) from problem
