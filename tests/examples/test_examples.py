"""The scripts under examples/ learn something that can be checked, and the notebook runs from top to bottom."""

from __future__ import annotations

import csv
import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from powderdsl.datasets import record
from powderdsl.ogbench.collect import collect
from powderdsl.ogbench.episodes import LevelProgram
from powderdsl.ogbench.levels import find_level

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
SCRIPTS = sorted(path.stem for path in EXAMPLES.glob("*.py"))

DIG = """
task: dig
rules: core+sand
size: [16, 16]
fill: empty
generate:
  - square sand at (4..11, 4..11) half 2
  - frame wall
agent: {may: [empty, nothing], bins: 4, brush: 4, actions: 4, steps_per_action: 1}
reward: {each: change(0 - count(sand)) / 10}
end: {success: count(sand) < 1}
expert:
  - {choose: empty, at: most(sand)}
splits:
  test:
    generate:
      - square sand at (4..11, 4..11) half 3
      - frame wall
"""
"""An episode ends early if all sand is gone. Random actions dig up less than half as much as the expert's."""


@pytest.fixture
def task(folder: Path) -> Path:
    """The file of a tiny task, in an empty working directory."""
    path = folder / "dig.yaml"
    path.write_text(DIG, encoding="utf-8")
    return path


def script(name: str) -> Callable[[list[str]], dict[str, float]]:
    """The main function of a script."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    main: Callable[[list[str]], dict[str, float]] = module.main
    return main


def rows_of(path: Path) -> list[dict[str, float]]:
    with open(path, newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def common(task: Path, out: Path) -> list[str]:
    return ["--task", str(task), "--backend", "wasm", "--worlds", "32", "--out", str(out)]


def test_behavior_cloning_imitates_on_worlds_it_has_not_seen(
    torch: Any, task: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(str(task), "expert", "data", episodes=150, backend="wasm")
    out = tmp_path / "curve.csv"
    options = ["--data", "data", "--updates", "150", "--every", "50", "--lr", "0.005"]
    found = script("behavior_cloning")([*common(task, out), *options])
    assert found["held_out_accuracy"] > 0.7
    assert found["clone"] > found["random"] + 0.8 * (found["expert"] - found["random"])
    curve = rows_of(out)
    assert [row["update"] for row in curve] == [50, 100, 150]
    assert curve[-1]["held_out_loss"] < curve[0]["held_out_loss"]
    printed = capsys.readouterr().out
    assert "(32 worlds, split test)" in printed
    assert f"{found['clone']:.2f}" in printed


@pytest.mark.slow
def test_ppo_rises_above_random_play(torch: Any, task: Path, tmp_path: Path) -> None:
    out = tmp_path / "curve.csv"
    options = ["--steps", "6000", "--envs", "16", "--rollout", "16", "--batch", "64", "--lr", "0.003"]
    found = script("ppo")([*common(task, out), *options])
    assert found["ppo"] > found["random"] + 0.5 * (found["expert"] - found["random"])
    curve = rows_of(out)
    assert len(curve) == 6000 // 256
    assert curve[-1]["interactions"] == 6000 // 256 * 256
    assert curve[-1]["return"] > curve[0]["return"]


@pytest.mark.slow
def test_iql_plays_better_than_its_data(torch: Any, task: Path, tmp_path: Path) -> None:
    record(str(task), "random", "random", episodes=200, backend="wasm")
    record(str(task), "expert", "expert", episodes=20, backend="wasm")
    out = tmp_path / "curve.csv"
    options = ["--data", "random", "expert", "--updates", "250", "--lr", "0.003"]
    found = script("iql")([*common(task, out), *options])
    assert found["iql"] > found["data"] + 0.4 * (found["expert"] - found["data"])
    assert rows_of(out)[-1]["update"] == 250


def test_an_agent_with_a_memory_learns_and_continues(torch: Any, task: Path, tmp_path: Path) -> None:
    pytest.importorskip("sb3_contrib", reason="needs sb3-contrib")
    options = [
        "--task",
        str(task),
        "--backend",
        "wasm",
        "--worlds",
        "32",
        "--out",
        str(tmp_path / "runs.json"),
    ]
    returns = script("recurrent_ppo")([*options, "--steps", "4096"])
    assert returns["test"] > 0
    (name,) = json.loads((tmp_path / "runs.json").read_text())
    assert name.endswith("steps=4096,seed=0")
    assert script("recurrent_ppo")([*options, "--steps", "4096"]) == returns


@pytest.mark.slow
def test_goals_help_to_predict_actions(torch: Any, tmp_path: Path) -> None:
    level = find_level("easy")
    collect(LevelProgram(level, backend="wasm"), tmp_path, episodes=2, validation=1)
    out = tmp_path / "curve.csv"
    options = ["--data", str(tmp_path), "--backend", "wasm", "--out", str(out), "--episodes", "1"]
    sizes = "--steps 30 --updates 120 --every 60 --batch 64 --width 16 --lr 0.003"
    found = script("ogbench_gcbc")([*options, *sizes.split()])
    assert found["random"] == 0
    assert 0 <= found["cloned"] <= 1
    curve = rows_of(out)
    assert [row["update"] for row in curve] == [60, 120]
    assert curve[-1]["held_out_loss"] < 1.9  # of the frequencies of actions alone it would be 1.94


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom(torch: Any, capsys: pytest.CaptureFixture[str]) -> None:
    notebook = json.loads((EXAMPLES / "tour.ipynb").read_text(encoding="utf-8"))
    cells = [one for one in notebook["cells"] if one["cell_type"] == "code"]
    namespace: dict[str, Any] = {"__name__": "notebook"}
    for cell in cells:
        exec(compile("".join(cell["source"]), f"tour.ipynb, {cell['id']}", "exec"), namespace)
    scores = {name: float(returns.mean()) for name, returns in namespace["scores"].items()}
    assert scores["clone"] > scores["random"] + 0.8 * (scores["expert"] - scores["random"])
    assert "error[PD301]: unknown name `watr`" in capsys.readouterr().out


def test_the_notebook_is_stored_with_its_outputs() -> None:
    """Readers on GitHub see the pictures and the returns without running it."""
    notebook = json.loads((EXAMPLES / "tour.ipynb").read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    assert any("expert:" in "".join(output.get("text", "")) for output in outputs)


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_are_short_and_explain_themselves(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Short enough for one sitting, and `--help` names what the script does."""
    text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) < 250
    with pytest.raises(SystemExit) as caught:
        script(name)(["--help"])
    assert caught.value.code == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert text.removeprefix('"""').partition("\n")[0] in printed
    assert "--seed" in printed
