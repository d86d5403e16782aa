"""Learning curves: groups of runs that differ in their seed, at the steps that they share."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from powderdsl.experiments.runs import Metrics, RunFolder, open_run, write_json
from powderdsl.experiments.studies.results import as_table, baselines_of, curves_of
from tests.cli.commands import powderdsl


def written(folder: Path, seed: int, rate: float, lines: dict[int, float]) -> RunFolder:
    run = open_run(folder, "ppo", {"task": "dig", "seed": seed, "learning_rate": rate})
    with Metrics(run.path) as metrics:
        for step, value in lines.items():
            metrics.write(step, {"held_out/return": value})
            metrics.write(step, {"rollout/other": 1.0})
    return run


@pytest.fixture
def runs(tmp_path: Path) -> list[RunFolder]:
    return [
        written(tmp_path / "a0", 0, 0.1, {0: 1.0, 10: 2.0, 20: 4.0}),
        written(tmp_path / "b0", 0, 0.2, {0: 0.0, 10: 1.0}),
        written(tmp_path / "a1", 1, 0.1, {0: 3.0, 10: 4.0}),
    ]


def test_runs_that_differ_in_their_seed_make_one_curve(runs: list[RunFolder]) -> None:
    first, second = curves_of(runs, "held_out/return")
    assert (first.label, first.places, first.samples) == (
        "learning rate 0.1",
        [0, 10],
        [[1.0, 3.0], [2.0, 4.0]],
    )
    assert (second.label, second.places, second.samples) == ("learning rate 0.2", [0, 10], [[0.0], [1.0]])
    assert curves_of(runs, "loss") == []
    row = as_table([first]).splitlines()[2].split(" | ")
    assert row[:4] == ["| learning rate 0.1", "2", "0", "2"]
    # Student's t of two values: 12.706 standard errors, here of √2 / √2.
    assert math.isclose(float(row[4].strip(" |")), 12.706, rel_tol=0.03)


def test_policies_that_need_no_training_are_lines(runs: list[RunFolder]) -> None:
    assert baselines_of(runs) == {}
    scores = {name: {"mean": number} for number, name in enumerate(("nothing", "trained", "expert"))}
    write_json(runs[1].path / "evaluation.json", {"splits": {"test": scores, "train": {}}})
    assert baselines_of(runs) == {"expert": 2, "nothing": 0}


def test_the_command(runs: list[RunFolder], tmp_path: Path) -> None:
    command = ("curves", *(run.path for run in runs))
    assert len(powderdsl(*command, exits=0).output.splitlines()) == 2 + 2 + 2
    picture = tmp_path / "curves.png"
    powderdsl(*command, "--out", picture, exits=0)
    assert picture.read_bytes()[:4] == b"\x89PNG"
    lines = tmp_path / "b0" / "metrics.jsonl"
    lines.write_text(lines.read_text() + '{"step": 30, "held_out/return": "x", "rollout/other": null}\n')
    table = powderdsl("curves", lines.parent, "--metric", "held_out/return,rollout/other", exits=0).output
    assert "| held_out/return | 1 | 10 |" in table
    assert "| rollout/other | 1 | 10 |" in table
    missing = powderdsl(*command, "--metric", "loss", exits=2)
    assert "no run has the metric loss; there are held_out/return, rollout/other" in missing.stderr
    lines.unlink()
    assert "nothing has been written yet" in powderdsl("curves", lines.parent, exits=2).output
    assert json.loads((tmp_path / "a0" / "run.json").read_text())["config"]["task"] == "dig"
