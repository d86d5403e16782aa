"""Offline data: recording episodes of tasks, and reading them as minibatches."""

from __future__ import annotations

from typing import TYPE_CHECKING

from powderdsl.system.packages import importing

if TYPE_CHECKING:
    from powderdsl.datasets.dataset import Dataset, Transitions, split
    from powderdsl.datasets.minari import from_minari, to_minari
    from powderdsl.datasets.recorder import record

__all__ = ["Dataset", "Transitions", "from_minari", "record", "split", "to_minari"]

__getattr__, __dir__ = importing(
    "powderdsl.datasets",
    {"dataset": "Dataset Transitions split", "minari": "from_minari to_minari", "recorder": "record"},
)
