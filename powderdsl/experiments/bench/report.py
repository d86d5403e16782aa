"""What was measured: the figures of each cell, and the report as plain data and as text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median
from typing import Any

from powderdsl.experiments.bench.machine import Machine, memory_measure
from powderdsl.experiments.bench.plan import WORKLOADS, Cell, Plan
from powderdsl.system.reports import table

MEGABYTE = 1 << 20


@dataclass(frozen=True)
class Spread:
    """The median, minimum and maximum of the rounds."""

    median: float
    min: float
    max: float

    @staticmethod
    def of(values: Iterable[float]) -> Spread:
        """The spread of one value a round."""
        numbers = list(values)
        return Spread(median(numbers), min(numbers), max(numbers))


@dataclass(frozen=True)
class CellFigures:
    """What was measured of a cell. `round_seconds` and `round_processor_seconds` get one value a round.

    `compile_seconds` are its backend's, shared by all cells that have it. `peak_memory_bytes` is None where the system
    does not report it, `state_bytes` are those of the worlds' tensors in storage dtypes. `passes` has the microseconds
    a world and step of each pass, in the order they run; it is empty if passes were not profiled. Processor times count
    all threads together; other processes hardly affect them.
    """

    cell: Cell
    compile_seconds: float
    first_step_seconds: float
    peak_memory_bytes: int | None
    state_bytes: int
    steps_per_call: int
    calls_per_round: int
    round_seconds: list[float] = field(default_factory=list)
    round_processor_seconds: list[float] = field(default_factory=list)
    passes: dict[str, float] = field(default_factory=dict)

    @property
    def world_steps(self) -> int:
        """Steps of single worlds in a round."""
        return self.cell.batch * self.steps_per_call * self.calls_per_round

    @property
    def world_steps_per_second(self) -> Spread:
        return Spread.of(self.world_steps / seconds for seconds in self.round_seconds)

    @property
    def processor_microseconds_per_world_step(self) -> Spread:
        return Spread.of(1e6 * seconds / self.world_steps for seconds in self.round_processor_seconds)

    @property
    def processors(self) -> float:
        """CPUs that this process used: fewer than its threads if other processes were running."""
        return sum(self.round_processor_seconds) / max(sum(self.round_seconds), 1e-9)


@dataclass(frozen=True)
class Report:
    """A plan and the figures of the cells that at least one round has reached."""

    plan: Plan
    machine: Machine
    cells: tuple[CellFigures, ...]
    interrupted: bool = False

    @property
    def programs(self) -> list[str]:
        """The names of the programs that were measured beside the backends."""
        return [program.name for program in self.plan.programs]

    def ratio(self, figures: CellFigures, backend: str) -> float | None:
        """The processor time of a cell divided by that of a backend or program for the same worlds."""
        other = replace(figures.cell, backend=backend)
        for candidate in self.cells:
            if candidate.cell == other:
                spent = candidate.processor_microseconds_per_world_step.median
                return figures.processor_microseconds_per_world_step.median / max(spent, 1e-9)
        return None


def report_data(report: Report) -> dict[str, Any]:
    """A report for `as_json`: every figure, and the seconds of every round."""
    plan = report.plan
    return {
        "machine": report.machine,
        "rules": plan.ruleset.name,
        "workload": plan.workload,
        "device": plan.device,
        "seed": plan.seed,
        "rounds": plan.rounds,
        "interrupted": report.interrupted,
        "cells": [
            {
                **vars(figures.cell),
                **{key: value for key, value in vars(figures).items() if key != "cell"},
                "world_steps_per_second": figures.world_steps_per_second,
                "processor_microseconds_per_world_step": figures.processor_microseconds_per_world_step,
                "beside": {name: report.ratio(figures, name) for name in report.programs},
            }
            for figures in report.cells
        ],
    }


def extra_words(cell: Cell, among: Iterable[CellFigures]) -> list[str]:
    """The numbers of elements and threads of a cell, if other cells have others."""
    cells = [figures.cell for figures in among]
    words = [f"{len(cell.elements)} elements"] if len({other.elements for other in cells}) > 1 else []
    return words + ([f"{cell.threads} threads"] if len({other.threads for other in cells}) > 1 else [])


# Text


def report_text(report: Report) -> str:
    """The whole report, without a newline at its end."""
    parts = ["\n".join(_header(report))]
    if report.cells:
        parts += [_cell_table(report), "\n".join(_footnotes(report))]
    if any(figures.passes for figures in report.cells):
        parts.append(_pass_table([figures for figures in report.cells if figures.passes]))
    if report.interrupted:
        rounds = max((len(figures.round_seconds) for figures in report.cells), default=0)
        parts.append(f"interrupted: {rounds} of {report.plan.rounds} rounds were begun")
    return "\n\n".join(parts)


def _header(report: Report) -> Iterator[str]:
    """Rules, worlds, versions and machine, and a warning if other processes were running."""
    plan, machine = report.plan, report.machine
    yield f"{plan.ruleset.name}, worlds of {plan.workload}: {WORKLOADS[plan.workload]}"
    versions = f"powderdsl {machine.powderdsl}, torch {machine.torch}, Python {machine.python}"
    yield f"{versions}, C++: {machine.compiler}"
    yield f"{machine.processor}, {machine.cpus} CPUs, {machine.system}, device {machine.device}"
    yield f"threads: {', '.join(map(str, sorted({cell.threads for cell in plan.cells})))} (torch is held to as many)"
    if machine.load is not None:
        yield f"load average before: {machine.load:.1f}"
    if machine.busy:
        at_work = f"warning: others are at work on these {machine.cpus} CPUs"
        yield f"{at_work}: compare figures within this table only"


def _cell_table(report: Report) -> str:
    """One line per cell. Elements and threads have columns only if cells differ in them, each program has one."""
    columns: dict[str, Callable[[CellFigures], str]] = {
        "backend": lambda figures: figures.cell.backend,
        "batch": lambda figures: f"{figures.cell.batch:,}",
        "size": lambda figures: figures.cell.size_text,
    }
    if len({figures.cell.elements for figures in report.cells}) > 1:
        columns["elements"] = lambda figures: str(len(figures.cell.elements))
    if len({figures.cell.threads for figures in report.cells}) > 1:
        columns["threads"] = lambda figures: str(figures.cell.threads)
    columns |= {
        "world-steps/s": lambda figures: number(figures.world_steps_per_second.median),
        "slowest..fastest": _range,
        "cells/s": lambda figures: number(figures.world_steps_per_second.median * figures.cell.world_cells),
        "µs/world-step": lambda figures: number(1e6 / figures.world_steps_per_second.median),
        "ns/cell": lambda figures: number(
            1e9 / figures.world_steps_per_second.median / figures.cell.world_cells
        ),
        "CPUs": lambda figures: f"{figures.processors:.2f}",
        "to first step": lambda figures: f"{figures.compile_seconds + figures.first_step_seconds:.2f} s",
        "memory": _memory,
        "state": lambda figures: f"{figures.state_bytes / figures.cell.cells:.3g} B/cell",
        **{f"÷ {name}": partial(_times, report, name) for name in report.programs},
    }
    rows = [[show(figures) for show in columns.values()] for figures in report.cells]
    return "\n".join(table([[*columns], *rows], indent=""))


def _range(figures: CellFigures) -> str:
    rate = figures.world_steps_per_second
    return f"{number(rate.min)}..{number(rate.max)}"


def _memory(figures: CellFigures) -> str:
    growth = figures.peak_memory_bytes
    return "?" if growth is None else f"{growth / MEGABYTE:.1f} MiB, {growth / figures.cell.cells:.0f} B/cell"


def _times(report: Report, program: str, figures: CellFigures) -> str:
    times = report.ratio(figures, program)
    if times is None:
        return "?"
    return number(times) if times >= 0.1 else f"1/{number(1 / times)}"


def _footnotes(report: Report) -> Iterator[str]:
    steps = sorted({figures.steps_per_call for figures in report.cells})
    shown = str(steps[0]) if len(steps) == 1 else f"{steps[0]} to {steps[-1]}"
    rounds = f"medians of {report.plan.rounds} interleaved rounds"
    yield f"{rounds}; a call makes {shown} steps, always from the same worlds"
    yield "CPUs: processor time by time; less than the threads means that others were at work"
    yield "to first step: compiling, which all lines of a backend share, and the first step"
    yield "state: the worlds' tensors, which are there before memory is measured"
    if report.programs:
        yield "÷: processor time divided by that of another program, from the same worlds"
    yield f"memory: {memory_measure(report.plan.device)}"


def _pass_table(profiled: Sequence[CellFigures]) -> str:
    """µs a world and step of each pass, and its share, for each cell that was profiled."""
    totals = [sum(figures.passes.values()) for figures in profiled]
    rows = [["µs/world-step", *(_label(figures.cell, profiled) for figures in profiled)]]
    for name in profiled[0].passes:
        spent = [figures.passes[name] for figures in profiled]
        shares = zip(spent, totals, strict=True)
        rows.append([name, *(f"{number(part)} {part / total:4.0%}" for part, total in shares)])
    wholes = {
        "all passes": totals,
        "whole step": [1e6 / figures.world_steps_per_second.median for figures in profiled],
        "of that, processor time": [
            figures.processor_microseconds_per_world_step.median for figures in profiled
        ],
    }
    for name, values in wholes.items():
        rows.append([name, *(f"{number(value)}     " for value in values)])
    return "\n".join(table(rows, indent=""))


def _label(cell: Cell, among: Sequence[CellFigures]) -> str:
    """A short name of a cell: what distinguishes it from the others."""
    words = [cell.backend, f"{cell.batch}"]
    if len({figures.cell.size for figures in among}) > 1:
        words.append(cell.size_text)
    return " ".join([*words, *extra_words(cell, among)])


def number(value: float) -> str:
    """Three significant digits: 0.0123, 1.23, 12.3, 1,234, 12.3 million as 12.3M."""
    if value >= 1e9:
        return f"{value / 1e9:.3g}G"
    if value >= 1e6:
        return f"{value / 1e6:.3g}M"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
