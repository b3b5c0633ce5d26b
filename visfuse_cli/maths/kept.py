"""What is kept of every frame until a track has ended: packed rows, and of a bank nothing that can be had again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import imm
from visfuse_cli.maths.imm import Bank, Step
from visfuse_cli.records import Array, Gaussian


class Rows:
    """A table that grows row by row, each of a numpy record type `kind`, packed."""

    def __init__(self, kind: list[tuple[Any, ...]]) -> None:
        self._kind, self._bytes = np.dtype(kind), bytearray()

    def append(self, *values: Any) -> None:
        """Add a row, field by field."""
        self._bytes += np.array(values, self._kind).tobytes()

    def __len__(self) -> int:
        return len(self._bytes) // self._kind.itemsize

    def __getitem__(self, k: int | slice) -> Any:
        """A copy of row k, or of several: fields by name."""
        return np.frombuffer(self._bytes, self._kind)[k].copy()


class Banks:
    """The banks of a track, instant by instant; of each model only the components that are its `own` (r, N).

    What a model lacks is in all of them as in the first one (see `imm.embedded`).
    """

    def __init__(self, first: Bank, own: NDArray[np.bool_]) -> None:
        self._first, self._mean = first.beliefs, np.nonzero(own)
        self._cov = np.nonzero(np.triu(own[:, :, None] & own[:, None, :]))
        means, covs = len(self._mean[0]), len(self._cov[0])
        self._rows = Rows([("mean", float, means), ("cov", float, covs), ("log_mu", float, len(own))])
        self.append(first)

    def append(self, bank: Bank) -> None:
        """Add the bank of the next instant; of its covariances the upper triangles."""
        self._rows.append(bank.beliefs.mean[self._mean], bank.beliefs.cov[self._cov], bank.log_mu)

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, k: int) -> Bank:
        row = self._rows[k]
        mean, cov = self._first.mean.copy(), self._first.cov.copy()
        model, i, j = self._cov
        mean[self._mean] = row["mean"]
        cov[model, i, j] = cov[model, j, i] = row["cov"]
        return Bank(Gaussian(mean, cov), row["log_mu"])

    def backward(self, instants: int) -> Iterator[Bank]:
        """The first banks, the last of them first."""
        return (self[k] for k in range(instants - 1, -1, -1))


def smoothed(
    banks: Banks,
    t: Array,
    predict: Callable[[Bank, float], Step],
    changes: Callable[[float], Array],
    angles: tuple[int, ...] = (),
) -> Iterator[Bank]:
    """The bank of every instant t (T,) s given the first T that were kept, the last first: `imm.backward`.

    The steps between them are made again by `predict`, from a bank over s, and `changes`, log p_ij (r, r) over s.
    """

    def way(k: int, before: Bank) -> tuple[Step, Array]:
        dt = float(t[k] - t[k - 1])
        return predict(before, dt), changes(dt)

    return imm.backward(len(t), banks.__getitem__, way, angles)
