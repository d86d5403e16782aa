"""What was measured: the figures of each cell, and the report as plain data and as text."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from typing import Any

from powderdsl.experiments.bench.plan import WORKLOADS, Cell, Plan
from powderdsl.system.reports import table

MEGABYTE = 1 << 20


@dataclass
class CellFigures:
    """What was measured of a cell. `round_seconds` and `round_processor_seconds` get one value a round.

    `compile_seconds` are its backend's, shared by all cells that have it. `peak_memory_bytes` is None where the system
    does not report it. `passes` has the microseconds a world and step of each pass, in the order they run; it is empty
    if passes were not profiled. Processor times count all threads together; other processes hardly affect them.
    """

    cell: Cell
    compile_seconds: float
    first_step_seconds: float = 0.0
    peak_memory_bytes: int | None = None
    steps_per_call: int = 1
    calls_per_round: int = 1
    round_seconds: list[float] = field(default_factory=list)
    round_processor_seconds: list[float] = field(default_factory=list)
    passes: dict[str, float] = field(default_factory=dict)

    @property
    def world_steps(self) -> int:
        """Steps of single worlds in a round."""
        return self.cell.batch * self.steps_per_call * self.calls_per_round

    @property
    def rates(self) -> list[float]:
        """World-steps per second of each round, the slowest first."""
        return sorted(self.world_steps / seconds for seconds in self.round_seconds)

    @property
    def world_step_microseconds(self) -> float:
        return 1e6 * median(self.round_seconds) / self.world_steps

    @property
    def processor_microseconds(self) -> float:
        """Processor time of a world and step."""
        return 1e6 * median(self.round_processor_seconds) / self.world_steps


@dataclass(frozen=True)
class Report:
    """A plan and the figures of the cells that at least one round has reached."""

    plan: Plan
    machine: Mapping[str, Any]
    cells: tuple[CellFigures, ...]
    interrupted: bool = False

    @property
    def programs(self) -> list[str]:
        """The names of the programs that were measured beside the backends."""
        return [program.name for program in self.plan.programs]

    def ratio(self, figures: CellFigures, program: str) -> float | None:
        """The processor time of a cell divided by that of a program for the same worlds; None if it is unknown."""
        same = figures.cell._replace(backend=program)
        times = [other.processor_microseconds for other in self.cells if other.cell == same]
        return figures.processor_microseconds / times[0] if times and times[0] else None


def report_data(report: Report) -> dict[str, Any]:
    """A report for `as_json`: every figure, and the seconds of every round."""
    plan = report.plan
    cells = []
    for figures in report.cells:
        values = figures.cell._asdict() | vars(figures)
        del values["cell"]
        values["world_steps_per_second"] = median(figures.rates)
        values["beside"] = {name: report.ratio(figures, name) for name in report.programs}
        cells.append(values)
    return {
        "machine": report.machine,
        "rules": plan.ruleset.name,
        "elements": [element.name for element in plan.elements],
        **{name: getattr(plan, name) for name in ("workload", "device", "seed", "rounds")},
        "interrupted": report.interrupted,
        "cells": cells,
    }


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
    """Rules, worlds, versions and machine."""
    plan, machine = report.plan, report.machine
    yield f"{plan.ruleset.name}, worlds of {plan.workload}: {WORKLOADS[plan.workload]}"
    yield "powderdsl {powderdsl}, torch {torch}, Python {python}, C++: {compiler}".format_map(machine)
    yield "{processor}, {cpus} CPUs, {system}, device {device}".format_map(machine)


def _cell_table(report: Report) -> str:
    """One line per cell, and a column for each program beside the backends."""
    columns: dict[str, Callable[[CellFigures], str]] = {
        "backend": lambda figures: figures.cell.backend,
        "batch": lambda figures: f"{figures.cell.batch:,}",
        "size": lambda figures: "{}×{}".format(*figures.cell.size),
        "threads": lambda figures: str(figures.cell.threads),
        "world-steps/s": lambda figures: number(median(figures.rates)),
        "slowest..fastest": lambda figures: f"{number(figures.rates[0])}..{number(figures.rates[-1])}",
        "µs/world-step": lambda figures: number(figures.world_step_microseconds),
        "CPUs": lambda figures: f"{figures.processor_microseconds / figures.world_step_microseconds:.2f}",
        "to first step": lambda figures: f"{figures.compile_seconds + figures.first_step_seconds:.2f} s",
        "memory": _memory,
        **{f"÷ {name}": partial(_times, report, name) for name in report.programs},
    }
    rows = [[show(figures) for show in columns.values()] for figures in report.cells]
    return "\n".join(table([[*columns], *rows], indent=""))


def _memory(figures: CellFigures) -> str:
    growth, cells = figures.peak_memory_bytes, figures.cell.batch * figures.cell.world_cells
    return "?" if growth is None else f"{growth / MEGABYTE:.1f} MiB, {growth / cells:.0f} B/cell"


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
    if report.programs:
        yield "÷: processor time divided by that of another program, from the same worlds"
    yield "memory: the peak during the first calls, less what was in use before"


def _pass_table(profiled: Sequence[CellFigures]) -> str:
    """µs a world and step of each pass, and its share, for each cell that was profiled."""
    totals = [sum(figures.passes.values()) for figures in profiled]
    rows = [["µs/world-step", *(str(figures.cell) for figures in profiled)]]
    for name in profiled[0].passes:
        shares = zip((figures.passes[name] for figures in profiled), totals, strict=True)
        rows.append([name, *(f"{number(part)} {part / total:4.0%}" for part, total in shares)])
    wholes = {
        "all passes": totals,
        "whole step": [figures.world_step_microseconds for figures in profiled],
        "of that, processor time": [figures.processor_microseconds for figures in profiled],
    }
    for name, values in wholes.items():
        rows.append([name, *(f"{number(value)}     " for value in values)])
    return "\n".join(table(rows, indent=""))


def number(value: float) -> str:
    """Three significant digits: 0.0123, 1.23, 12.3, 1,234, 12.3 million as 12.3M."""
    if value >= 1e9:
        return f"{value / 1e9:.3g}G"
    if value >= 1e6:
        return f"{value / 1e6:.3g}M"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
