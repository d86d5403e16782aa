"""The figure of a study: each measure along the first setting, a line for each combination of the others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from powderdsl.experiments.bench.plot import require_matplotlib
from powderdsl.experiments.studies.results import Cell, Finding, findings
from powderdsl.experiments.studies.run import Outcome
from powderdsl.experiments.studies.study import Study
from powderdsl.system.writing import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def write_figure(path: Path, study: Study, size: str, outcomes: Sequence[Outcome]) -> None:
    """Draw what was found (PNG, or what else the suffix says). Bars are 95 % intervals over seeds.

    Raises:
        CompileError: PD612 without matplotlib, PD613 if the file cannot be written.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    found = [one for one in findings(study, outcomes) if one.cells]
    if not found:
        return
    figure = Figure(figsize=(5.5 * len(found), 4.2), layout="constrained")
    for axes, one in zip(figure.subplots(1, len(found), squeeze=False)[0], found, strict=True):
        _draw(axes, study, size, one)
    seeds = max(len(cell.samples) for one in found for cell in one.cells)
    figure.suptitle(f"{study.about} ({size}, {seeds} seeds)", fontsize=8, wrap=True)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _draw(axes: Axes, study: Study, size: str, finding: Finding) -> None:
    from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullLocator

    first = study.axes[0]
    ticks = list(first.values[size])
    numbers = _numbers(ticks)
    joined = "-" if numbers is not None else ""  # between words there is nothing
    numbers = numbers or [float(place) for place in range(len(ticks))]
    lines: dict[str, list[Cell]] = {}
    for cell in finding.cells:
        lines.setdefault(", ".join(f"{name} {value}" for name, value in cell.values[1:]), []).append(cell)
    for label, cells in lines.items():
        across = [numbers[ticks.index(cell.values[0][1])] for cell in cells]
        found = [cell.over_seeds for cell in cells]
        # A single value has no interval.
        bars = [
            (one.mean - one.low, one.high - one.mean) if math.isfinite(one.high) else (0.0, 0.0)
            for one in found
        ]
        axes.errorbar(
            across,
            [one.mean for one in found],
            list(zip(*bars, strict=True)),
            fmt=f"o{joined}",
            capsize=3,
            label=label or None,
        )
        for place, cell in zip(across, cells, strict=True):
            axes.plot([place] * len(cell.samples), cell.samples, "k.", markersize=3, alpha=0.4)
    if min(numbers) > 0 and max(numbers) >= 10 * min(numbers):
        axes.set_xscale("log")
    axes.set_xticks(numbers, ticks, minor=False)
    if not joined and sum(map(len, ticks)) > 40:
        axes.tick_params("x", labelrotation=25)
    axes.xaxis.set_minor_locator(NullLocator())
    if finding.measure.scale == "log":
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        axes.yaxis.set_major_locator(MaxNLocator(6) if high < 5 * low else LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.set_xlabel(first.about)
    axes.set_ylabel(finding.measure.about)
    axes.grid(linewidth=0.3)
    if any(lines):
        axes.legend(fontsize=8)


def _numbers(words: Sequence[str]) -> list[float] | None:
    """Where values stand, if they are numbers."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return None
