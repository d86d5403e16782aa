"""Results of earlier work, for programs that compile again and again: an editor, a page, a watcher of files."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

T = TypeVar("T")

LIMIT = 400
"""Results that are kept: the files and passes of several versions of a large ruleset, some ten megabytes."""


class Memo:
    """Results by what they depend on. Beyond the limit, those that were not used for longest are forgotten.

    Functions that take one return what they would return without. It is for one thread at a time.
    """

    def __init__(self, limit: int = LIMIT):
        if limit < 1:
            raise ValueError(f"a memo keeps at least one result, not {limit}")
        self.limit = limit
        self._kept: dict[Hashable, Any] = {}

    def __len__(self) -> int:
        return len(self._kept)

    def of(self, key: Hashable, make: Callable[[], T]) -> T:
        """The result for a key, which is made if it is not known. An exception is not kept."""
        found: T = self._kept.pop(key) if key in self._kept else make()
        self._kept[key] = found
        if len(self._kept) > self.limit:
            del self._kept[next(iter(self._kept))]
        return found
