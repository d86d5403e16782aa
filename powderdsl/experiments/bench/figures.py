"""What was measured: the figures of each cell, and the report as plain data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any

from powderdsl.experiments.bench.machine import Machine, Memory
from powderdsl.experiments.bench.plan import Cell, Plan

FORMAT_VERSION = 1
"""Of `report_data`: raised when a key changes its meaning."""


@dataclass(frozen=True)
class Spread:
    """The middle of the rounds, and their ends."""

    median: float
    min: float
    max: float

    @staticmethod
    def of(values: Iterable[float]) -> Spread:
        """The spread of one value a round."""
        found = list(values)
        return Spread(median(found), min(found), max(found))

    def scaled(self, factor: float) -> dict[str, float]:
        """The three numbers times a factor, by name."""
        return {name: value * factor for name, value in asdict(self).items()}


@dataclass
class CellFigures:
    """What was measured of a cell. `seconds` and `processor_seconds` get one value a round.

    `compile_seconds` are its backend's, shared by all cells that have it. `state_bytes` are those of the worlds' tensors
    in storage dtypes. A round makes `calls` calls of `steps` steps. `passes` has the seconds a world and step of each
    pass, in the order they run; it is empty if passes were not profiled.
    """

    cell: Cell
    compile_seconds: float
    first_step_seconds: float
    memory: Memory
    state_bytes: int
    steps: int
    calls: int
    seconds: list[float] = field(default_factory=list)
    processor_seconds: list[float] = field(default_factory=list)
    passes: tuple[tuple[str, float], ...] = ()

    @property
    def world_steps(self) -> int:
        """Steps of single worlds in a round."""
        return self.cell.batch * self.steps * self.calls

    @property
    def to_first_step(self) -> float:
        """Seconds from the checked rules to the state after one step."""
        return self.compile_seconds + self.first_step_seconds

    @property
    def processors(self) -> float:
        """CPUs that this process had: less than its threads where others were at work."""
        return sum(self.processor_seconds) / max(sum(self.seconds), 1e-9)

    @property
    def rate(self) -> Spread:
        """World-steps a second."""
        return Spread.of(self.world_steps / seconds for seconds in self.seconds)

    @property
    def world_step_seconds(self) -> Spread:
        """Seconds a world and step."""
        return Spread.of(seconds / self.world_steps for seconds in self.seconds)

    @property
    def processor_step_seconds(self) -> Spread:
        """The processor's seconds a world and step, all threads together: what others do hardly changes them."""
        return Spread.of(seconds / self.world_steps for seconds in self.processor_seconds)


@dataclass(frozen=True)
class Report:
    """A plan and the figures of the cells that at least one round has reached.

    `load_after` is the load average of the last minute of measuring.
    """

    plan: Plan
    machine: Machine
    cells: tuple[CellFigures, ...]
    interrupted: bool
    load_after: float | None


def make_report(
    plan: Plan,
    machine: Machine,
    cells: Iterable[CellFigures],
    load_after: float | None = None,
    *,
    interrupted: bool = False,
) -> Report:
    """The report of what has been measured; cells that no round has reached are left out."""
    return Report(plan, machine, tuple(one for one in cells if one.seconds), interrupted, load_after)


def report_data(report: Report) -> dict[str, Any]:
    """A report as plain data for JSON: every figure, and the seconds of every round."""
    plan = report.plan
    return {
        "format": "powderdsl bench",
        "version": FORMAT_VERSION,
        "machine": {**asdict(report.machine), "load_after": report.load_after},
        "rules": plan.ruleset.name,
        "workload": plan.workload,
        "device": plan.device,
        "seed": plan.seed,
        "rounds": plan.rounds,
        "interrupted": report.interrupted,
        "cells": [_cell_data(figures) for figures in report.cells],
    }


def _cell_data(figures: CellFigures) -> dict[str, Any]:
    cell = figures.cell
    seconds, growth, cells = figures.world_step_seconds, figures.memory.growth, cell.cells
    return {
        "backend": cell.backend,
        "batch": cell.batch,
        "rows": cell.size[0],
        "columns": cell.size[1],
        "elements": list(cell.elements),
        "threads": cell.threads,
        "compile_seconds": figures.compile_seconds,
        "first_step_seconds": figures.first_step_seconds,
        "peak_memory_bytes": growth,
        "peak_memory_how": figures.memory.how,
        "peak_memory_bytes_per_cell": None if growth is None else growth / cells,
        "state_bytes_per_cell": figures.state_bytes / cells,
        "steps_per_call": figures.steps,
        "calls_per_round": figures.calls,
        "round_seconds": figures.seconds,
        "round_processor_seconds": figures.processor_seconds,
        "world_steps_per_second": asdict(figures.rate),
        "cell_updates_per_second": figures.rate.scaled(cell.world_cells),
        "microseconds_per_world_step": seconds.scaled(1e6),
        "processor_microseconds_per_world_step": figures.processor_step_seconds.scaled(1e6),
        "nanoseconds_per_cell_step": seconds.scaled(1e9 / cell.world_cells),
        "passes": [
            {"name": name, "microseconds_per_world_step": spent * 1e6, "share": share}
            for name, spent, share in pass_shares(figures)
        ],
    }


def pass_shares(figures: CellFigures) -> list[tuple[str, float, float]]:
    """(pass, seconds a world and step, its part of all passes)."""
    total = sum(spent for _, spent in figures.passes)
    return [(name, spent, spent / total if total else 0.0) for name, spent in figures.passes]


def extra_words(cell: Cell, among: Iterable[CellFigures]) -> list[str]:
    """How many elements and threads a cell has, if that tells it from other cells."""
    cells = [one.cell for one in among]
    words = [f"{len(cell.elements)} elements"] if len({one.elements for one in cells}) > 1 else []
    return words + ([f"{cell.threads} threads"] if len({one.threads for one in cells}) > 1 else [])
