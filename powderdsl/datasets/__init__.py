"""Offline data: episodes recorded from tasks, and read back as minibatches."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from powderdsl.datasets.dataset import Dataset, Transitions, split
    from powderdsl.datasets.minari import from_minari, to_minari
    from powderdsl.datasets.recorder import record

__all__ = ["Dataset", "Transitions", "from_minari", "record", "split", "to_minari"]

_HOMES = {
    "Dataset": "dataset",
    "Transitions": "dataset",
    "from_minari": "minari",
    "record": "recorder",
    "split": "dataset",
    "to_minari": "minari",
}


def __getattr__(name: str) -> Any:
    """Public names are imported when first used."""
    if name not in _HOMES:
        raise AttributeError(f"module 'powderdsl.datasets' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"powderdsl.datasets.{_HOMES[name]}"), name)
