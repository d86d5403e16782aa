"""What a run measures: JSON lines for programs, TensorBoard for people; means over runs and their intervals."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from powderdsl.system.reading import open_regular, parse_json
from powderdsl.system.writing import replacing

LINES = "metrics.jsonl"
EVENTS = "tensorboard"
MAX_LINE = 1 << 16
"""Bytes of a line."""
T_975 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
"""97.5 % quantiles of Student's t for 1 to 10 degrees of freedom, for which no short formula is exact enough."""


class Metrics:
    """Writes numbers by step. A context manager.

    Args:
        folder: the run's. step: where the run continues; what was written for later steps is dropped, so that a run that
            was killed after its last checkpoint writes nothing twice.
    """

    def __init__(self, folder: Path, step: int = 0):
        self._lines = folder / LINES
        kept = [json.dumps(line) for line in read_metrics(folder) if line["step"] <= step]
        with replacing(self._lines) as temporary:
            temporary.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")
        self._file = self._lines.open("a", encoding="utf-8")
        self._events = _events(folder / EVENTS, step)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Numbers by name, such as ``loss/train``, after `step` steps. What is not finite is left out of the lines."""
        numbers = {name: float(value) for name, value in values.items()}
        finite = {name: value for name, value in numbers.items() if math.isfinite(value)}
        self._file.write(json.dumps({"step": step, **finite}) + "\n")
        self._file.flush()
        if self._events is not None:
            for name, value in numbers.items():
                self._events.add_scalar(name, value, step)

    def __enter__(self) -> Metrics:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        if self._events is not None:
            self._events.close()


def read_metrics(folder: Path) -> Iterator[dict[str, Any]]:
    """The lines of a run, each with ``step``. A last line that a kill cut short is left out."""
    with suppress(FileNotFoundError), open_regular(folder / LINES) as file:
        for text in iter(lambda: file.readline(MAX_LINE), b""):
            with suppress(ValueError):
                line = parse_json(text)
                if isinstance(line, dict) and isinstance(line.get("step"), int):
                    yield line


def _events(folder: Path, step: int) -> Any:
    """TensorBoard's writer; None where it is not installed: the lines hold the same."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder), purge_step=step + 1 if step else None)


def mean_and_interval(values: Sequence[float]) -> tuple[float, float | None]:
    """The mean, and half of its 95 % interval by Student's t; None for a single value."""
    mean, freedom = statistics.fmean(values), len(values) - 1
    if freedom < 1:
        return mean, None
    # Beyond the table: the expansion of Cornish and Fisher, exact to four digits.
    expansion = 1.95996 + 2.37227 / freedom + 2.8225 / freedom**2 + 2.5557 / freedom**3
    quantile = T_975[freedom - 1] if freedom <= len(T_975) else expansion
    return mean, quantile * statistics.stdev(values) / math.sqrt(len(values))
