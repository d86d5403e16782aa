"""Packages that only some commands need, imported when they are asked for."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from powderdsl.system.writing import failure


def pillow(work: str, *more: str) -> Any:
    """Pillow's module of images.

    Args:
        work: what it is needed for, as a sentence begins: ``reading a picture``.
        more: other modules that the work needs.

    Raises:
        CompileError: PD612 if one of them cannot be imported.
    """
    for name in more:
        _needed(name, name, work)
    return _needed("PIL.Image", "Pillow", work)


def _needed(module: str, package: str, work: str) -> Any:
    try:
        return import_module(module)
    except ImportError:
        message = f"{work} needs {package}, which is not installed"
        raise failure("PD612", message, helps=(f"pip install {package.lower()}",)) from None
