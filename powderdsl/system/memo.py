"""Results of earlier work, for programs that compile again and again: an editor, a page, a watcher of files."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

T = TypeVar("T")


class Memo:
    """Results by what they depend on: for each thing, such as a file, those of its last few versions.

    Functions that take one return what they would return without. It is for one thread at a time.

    Args:
        versions: of each thing.
        things: beyond that, those that were not used for longest are forgotten.
    """

    def __init__(self, versions: int = 4, things: int = 4000):
        if versions < 1 or things < 1:
            raise ValueError(f"a memo keeps at least one version of one thing, not {versions} of {things}")
        self.versions, self.things = versions, things
        self._kept: dict[Hashable, dict[Hashable, Any]] = {}

    def of(self, thing: Hashable, version: Hashable, make: Callable[[], T]) -> T:
        """The result for a version of a thing, which is made if it is not known. An exception is not kept."""
        found = self._kept.pop(thing, {})
        self._kept[thing] = found
        result: T = found.pop(version) if version in found else make()
        found[version] = result
        for kept, limit in ((found, self.versions), (self._kept, self.things)):
            if len(kept) > limit:
                del kept[next(iter(kept))]
        return result
