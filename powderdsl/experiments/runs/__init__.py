"""Run folders: what a training run is, how far it got, and what it measured. A killed process leaves a readable folder."""

from powderdsl.experiments.runs.checkpoints import Checkpoint
from powderdsl.experiments.runs.folder import (
    RunFolder,
    does_not_fit,
    find_run,
    fitting,
    no_run,
    open_run,
    read_run,
)
from powderdsl.experiments.runs.metrics import Metrics

__all__ = [
    "Checkpoint",
    "Metrics",
    "RunFolder",
    "does_not_fit",
    "find_run",
    "fitting",
    "no_run",
    "open_run",
    "read_run",
]
