"""Public names of a package that are imported when they are first used, so that importing the package is quick."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any


def importing(package: str, **homes: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package; `homes` are its modules, each with the public names that are in it."""

    def import_name(name: str) -> Any:
        for module, names in homes.items():
            if name in names.split():
                return getattr(import_module(f"{package}.{module}"), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return import_name
