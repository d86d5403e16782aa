"""Files that may come from strangers: reading them within bounds, and confining the paths that they name to their folders.

Every loader reads through `open_regular` or `read_bytes`. Every path that a file names goes through `inside`, every
folder that is one thing (a run, a dataset, the results of a study) through `check_links`.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from io import BufferedReader
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

MAX_LINKS_SEARCHED = 1 << 20
"""Maximum number of entries of a folder that are searched for links."""

_KINDS = (
    (stat.S_ISDIR, errno.EISDIR, "it is a folder, not a file"),
    (stat.S_ISFIFO, errno.EINVAL, "it is a pipe, not a file; write to a file first"),
    (stat.S_ISSOCK, errno.EINVAL, "it is a socket, not a file"),
    (stat.S_ISCHR, errno.EINVAL, "it is a device, not a file"),
    (stat.S_ISBLK, errno.EINVAL, "it is a device, not a file"),
)


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading, also through links, without blocking.

    Raises:
        OSError: it cannot be opened, or is a folder, a pipe, a socket or a device; `strerror` says which.
    """
    name = os.fspath(path)
    if "\0" in name:
        raise OSError(errno.EINVAL, "its name has a NUL character", name.replace("\0", "\\0"))
    # A pipe that nobody writes to is opened at once, and refused below.
    flags = (
        os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOCTTY", 0)
    )
    try:
        handle = os.open(name, flags | getattr(os, "O_BINARY", 0))
    except OSError:
        _refuse(name, os.stat(name).st_mode)  # a socket cannot be opened, which says less
        raise
    try:
        _refuse(name, os.fstat(handle).st_mode)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def refuse_irregular(path: str | Path) -> None:
    """Raise OSError if there is a folder, a pipe, a socket or a device."""
    _refuse(os.fspath(path), os.stat(path).st_mode)


def _refuse(name: str, mode: int) -> None:
    """Raise OSError unless a mode is that of a regular file."""
    for is_kind, number, says in _KINDS:
        if is_kind(mode):
            raise OSError(number, says, name)


def read_bytes(path: str | Path, limit: int) -> bytes:
    """The contents of a regular file of at most `limit` bytes.

    Raises:
        OSError: as `open_regular`; with the number EFBIG if it has more bytes, of which no more than `limit` are read.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        data = b"" if size > limit else file.read(limit + 1)
    if size > limit or len(data) > limit:
        raise OSError(errno.EFBIG, f"it has more than {limit:,} bytes", os.fspath(path))
    return data


def parse_json(data: bytes, values: int = 1 << 19) -> Any:
    """The value of a JSON text.

    Args:
        values: how many values it may hold: a value takes up to a hundred times as much memory as text.

    Raises:
        ValueError: it is not JSON, holds more values, or is nested too deep.
    """
    if data.count(b",") + data.count(b"[") + data.count(b"{") > values:
        raise ValueError(f"it has more than {values:,} values")
    try:
        return json.loads(data.decode("utf-8"))
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def read_json(path: str | Path, limit: int = 1 << 22) -> Any:
    """The value in a JSON file of at most `limit` bytes; None if there is none or it is damaged."""
    try:
        return parse_json(read_bytes(path, limit))
    except (OSError, ValueError):
        return None


# Paths that files name


def inside(folder: str | Path, name: str) -> Path:
    """The path of a file that a text names: relative to `folder`, and in it or below, also once links are followed.

    Raises:
        ValueError: the path leads elsewhere; the text says why.
    """
    if any(ord(char) < 32 or ord(char) == 127 for char in name):
        raise ValueError("it has control characters")
    posix, windows = PurePosixPath(name), PureWindowsPath(name)
    if not name.strip() or name.strip() in (".", "./"):
        raise ValueError("it names no file")
    if posix.is_absolute() or windows.drive or windows.root:
        raise ValueError("it is absolute")
    if name.startswith("~"):
        raise ValueError("it begins with `~`")
    if ".." in posix.parts or ".." in windows.parts:
        raise ValueError("`..` leads out of the folder")
    path = Path(folder) / name
    try:
        if not path.resolve().is_relative_to(Path(folder).resolve()):
            raise ValueError("a link in it leads out of the folder")
    except (OSError, RuntimeError) as error:  # a loop of links
        raise ValueError(getattr(error, "strerror", None) or str(error)) from None
    return path


def is_path(word: str) -> bool:
    """Whether a word that may be a name or a path is a path: rules, tasks, runs and packs have plain names."""
    return (
        any(char in word for char in "/\\")
        or word.startswith(("~", "."))
        or word.lower().endswith((".yaml", ".yml"))
    )


def check_links(folder: str | Path) -> None:
    """Refuse a folder with links that lead out of it: who writes there would write elsewhere.

    Raises:
        OSError: there is such a link, or the folder cannot be listed; `filename` says which.
    """
    top = Path(folder)
    here, waiting, seen = top.resolve(), [top], 0
    while waiting:
        with os.scandir(waiting.pop()) as entries:
            for entry in entries:
                seen += 1
                if seen > MAX_LINKS_SEARCHED:
                    raise OSError(errno.EFBIG, f"it has more than {MAX_LINKS_SEARCHED:,} entries", str(top))
                if entry.is_symlink():
                    _check_link(Path(entry.path), here)
                elif entry.is_dir(follow_symlinks=False):
                    waiting.append(Path(entry.path))


def _check_link(link: Path, folder: Path) -> None:
    try:
        inward = link.resolve().is_relative_to(folder)
    except (OSError, RuntimeError):  # a loop leads nowhere
        inward = False
    if not inward:
        raise OSError(errno.ELOOP, "it is a link that leads out of its folder", str(link))
