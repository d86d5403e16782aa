"""Offline data: episodes recorded from tasks, and read back as minibatches."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from powderdsl.datasets.dataset import Dataset
    from powderdsl.datasets.recorder import record
    from powderdsl.datasets.transitions import Transitions, split

__all__ = ["Dataset", "Transitions", "record", "split"]

_HOMES = {"Dataset": "dataset", "Transitions": "transitions", "record": "recorder", "split": "transitions"}


def __getattr__(name: str) -> Any:
    """Public names are imported when first used."""
    if name not in _HOMES:
        raise AttributeError(f"module 'powderdsl.datasets' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"powderdsl.datasets.{_HOMES[name]}"), name)
