"""Compiled code on disk, libraries and kernels for GPUs: a folder for each, which appears whole or not at all, and is checked before it is loaded.

<key>/program, about.json    a library, and what is known of it
<key>.json                      what a program needs besides its library (`targets.cpp.code`)
<key>.lock                      held by who is compiling
.powderdsl-…                    on the way in, on the way out: see `scratch`
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

# Not later: a fork in the middle of an import, which a thread makes, leaves the child waiting for it for ever.
from filelock import FileLock, Timeout

from powderdsl.system.reading import read_bytes, read_json
from powderdsl.system.scratch import is_scratch, scratch_file, scratch_folder, sweep

LIBRARY, ABOUT = "program", "about.json"

KEY = re.compile(r"[0-9A-Za-z_-]{1,64}")
LATEST = 1e11
"""Seconds since the epoch; a later time is a mistake."""

LIMIT = 512 << 20
"""Bytes of libraries that are kept; of more, those used longest ago go."""

UNUSED = 24 * 3600.0
"""Seconds after which a `<key>.json` without its library is removed: another process may be about to add that."""

PATIENCE = 120.0
"""Seconds to wait for another process that compiles the same; after that both do."""


@dataclass(frozen=True)
class About:
    """What is written down about a library when it is made: `created` in seconds since the epoch."""

    ruleset: str
    backend: str
    compiler: str
    created: float
    seconds: float
    size: int
    sha256: str


@dataclass(frozen=True)
class Entry:
    """A library in the cache; `used` is when last, in seconds since the epoch."""

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
"""What the fields of `About` may be."""


def find(folder: Path, key: str) -> Path | None:
    """The library of a key if it is there and whole; one that is damaged counts as absent. Marks it as used."""
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
    """Take a folder with a LIBRARY into the cache; the library's path. Whoever is first wins.

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
    """What lies in the cache, the last used first."""
    found = []
    for place in sorted(folder.iterdir()):
        about = _about(place) if KEY.fullmatch(place.name) else None
        if about is not None:
            with suppress(OSError):
                used = min(max((place / ABOUT).stat().st_mtime, 0.0), LATEST)
                found.append(Entry(place.name, about, used))
    return sorted(found, key=lambda entry: (-entry.used, entry.key))


def clear(folder: Path, older_than: float = 0.0) -> list[Entry]:
    """Remove libraries not used for `older_than` seconds; returns which. With 0, whatever else lies there goes too."""
    gone = [entry for entry in entries(folder) if entry.age >= older_than]
    for entry in gone:
        _discard(folder / entry.key)
    if older_than <= 0:
        for place in sorted(folder.iterdir()):
            # A lock may be held, and what is being built belongs to another process.
            if place.suffix != ".lock" and not is_scratch(place.name):
                _discard(place)
    tidy(folder)
    return gone


def tidy(folder: Path, limit: int = LIMIT, keep: str = "") -> None:
    """Remove what killed processes have left, and the libraries used longest ago beyond `limit` bytes, except `keep`."""
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
    """Remove a lock file that nobody holds. Whoever waits for it then compiles too, which costs time and nothing else."""
    lock = FileLock(path)
    with suppress(OSError, NotImplementedError, Timeout):
        lock.acquire(timeout=0)
        path.unlink(missing_ok=True)
        lock.release()


def _needed(folder: Path, place: Path) -> bool:
    """Whether a `<key>.json` names a library that is there."""
    if place.suffix != ".json":
        return False
    kept = read_object(place)
    key = kept.get("library") if kept is not None else None
    return isinstance(key, str) and bool(KEY.fullmatch(key)) and (folder / key / ABOUT).is_file()


@contextmanager
def turn(folder: Path, key: str) -> Iterator[None]:
    """One process at a time inside the block, for a while: they would all compile the same.

    The kernel lets go of the lock of a process that dies. Where there are no locks, nobody waits.
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
    """A JSON object, None if there is none or it is damaged."""
    value = read_json(path)
    return value if isinstance(value, dict) else None


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write a file whole or not at all. Raises OSError."""
    with scratch_file(path) as temporary:
        temporary.write_text(json.dumps(value), encoding="utf-8")
        os.replace(temporary, path)


def _about(place: Path) -> About | None:
    kept = read_object(place / ABOUT)
    if kept is None or kept.keys() != _HOLDS.keys():
        return None
    return About(**kept) if all(holds(kept[name]) for name, holds in _HOLDS.items()) else None


def _discard(place: Path) -> None:
    """Remove a file or a folder; a folder gets another name first, so that nobody finds half of it."""
    with suppress(OSError):
        if not place.is_dir():
            place.unlink(missing_ok=True)
            return
        with scratch_folder(place.parent) as gone:
            os.rename(place, gone / "it")
