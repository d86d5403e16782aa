"""The user's private cache folder. Its contents are loaded and executed, so nobody else may write to it."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def cache_folder(name: str) -> Path:
    """A folder of the cache, made with mode 0700.

    Raises:
        OSError: it cannot be made, belongs to somebody else, or others may write to it; or there is no home folder.
    """
    try:
        top = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "powderdsl"
    except RuntimeError as error:
        raise OSError(str(error)) from None
    for folder in (top, top / name):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        check_private(folder)
    return top / name


def check_private(folder: Path) -> None:
    """Refuse a folder to which another user may write. Raises PermissionError."""
    if not hasattr(os, "getuid"):
        return
    # A link is checked too: its owner decides where it leads.
    for status in (folder.lstat(), folder.stat()):
        if status.st_uid != os.getuid():
            raise PermissionError(f"{folder} belongs to another user")
    if folder.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(f"others may write to {folder}: empty it, then `chmod 700` it")
