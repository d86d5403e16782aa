"""Lazy imports of optional packages and of our own modules."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def require(module: str, work: str, *helps: str) -> Any:
    """Import a module. Raises CompileError (PD612) if it cannot be imported.

    `work`: the subject of a sentence that needs the module: ``reading a picture``. `helps`: fixes.
    """
    try:
        return import_module(module)
    except ImportError as error:
        from powderdsl.system.writing import failure

        missing = error.name or module
        raise failure("PD612", f"{work} needs {missing}, which is not installed", helps=helps) from None


def importing(package: str, homes: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The ``__getattr__`` and ``__dir__`` of a package that imports a public name on first use.

    `homes` has the names in each module.
    """

    def import_name(name: str) -> Any:
        for module, names in homes.items():
            if name in names.split():
                return getattr(import_module(f"{package}.{module}"), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return import_name, lambda: list(sys.modules[package].__all__)
