"""Inputs as names on disk: what a folder holds, in which order, and the hash that tells it from any other."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from visfuse_cli.errors import InputError

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".ts", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".flv", ".3gp"}
    | {".ogv", ".asf", ".vob", ".mxf", ".h264", ".264", ".hevc", ".265", ".mjpeg", ".mjpg", ".y4m"}
)
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm", ".pnm"})


def is_folder(path: Path) -> bool:
    """Whether an input is a folder; raises InputError where it is missing or may not be looked at."""
    try:
        path.stat()
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror}") from problem
    return path.is_dir()


def is_clip_folder(path: str | Path) -> bool:
    """Whether a path is a folder of video files; raises InputError where it holds images as well, or is missing."""
    path = Path(path)
    if not is_folder(path):
        return False
    clips, images = list_files(path, VIDEO_SUFFIXES), list_files(path, IMAGE_SUFFIXES)
    if clips and images:
        raise InputError(
            f"{path}: holds clips ({clips[0].name}) and images ({images[0].name}); keep them in folders of their own"
        )
    return bool(clips)


def list_clips(path: str | Path) -> list[Path]:
    """The video files of a folder, in natural name order."""
    return list_files(Path(path), VIDEO_SUFFIXES)


def list_files(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    """The visible files of a folder that end so, in natural name order (frame2 before frame10); raises InputError."""
    try:
        found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.name[0] != "." and p.is_file()]
    except OSError as problem:
        raise InputError(f"{folder}: cannot be read: {problem.strerror}") from problem
    return sorted(found, key=lambda path: natural(path.name))


def natural(name: str) -> tuple[list[tuple[int, str]], str]:
    """The key that sorts names as people do: frame2 before frame10."""
    parts = re.split(r"([0-9]+)", name.lower())
    return [(int(part), "") if part[:1].isdecimal() else (-1, part) for part in parts], name


def paths_of(described: Iterable[dict[str, Any]]) -> list[str]:
    """The paths of what `describe` has described."""
    return [entry["path"] for entry in described]


def describe(path: str | Path) -> dict[str, Any]:
    """An input's path, size (bytes) and SHA-256 for run.json; a folder's is over its files' names and contents."""
    path = Path(path)
    digest, size = hashlib.sha256(), 0
    try:
        names = sorted(p for p in path.iterdir() if p.is_file() and p.name[0] != ".") if path.is_dir() else [path]
        for name in names:
            if name.exists() and not name.is_file():  # a device or a pipe has no end, or can be read once only
                raise InputError(f"{name}: is not a file")
            with open(name, "rb") as file:
                own = hashlib.file_digest(file, "sha256")
                size += file.tell()
            digest.update(f"{own.hexdigest()}  {name.name}\n".encode("utf-8", "surrogateescape"))
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror}") from problem
    return {"path": str(path), "size": size, "sha256": digest.hexdigest() if path.is_dir() else own.hexdigest()}
