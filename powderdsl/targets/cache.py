"""The cache of compiled code: a folder per library or GPU kernel, added atomically and checked before it is loaded.

<key>/program, about.json    a library, and facts about it
<key>.json                      the rest of a compiled program (`targets.cpp.code`)
<key>.lock                      held by the process that compiles
.powderdsl-…                    being added or removed
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

# Imported here, not later: a fork while another thread imports it would leave the child waiting forever.
from filelock import FileLock, Timeout

from powderdsl.system.reading import read_bytes, read_json
from powderdsl.system.writing import scratch_folder

LIBRARY, ABOUT = "program", "about.json"

LIMIT = 512 << 20
"""Bytes of libraries to keep; beyond that, those used longest ago are removed."""

UNUSED = 24 * 3600.0
"""Seconds after which what is not part of a library is removed; until then another process may be at work on it."""

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


def find(folder: Path, key: str) -> Path | None:
    """The library of a key, marked as used; None if it is missing or damaged."""
    about = _about(folder / key)
    if about is None:
        return None
    library = folder / key / LIBRARY
    try:
        data = read_bytes(library, LIMIT)
    except OSError:
        return None
    if hashlib.sha256(data).hexdigest() != about.sha256:
        return None
    with suppress(OSError):  # a cache that cannot be written is still a cache
        os.utime(folder / key / ABOUT)
    return library


def add(
    folder: Path, key: str, code: bytes, *, ruleset: str, backend: str, compiler: str, began: float
) -> Path:
    """Take code into the cache; the path of its library. The first of several processes wins.

    Args:
        began: when the compiler was started, in seconds since the epoch.

    Raises:
        OSError: it cannot be written.
    """
    seconds = round(time.time() - began, 2)
    digest = hashlib.sha256(code).hexdigest()
    about = About(ruleset, backend, compiler, began, seconds, len(code), digest)
    with scratch_folder(folder) as scratch:
        (scratch / LIBRARY).write_bytes(code)
        (scratch / ABOUT).write_text(signed(asdict(about)), encoding="utf-8")
        try:
            os.rename(scratch, folder / key)
        except OSError:  # there is one already
            found = find(folder, key)
            if found is not None:
                return found
            _discard(folder / key)
            os.rename(scratch, folder / key)
    tidy(folder, keep=key)
    return folder / key / LIBRARY


def entries(folder: Path) -> list[Entry]:
    """The libraries in the cache, most recently used first."""
    found = []
    for place in sorted(folder.iterdir()):
        about = _about(place)
        if about is not None:
            with suppress(OSError):
                found.append(Entry(place.name, about, (place / ABOUT).stat().st_mtime))
    return sorted(found, key=lambda entry: (-entry.used, entry.key))


def clear(folder: Path, older_than: float = 0.0) -> list[Entry]:
    """Remove libraries not used for `older_than` seconds, and return them. With 0, other files are removed too."""
    gone = [entry for entry in entries(folder) if entry.age >= older_than]
    for entry in gone:
        _discard(folder / entry.key)
    if older_than <= 0:
        for place in sorted(folder.iterdir()):
            # A lock may be held, and a build in progress belongs to another process.
            if place.suffix != ".lock" and not place.name.startswith("."):
                _discard(place)
    tidy(folder)
    return gone


def tidy(folder: Path, limit: int = LIMIT, keep: str = "") -> None:
    """Remove old leftovers and, beyond `limit` bytes, the libraries used longest ago, except `keep`."""
    total = 0
    libraries = entries(folder)
    for entry in sorted(libraries, key=lambda entry: entry.key != keep):
        total += entry.about.size
        if total > limit and entry.key != keep:
            _discard(folder / entry.key)
    for place in sorted({*folder.iterdir()} - {folder / entry.key for entry in libraries}):
        with suppress(OSError):
            if time.time() - place.stat().st_mtime > UNUSED and not _needed(folder, place):
                _discard(place)


def _needed(folder: Path, place: Path) -> bool:
    """Whether a `<key>.json` names a library that exists."""
    kept = read_signed(place)
    key = kept.get("library") if kept is not None else None
    return key is not None and (folder / key / ABOUT).is_file()


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


def signed(value: dict[str, Any]) -> str:
    """JSON with a hash that detects damage: native code reads and writes where its numbers point."""
    return json.dumps({**value, "digest": _digest(value)})


def read_signed(path: Path) -> dict[str, Any] | None:
    """The object in a file that `signed` made; None if the file is missing or damaged."""
    value = read_json(path)
    whole = isinstance(value, dict) and value.pop("digest", None) == _digest(value)
    return value if whole else None


def _digest(value: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def _about(place: Path) -> About | None:
    facts = read_signed(place / ABOUT)
    return None if facts is None else About(**facts)


def _discard(place: Path) -> None:
    """Remove a file or a folder. A folder is renamed first, so that no process finds half of it."""
    with suppress(OSError):
        if not place.is_dir():
            place.unlink(missing_ok=True)
            return
        with scratch_folder(place.parent) as gone:
            os.rename(place, gone / "it")
