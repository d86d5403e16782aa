"""Claims: who works on a folder, also where processes on other machines share its storage.

A claim is a file, ``claim-000001``. Its owner changes the time of the file every `BEAT` seconds. A claim is dead if its
process was on this machine and has left its lock, or if the file has not changed for `LEASE` seconds while somebody
watched it: clocks of machines are never compared. Whoever finds the last claim dead creates the one with the next
number, which only one process can do. An owner that has not renewed its claim for half of `LEASE`, say because its
machine was suspended, gives up by itself before anybody else may start.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import re
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

from powderdsl.system.reading import parse_json

fcntl: Any
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

BEAT = 5.0
"""Seconds between two signs of life."""
LEASE = 60.0
"""Seconds without a sign of life after which an owner on another machine is taken for dead."""

NAME, LAST = re.compile(r"claim-([0-9]{6})"), 999_999
MAX_BYTES = 1 << 12


class Held(Exception):
    """Somebody else has a claim; the message says who. `sure`: it is alive, or else not watched for long enough."""

    def __init__(self, who: str, sure: bool):
        super().__init__(who)
        self.sure = sure


class Lost(Exception):
    """A claim may belong to somebody else by now."""


class Claim:
    """A claim of this process, renewed by a thread until it is released. A context manager.

    Args:
        path: the file. handle: its descriptor, which holds the lock and is closed at the end.
    """

    def __init__(self, path: Path, handle: int):
        self.path, self._handle = path, handle
        self._lost, self._ended = threading.Event(), threading.Event()
        self._stop: Callable[[], None] = lambda: None
        self._renewed = _clock()
        self._thread = threading.Thread(target=self._beat, daemon=True)

    def __enter__(self) -> Claim:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        if not self._lost.is_set():
            release(self.path)
        os.close(self._handle)

    def check(self) -> None:
        """Raise Lost unless the claim is ours for certain."""
        if self._lost.is_set() or _clock() - self._renewed > LEASE / 2:
            self._lose()
            raise Lost("another process may have taken over")

    def stop_if_lost(self, stop: Callable[[], None]) -> None:
        """A function to call as soon as the claim is lost, in place of the one before."""
        self._stop = stop
        if self._lost.is_set():
            stop()

    def _lose(self) -> None:
        self._lost.set()
        self._stop()

    def _beat(self) -> None:
        while not self._ended.wait(BEAT):
            if _clock() - self._renewed > LEASE / 2 or self._is_taken():
                self._lose()
                return
            with suppress(OSError):  # the storage may be back in time
                os.utime(self.path)
                self._renewed = _clock()

    def _is_taken(self) -> bool:
        return not self.path.exists() or _successor(self.path).exists()


class Claims:
    """Makes claims, and remembers for how long those of others have not changed."""

    def __init__(self) -> None:
        self._seen: dict[Path, tuple[int, float]] = {}
        """The time of each file, and when it was first seen with that time."""

    def take(self, folder: Path) -> tuple[Claim, bool]:
        """Claim a folder; also returns whether it was left by a process on another machine.

        Raises:
            Held: another process has it. OSError: it cannot be written to.
        """
        last = max(_numbers(folder), default=0)
        if last == LAST:  # not one of ours: this takes years
            raise OSError(errno.EMFILE, "it has too many claims", str(folder))
        elsewhere = bool(last) and self._is_elsewhere(_path(folder, last))
        path = _path(folder, last + 1)
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0)
        try:
            handle = os.open(path, flags, 0o666)
        except FileExistsError:
            raise Held("a process that started at the same time", False) from None
        try:
            about = {
                "machine": machine(),
                "host": platform.node(),
                "pid": os.getpid(),
                "locked": _lock(handle),
            }
            os.write(handle, json.dumps(about).encode())
            # Others may have removed what was found above, and started anew.
            numbers = _numbers(folder)
            if max(numbers, default=0) != last + 1 or (last and last not in numbers):
                raise Held("a process that started at the same time", False)
        except BaseException:
            with suppress(OSError):
                path.unlink()
            os.close(handle)
            raise
        return Claim(path, handle), elsewhere

    def _is_elsewhere(self, path: Path) -> bool:
        """Whether a dead claim was one of another machine's. Raises Held if it is not dead, OSError if it is not a file."""
        try:
            handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
        except FileNotFoundError:
            raise Held("a process that has just ended", False) from None
        try:
            about = _read(handle)
            who = f"{about.get('host', '?')}, process {about.get('pid', '?')}"
            here = about.get("machine") == machine()
            if here and about.get("locked") is True and fcntl is not None:
                try:
                    fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
                    return False
                except BlockingIOError:
                    raise Held(who, True) from None
                except OSError:  # no locks here any more
                    pass
            changed = os.fstat(handle).st_mtime_ns  # after `open`, which asks a file server anew
        finally:
            os.close(handle)
        now = _clock()
        seen, since = self._seen.setdefault(path, (changed, now))
        if seen != changed:
            self._seen[path] = changed, now
            raise Held(who, True)
        if now - since <= LEASE:
            raise Held(who, False)
        return not here


def lock_if_free(handle: int) -> bool:
    """Lock an open file until all processes that inherit it have closed it; False if others have locked it.

    Where there are no locks, every file is free.
    """
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def release(path: Path) -> None:
    """Remove a claim of ours, after those before it."""
    number = int(path.name.rpartition("-")[2])
    for before in sorted(_numbers(path.parent)):
        if before < number:
            with suppress(OSError):
                _path(path.parent, before).unlink()
    with suppress(OSError):
        path.unlink()


@cache
def machine() -> str:
    """Names this machine since it was started. Containers on it have the same name, and see each other's locks."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return platform.node()


def _numbers(folder: Path) -> set[int]:
    return {int(match[1]) for name in os.listdir(folder) if (match := NAME.fullmatch(name))}


def _path(folder: Path, number: int) -> Path:
    return folder / f"claim-{number:06d}"


def _successor(path: Path) -> Path:
    return _path(path.parent, int(path.name.rpartition("-")[2]) + 1)


def _lock(handle: int) -> bool:
    """Lock a new file, whose reader is still told nothing; whether there are locks here."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
    except OSError:
        return False
    return True


def _read(handle: int) -> dict[str, Any]:
    """What a claim says; nothing if its owner has only just made it."""
    try:
        found = parse_json(os.read(handle, MAX_BYTES))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _clock() -> float:
    """Seconds, those included in which the machine was suspended."""
    boot = getattr(time, "CLOCK_BOOTTIME", None)  # Linux
    return time.monotonic() if boot is None else time.clock_gettime(boot)
