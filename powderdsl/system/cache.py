"""Caches of results: files, added atomically and checked before they are loaded, and memos in memory.

<ke>/<key>-<digest>-<name>    a library, a GPU kernel, or the result of a stage; modified when it was last used
<key>.lock                    held by the process that compiles
.powderdsl-…                  being added, or a compiler's
"""

from __future__ import annotations

import gc
import hashlib
import os
import pickle
import re
import shutil
import sys
import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from powderdsl.system.reading import read_bytes
from powderdsl.system.writing import cache_folder, scratch_folder

T = TypeVar("T")

NAME = re.compile(r"([0-9a-f]+)-([0-9a-f]{64})-(.+)")
HOME = re.compile(r"[0-9a-f]{1,2}")
"""The name of a folder: the first digits of the keys in it. Searching one large folder for a key would be slow."""

LIMIT, MOST = 512 << 20, 4000
"""Maximum number of bytes, and of files. The least recently used are removed first."""

STORED = sys.platform != "emscripten"
"""Whether results of stages are stored: files do not outlive a page, and editors make new ones with each key."""
QUICK = 0.002
"""Results that took fewer seconds are not stored."""

UNUSED = 24 * 3600.0
"""Seconds after which other files are removed; until then another process may be at work on them."""


class CachedFile(NamedTuple):
    """A file in the cache. `used` is the time of its last use, in seconds since the epoch."""

    path: Path
    name: str
    size: int
    used: float


def compiled_folder() -> Path:
    """The user's folder of compiled code. Raises OSError if it is not private to the user."""
    return cache_folder("compiled")


@cache
def code_hash() -> str:
    """A hash of the code of this package."""
    here = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(path for path in here.rglob("*") if path.suffix in (".py", ".lark", ".hpp")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def persistent(name: str, inputs: str | Callable[[], str], make: Callable[[], T]) -> T:
    """The result of `make`, from the cache if an earlier process made it with the same code.

    Exceptions and quick results are not stored. A cache that cannot be read or written only costs time.

    Args:
        name: what the result is; each stage has its own names.
        inputs: a text that determines the result of the stage, or a function that returns it, if that takes long.
        make: returns the result, which can be pickled.
    """
    if not STORED:
        return make()
    known = inputs if isinstance(inputs, str) else inputs()
    text = f"{code_hash()}\0{sys.version}\0{name}\0{known}"
    key = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:32]
    with suppress(OSError):
        path = find(compiled_folder(), key)
        if path is not None:
            # Anyone who can write to the folder could also replace libraries, so pickles are as safe as those.
            return pickle.loads(read_bytes(path, LIMIT))
    start = time.process_time()
    result = make()
    if time.process_time() - start > QUICK:
        with suppress(OSError, RecursionError):
            add(compiled_folder(), key, pickle.dumps(result), name)
    return result


def find(folder: Path, key: str) -> Path | None:
    """The file of a key, marked as used; None if it is missing or damaged."""
    for path in sorted(folder.glob(f"{key[:2]}/{key}-*")):
        match = NAME.fullmatch(path.name)
        with suppress(OSError):
            if match and hashlib.sha256(read_bytes(path, LIMIT)).hexdigest() == match[2]:
                with suppress(OSError):  # a cache that cannot be written is still a cache
                    os.utime(path)
                return path
    return None


def add(folder: Path, key: str, code: bytes, name: str) -> Path:
    """Write code into the cache; the path of its file.

    The key is hexadecimal digits, the name for `powderdsl cache list`. Raises OSError if it cannot be written.
    """
    (home := folder / key[:2]).mkdir(mode=0o700, exist_ok=True)
    name = re.sub(r"[^\w.+]", "_", name)[:80] or "?"
    path = home / f"{key}-{hashlib.sha256(code).hexdigest()}-{name}"
    for other in sorted(home.glob(f"{key}-*")):
        if other != path:  # another process may be loading this one
            other.unlink(missing_ok=True)
    with scratch_folder(folder) as scratch:
        (scratch / "code").write_bytes(code)
        os.replace(scratch / "code", path)
    if key.startswith("0"):  # reading all folders takes as long as some stages
        tidy(folder, keep=path)
    return path


def entries(folder: Path) -> list[CachedFile]:
    """The files in the cache, most recently used first."""
    stored = []
    homes = [home for home in folder.iterdir() if HOME.fullmatch(home.name)]  # others may vanish meanwhile
    for path in sorted(path for home in homes for path in home.glob("*")):
        with suppress(OSError):
            if match := NAME.fullmatch(path.name):
                status = path.stat()
                stored.append(CachedFile(path, match[3], status.st_size, status.st_mtime))
    return sorted(stored, key=lambda entry: -entry.used)


def clear(folder: Path) -> list[CachedFile]:
    """Remove and return all files of the cache, except builds in progress in other processes."""
    removed = entries(folder)
    tidy(folder, limit=-1)
    return removed


def fused_code(*, remove: bool = False) -> list[CachedFile]:
    """The files that the backend `torch-fused` keeps in its own folder, as one entry; none if there is nothing."""
    folder = cache_folder("inductor")
    sizes = [path.lstat().st_size for path in folder.rglob("*") if path.is_file()]
    stored = [CachedFile(folder, "torch-fused", sum(sizes), folder.stat().st_mtime)] if sizes else []
    if remove:
        _discard(folder)
    return stored


def tidy(folder: Path, limit: int = LIMIT, keep: Path | None = None) -> None:
    """Remove old leftovers and, beyond `limit` bytes or `MOST` files, the files used longest ago, except `keep`."""
    total = 0
    for count, entry in enumerate(sorted(entries(folder), key=lambda entry: entry.path != keep)):
        total += entry.size
        if (total > limit or count >= MOST) and entry.path != keep:
            _discard(entry.path)
    for path in sorted(folder.iterdir()):
        with suppress(OSError):
            if not HOME.fullmatch(path.name) and time.time() - path.lstat().st_mtime > UNUSED:
                _discard(path)


def _discard(path: Path) -> None:
    """Remove a file or a folder, if possible."""
    with suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


# Results in memory, and a pause of garbage collection

_MISSING: Any = object()


class Memo:
    """A cache of results by input: for each thing, such as a file, the results of its last few versions.

    For programs that compile repeatedly, such as an editor, a page, or a file watcher. A memo never changes a
    function's result. Threads may share one: two of them may compute the same result at once.

    Args:
        versions: maximum number of versions of each thing.
        things: maximum number of things; the least recently used are dropped.
    """

    def __init__(self, versions: int = 4, things: int = 4000):
        self.versions, self.things = versions, things
        self._results: dict[Hashable, dict[Hashable, Any]] = {}

    def of(self, thing: Hashable, version: Hashable, make: Callable[[], T]) -> T:
        """The result for a version of a thing, computed by `make` if it is not cached. Exceptions are not cached."""
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
