"""Scene folders: which file or image folder is which view, and where the scene's own files lie."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from visfuse_cli.errors import InputError
from visfuse_cli.files.folders import VIDEO_SUFFIXES, is_folder


def check_scene(scene: Path) -> None:
    """Raises InputError where a scene is no folder that can be looked into."""
    if not is_folder(scene):
        raise InputError(f"{scene}: not a scene folder; give the folder that holds the views and their calibration")


def find_view(scene: Path, name: str) -> Path | None:
    """The video `<name>.*` or the image folder `<name>/` of a view, None where there is neither.

    Raises InputError where there is more than one.
    """
    try:
        found = [
            entry
            for entry in sorted(scene.iterdir())
            if (entry.name == name and entry.is_dir())
            or (entry.stem == name and entry.suffix.lower() in VIDEO_SUFFIXES and entry.is_file())
        ]
    except OSError as problem:
        raise InputError(f"{scene}: cannot be read: {problem.strerror}") from problem
    if len(found) > 1:
        raise InputError(f"{scene}: view '{name}' is there twice, as {found[0].name} and {found[1].name}; keep one")
    return found[0] if found else None


def view(scene: Path, name: str) -> Path:
    """The video `<name>.*` or image folder `<name>/` of a view; raises InputError where it is missing or doubled."""
    found = find_view(scene, name)
    if found is None:
        raise InputError(f"{scene}: has no view '{name}': neither a video {name}.* nor an image folder {name}/")
    return found


def find_file(scene: Path, names: Sequence[str]) -> Path | None:
    """The first of `names` that the scene holds, or None."""
    return next((scene / name for name in names if (scene / name).exists()), None)


def file(scene: Path, names: Sequence[str], what: str) -> Path:
    """The first of `names` that the scene holds; raises InputError saying that `what` is missing."""
    found = find_file(scene, names)
    if found is None:
        raise InputError(f"{scene}: has no {what}; expected {' or '.join(names)}")
    return found
