"""The user's private cache folder. What lies there is loaded and executed, so nobody else may write to it."""

from __future__ import annotations

import os
import platform
from pathlib import Path


def cache_folder(name: str) -> Path:
    """A folder of the cache, made with mode 0700.

    Raises:
        OSError: it cannot be made, or belongs to somebody else.
    """
    folder = _root() / "powderdsl" / name
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    if hasattr(os, "getuid"):
        if folder.stat().st_uid != os.getuid():
            raise PermissionError(f"{folder} belongs to another user")
        folder.chmod(0o700)
    return folder


def _root() -> Path:
    """Where caches of this user live."""
    if platform.system() == "Linux":  # what platformdirs says too, without the time its import takes
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    import platformdirs

    return Path(platformdirs.user_cache_dir())
