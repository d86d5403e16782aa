"""Packages that only some work needs."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from powderdsl.system.writing import failure


def require(module: str, work: str, *helps: str) -> Any:
    """Import a module.

    Args:
        work: what needs it, as a sentence begins: ``reading a picture``. helps: how to install it, what to do without.

    Raises:
        CompileError: PD612 if it cannot be imported.
    """
    try:
        return import_module(module)
    except ImportError as error:
        missing = error.name or module
        raise failure("PD612", f"{work} needs {missing}, which is not installed", helps=helps) from None


def require_matplotlib() -> None:
    """Raise CompileError (PD612) if matplotlib is not installed: before long work, not after it."""
    require("matplotlib", "drawing a plot", "pip install 'powderdsl[plot]'")
