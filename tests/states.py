"""Comparing nested states, and what runs have logged."""

from __future__ import annotations

from typing import Any

import torch

from powderdsl.experiments.runs import RunFolder, read_metrics


def same(a: Any, b: Any) -> bool:
    """Whether two nests of tensors and values are equal, bit by bit."""
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return bool(a == b)


def logged(run: RunFolder) -> list[dict[str, Any]]:
    """The metrics of a run without times of day, and without the count of rollouts since the last start."""
    return [
        {name: value for name, value in line.items() if not name.startswith("time/")}
        for line in read_metrics(run.path)
    ]
