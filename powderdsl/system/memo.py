"""Compiling soon, and soon again: results of earlier work, and no garbage collection meanwhile."""

from __future__ import annotations

import gc
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

T = TypeVar("T")

_MISSING: Any = object()


class Memo:
    """Results by what they depend on: for each thing, such as a file, those of its last few versions.

    For programs that compile again and again: an editor, a page, a watcher of files. Functions that take one return what
    they would return without. Threads may share one: two of them may make the same thing at once.

    Args:
        versions: of each thing.
        things: beyond that, those that were not used for longest are forgotten.
    """

    def __init__(self, versions: int = 4, things: int = 4000):
        self.versions, self.things = versions, things
        self._results: dict[Hashable, dict[Hashable, Any]] = {}

    def of(self, thing: Hashable, version: Hashable, make: Callable[[], T]) -> T:
        """The result for a version of a thing, which is made if it is not known. An exception is not kept."""
        # Each line below is one operation on a dict, which threads see done or not done. There is no lock, which a
        # fork could copy while another thread holds it.
        results = self._results.setdefault(thing, {})
        result: T = results.pop(version, _MISSING)
        if result is _MISSING:
            result = make()
        results[version] = result
        self._results.pop(thing, None)
        self._results[thing] = results
        for table, limit in ((results, self.versions), (self._results, self.things)):
            if len(table) > limit:
                with suppress(StopIteration, RuntimeError):  # another thread has changed it meanwhile
                    table.pop(next(iter(table)), None)
        return result


@contextmanager
def collection_paused() -> Iterator[None]:
    """Do not look for cycles meanwhile; also a decorator.

    Compilation makes many small objects that all live on. Looking through them, and through everything that torch
    has loaded, again and again takes a quarter of its time and finds nothing.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
