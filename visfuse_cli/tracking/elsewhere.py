"""Work that is done while something else is thought about."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

T = TypeVar("T")


class HandOver(Protocol):
    """Takes pieces of work that are done one after another, in order; what comes back waits for the result."""

    def __call__(self, work: Callable[[], T]) -> Callable[[], T]: ...


def at_once(work: Callable[[], T]) -> Callable[[], T]:
    """Work that is done here and now."""
    result = work()
    return lambda: result
