"""`powderdsl wm` from end to end, on worlds that take no time."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from powderdsl.compiler import load
from tests.cli.commands import powderdsl as run

QUICK = ("--width", 4, "--batch", 4, "--buffer", 32, "--refresh", 2, "--worlds", 100, "--backend", "torch")


def begin(task: str, folder: Path, *more: object) -> tuple[object, ...]:
    return "wm", "train", task, "--run", folder, *QUICK, *more


def test_train_eval_finetune_and_show(dunes: str, tmp_path: Path) -> None:
    folder, tuned = tmp_path / "run", tmp_path / "tuned"
    more = ("--held-out", "stone", "--iterations", 5, "--knob", "squares=2", "--validate-every", 5)
    words = begin(dunes, folder, *more)
    advice = run(*words, exits=0).output.splitlines()[-1]
    about = json.loads((folder / "run.json").read_text())
    assert load(about["config"]["data"]["rules"]).packs == ("core", "sand", "water")
    assert about["config"]["data"]["knobs"] == {"squares": 2}
    assert about["config"]["palette"][9] == "stone.stone"
    assert about["versions"]["torch"]
    assert (folder / "metrics.jsonl").read_text().count("loss/train") == 1
    assert (folder / "metrics.jsonl").read_text().count("loss/validation") == 1

    told = run("wm", "eval", folder, "--split", "two", "--worlds", 1, "--backend", "torch", exits=0)
    assert "falling" in told.stdout
    assert "left out: lying, which needs stone" in told.stdout
    kept = json.loads((folder / "evaluation.json").read_text())
    assert list(kept["tests"]) == ["falling"]

    words = f"wm finetune {folder} --packs stone --iterations 3 --run {tuned} --backend torch"
    run(*words.split(), exits=0)
    about = json.loads((tuned / "run.json").read_text())
    assert about["config"]["data"]["only"] == ["stone"]
    assert about["config"]["parent"] in {path.name for path in (folder / "checkpoints").iterdir()}
    assert about["parent"] == {"path": str(folder), "iterations": 5}
    # The advice of `wm train` works as printed: a task without the split `designed` is tested on that of the training.
    assert advice.split("; ")[1] == f"powderdsl wm eval {folder}"
    found = run("wm", "eval", tuned, "--worlds", 2, "--json", "--backend", "torch", exits=0)
    data = json.loads(found.stdout)
    assert (data["only"], data["iterations"], data["split"]) == (["stone"], 3, "train")
    assert set(data["mean"]) == {"model", "nothing changes", "most frequent outcome"}

    out = tmp_path / "strips.png"
    shown = run(
        "wm", "show", tuned, "--split", "two", "--steps", 16, "--out", out, "--backend", "torch", exits=0
    )
    assert [line.split(":")[0] for line in shown.stdout.splitlines()] == ["1  falling", "2  lying"]
    # Two strips of four pictures of 14×18 cells, four pixels a cell, below titles of 14; four between and around.
    assert np.asarray(Image.open(out)).shape == (2 * (14 + 56 + 4) + 4, 4 * (72 + 4) + 4, 3)


def test_preset_and_options_make_the_configuration(tmp_path: Path, dunes: str) -> None:
    folder = tmp_path / "run"
    given = ("--preset", "paper", "--knob", "kinds=2", "--iterations", 1, "--seed", 5)
    run(*begin(dunes, folder, "--packs", "core,sand", *given), exits=0)
    config = json.loads((folder / "run.json").read_text())["config"]
    assert (config["learning_rate"], config["seed"], config["batch"]) == (0.005, 5, 4)
    assert config["data"]["knobs"] == {"kinds": 2}
    assert load(config["data"]["rules"]).packs == ("core", "sand")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("train", "--packs", "core", "--held-out", "sand"), "cannot be combined"),
        (("train", "--held-out", "snad"), "did you mean `sand`?"),
        (("train", "--rules", "core+snad"), "PD304"),
        (("train", "--knob", "kinds=99"), "the knob `kinds` must lie in 0..4"),
        (("train", "--knob", "lines=2"), "no knob `lines`"),
        (("train", "--iterations", "0"), "`iterations` must be an integer from 1"),
        (("train", "--rulesets", "2"), "has no `rulesets`"),
        (("train", "--device", "cuda:77"), "PD701"),
        (("finetune", "nowhere"), "Missing option '--packs'"),
        (("eval", "nowhere"), "PD620"),
        (("show", "nowhere", "--out", "x.gif"), "must end in .png"),
        (("show", "nowhere", "--out", "no/where.png"), "PD613"),
    ],
)
def test_bad_input_is_said_and_nothing_is_begun(
    words: tuple[str, ...], said: str, dunes: str, folder: Path
) -> None:
    task = (dunes,) if words[0] == "train" else ()
    assert said in run("wm", words[0], *task, *words[1:], exits=2).output
    assert not (folder / "runs").exists()
