"""The results of a study: means over seeds with intervals, a table, a figure, and whether expectations held."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from powderdsl.experiments.bench.plot import require_matplotlib
from powderdsl.experiments.studies.run import Outcome
from powderdsl.experiments.studies.study import Measure, Study
from powderdsl.system.writing import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

T_975 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
"""97.5 % quantiles of Student's t for 1 to 10 degrees of freedom."""


@dataclass(frozen=True)
class Interval:
    """A mean over seeds, and the ends of its 95 % interval by Student's t: not finite for a single value.

    On the scale ``log`` the mean is the geometric one, and the ends are as many times smaller and larger.
    """

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class Cell:
    """A measure at one combination: over seeds, and the value of each."""

    values: tuple[tuple[str, str], ...]
    over_seeds: Interval
    samples: tuple[float, ...]


@dataclass(frozen=True)
class Trend:
    """A measure along the first setting, the others fixed, which `label` names. `change` compares the last with the first,
    seed by seed: their difference, on the scale ``log`` their ratio. `agreeing`: in how many seeds it goes as expected,
    and how many have both. `ordered`: all means do."""

    label: str
    change: Interval
    ordered: bool
    agreeing: tuple[int, int]

    def verdict(self, measure: Measure) -> str:
        """A sentence: whether the measure went as expected."""
        sign = 1 if measure.expect == "rises" else -1
        log = measure.scale == "log"
        same = 1.0 if log else 0.0
        plus = "+" if not log and self.change.mean > 0 else ""
        ends = f"last {'/' if log else '−'} first: {plus}{shown(self.change, measure.scale)}"
        label = f"{self.label}: " if self.label else ""
        if sign * (self.change.mean - same) <= 0:
            return f"{label}does not {str(measure.expect)[:-1]} ({ends})"
        sure = f", but the interval holds {same:.0f}" if self.change.low <= same <= self.change.high else ""
        every = "at every point" if self.ordered else "not at every point"
        seeds = "{} of {} seeds".format(*self.agreeing)
        return f"{label}{measure.expect} {every}, in {seeds}{sure} ({ends})"


@dataclass(frozen=True)
class Finding:
    """A measure over all combinations, and its trends, one for each combination of all settings but the first."""

    measure: Measure
    cells: tuple[Cell, ...]
    trends: tuple[Trend, ...]

    @property
    def verdict(self) -> str:
        """Whether the measure went as expected; empty if nothing is expected."""
        return "; ".join(trend.verdict(self.measure) for trend in self.trends)


def interval(samples: Sequence[float], scale: str = "linear") -> Interval:
    """Mean and 95 % interval of samples, which are above 0 on the scale ``log``."""
    if scale == "log":
        found = interval([math.log(sample) for sample in samples])
        return Interval(math.exp(found.mean), math.exp(found.low), math.exp(found.high))
    mean = statistics.fmean(samples)
    if len(samples) < 2:
        return Interval(mean, -math.inf, math.inf)
    quantile = T_975[min(len(samples) - 1, len(T_975)) - 1]  # a little wide for more than 11
    half = quantile * statistics.stdev(samples) / math.sqrt(len(samples))
    return Interval(mean, mean - half, mean + half)


def findings(study: Study, outcomes: Sequence[Outcome]) -> list[Finding]:
    """The findings from finished points. Combinations are in the order in which values were written."""
    good = [one for one in outcomes if one.problem is None]
    return [_finding(measure, good) for measure in study.measures]


def _finding(measure: Measure, outcomes: Sequence[Outcome]) -> Finding:
    groups: dict[tuple[tuple[str, str], ...], dict[int, float]] = {}
    for one in outcomes:
        groups.setdefault(one.point.values, {})[one.point.seed] = one.values[measure.name]
    cells = []
    for values, by_seed in groups.items():
        samples = tuple(value for _, value in sorted(by_seed.items()))
        cells.append(Cell(values, interval(samples, measure.scale), samples))
    trends = []
    for label, line in _lines(cells).items():
        found = _trend(measure, label, line, [groups[cell.values] for cell in line])
        trends += [found] if found else []
    return Finding(measure, tuple(cells), tuple(trends))


def _trend(
    measure: Measure, label: str, cells: Sequence[Cell], by_seed: Sequence[Mapping[int, float]]
) -> Trend | None:
    """How a measure goes along some cells, if that is asked and seeds have both ends."""
    first, last = by_seed[0], by_seed[-1]
    both = sorted(first.keys() & last.keys())
    if measure.expect is None or len(cells) < 2 or not both:
        return None
    sign = 1 if measure.expect == "rises" else -1
    agreeing = sum(sign * (last[seed] - first[seed]) > 0 for seed in both), len(both)
    log = measure.scale == "log"
    change = [last[seed] / first[seed] if log else last[seed] - first[seed] for seed in both]
    means = [sign * cell.over_seeds.mean for cell in cells]
    ordered = all(one < two for one, two in itertools.pairwise(means))
    return Trend(label, interval(change, measure.scale), ordered, agreeing)


def _lines(cells: Sequence[Cell]) -> dict[str, list[Cell]]:
    """The cells of each combination of all settings but the first, labeled with the settings that vary."""
    values: dict[str, set[str]] = {}
    for cell in cells:
        for name, value in cell.values[1:]:
            values.setdefault(name, set()).add(value)
    found: dict[str, list[Cell]] = {}
    for cell in cells:
        label = ", ".join(f"{name} {value}" for name, value in cell.values[1:] if len(values[name]) > 1)
        found.setdefault(label, []).append(cell)
    return found


def as_data(study: Study, size: str, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """All results, for JSON."""
    return {
        "study": study.name,
        "size": size,
        "points": [
            {
                "values": dict(one.point.values),
                "seed": one.point.seed,
                "measures": dict(one.values),
                "problem": one.problem,
            }
            for one in outcomes
        ],
        "findings": [
            {
                "measure": one.measure.name,
                "verdict": one.verdict,
                "cells": [
                    {
                        "values": dict(cell.values),
                        **{key: _finite(value) for key, value in asdict(cell.over_seeds).items()},
                        "samples": cell.samples,
                    }
                    for cell in one.cells
                ],
            }
            for one in findings(study, outcomes)
        ],
    }


def as_markdown(study: Study, size: str, outcomes: Sequence[Outcome]) -> str:
    """A table of means and intervals, and the verdicts."""
    found = findings(study, outcomes)
    names = [axis.name for axis in study.axes]
    head = [*names, *(one.measure.about for one in found), "seeds"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    rows: dict[tuple[tuple[str, str], ...], list[str]] = {}
    counts: dict[tuple[tuple[str, str], ...], int] = {}
    for one in found:
        for cell in one.cells:
            rows.setdefault(cell.values, []).append(shown(cell.over_seeds, one.measure.scale))
            counts[cell.values] = len(cell.samples)
    for values, numbers in rows.items():
        words = [*(value for _, value in values), *numbers, str(counts[values])]
        lines.append("| " + " | ".join(words) + " |")
    verdicts = [
        f"- {one.measure.about}: {trend.verdict(one.measure)}" for one in found for trend in one.trends
    ]
    failed = [f"- {one.point.name}: {one.problem}" for one in outcomes if one.problem]
    text = [f"{study.about} Size: {size}.", "", *lines]
    text += ["", *verdicts] if verdicts else []
    text += ["", "Not finished:", "", *failed] if failed else []
    return "\n".join(text) + "\n"


def shown(found: Interval, scale: str = "linear") -> str:
    """`0.1234 ± 0.0056`, as many places as the interval deserves; `0.123 (0.118 to 0.129)` on the scale ``log``."""
    half = (found.high - found.low) / 2
    if not math.isfinite(half):
        return f"{found.mean:.4g}"
    if scale == "log":
        mean, low, high = (f"{one:#.3g}".rstrip(".") for one in (found.mean, found.low, found.high))
        return f"{mean} ({low} to {high})"
    places = 4 if half <= 0 else min(max(1 - math.floor(math.log10(half)), 0), 6)
    return f"{found.mean:.{places}f} ± {half:.{places}f}"


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


# The figure: each measure along the first setting, a line for each combination of the others


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
    lines = _lines(finding.cells)
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
    above = [number for number in numbers if number > 0]
    if joined and min(numbers) >= 0 and above and max(above) >= 10 * min(above):
        axes.set_xscale("symlog", linthresh=min(above)) if 0 in numbers else axes.set_xscale("log")
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
    """The values as numbers, or None."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return None
