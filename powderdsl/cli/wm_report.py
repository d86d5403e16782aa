"""What `powderdsl wm` reports: tables of a test, and the curves of a training."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from powderdsl.cli.exits import BadInput
from powderdsl.system.reports import table

if TYPE_CHECKING:
    from powderdsl.experiments.runs import RunFolder
    from powderdsl.worldmodel.evaluation import Tested

CURVES = {"loss/train": "training worlds", "loss/validation": "held-out worlds"}
"""Metrics that are plotted, and their labels."""


def told(tested: Tested, plain: Mapping[str, Any]) -> Iterator[str]:
    """The results of a test as tables. `plain` has them for JSON."""
    predictors = list(plain["mean"])
    yield f"{tested.rules}, {tested.task}/{tested.split}, after {tested.step:,} iterations: loss (accuracy; of cells that change)"
    rows = [["", *predictors]]
    for name, found in {**plain["tests"], "mean": plain["mean"]}.items():
        rows.append([name, *(_figures(found[who]) for who in predictors)])
    yield from ("", *table(rows))
    yield ""
    rows = [["element", "cells", "recall", "precision"]]
    for name, one in plain["elements"].items():
        rows.append([name, f"{one['cells']:,}", _share(one["recall"]), _share(one["precision"])])
    yield from table(rows)
    yield ""
    rows = [["changes, calibration", "recall", "precision", "F1", "ECE", "ECE, changed", "ECE, of change"]]
    for who, one in plain["mean"].items():
        shares = (_share(one[name]) for name in ("changed_accuracy", "change_precision", "change_f1"))
        errors = (_number(one[name]) for name in ("ece", "changed_ece", "change_ece"))
        rows.append([who, *shares, *errors])
    yield from table(rows)
    for name, lacking in plain["left_out"].items():
        yield f"left out: {name}, which needs {', '.join(lacking)}"


def _figures(one: Mapping[str, Any]) -> str:
    return f"{one['loss']:.4f} ({_share(one['accuracy'])}; {_share(one['changed_accuracy'])})"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f} %"


def write_curve(run: RunFolder, out: Path) -> None:
    """Plot the losses of a run against its iterations (PNG, or what else the suffix says).

    Raises:
        BadInput: the run has no losses yet. CompileError: PD612 without matplotlib, PD613 if the file cannot be written.
    """
    from powderdsl.experiments.studies.results import curves_of, write_curves

    curves = [
        replace(curve, label=label) for metric, label in CURVES.items() for curve in curves_of([run], metric)
    ]
    if not curves:
        raise BadInput(f"{run.path} has no losses yet")
    write_curves(out, curves, "loss", {}, run.path.name)
