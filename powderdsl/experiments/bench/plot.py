"""The scaling figure: world-steps a second against the batch."""

from __future__ import annotations

from pathlib import Path
from statistics import median

from powderdsl.experiments.bench.report import CellFigures, Report, label
from powderdsl.system.packages import require
from powderdsl.system.writing import replacing


def require_matplotlib() -> None:
    """Raise CompileError (PD612) if matplotlib is not installed: before long work, not after it."""
    helps = ("pip install 'powderdsl[plot]'", "or write the figures with --json")
    require("matplotlib", "drawing a plot", *helps)


def write_plot(path: Path, report: Report) -> None:
    """Draw a report as a picture (PNG, or what else the suffix says that matplotlib can write).

    It is the paper's figure: world-steps a second against the batch, both logarithmic (Frans & Isola 2023). Bars reach
    from the slowest round to the fastest. Raises CompileError: PD612 without matplotlib, PD613 if the file cannot be
    written.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.5, 4.5), layout="constrained")
    axes = figure.subplots()
    lines: dict[str, list[CellFigures]] = {}
    for figures in sorted(report.cells, key=lambda figures: figures.cell.batch):
        lines.setdefault(label(figures.cell, report.cells), []).append(figures)
    for name, members in lines.items():
        rates = [median(figures.rates) for figures in members]
        below = [rate - figures.rates[0] for rate, figures in zip(rates, members, strict=True)]
        above = [figures.rates[-1] - rate for rate, figures in zip(rates, members, strict=True)]
        batches = [figures.cell.batch for figures in members]
        axes.errorbar(batches, rates, [below, above], label=name, marker="o", capsize=3)
    axes.set_xscale("log", base=2)
    batches = sorted({figures.cell.batch for figures in report.cells})
    axes.set_xticks(batches, [f"{batch:,}" for batch in batches], minor=False)
    axes.set_yscale("log")
    axes.set_xlabel("worlds in a batch")
    axes.set_ylabel("world-steps a second")
    axes.grid(which="both", linewidth=0.3)
    axes.legend(fontsize=8)
    title = f"{report.plan.ruleset.name}, {report.plan.workload}: {report.machine.processor}"
    figure.suptitle(title, fontsize=9)
    with replacing(path, follow=True) as temporary:
        figure.savefig(temporary, dpi=150)
