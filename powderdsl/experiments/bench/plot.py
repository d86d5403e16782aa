"""The scaling figure: world-steps a second against the batch, and time per cell against the size of worlds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from powderdsl.experiments.bench.report import CellFigures, Report, extra_words
from powderdsl.system.writing import failure, replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def require_matplotlib() -> None:
    """Raise CompileError (PD612) if matplotlib is not installed: before long work, not after it."""
    if find_spec("matplotlib") is None:
        raise failure(
            "PD612",
            "drawing a plot needs matplotlib, which is not installed",
            helps=("pip install 'powderdsl[plot]'", "or write the figures with --json"),
        )


def write_plot(path: Path, report: Report) -> None:
    """Draw a report as a picture (PNG, or what else the suffix says that matplotlib can write).

    The left figure is the paper's: world-steps a second against the batch, both logarithmic (Frans & Isola 2023).
    The right one, drawn for worlds of several sizes, shows nanoseconds a cell and step. Bars reach from the slowest
    round to the fastest. Raises CompileError: PD612 without matplotlib, PD613 if the file cannot be written.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    several = len({one.cell.world_cells for one in report.cells}) > 1
    figure = Figure(figsize=(11 if several else 6.5, 4.5), layout="constrained")
    axes = figure.subplots(1, 2 if several else 1, squeeze=False)[0]
    _scaling(axes[0], report.cells)
    if several:
        _time_a_cell(axes[1], report.cells)
    figure.suptitle(
        f"{report.plan.ruleset.name}, {report.plan.workload}: {report.machine.processor}", fontsize=9
    )
    with replacing(path, follow=True) as temporary:
        figure.savefig(temporary, dpi=150)


def _scaling(axes: Axes, cells: Sequence[CellFigures]) -> None:
    lines = _lines(cells, lambda one: f"{one.cell.size[0]}×{one.cell.size[1]}")
    for name, members in lines.items():
        members = sorted(members, key=lambda one: one.cell.batch)
        rates = [one.rate for one in members]
        below = [rate.median - rate.min for rate in rates]
        above = [rate.max - rate.median for rate in rates]
        batches = [one.cell.batch for one in members]
        axes.errorbar(
            batches, [rate.median for rate in rates], [below, above], label=name, marker="o", capsize=3
        )
    axes.set_xscale("log", base=2)
    batches = sorted({one.cell.batch for one in cells})
    axes.set_xticks(batches, [f"{batch:,}" for batch in batches], minor=False)
    _finish(axes, "worlds in a batch", "world-steps a second", len(lines))


def _time_a_cell(axes: Axes, cells: Sequence[CellFigures]) -> None:
    lines = _lines(cells, lambda one: f"batch {one.cell.batch}")
    for name, members in lines.items():
        members = sorted(members, key=lambda one: one.cell.world_cells)
        times = [one.world_step_seconds.median * 1e9 / one.cell.world_cells for one in members]
        axes.plot([one.cell.world_cells for one in members], times, label=name, marker="o")
    axes.set_xscale("log", base=2)
    sizes = {one.cell.world_cells: f"{one.cell.size[0]}×{one.cell.size[1]}" for one in cells}
    axes.set_xticks(list(sizes), list(sizes.values()), minor=False)
    _finish(axes, "cells of a world", "nanoseconds a cell and step", len(lines))


def _lines(
    cells: Sequence[CellFigures], besides: Callable[[CellFigures], str]
) -> dict[str, list[CellFigures]]:
    """The cells by line: backend, `besides`, and whatever else differs."""
    lines: dict[str, list[CellFigures]] = {}
    for one in cells:
        words = [one.cell.backend, besides(one), *extra_words(one.cell, cells)]
        lines.setdefault(", ".join(words), []).append(one)
    return lines


def _finish(axes: Axes, across: str, up: str, lines: int) -> None:
    options: dict[str, Any] = {"which": "both", "linewidth": 0.3}
    axes.set_yscale("log")
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.grid(**options)
    if lines:
        axes.legend(fontsize=8)
