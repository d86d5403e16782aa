"""What was measured: the figures of each cell, and the report as plain data and as text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from statistics import median
from typing import Any

from powderdsl.experiments.bench.machine import Machine, Memory
from powderdsl.experiments.bench.plan import WORKLOADS, Cell, Plan
from powderdsl.system.reports import table

FORMAT_VERSION = 1
"""Version of `report_data`, increased when a key changes its meaning."""
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
        """CPUs that this process used: fewer than its threads if other processes were running."""
        return sum(self.processor_seconds) / max(sum(self.seconds), 1e-9)

    @property
    def rate(self) -> Spread:
        """World-steps per second."""
        return Spread.of(self.world_steps / seconds for seconds in self.seconds)

    @property
    def world_step_seconds(self) -> Spread:
        """Seconds per world and step."""
        return Spread.of(seconds / self.world_steps for seconds in self.seconds)

    @property
    def processor_step_seconds(self) -> Spread:
        """Processor seconds per world and step, all threads together; other processes hardly affect them."""
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
        "programs": [program.name for program in plan.programs],
        "cells": [_cell_data(figures, report) for figures in report.cells],
    }


def _cell_data(figures: CellFigures, report: Report) -> dict[str, Any]:
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
        "beside": {
            program.name: ratio(figures, report.cells, program.name) for program in report.plan.programs
        },
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
    """The numbers of elements and threads of a cell, if other cells have others."""
    cells = [one.cell for one in among]
    words = [f"{len(cell.elements)} elements"] if len({one.elements for one in cells}) > 1 else []
    return words + ([f"{cell.threads} threads"] if len({one.threads for one in cells}) > 1 else [])


# Text


def report_text(report: Report) -> str:
    """The whole report, without a newline at its end."""
    parts = [header(report)]
    if report.cells:
        parts.append(cell_table(report.cells, [program.name for program in report.plan.programs]))
        parts.append("\n".join(_footnotes(report)))
    if any(figures.passes for figures in report.cells):
        parts.append(pass_table(report.cells))
    if report.interrupted:
        rounds = max((len(figures.seconds) for figures in report.cells), default=0)
        parts.append(f"interrupted: {rounds} of {report.plan.rounds} rounds were begun")
    return "\n\n".join(parts)


def header(report: Report) -> str:
    """Rules, worlds, versions and machine, and a warning if other processes were running."""
    plan, machine = report.plan, report.machine
    threads = sorted({cell.threads for cell in plan.cells})
    lines = [
        f"{plan.ruleset.name}, worlds of {plan.workload}: {WORKLOADS[plan.workload]}",
        f"powderdsl {machine.powderdsl}, torch {machine.torch}, Python {machine.python}, "
        f"C++: {machine.compiler}",
        f"{machine.processor}, {machine.cpus} CPUs, {machine.system}, device {machine.device}",
        f"threads: {', '.join(map(str, threads))} (torch is held to as many)",
    ]
    if machine.load is not None:
        after = "" if report.load_after is None else f", after it {report.load_after:.1f}"
        lines.append(f"load average before: {machine.load:.1f}{after}")
    if machine.busy:
        lines.append(
            f"warning: others are at work on these {machine.cpus} CPUs: "
            "compare figures within this table only"
        )
    return "\n".join(lines)


def cell_table(cells: Sequence[CellFigures], programs: Sequence[str] = ()) -> str:
    """One line per cell. Elements and threads have columns only if cells differ in them.

    Each of `programs` has a column: the processor time of a cell divided by the program's for the same worlds.
    """
    columns: list[tuple[str, Callable[[CellFigures], str]]] = [
        ("backend", lambda one: one.cell.backend),
        ("batch", lambda one: f"{one.cell.batch:,}"),
        ("size", lambda one: f"{one.cell.size[0]}×{one.cell.size[1]}"),
    ]
    if len({one.cell.elements for one in cells}) > 1:
        columns.append(("elements", lambda one: str(len(one.cell.elements))))
    if len({one.cell.threads for one in cells}) > 1:
        columns.append(("threads", lambda one: str(one.cell.threads)))
    columns += [
        ("world-steps/s", lambda one: number(one.rate.median)),
        ("slowest..fastest", lambda one: f"{number(one.rate.min)}..{number(one.rate.max)}"),
        ("cells/s", lambda one: number(one.rate.median * one.cell.world_cells)),
        ("µs/world-step", lambda one: number(one.world_step_seconds.median * 1e6)),
        ("ns/cell", lambda one: number(one.world_step_seconds.median * 1e9 / one.cell.world_cells)),
        ("CPUs", lambda one: f"{one.processors:.2f}"),
        ("to first step", lambda one: f"{one.to_first_step:.2f} s"),
        ("memory", _memory),
        ("state", lambda one: f"{one.state_bytes / one.cell.cells:.3g} B/cell"),
        *((f"÷ {name}", partial(_times, cells, name)) for name in programs),
    ]
    rows = [[name for name, _ in columns], *([show(one) for _, show in columns] for one in cells)]
    return "\n".join(table(rows, indent=""))


def ratio(figures: CellFigures, cells: Iterable[CellFigures], backend: str) -> float | None:
    """The median processor time of a cell divided by that of a backend or program for the same worlds."""
    other = replace(figures.cell, backend=backend)
    for one in cells:
        if one.cell == other and (spent := one.processor_step_seconds.median):
            return figures.processor_step_seconds.median / spent
    return None


def _times(cells: Sequence[CellFigures], backend: str, figures: CellFigures) -> str:
    times = ratio(figures, cells, backend)
    if times is None:
        return "?"
    return number(times) if times >= 0.1 else f"1/{number(1 / times)}"


def pass_table(cells: Sequence[CellFigures]) -> str:
    """µs a world and step of each pass, and its share, for each cell that was profiled."""
    profiled = [figures for figures in cells if figures.passes]
    rows = [["µs/world-step", *(label(figures.cell, profiled) for figures in profiled)]]
    shares = [pass_shares(figures) for figures in profiled]
    for i, (name, _, _) in enumerate(shares[0]):
        rows.append([name, *(f"{number(one[i][1] * 1e6)} {one[i][2]:4.0%}" for one in shares)])
    totals = [sum(spent for _, spent, _ in one) for one in shares]
    rows.append(["all passes", *(f"{number(total * 1e6)}     " for total in totals)])
    whole = [figures.world_step_seconds.median for figures in profiled]
    rows.append(["whole step", *(f"{number(seconds * 1e6)}     " for seconds in whole)])
    busy = [figures.processor_step_seconds.median for figures in profiled]
    rows.append(["of that, processor time", *(f"{number(seconds * 1e6)}     " for seconds in busy)])
    return "\n".join(table(rows, indent=""))


def label(cell: Cell, among: Sequence[CellFigures]) -> str:
    """A short name of a cell: what distinguishes it from the others."""
    words = [cell.backend, f"{cell.batch}"]
    if len({one.cell.size for one in among}) > 1:
        words.append(f"{cell.size[0]}×{cell.size[1]}")
    return " ".join([*words, *extra_words(cell, among)])


def number(value: float) -> str:
    """Three significant digits: 0.0123, 1.23, 12.3, 1,234, 12.3 million as 12.3M."""
    if value >= 1e9:
        return f"{value / 1e9:.3g}G"
    if value >= 1e6:
        return f"{value / 1e6:.3g}M"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _memory(figures: CellFigures) -> str:
    growth = figures.memory.growth
    if growth is None:
        return "?"
    return f"{growth / MEGABYTE:.1f} MiB, {growth / figures.cell.cells:.0f} B/cell"


def _footnotes(report: Report) -> list[str]:
    plan = report.plan
    steps = sorted({figures.steps for figures in report.cells})
    shown = str(steps[0]) if len(steps) == 1 else f"{steps[0]} to {steps[-1]}"
    notes = [
        f"medians of {plan.rounds} interleaved rounds; a call makes {shown} steps, always from the same worlds",
        "CPUs: processor time by time; less than the threads means that others were at work",
        "to first step: compiling, which all lines of a backend share, and the first step",
        "state: the worlds' tensors, which are there before memory is measured",
    ]
    hows = dict.fromkeys(figures.memory.how for figures in report.cells)
    if plan.programs:
        notes.append("÷: processor time divided by that of another program, from the same worlds")
    return [*notes, *(f"memory: {how}" for how in hows)]
