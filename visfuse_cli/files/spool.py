"""Tracks and tables on their way out: written as they are found, sorted at the end, whole or not at all."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from visfuse_cli.files.atomic import failing_as_output, replacing
from visfuse_cli.files.runfolder import TRACKS_PARTIAL

SCHEMA = "visfuse.tracks/1"
DIGITS = 12  # significant; a UTM northing keeps its tenth of a millimetre
COVARIANCE_DIGITS = 9
PIECE = 1 << 20  # bytes that are copied at once


class TrackSpool:
    """`with TrackSpool(folder, command, seed, frame_of_reference) as tracks:` writes tracks.json track by track.

    Finished tracks wait in a hidden file beside it, so memory holds one offset a track. A clean end of the block
    writes tracks.json; an exception leaves none. Raises OutputError where the folder cannot be written.
    """

    def __init__(self, folder: Path, command: str, seed: int, frame_of_reference: str) -> None:
        self.path = folder / "tracks.json"
        self.head = {"schema": SCHEMA, "command": command, "seed": seed, "frame_of_reference": frame_of_reference}
        self._partial = folder / TRACKS_PARTIAL
        with failing_as_output(self._partial):
            self._file = open(self._partial, "w+b")  # noqa: SIM115  closed by __exit__
        self._index: dict[int, list[tuple[int, int]]] = {}  # id -> offset, length of its pieces: summary, states
        self._end = 0

    def __enter__(self) -> TrackSpool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.finish()
        finally:
            with suppress(OSError):  # nothing is left to write, unless a write was refused and has been reported
                self._file.close()
            self._partial.unlink(missing_ok=True)

    def __len__(self) -> int:
        return len(self._index)

    def add(self, track: Mapping[str, Any]) -> None:
        """Keep one finished track; its `states` may be any iterable, and are taken one by one.

        Raises ValueError on a number that is not finite or an id seen before.
        """
        identity = int(track["id"])
        if identity in self._index:
            raise ValueError(f"two tracks have the id {identity}")
        self._index[identity] = [self._append([_head(track)]), self._append(_states(track))]

    def amend(self, identity: int, **changes: Any) -> None:
        """Change entries of the summary of a track that was added."""
        head, states = self._index[identity]
        known = json.loads(self._stored(head) + b"}")
        known["summary"] |= changes
        self._index[identity] = [self._append([_head(known)]), states]

    def _append(self, text: Iterable[bytes]) -> tuple[int, int]:
        """Write at the end of the hidden file; offset and length of what was written."""
        begin = self._end
        with failing_as_output(self._partial):
            self._file.seek(begin)
            self._file.writelines(text)
            self._file.flush()
        self._end = self._file.tell()
        return begin, self._end - begin

    def _stored(self, where: tuple[int, int]) -> bytes:
        self._file.seek(where[0])
        return self._file.read(where[1])

    def read(self, identity: int) -> dict[str, Any]:
        """One track as it was added or amended, but for its covariances."""
        track: dict[str, Any] = json.loads(b"".join(self._copied(identity)), object_hook=without_covariance)
        return track

    def _copied(self, identity: int) -> Iterator[bytes]:
        """The text of one track, piece by piece."""
        for offset, left in self._index[identity]:
            self._file.seek(offset)
            while left:
                piece = self._file.read(min(left, PIECE))
                left -= len(piece)
                yield piece

    def finish(self) -> None:
        """Write tracks.json from what was added so far, sorted by id."""
        head = json.dumps(self.head, allow_nan=False)[:-1].encode()
        with replacing(self.path) as file:
            file.write(head + b', "tracks": [')
            for number, identity in enumerate(sorted(self._index)):
                file.write(b",\n" if number else b"\n")
                file.writelines(self._copied(identity))
            file.write(b"\n]}\n")


def write_table(path: str | Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write speeds.csv or rejected.csv: rows in any order, sorted by clip, t_start and track_id; None is empty.

    Raises ValueError where a row has a column that is not in `columns`, OutputError where it cannot be written.
    """
    with replacing(path, "w") as file:
        table = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        table.writeheader()
        table.writerows(sorted(rows, key=_table_order))


def _table_order(row: Mapping[str, Any]) -> tuple[str, float, float]:
    start, identity = row.get("t_start"), row.get("track_id")
    unknown = (None, "")
    return (
        str(row.get("clip") or ""),
        float("-inf") if start in unknown else float(start),
        float("inf") if identity in unknown else float(identity),
    )


def without_covariance(entry: dict[str, Any]) -> dict[str, Any]:
    """The hook for JSON objects that leaves out the largest part of a state, which nobody draws."""
    entry.pop("covariance", None)
    return entry


def _head(track: Mapping[str, Any]) -> bytes:
    """The beginning of the JSON text of one track, without its states, which come last, and without the end."""
    return _text({key: value for key, value in track.items() if key != "states"})[:-1]


def _states(track: Mapping[str, Any]) -> Iterator[bytes]:
    """The rest of it, state by state."""
    yield b',"states":['
    for number, state in enumerate(track.get("states", ())):
        yield (b"," if number else b"") + _text(state)
    yield b"]}"


def _text(value: Any) -> bytes:
    return json.dumps(_rounded(value, DIGITS), allow_nan=False, separators=(",", ":")).encode()


def _rounded(value: Any, digits: int) -> Any:
    """The same value in plain JSON types, floats cut to significant digits so that the last bit shows in no byte."""
    if isinstance(value, float):  # np.float64 too
        return float(f"{value:.{digits}g}") + 0.0  # -0.0 becomes 0.0
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, Mapping):
        return {k: _rounded(item, COVARIANCE_DIGITS if k == "covariance" else digits) for k, item in value.items()}
    if hasattr(value, "tolist"):
        return _rounded(value.tolist(), digits)
    return [_rounded(item, digits) for item in value]
