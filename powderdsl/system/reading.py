"""Untrusted files: reading them within limits, and confining the paths that they name to their folders.

Every loader reads through `open_regular` or `read_bytes`. Every path that a file names goes through `inside`, every
folder that is one thing (a run, a dataset, the results of a study) through `check_links`.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Callable
from io import BufferedReader
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading, also through links.

    Raises OSError if it cannot be opened or is not a regular file.
    """
    check_regular(path)
    return open(path, "rb")


def check_regular(path: str | Path) -> None:
    """Reject folders, and pipes and devices, which may be endless.

    Raises OSError if there is no regular file; `strerror` says why.
    """
    name = os.fspath(path)
    if "\0" in name:
        raise OSError(errno.EINVAL, "its name has a NUL character", name.replace("\0", "\\0"))
    if not stat.S_ISREG(os.stat(name).st_mode):
        raise OSError(errno.EINVAL, "it is not a regular file", name)


def read_bytes(path: str | Path, limit: int) -> bytes:
    """The contents of a regular file of at most `limit` bytes.

    Raises OSError: as `open_regular`; with the number EFBIG if it has more bytes, of which no more than one is read.
    """
    with open_regular(path) as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise OSError(errno.EFBIG, f"it has more than {limit:,} bytes", os.fspath(path))
    return data


def parse_json(
    data: bytes, values: int = 1 << 19, hook: Callable[[dict[str, Any]], Any] | None = None
) -> Any:
    """The value of a JSON text. `hook` makes a value of each object, as `json.loads` takes it.

    Raises ValueError if it is not JSON, is nested too deeply, or has too many values, each of which takes up to a
    hundred times the memory of its text.
    """
    if data.count(b",") + data.count(b"[") + data.count(b"{") > values:
        raise ValueError(f"it has more than {values:,} values")
    try:
        return json.loads(data.decode("utf-8"), object_hook=hook)
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
    """The path of a file named in a text, relative to `folder`, and inside it even after following links.

    Raises ValueError with the reason if the path leads elsewhere.
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
    """True if a word is a path and not a name: rules, tasks, runs and packs have plain names."""
    return (
        any(char in word for char in "/\\")
        or word.startswith(("~", "."))
        or word.lower().endswith((".yaml", ".yml"))
    )


def check_links(folder: str | Path) -> None:
    """Reject a folder with links that lead out of it, since writes to them would end up elsewhere.

    Raises OSError if there is such a link, or the folder cannot be listed; `filename` says which.
    """
    top, waiting = os.path.realpath(folder), [os.fspath(folder)]
    while waiting:
        with os.scandir(waiting.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)
                elif entry.is_symlink() and not Path(os.path.realpath(entry.path)).is_relative_to(top):
                    raise OSError(errno.ELOOP, "it is a link that leads out of its folder", entry.path)
