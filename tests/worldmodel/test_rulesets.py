"""World models of tasks whose worlds run under different laws."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import powderdsl
from powderdsl.tasks.laws import experiments, tried_pairs
from powderdsl.worldmodel import DataConfig, Machine, TaskWorlds, TrainConfig, evaluate, load_trained, train
from powderdsl.worldmodel.evaluation import ahead, unseen_worlds
from powderdsl.worldmodel.networks import LawChannels
from powderdsl.worldmodel.worlds import inputs_of

LAWS = """
task: drawn
rules: core+water+fire+lava
params: {water.melt: 1%..90%}
rulesets: [core+water+fire+lava, core+water+fire+lava+sand]
size: [14, 18]
fill: empty
generate:
  - disk ice at (7, 9) radius 5
  - disk lava at (3, 9) radius 2
  - frame wall
agent: {may: nothing, actions: 16}
splits:
  test: {rulesets: [core+water+fire+lava+wood?]}
"""
MACHINE = Machine(backend="torch")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A task of two rulesets, and a parameter that each world draws."""
    path = tmp_path_factory.mktemp("laws") / "drawn.yaml"
    path.write_text(LAWS.replace("+wood?", "+plant"), encoding="utf-8")
    return str(path)


def test_every_world_runs_under_its_own_laws(drawn: str) -> None:
    worlds = TaskWorlds(DataConfig(drawn), backend="torch")
    seeds = torch.tensor([5, 0, 1, 3, 2, 4])
    start = worlds.start(seeds)
    end = worlds.later(worlds.later(start, 8), 8)
    assert start.ids.shape == (6, 14, 18)
    rates = set()
    for place, seed in enumerate(seeds.tolist()):
        ((_, episodes),) = worlds.start(torch.tensor([seed])).parts
        rules = "core+water+fire+lava" + ("+sand" if seed % 2 else "")
        rate = float(episodes.params["water.melt"])
        rates.add(rate)
        alone = powderdsl.compile(powderdsl.load(rules), backend="torch")
        world = alone.world(episodes.world.ids, episodes.world.seed, index=episodes.world.index)
        after = alone.step(world, 16, params={"water.melt": rate})
        assert torch.equal(after.ids[0], end.ids[place])
    assert len(rates) == 6


def test_models_are_tested_under_rulesets_that_training_did_not_show(drawn: str, tmp_path: Path) -> None:
    data = DataConfig(drawn, states=12, steps=2, pairs=2, rulesets=1, capacity=24, refresh=1)
    config = TrainConfig(data, width=4, iterations=3, batch=4)
    trained = load_trained(train(config, tmp_path / "run", machine=MACHINE))
    assert trained.config.data == data
    assert unseen_worlds(trained, split="train", machine=MACHINE).config.rulesets == 1
    assert unseen_worlds(trained, split="test", machine=MACHINE).config.rulesets == 0
    near, far = (evaluate(trained, split="test", worlds=4, times=times, machine=MACHINE) for times in (1, 3))
    assert (near.steps, far.steps) == (2, 6)
    assert near.mean("model") != far.mean("model") > 0


def test_a_network_predicts_several_times_its_steps() -> None:
    def rise(ids: torch.Tensor) -> torch.Tensor:
        """Every cell becomes the next of five elements."""
        return torch.nn.functional.one_hot((ids.long() + 1) % 5, 5).permute(0, 3, 1, 2)

    ids = torch.tensor([[[0, 3], [4, 1]]], dtype=torch.uint8)
    assert ahead(rise, 1)(ids).argmax(1).tolist() == [[[1, 4], [0, 2]]]
    assert ahead(rise, 3)(ids).argmax(1).tolist() == [[[3, 1], [2, 4]]]


@pytest.mark.parametrize("store", ["memory", "disk"])
def test_a_model_sees_what_each_element_does_amid_others(drawn: str, tmp_path: Path, store: str) -> None:
    large = tmp_path / "large.yaml"
    large.write_text(
        Path(drawn).read_text(encoding="utf-8").replace("[14, 18]", "[28, 28]"), encoding="utf-8"
    )
    data = DataConfig(str(large), states=12, steps=2, pairs=2, capacity=24, refresh=1, observation="laws")
    config = TrainConfig(data, width=4, iterations=3, batch=4)
    machine = Machine(backend="torch", store=store)
    trained = load_trained(train(config, tmp_path / "run", machine=machine))
    slots = len(trained.palette)
    worlds = unseen_worlds(trained, split="train", machine=machine)
    inputs = inputs_of(worlds.start(torch.arange(4)))
    assert inputs.shape == (4, 2, 28, 28)
    channels = LawChannels(slots)(inputs)
    assert channels.shape == (4, 5 * slots, 28, 28)
    assert torch.equal(channels[:, :slots].argmax(1), inputs[:, 0].long())
    rules = powderdsl.load("core+water+fire+lava", palette=trained.palette)
    outcomes = experiments(rules).view(-1, 4).float() / 127.5 - 1
    for (inner, outer), numbers in zip(tried_pairs(rules).tolist(), outcomes, strict=True):
        cells = (inputs[0, 0] == inner).nonzero()[:1]
        for row, column in cells.tolist():
            first = slots + 4 * outer
            assert torch.allclose(channels[0, first : first + 4, row, column], numbers)
    assert not torch.equal(inputs[0, 1], inputs[1, 1])  # one of them has sand
    near, far = (evaluate(trained, split="test", worlds=4, times=times, machine=MACHINE) for times in (1, 3))
    assert near.mean("model") != far.mean("model") > 0


def test_laws_need_rulesets_and_room(drawn: str) -> None:
    for task, why in (("world-model", "world-model has no `rulesets`"), (drawn, "they need 676 cells")):
        with pytest.raises(powderdsl.CompileError, match=why):
            TaskWorlds(DataConfig(task, observation="laws"), backend="torch")
