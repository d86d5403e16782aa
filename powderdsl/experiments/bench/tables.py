"""A report as text: what it was measured on, a table of cells, a table of passes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from powderdsl.experiments.bench.figures import CellFigures, Report, extra_words, pass_shares
from powderdsl.experiments.bench.plan import WORKLOADS, Cell

MEGABYTE = 1 << 20


def report_text(report: Report) -> str:
    """The whole report, without a newline at its end."""
    parts = [header(report)]
    if report.cells:
        parts.append(cell_table(report.cells))
        parts.append("\n".join(_footnotes(report)))
    if any(figures.passes for figures in report.cells):
        parts.append(pass_table(report.cells))
    if report.interrupted:
        rounds = max((len(figures.seconds) for figures in report.cells), default=0)
        parts.append(f"interrupted: {rounds} of {report.plan.rounds} rounds were begun")
    return "\n\n".join(parts)


def header(report: Report) -> str:
    """Rules, worlds, versions and machine, and a warning if others were at work."""
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


def cell_table(cells: Sequence[CellFigures]) -> str:
    """One line a cell. What is the same for all cells and not asked for by most stands in no column."""
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
    ]
    return aligned([[name for name, _ in columns], *([show(one) for _, show in columns] for one in cells)])


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
    return aligned(rows)


def label(cell: Cell, among: Sequence[CellFigures]) -> str:
    """A cell in few words: what tells it from the others."""
    words = [cell.backend, f"{cell.batch}"]
    if len({one.cell.size for one in among}) > 1:
        words.append(f"{cell.size[0]}×{cell.size[1]}")
    return " ".join([*words, *extra_words(cell, among)])


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Columns of equal width, the first to the left, the others to the right; a blank pair between two."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for first, *others in rows:
        to_right = [text.rjust(width) for text, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join([first.ljust(widths[0]), *to_right]).rstrip())
    return "\n".join(lines)


def number(value: float) -> str:
    """Three figures that say something: 0.0123, 1.23, 12.3, 1,234, 12.3 million as 12.3M."""
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
    return [*notes, *(f"memory: {how}" for how in hows)]
