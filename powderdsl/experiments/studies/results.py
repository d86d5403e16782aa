"""Results over seeds: tables, figures and verdicts of studies, and learning curves of runs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from powderdsl.experiments.runs import RunFolder, mean_and_interval, read_metrics
from powderdsl.experiments.studies.run import EVALUATION, Outcome
from powderdsl.experiments.studies.study import Measure, Study
from powderdsl.system.packages import require
from powderdsl.system.reading import read_json
from powderdsl.system.writing import replacing

BASELINES = ("expert", "random", "nothing")
DERIVED = ("fingerprint", "palette", "channels")
"""Suffixes of settings that follow from the task and its rules."""


@dataclass(frozen=True)
class Interval:
    """A mean over seeds, and the ends of its 95 % interval by Student's t: not finite for a single value.

    On the scale ``log``, the mean is geometric, and the ends are equal factors below and above it.
    """

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class Cell:
    """A measure at one combination of values, for each seed and over seeds."""

    values: Mapping[str, str]
    by_seed: Mapping[int, float]
    over_seeds: Interval


@dataclass(frozen=True)
class Finding:
    """A measure at all combinations. `verdicts` say whether it changed as expected along the first setting, a sentence for
    each combination of the others; none if nothing is expected.
    """

    measure: Measure
    cells: tuple[Cell, ...]
    verdicts: tuple[str, ...]

    @property
    def verdict(self) -> str:
        return "; ".join(self.verdicts)


def interval(samples: Sequence[float], scale: str = "linear") -> Interval:
    """Mean and 95 % interval of samples, which are above 0 on the scale ``log``."""
    if scale == "log":
        logs = interval([math.log(sample) for sample in samples])
        return Interval(math.exp(logs.mean), math.exp(logs.low), math.exp(logs.high))
    mean, half = mean_and_interval(samples)
    half = math.inf if half is None else half
    return Interval(mean, mean - half, mean + half)


def findings(study: Study, outcomes: Sequence[Outcome]) -> list[Finding]:
    """The findings from finished points. Combinations are in the order of the values in the file."""
    finished = [outcome for outcome in outcomes if outcome.problem is None]
    finished.sort(key=lambda outcome: outcome.point.seed)
    measured = []
    for measure in study.measures:
        by_values: dict[tuple[tuple[str, str], ...], dict[int, float]] = {}
        for outcome in finished:
            by_seed, value = by_values.setdefault(outcome.point.values, {}), outcome.values[measure.name.text]
            by_seed[outcome.point.seed] = value
        cells = tuple(
            Cell(dict(values), by_seed, interval([*by_seed.values()], measure.scale))
            for values, by_seed in by_values.items()
        )
        verdicts = [_verdict(measure, label, line) for label, line in _lines(cells).items()]
        measured.append(Finding(measure, cells, tuple(filter(None, verdicts))))
    return measured


def _verdict(measure: Measure, label: str, cells: Sequence[Cell]) -> str:
    """A verdict on whether a measure changes along cells as expected; empty if nothing is expected or no seed has both
    ends.

    The last value is compared with the first, seed by seed: by their difference, on the scale ``log`` by their ratio.
    """
    first, last = cells[0].by_seed, cells[-1].by_seed
    both = sorted(first.keys() & last.keys())
    if measure.expect is None or len(cells) < 2 or not both:
        return ""
    log = measure.scale == "log"
    changes = [last[seed] / first[seed] if log else last[seed] - first[seed] for seed in both]
    change, same = interval(changes, measure.scale), 1 if log else 0
    is_expected = change.mean > same if measure.expect == "rises" else change.mean < same
    does = measure.expect if is_expected else f"does not {measure.expect[:-1]}"
    sure = f", but the interval holds {same}" if is_expected and change.low <= same <= change.high else ""
    plus = "+" if not log and change.mean > 0 else ""
    start = f"{label}: " if label else ""
    return f"{start}{does}{sure} (last {'/' if log else '−'} first: {plus}{show_interval(change, measure.scale)})"


def _lines(cells: Sequence[Cell]) -> dict[str, list[Cell]]:
    """The cells of each combination of all settings but the first, labeled with the settings that vary."""
    settings = [*cells[0].values] if cells else []
    varied = [name for name in settings[1:] if len({cell.values[name] for cell in cells}) > 1]
    lines: dict[str, list[Cell]] = {}
    for cell in cells:
        label = ", ".join(f"{name} {cell.values[name]}" for name in varied)
        lines.setdefault(label, []).append(cell)
    return lines


def as_data(study: Study, size: str, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """All results for JSON, without numbers that are not finite."""
    points = [
        {
            "values": dict(outcome.point.values),
            "seed": outcome.point.seed,
            "measures": outcome.values,
            "problem": outcome.problem,
        }
        for outcome in outcomes
    ]
    described = []
    for finding in findings(study, outcomes):
        cells = []
        for cell in finding.cells:
            numbers = asdict(cell.over_seeds)
            finite = {name: number if math.isfinite(number) else None for name, number in numbers.items()}
            cells.append({"values": cell.values, **finite, "samples": [*cell.by_seed.values()]})
        described.append({"measure": finding.measure.name.text, "verdict": finding.verdict, "cells": cells})
    return {"study": study.name, "size": size, "points": points, "findings": described}


def as_markdown(study: Study, size: str, outcomes: Sequence[Outcome]) -> str:
    """A table of means and intervals, and the verdicts."""
    measured = findings(study, outcomes)
    rows = [[*(axis.name for axis in study.axes), *(finding.measure.about for finding in measured), "seeds"]]
    for cells in zip(*(finding.cells for finding in measured), strict=True):
        numbers = [
            show_interval(cell.over_seeds, measure.scale)
            for cell, measure in zip(cells, study.measures, strict=True)
        ]
        rows.append([*cells[0].values.values(), *numbers, str(len(cells[0].by_seed))])
    verdicts = [
        f"- {finding.measure.about}: {verdict}" for finding in measured for verdict in finding.verdicts
    ]
    failed = [f"- {outcome.point.name}: {outcome.problem}" for outcome in outcomes if outcome.problem]
    parts = [f"{study.about} Size: {size}.", markdown(rows).rstrip(), "\n".join(verdicts)]
    parts += ["Not finished:", "\n".join(failed)] if failed else []
    return "\n\n".join(filter(None, parts)) + "\n"


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table as Markdown; the first row has the titles."""
    titles, *others = ("| " + " | ".join(row) + " |" for row in rows)
    return "\n".join([titles, "|" + "---|" * len(rows[0]), *others]) + "\n"


def show_interval(number: Interval, scale: str = "linear") -> str:
    """`0.1234 ± 0.0056`, as many places as the interval deserves; `0.123 (0.118 to 0.129)` on the scale ``log``."""
    half = (number.high - number.low) / 2
    if not math.isfinite(half):
        return f"{number.mean:.4g}"
    if scale == "log":
        mean, low, high = (f"{end:#.3g}".rstrip(".") for end in (number.mean, number.low, number.high))
        return f"{mean} ({low} to {high})"
    places = 4 if half <= 0 else min(max(1 - math.floor(math.log10(half)), 0), 6)
    return f"{number.mean:.{places}f} ± {half:.{places}f}"


@dataclass(frozen=True)
class Line:
    """Samples at several positions along an axis, in the order of seeds. The label may be empty."""

    label: str
    places: Sequence[int]
    samples: Sequence[Sequence[float]]


@dataclass(frozen=True)
class Panel:
    """A part of a figure: lines with 95 % intervals.

    `across` and `up` name the axes, `ticks` the places 0, 1, … unless these are numbers; `baselines` are dashed.
    """

    across: str
    up: str
    lines: Sequence[Line]
    scale: str = "linear"
    ticks: Sequence[str] = ()
    baselines: Mapping[str, float] = field(default_factory=dict)
    title: str = ""


def write_figure(path: Path, study: Study, size: str, outcomes: Sequence[Outcome]) -> None:
    """Draw each measure along the first setting, a line for each combination of the others. Raises as `draw`.

    If several others vary, each value of the one with the most values has a row of panels.
    """
    first, rows, seeds = study.axes[0], [], 0
    ticks = [word.text for word in first.values[size]]
    measured = findings(study, outcomes)
    values: dict[str, dict[str, None]] = {axis.name: {} for axis in study.axes[1:]}
    for cell in (cell for finding in measured for cell in finding.cells):
        for name, seen in values.items():
            seen[cell.values[name]] = None
    varied = [name for name, seen in values.items() if len(seen) > 1]
    split = max(varied, key=lambda name: len(values[name])) if len(varied) > 1 else None
    for value in values[split] if split else [None]:
        panels = []
        for finding in measured:
            lines, own = [], [cell for cell in finding.cells if split is None or cell.values[split] == value]
            for label, cells in _lines(own).items():
                samples = [[*cell.by_seed.values()] for cell in cells]
                lines.append(Line(label, [ticks.index(cell.values[first.name]) for cell in cells], samples))
                seeds = max(seeds, *map(len, samples))
            measure = finding.measure
            panels.append(Panel(first.about, measure.about, lines, measure.scale, ticks, title=value or ""))
        rows.append(panels)
    if seeds:
        draw(path, rows, f"{study.name} ({size}, {seeds} seeds)")


def draw(path: Path, rows: Sequence[Sequence[Panel]], title: str, *, follow: bool = False) -> None:
    """Draw rows of panels, with all samples as dots. The format follows from the suffix of the path.

    `follow`: write to where a link leads. Raises CompileError: PD612 without matplotlib, PD613 if the file cannot be
    written.
    """
    require("matplotlib", "drawing a plot", "pip install 'powderdsl[plot]'")
    from matplotlib.figure import Figure

    columns = len(rows[0])
    height = 4.2 if len(rows) == 1 else 3 * len(rows)
    figure = Figure(figsize=(max(5.5 * columns, 6.5), height), layout="constrained")
    parts = figure.subplots(len(rows), columns, squeeze=False).flat
    for axes, panel in zip(parts, chain.from_iterable(rows), strict=True):
        for line in panel.lines:
            intervals = [interval(samples, panel.scale) for samples in line.samples]
            means = [interval.mean for interval in intervals]
            # A single value has no interval.
            bars = [(i.mean - i.low, i.high - i.mean) if i.high < math.inf else (0, 0) for i in intervals]
            axes.errorbar(
                line.places, means, [*zip(*bars, strict=True)], fmt="o-", capsize=3, label=line.label or None
            )
            for place, samples in zip(line.places, line.samples, strict=True):
                axes.plot([place] * len(samples), samples, "k.", markersize=3, alpha=0.4)
        for name, value in panel.baselines.items():
            axes.axhline(value, color="0.4", linestyle="--", linewidth=1, label=name)
        if panel.ticks:
            axes.set_xticks(range(len(panel.ticks)), panel.ticks)
        if sum(map(len, panel.ticks)) > 40:
            axes.tick_params("x", labelrotation=25)
        axes.set_yscale(panel.scale)
        axes.set_xlabel(panel.across)
        axes.set_ylabel(panel.up)
        axes.set_title(panel.title, fontsize=10)
        axes.grid(linewidth=0.3)
        if axes.get_legend_handles_labels()[1]:
            axes.legend(fontsize=8)
    figure.suptitle(title, fontsize=8, wrap=True)
    with replacing(path, follow=follow) as temporary:
        figure.savefig(temporary, dpi=150)


# Learning curves of runs that differ only in their seed, by training step


def curves_of(runs: Sequence[RunFolder], metric: str) -> list[Line]:
    """A curve for each group of runs that differ only in their seed, at the steps common to the group.

    A label names the settings in which the groups differ. Runs without the metric are left out.
    """
    groups: dict[tuple[tuple[str, str], ...], dict[str, dict[int, float]]] = {}
    for run in runs:
        settings = {name: json.dumps(value) for name, value in run.config.items() if value is not None}
        seed = settings.pop("seed", "")
        lines = [line for line in read_metrics(run.path) if isinstance(line.get(metric), int | float)]
        if lines:
            by_step = {line["step"]: line[metric] for line in lines}
            groups.setdefault(tuple(sorted(settings.items())), {})[seed] = by_step
    shared = set.intersection(*map(set, groups)) if groups else set()
    curves = []
    for group, by_seed in groups.items():
        differ = [
            (name, value.rpartition("/")[2].strip('"'))  # files are shown by their names
            for name, value in group
            if (name, value) not in shared and not name.endswith(DERIVED)
        ]
        steps = sorted(set.intersection(*map(set, by_seed.values())))
        samples = [[by_step[step] for by_step in by_seed.values()] for step in steps]
        label = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in differ)
        curves.append(Line(label, steps, samples))
    return curves


def baselines_of(runs: Sequence[RunFolder]) -> dict[str, float]:
    """The mean returns of untrained policies in the held-out worlds, from the first evaluated run."""
    for run in runs:
        evaluation = read_json(run.path / EVALUATION)
        split = (read_json(run.path / "asked.json") or {}).get("eval_split", "test")
        scores = evaluation.get("splits", {}).get(split, {}) if isinstance(evaluation, dict) else {}
        means = {name: scores[name]["mean"] for name in BASELINES if name in scores}
        if means:
            return means
    return {}


def as_table(curves: Sequence[Line]) -> str:
    """The curves as Markdown: the mean over seeds and its 95 % interval at each step."""
    rows = [["runs", "seeds", "steps", "mean", "interval"]]
    for curve in curves:
        for step, samples in zip(curve.places, curve.samples, strict=True):
            mean, half = mean_and_interval(samples)
            words = [curve.label or "all", str(len(samples)), f"{step:,}", f"{mean:.4g}"]
            rows.append([*words, "" if half is None else f"{half:.2g}"])
    return markdown(rows)


def write_curves(
    path: Path, curves: Sequence[Line], metric: str, baselines: Mapping[str, float], title: str
) -> None:
    """Draw means with their 95 % intervals over seeds, and baselines as dashed lines; losses on a
    logarithmic scale. Raises as `draw`."""
    across = "interactions" if metric.startswith(("held_out/", "rollout/")) else "steps"
    positive = all(min(samples) > 0 for curve in curves for samples in curve.samples)
    scale = "log" if metric.startswith("loss") and positive else "linear"
    draw(path, [[Panel(across, metric, curves, scale, baselines=baselines)]], title, follow=True)
