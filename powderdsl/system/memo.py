"""Faster repeated compilation: results of earlier work, and a pause of garbage collection."""

from __future__ import annotations

import gc
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

T = TypeVar("T")

_MISSING: Any = object()


class Memo:
    """A cache of results by their inputs: for each thing, such as a file, the results of its last few versions.

    For programs that compile again and again: an editor, a page, a watcher of files. A memo never changes a function's
    result. Threads may share one: two of them may compute the same result at once.

    Args:
        versions: the most versions of each thing.
        things: the most things; the least recently used are dropped.
    """

    def __init__(self, versions: int = 4, things: int = 4000):
        self.versions, self.things = versions, things
        self._results: dict[Hashable, dict[Hashable, Any]] = {}

    def of(self, thing: Hashable, version: Hashable, make: Callable[[], T]) -> T:
        """The result for a version of a thing, computed by `make` if it is not known. Exceptions are not kept."""
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
    """Pause garbage collection inside the block; also a decorator.

    Compilation makes many small objects that stay alive. Searching them, and all objects of torch, for cycles takes a
    quarter of its time and frees nothing.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
