"""Temporary files and folders that no process leaves behind, not even one that is killed.

Their names are marked, and each is locked while the process that made it lives. So whoever writes to the same folder
next can tell which of them nobody owns any more, and removes those.
"""

from __future__ import annotations

import atexit
import os
import re
import shutil
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from typing import Any

fcntl: Any
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

MARK = ".powderdsl-"
NAME = re.compile(r".*\.powderdsl-[0-9a-f]{16}(\..*)?", re.DOTALL)

OLD = 24 * 3600.0
"""Age in seconds after which leftovers are removed where there are no file locks."""

_mine: dict[Path, int] = {}
"""What is to be removed when this process ends, with the descriptor that holds its lock, or -1."""
_swept: set[Path] = set()


def scratch_file(target: Path) -> AbstractContextManager[Path]:
    """An empty file that only its owner can read, beside `target` and with its suffix. It may be moved away.

    Raises:
        OSError, ValueError: it cannot be made there.
    """
    return _scratch(target.parent, f".{target.stem[:40]}", target.suffix, _new_file)


def scratch_folder(parent: Path) -> AbstractContextManager[Path]:
    """An empty folder in `parent` that only its owner can read, removed at the end with all that it holds.

    Raises:
        OSError: it cannot be made there.
    """
    return _scratch(parent, "", "", _new_folder)


@contextmanager
def _scratch(parent: Path, start: str, suffix: str, make: Callable[[Path], int]) -> Iterator[Path]:
    folder = parent.absolute()
    if folder not in _swept:
        _swept.add(folder)
        sweep(folder)
    path = _made(parent, start, suffix, make)
    try:
        yield path
    finally:
        _dispose(path)


def sweep(folder: Path) -> None:
    """Remove the scratch files and folders in a folder whose processes are dead."""
    with suppress(OSError, ValueError), os.scandir(folder) as entries:
        found = [Path(entry.path) for entry in entries if is_scratch(entry.name)]
        for path in found:
            _remove_unless_held(path)


def is_scratch(name: str) -> bool:
    """Whether a file or folder has the name of one that is made here."""
    return NAME.fullmatch(name) is not None


def _made(parent: Path, start: str, suffix: str, make: Callable[[Path], int]) -> Path:
    """Make and lock a new file or folder. Its name is recorded first: a signal may come between any two lines."""
    while True:
        path = parent / f"{start}{MARK}{token_hex(8)}{suffix}"
        _mine[path] = -1
        try:
            _mine[path] = make(path)
        except (OSError, ValueError):
            del _mine[path]
            raise
        if _hold(path, _mine[path]):
            return path
        _dispose(path)


def _new_file(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0), 0o600)


def _new_folder(path: Path) -> int:
    path.mkdir(mode=0o700)
    return os.open(path, os.O_RDONLY) if fcntl else -1


def _hold(path: Path, handle: int) -> bool:
    """Lock a new file or folder; False if another process has swept it in between."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_SH)
    except OSError:  # no locks here: `OLD` protects it
        return True
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def _dispose(path: Path) -> None:
    """Remove a file or folder of ours, unless it has been moved away, and let go of its lock."""
    if path not in _mine:  # in a fork: it belongs to the parent
        return
    _remove(path)
    handle = _mine.pop(path)
    if handle >= 0:
        os.close(handle)


def _remove_unless_held(path: Path) -> None:
    """Remove a leftover of this user's. What is neither a file nor a folder, or a link, is left alone."""
    handle = -1
    try:
        found = path.lstat()
        if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):
            return
        if hasattr(os, "getuid") and found.st_uid != os.getuid():
            return
        if fcntl is not None:
            handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        if _nobodys(handle, found):
            _remove(path)
    except OSError:
        return
    finally:
        if handle >= 0:
            os.close(handle)


def _nobodys(handle: int, found: os.stat_result) -> bool:
    """Lock a leftover; whether its process is dead, or it is old where there are no locks."""
    if fcntl is not None:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            return False
        except OSError:  # no locks here
            pass
    return time.time() - found.st_mtime > OLD


def _remove(path: Path) -> None:
    with suppress(FileNotFoundError):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()


@atexit.register
def _remove_all() -> None:
    """Remove what daemon threads had made, and what a signal kept from being removed."""
    for path in list(_mine):
        with suppress(OSError):
            _remove(path)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_mine.clear)  # it is the parent's
