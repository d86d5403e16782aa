"""Learning curves: a number of runs that differ only in their seed, against what they have learned from."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from powderdsl.experiments.runs import RunFolder
from powderdsl.experiments.runs.metrics import mean_and_interval, read_metrics
from powderdsl.experiments.studies.results import Line, Panel, draw, markdown
from powderdsl.system.reading import read_json

BASELINES = ("expert", "random", "nothing")
EVALUATION = "evaluation.json"
DERIVED = ("fingerprint", "palette", "channels")
"""Ends of the names of settings that follow from the task and its rules."""


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
    names = sorted({name for config in settings for name in config if not name.endswith(DERIVED)})
    differ = [name for name in names if len({json.dumps(config.get(name)) for config in settings}) > 1]
    curves = []
    for config, members in zip(settings, groups.values(), strict=True):
        lines = {}
        for run in members:
            line = {line["step"]: line[metric] for line in read_metrics(run.path) if metric in line}
            if line:
                lines[int(run.config.get("seed", 0))] = line
        if lines:
            steps = tuple(sorted(set.intersection(*map(set, lines.values()))))
            values = tuple(tuple(line[step] for step in steps) for line in lines.values())
            # Settings at their defaults are not recorded.
            label = ", ".join(
                f"{name} {_shown(config[name])}" for name in differ if config.get(name) is not None
            )
            curves.append(Curve(label, tuple(lines), steps, values))
    return curves


def _shown(value: Any) -> Any:
    return Path(value).name if isinstance(value, str) and "/" in value else value


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
        for step, samples in zip(curve.steps, zip(*curve.values, strict=True), strict=True):
            mean, half = mean_and_interval(samples)
            words = [curve.label or "all", str(len(curve.seeds)), f"{step:,}", f"{mean:.4g}"]
            rows.append([*words, "" if half is None else f"{half:.2g}"])
    return markdown(rows)


def write_curves(
    path: Path, curves: Sequence[Curve], metric: str, baselines: Mapping[str, float], title: str = ""
) -> None:
    """Draw means with their 95 % intervals over seeds, and baselines as dashed lines. Raises as `draw`."""
    lines = [Line(curve.label, curve.steps, [*zip(*curve.values, strict=True)]) for curve in curves]
    across = "interactions" if metric.startswith(("held_out/", "rollout/")) else "steps"
    draw(path, [Panel(across, metric, lines, baselines=baselines)], title, follow=True)
