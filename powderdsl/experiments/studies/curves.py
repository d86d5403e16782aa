"""Learning curves: a number of runs that differ only in their seed, against what they have learned from."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from powderdsl.experiments.runs import RunFolder
from powderdsl.experiments.runs.intervals import mean_and_interval
from powderdsl.experiments.runs.metrics import read_metrics
from powderdsl.experiments.studies.results import interval, markdown
from powderdsl.system.packages import require_matplotlib
from powderdsl.system.reading import read_json
from powderdsl.system.writing import replacing

BASELINES = ("expert", "random", "nothing")
EVALUATION = "evaluation.json"


@dataclass(frozen=True)
class Curve:
    """A metric of runs that differ only in their seed. `values` has those of each run, in the order of `seeds`."""

    label: str
    seeds: tuple[int, ...]
    steps: tuple[int, ...]
    values: tuple[tuple[float, ...], ...]


def curves_of(runs: Sequence[RunFolder], metric: str) -> list[Curve]:
    """A curve for each group of runs that differ only in their seed, at the steps that all of a group have.

    A label names the settings in which the groups differ. Runs without the metric are left out.
    """
    groups: dict[str, list[RunFolder]] = {}
    for run in runs:
        key = json.dumps(
            {name: value for name, value in run.config.items() if name != "seed"}, sort_keys=True
        )
        groups.setdefault(key, []).append(run)
    settings = [json.loads(key) for key in groups]
    names = sorted({name for one in settings for name in one})
    differ = [name for name in names if len({json.dumps(one.get(name)) for one in settings}) > 1]
    found = []
    for one, members in zip(settings, groups.values(), strict=True):
        lines = {
            int(run.config.get("seed", 0)): {
                line["step"]: line[metric] for line in read_metrics(run.path) if metric in line
            }
            for run in members
        }
        lines = {seed: line for seed, line in lines.items() if line}
        if lines:
            steps = tuple(sorted(set.intersection(*(set(line) for line in lines.values()))))
            values = tuple(tuple(line[step] for step in steps) for line in lines.values())
            found.append(Curve(_label(one, differ), tuple(lines), steps, values))
    return found


def _label(config: Mapping[str, Any], differ: Sequence[str]) -> str:
    shown = [
        name for name in differ if not name.endswith("fingerprint") and name not in ("palette", "channels")
    ]
    words = []
    for name in shown:
        value = config.get(name)
        if value is None:  # settings at their defaults are not recorded
            continue
        words.append(f"{name} {Path(value).name if isinstance(value, str) and '/' in value else value}")
    return ", ".join(words)


def baselines_of(runs: Sequence[RunFolder]) -> dict[str, float]:
    """The mean returns of policies that need no training, in the held-out worlds: from the first run that was evaluated."""
    for run in runs:
        found = read_json(run.path / EVALUATION)
        split = (run.read_json("asked.json") or {}).get("eval_split", "test")
        scores = found.get("splits", {}).get(split, {}) if isinstance(found, dict) else {}
        lines = {name: scores[name]["mean"] for name in BASELINES if name in scores}
        if lines:
            return lines
    return {}


def as_table(curves: Sequence[Curve]) -> str:
    """The curves as Markdown: the mean over seeds and its 95 % interval at each step."""
    rows = [["runs", "seeds", "steps", "mean", "interval"]]
    for curve in curves:
        for place, step in enumerate(curve.steps):
            mean, half = mean_and_interval([values[place] for values in curve.values])
            words = [curve.label or "all", str(len(curve.seeds)), f"{step:,}", f"{mean:.4g}"]
            rows.append([*words, "" if half is None else f"{half:.2g}"])
    return markdown(rows)


def write_curves(
    path: Path, curves: Sequence[Curve], metric: str, baselines: Mapping[str, float], title: str = ""
) -> None:
    """Draw means with their 95 % intervals over seeds, each seed's own line, and baselines as dashed lines.

    Raises:
        CompileError: PD612 without matplotlib, PD613 if the file cannot be written.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.5, 4.2), layout="constrained")
    axes = figure.subplots()
    for number, curve in enumerate(curves):
        color = f"C{number}"
        found = [interval([one[place] for one in curve.values]) for place in range(len(curve.steps))]
        axes.plot(curve.steps, [one.mean for one in found], color=color, label=curve.label or None)
        if len(curve.seeds) > 1:
            low, high = [one.low for one in found], [one.high for one in found]
            axes.fill_between(curve.steps, low, high, color=color, alpha=0.2, linewidth=0)
            for values in curve.values:
                axes.plot(curve.steps, values, color=color, linewidth=0.5, alpha=0.5)
    for number, (name, value) in enumerate(baselines.items()):
        axes.axhline(value, color=f"{0.2 + 0.25 * number}", linestyle="--", linewidth=1)
        axes.annotate(
            name, (1, value), xycoords=("axes fraction", "data"), fontsize=8, ha="right", va="bottom"
        )
    axes.set_xlabel("interactions" if metric.startswith(("held_out/", "rollout/")) else "steps")
    axes.set_ylabel(metric)
    axes.grid(linewidth=0.3)
    axes.set_title(title, fontsize=8)
    if any(curve.label for curve in curves):
        figure.legend(fontsize=8, loc="outside lower center")
    with replacing(path, follow=True) as temporary:
        figure.savefig(temporary, dpi=150)
