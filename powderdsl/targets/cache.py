"""The cache of compiled code: a folder per library or GPU kernel, added atomically and checked before it is loaded.

<key>/program, about.json    a library, and facts about it
<key>.json                      the rest of a compiled program (`targets.cpp.code`)
<key>.lock                      held by the process that compiles
.powderdsl-…                    being added or removed: see `system.scratch`
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

# Imported here, not later: a fork while another thread imports it would leave the child waiting forever.
from filelock import FileLock, Timeout

from powderdsl.system.reading import read_bytes, read_json
from powderdsl.system.scratch import is_scratch, scratch_file, scratch_folder, sweep

LIBRARY, ABOUT = "program", "about.json"

KEY = re.compile(r"[0-9A-Za-z_-]{1,64}")
LATEST = 1e11
"""Seconds since the epoch; a later time is an error."""

LIMIT = 512 << 20
"""Bytes of libraries to keep; beyond that, those used longest ago are removed."""

UNUSED = 24 * 3600.0
"""Seconds after which a `<key>.json` without a library is removed; until then another process may add the library."""

PATIENCE = 120.0
"""Seconds to wait for another process that compiles the same source; after that both compile."""


@dataclass(frozen=True)
class About:
    """Facts recorded when a library is made. `created` is in seconds since the epoch."""

    ruleset: str
    backend: str
    compiler: str
    created: float
    seconds: float
    size: int
    sha256: str


@dataclass(frozen=True)
class Entry:
    """A library in the cache. `used` is the time of its last use, in seconds since the epoch."""

    key: str
    about: About
    used: float

    @property
    def age(self) -> float:
        """Seconds since it was used."""
        return max(0.0, time.time() - self.used)


def _is_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= 1000


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= LATEST


_HOLDS: dict[str, Callable[[object], bool]] = {
    "ruleset": _is_text,
    "backend": _is_text,
    "compiler": _is_text,
    "created": _is_number,
    "seconds": _is_number,
    "size": lambda value: type(value) is int and 0 <= value <= LIMIT,
    "sha256": lambda value: isinstance(value, str) and bool(re.fullmatch(r"[0-9a-f]{64}", value)),
}
"""The valid types of the fields of `About`."""


def find(folder: Path, key: str) -> Path | None:
    """The library of a key, marked as used; None if it is missing or damaged."""
    about = _about(folder / key) if KEY.fullmatch(key) else None
    if about is None:
        return None
    library = folder / key / LIBRARY
    try:
        data = read_bytes(library, LIMIT)
    except OSError:
        return None
    if len(data) != about.size or hashlib.sha256(data).hexdigest() != about.sha256:
        return None
    with suppress(OSError):  # a cache that cannot be written is still a cache
        os.utime(folder / key / ABOUT)
    return library


def add(folder: Path, key: str, built: Path, about: dict[str, Any]) -> Path:
    """Take a folder with a LIBRARY into the cache; the library's path. The first of several processes wins.

    Args:
        about: the fields of `About` except size and hash.

    Raises:
        OSError: it cannot be written.
    """
    data = (built / LIBRARY).read_bytes()
    written = About(**about, size=len(data), sha256=hashlib.sha256(data).hexdigest())
    (built / ABOUT).write_text(json.dumps(asdict(written)), encoding="utf-8")
    for _ in range(3):
        try:
            os.rename(built, folder / key)
            break
        except OSError:
            found = find(folder, key)
            if found is not None:
                return found
            _discard(folder / key)
    else:
        raise OSError(f"cannot write {folder / key}")
    tidy(folder, keep=key)
    return folder / key / LIBRARY


def entries(folder: Path) -> list[Entry]:
    """The libraries in the cache, most recently used first."""
    found = []
    for place in sorted(folder.iterdir()):
        about = _about(place) if KEY.fullmatch(place.name) else None
        if about is not None:
            with suppress(OSError):
                used = min(max((place / ABOUT).stat().st_mtime, 0.0), LATEST)
                found.append(Entry(place.name, about, used))
    return sorted(found, key=lambda entry: (-entry.used, entry.key))


def clear(folder: Path, older_than: float = 0.0) -> list[Entry]:
    """Remove libraries not used for `older_than` seconds, and return them. With 0, other files are removed too."""
    gone = [entry for entry in entries(folder) if entry.age >= older_than]
    for entry in gone:
        _discard(folder / entry.key)
    if older_than <= 0:
        for place in sorted(folder.iterdir()):
            # A lock may be held, and a build in progress belongs to another process.
            if place.suffix != ".lock" and not is_scratch(place.name):
                _discard(place)
    tidy(folder)
    return gone


def tidy(folder: Path, limit: int = LIMIT, keep: str = "") -> None:
    """Remove leftovers of killed processes and, beyond `limit` bytes, the libraries used longest ago, except `keep`."""
    total = 0
    for entry in sorted(entries(folder), key=lambda entry: entry.key != keep):
        total += entry.about.size
        if total > limit and entry.key != keep:
            _discard(folder / entry.key)
    sweep(folder)
    for place in sorted(folder.iterdir()):
        if place.suffix == ".lock":
            _remove_free_lock(place)
        with suppress(OSError):
            old = place.suffix == ".json" and time.time() - place.stat().st_mtime > UNUSED
            if old and not _needed(folder, place):
                _discard(place)


def _remove_free_lock(path: Path) -> None:
    """Remove a lock file that no process holds. A process that waits for it then compiles too, which only costs time."""
    lock = FileLock(path)
    with suppress(OSError, NotImplementedError, Timeout):
        lock.acquire(timeout=0)
        path.unlink(missing_ok=True)
        lock.release()


def _needed(folder: Path, place: Path) -> bool:
    """Whether a `<key>.json` names a library that exists."""
    if place.suffix != ".json":
        return False
    kept = read_object(place)
    key = kept.get("library") if kept is not None else None
    return isinstance(key, str) and bool(KEY.fullmatch(key)) and (folder / key / ABOUT).is_file()


@contextmanager
def turn(folder: Path, key: str) -> Iterator[None]:
    """Let one process at a time into the block, up to a time limit: all of them would compile the same source.

    The operating system releases the lock of a process that dies. Without file locks, nobody waits.
    """
    lock = FileLock(folder / f"{key}.lock")
    try:
        lock.acquire(timeout=PATIENCE)
    except (OSError, NotImplementedError, Timeout):
        yield
        return
    try:
        yield
    finally:
        lock.release()


def read_object(path: Path) -> dict[str, Any] | None:
    """A JSON object; None if the file is missing or damaged."""
    value = read_json(path)
    return value if isinstance(value, dict) else None


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write a file atomically. Raises OSError."""
    with scratch_file(path) as temporary:
        temporary.write_text(json.dumps(value), encoding="utf-8")
        os.replace(temporary, path)


def _about(place: Path) -> About | None:
    kept = read_object(place / ABOUT)
    if kept is None or kept.keys() != _HOLDS.keys():
        return None
    return About(**kept) if all(holds(kept[name]) for name, holds in _HOLDS.items()) else None


def _discard(place: Path) -> None:
    """Remove a file or a folder. A folder is renamed first, so that no process finds half of it."""
    with suppress(OSError):
        if not place.is_dir():
            place.unlink(missing_ok=True)
            return
        with scratch_folder(place.parent) as gone:
            os.rename(place, gone / "it")
