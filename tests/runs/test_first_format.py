"""What was saved before elements had palettes: it loads as it is, and runs continue."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import powderdsl
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.experiments.runs import find_run
from powderdsl.rl import train as train_agent
from powderdsl.rl.policies import config_of, load_policy, recorded_palette, task_of
from powderdsl.worldmodel import Machine, TrainConfig, load_trained, train
from powderdsl.worldmodel.trained import finetuned
from powderdsl.worlds.store import load_world

SAVED = Path(__file__).parent.parent / "data" / "first_format"
TORCH = Machine(backend="torch")


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(SAVED, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)


def test_a_world_finds_its_elements_under_other_ids() -> None:
    sim = powderdsl.compile(powderdsl.load("powderworld", "beetle.yaml"), "torch")
    world = load_world("world.npz", sim)
    with np.load("world.npz", allow_pickle=False) as saved:
        palette = json.loads(str(saved["about"]))["palette"]
        names = np.vectorize(lambda number: palette[str(number)])(saved["slot_element"])
    here = {element.id: element.qualified for element in sim.ruleset.elements}
    assert (np.vectorize(here.get)(world.ids.numpy()) == names).all()
    assert "beetle.beetle" in names


@pytest.mark.parametrize(("name", "slots"), [("wm", 14), ("wm21", 33)])
def test_a_world_model_continues_with_the_slots_that_it_has(name: str, slots: int) -> None:
    trained = load_trained(name)
    assert len(trained.palette) == slots
    config = TrainConfig.of({**trained.run.config, "iterations": 6})
    # The number of iterations is part of what a run is, so the file says the new one too.
    about = json.loads(Path(name, "run.json").read_text())
    about["config"]["iterations"] = 6
    Path(name, "run.json").write_text(json.dumps(about))
    assert load_trained(train(config, name, machine=TORCH)).checkpoint.step == 6
    assert load_trained(name).palette == trained.palette


def test_an_old_world_model_learns_a_new_pack() -> None:
    trained = load_trained("wm")
    config = finetuned(trained, ["beetle.yaml"], iterations=2)
    assert config.palette == (*trained.palette, "beetle.beetle")
    run = train(config, "more", machine=TORCH, parent=trained.checkpoint)
    grown = load_trained(run).network.state_dict()
    assert grown["head.weight"].shape[0] == 15


def test_an_agent_is_read_and_continues() -> None:
    run = find_run("agent")
    assert recorded_palette(run) is None
    env = TensorEnv(task_of(run), 1, observation="ids", backend="torch")
    assert load_policy(run, env).step == 16
    config = config_of(run)
    assert config.packs == ()
    assert train_agent(replace(config, steps=24, backend="torch"), "agent").checkpoint().step == 24
