"""Training: what is learned, that kills change nothing, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest
import torch
from torch import Tensor, nn

from powderdsl.experiments.runs import RunFolder
from powderdsl.worldmodel import (
    DataConfig,
    Machine,
    TaskWorlds,
    TrainConfig,
    evaluate,
    finetuned,
    load_trained,
    pairs_of,
    train,
)
from powderdsl.worldmodel.config import TEST_SEEDS
from powderdsl.worldmodel.evaluation import unseen_worlds
from powderdsl.worldmodel.worlds import VALIDATION_SEEDS, VALIDATION_WORLDS, validation_pairs
from tests.refusals import refusal, refused_codes

HERE = Machine(backend="torch")


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def tiny(task: str, **changes: object) -> TrainConfig:
    data = DataConfig(task=task, states=500, steps=2, pairs=4, capacity=64, refresh=3)
    config = TrainConfig(data, width=4, iterations=30, batch=4, learning_rate=0.005, seed=3)
    return replace(config, **changes)  # type: ignore[arg-type]


def few(config: TrainConfig) -> TrainConfig:
    """On worlds that all fit into the buffer: no time goes into making others."""
    return replace(config, data=replace(config.data, states=60, capacity=240))


def weights(run: RunFolder) -> dict[str, Tensor]:
    found: dict[str, Tensor] = run.checkpoint().state["model"]
    return found


@pytest.mark.slow
def test_a_network_learns_what_baselines_cannot_know(garden: str, tmp_path: Path) -> None:
    config = few(tiny(garden, width=6, iterations=250, batch=8))
    trained = load_trained(train(config, tmp_path / "run", machine=HERE))
    tested = evaluate(trained, split="train", worlds=8, machine=HERE)
    (scores,) = tested.scores.values()
    losses = {name: one.loss for name, one in scores.items()}
    assert losses["model"] < 0.3 * min(losses["nothing changes"], losses["most frequent outcome"]), losses
    assert (scores["model"].plain()["changed_accuracy"] or 0) > 0.9


def test_validation_worlds_are_held_out(dunes: str) -> None:
    data = tiny(dunes).data
    worlds = TaskWorlds(data, backend="torch")
    with mock.patch.object(worlds, "start", wraps=worlds.start) as start:
        pairs = validation_pairs(worlds, data)
    seeds = [seed for call in start.call_args_list for seed in call.args[0].tolist()]
    assert len(set(seeds)) == VALIDATION_WORLDS == sum(len(starts) for starts, _ in pairs)
    assert min(seeds) > TEST_SEEDS + (1 << 20)  # tests have at most that many worlds
    # World n gives pair n mod 4 of its future.
    whole = list(pairs_of(worlds, VALIDATION_SEEDS + torch.arange(VALIDATION_WORLDS), data.steps, data.pairs))
    for moment, (starts, ends) in enumerate(pairs):
        assert torch.equal(starts, whole[moment][0][moment::4])
        assert torch.equal(ends, whole[moment][1][moment::4])


def test_another_configuration_or_task_file_is_another_run(dunes: str, tmp_path: Path) -> None:
    config = tiny(dunes, iterations=1)
    train(config, tmp_path / "run", machine=HERE)
    assert refused_codes(train, replace(config, width=5), tmp_path / "run", machine=HERE) == ["PD621"]
    path = Path(dunes)
    path.write_text(path.read_text(encoding="utf-8").replace("half 1..4", "half 1..5"), encoding="utf-8")
    (found,) = refusal(train, config, tmp_path / "run", machine=HERE)
    assert found.code == "PD621"
    assert "`worlds`" in found.notes[0]


class Own(nn.Module):
    """Somebody's network."""

    def __init__(self, slots: int):
        super().__init__()
        self.table = nn.Embedding(256, slots)
        nn.init.zeros_(self.table.weight)  # not the state of torch's generator after other tests

    def forward(self, ids: Tensor) -> Tensor:
        found: Tensor = self.table(ids.long()).permute(0, 3, 1, 2)
        return found


def test_other_networks_are_trained_and_tested_too(dunes: str, tmp_path: Path) -> None:
    config = few(tiny(dunes, iterations=100, learning_rate=0.05))
    run = train(config, tmp_path / "run", machine=HERE, network=Own(10))
    tested = evaluate(load_trained(run, network=Own(10)), split="train", worlds=8, machine=HERE)
    # A table of elements can learn one thing: each one's most frequent outcome.
    assert tested.mean("model") == pytest.approx(tested.mean("most frequent outcome"), rel=0.25)
    with pytest.raises(ValueError, match=r"logits \[4, 10, 14, 18\], found \[4, 9, 14, 18\]"):
        train(config, tmp_path / "other", machine=HERE, network=Own(9))
    errors = refusal(load_trained, run)
    assert errors[0].code == "PD623"
    assert "its weights belong to another network" in errors[0].notes[0]


@pytest.mark.slow
def test_held_out_packs_are_plugged_in(dunes: str, tmp_path: Path) -> None:
    config = few(tiny(dunes, iterations=40))
    config = replace(config, data=replace(config.data, rules="core+sand+water", knobs={"kinds": 1}))
    trained = load_trained(train(config, tmp_path / "run", machine=HERE))
    assert trained.palette[9] == "stone.stone"
    tuned = finetuned(trained, ["stone"], iterations=60)
    assert (tuned.data.rules, tuned.data.only, tuned.data.knobs) == ("core+sand+water+stone", ("stone",), {})
    assert tuned.parent == trained.checkpoint.path.name
    parent = trained.checkpoint
    run = train(tuned, tmp_path / "tuned", machine=HERE, parent=parent)
    before = evaluate(trained, split="train", rules=tuned.data.rules, only=("stone",), knobs={}, machine=HERE)
    after = evaluate(load_trained(run), split="train", machine=HERE)
    assert (before.rules, before.only) == (after.rules, after.only)
    assert after.mean("nothing changes") == pytest.approx(before.mean("nothing changes"), rel=0.5)
    assert after.mean("model") < before.mean("model")
    assert "stone.stone" in after.plain()["elements"]
    assert "sand.sand" not in {name for name, one in after.plain()["elements"].items() if one["cells"]}
    # The parent's weights are where it began.
    again = train(
        replace(tuned, iterations=1, learning_rate=1e-12), tmp_path / "still", machine=HERE, parent=parent
    )
    assert all(torch.allclose(weights(again)[n], w, atol=1e-9) for n, w in weights(trained.run).items())


def test_stands_are_tested_one_by_one(dunes: str, tmp_path: Path) -> None:
    trained = load_trained(train(tiny(dunes, iterations=2), tmp_path / "run", machine=HERE))
    tested = evaluate(trained, split="two", worlds=3, machine=HERE)
    assert list(tested.scores) == ["falling", "lying"]
    assert all(one["model"].cells == 3 * 4 * 14 * 18 for one in tested.scores.values())
    plain = json.loads(json.dumps(tested.plain()))
    losses = [plain["tests"][name]["model"]["loss"] for name in ("falling", "lying")]
    assert plain["mean"]["model"]["loss"] == pytest.approx(sum(losses) / 2)
    without = evaluate(trained, split="two", rules="core+sand+water", worlds=1, machine=HERE)
    assert list(without.scores) == ["falling"]
    assert without.plain()["left_out"] == {"lying": ["stone"]}


def test_other_elements_get_free_slots_and_are_refused_where_none_are_left(
    dunes: str, garden: str, tmp_path: Path
) -> None:
    trained = load_trained(train(tiny(dunes, iterations=1), tmp_path / "run", machine=HERE))
    assert [number for number, name in enumerate(trained.palette) if name is None] == [4, 5, 7, 8]
    moss = Path(garden).with_name("moss.yaml")
    moss.write_text(moss.read_text(encoding="utf-8").replace("id: 5", "id: 2"), encoding="utf-8")
    found = unseen_worlds(trained, split="train", rules=f"core+{moss}", machine=HERE)
    assert found.rules.element("moss.moss").id == 4  # 2 is another's in this network
    errors = refusal(evaluate, trained, split="train", rules="core+lava+cloner+fire", machine=HERE)
    assert errors[0].code == "PD623"
    assert errors[0].notes == ("there is no free slot for `fire.dust`: the network has 10",)
    assert "--slots 11" in errors[0].helps[0]


def test_damaged_runs_are_refused(dunes: str, tmp_path: Path) -> None:
    run = train(tiny(dunes, iterations=1), tmp_path / "run", machine=HERE)
    (path,) = (run.path / "checkpoints").glob("*.safetensors")
    data = path.read_bytes()
    path.write_bytes(data[:-20])
    assert refused_codes(load_trained, run.path) == ["PD620"]
    path.write_bytes(data)
    about = json.loads((run.path / "run.json").read_text())
    for code, change in (
        ("PD623", {"width": 8}),
        ("PD623", {"palette": ["a", "b"]}),
        ("PD620", {"width": "wide"}),
        ("PD620", {"data": 3}),
        ("PD620", {"palette": 1}),
        ("PD620", {"width": 10**9}),
    ):
        (run.path / "run.json").write_text(json.dumps({**about, "config": {**about["config"], **change}}))
        assert refused_codes(load_trained, run.path) == [code]
    assert refused_codes(load_trained, tmp_path / "nowhere") == ["PD620"]


def test_a_loss_that_is_no_number_ends_a_run(dunes: str, tmp_path: Path) -> None:
    assert refused_codes(train, tiny(dunes, learning_rate=1e30), tmp_path / "run", machine=HERE) == ["PD624"]
