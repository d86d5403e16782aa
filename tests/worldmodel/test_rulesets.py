"""Rulesets drawn from a distribution: a number decides each, and every world runs under its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import powderdsl
from powderdsl.worldmodel import DataConfig, Machine, TaskWorlds, TrainConfig, evaluate, load_trained, train
from powderdsl.worldmodel.config import Variety
from powderdsl.worldmodel.evaluation import unseen_worlds
from powderdsl.worldmodel.worlds import UNSEEN_RULESETS, RulesetSource
from tests.refusals import refusal

RULES = "core+sand+water+lava+fire"
MANY = Variety(chances=4.0, swaps=("density",), leave_out=0.3)


def test_a_number_decides_a_ruleset() -> None:
    one, other = RulesetSource(RULES, MANY), RulesetSource(RULES, MANY)
    drawn = [one.draw(number) for number in range(8)]
    assert drawn == [other.draw(number) for number in range(8)]
    assert one.draw(3) == drawn[3]
    assert len(set(drawn)) == 8
    base = RulesetSource(RULES, Variety())
    plain = base.draw(7)
    assert (plain.left_out, plain.swapped, plain.params) == ((), (), ())
    assert base.model(plain) is base.base


def test_chances_stay_within_the_factor() -> None:
    source = RulesetSource(RULES, Variety(chances=2.0))
    defaults = {
        param.name: float(param.default) for param in source.base.params if param.kind.name == "chance"
    }
    drawn = [dict(source.draw(number).params) for number in range(200)]
    for name, default in defaults.items():
        values = [one[name] for one in drawn]
        assert default / 2 <= min(values) < 0.6 * default
        assert 1.7 * default < max(values) <= min(1.0, 2 * default) + 1e-12
        # Uniform in the logarithm.
        assert sum(value < default for value in values) == pytest.approx(100, abs=25)


def test_swapped_elements_have_each_others_property() -> None:
    source = RulesetSource(RULES, Variety(swaps=("density",)))
    base = source.base.property("density")
    assert base is not None
    for number in range(10):
        drawn = source.draw(number)
        ((name, one, other),) = drawn.swapped
        first, second = (source.base.element(element) for element in (one, other))
        found = source.model(drawn).property("density")
        assert name == "density"
        expected = list(base.values)
        expected[first.id], expected[second.id] = expected[second.id], expected[first.id]
        assert list(found.values) == expected
        assert base.values[first.id] != base.values[second.id]


def test_packs_that_others_need_stay() -> None:
    source = RulesetSource(RULES, Variety(leave_out=0.5))
    left = [set(source.draw(number).left_out) for number in range(40)]
    needed = {name.text for pack in source.packs for name in pack.needs}
    assert set().union(*left) == set(source.base.packs) - needed
    assert "core" in needed
    for number in range(5):
        model = source.model(source.draw(number))
        assert set(model.packs) == set(source.base.packs) - left[number]
        # Ids stay where they are.
        ids = {one.qualified: one.id for one in source.base.elements}
        assert all(ids[one.qualified] == one.id for one in model.elements)


@pytest.mark.slow
def test_every_world_runs_under_its_own_ruleset(dunes: str) -> None:
    worlds = TaskWorlds(DataConfig(dunes, rulesets=3, variety=MANY), backend="torch")
    source = RulesetSource("core+sand+water+stone", MANY)
    seeds = torch.tensor([5, 0, 1, 3, 2, 4])
    start = worlds.start(seeds)
    end = worlds.later(worlds.later(start, 8), 8)
    assert start.ids.shape == (6, 14, 18)
    for place, seed in enumerate(seeds.tolist()):
        drawn = worlds.rulesets[seed % 3]
        model = source.model(drawn)
        alone = powderdsl.compile(model.with_params(dict(drawn.params)), backend="torch")
        world = worlds.start(torch.tensor([seed]))
        assert torch.equal(world.ids[0], start.ids[place])
        # The same start under this ruleset alone, with its chances as defaults.
        part = world.parts[0].world
        own = alone.world(part.ids, part.seed, index=part.index)
        assert torch.equal(alone.step(own, 16).ids[0], end.ids[place])


def test_training_and_tests_draw_different_rulesets(dunes: str, tmp_path: Path) -> None:
    data = DataConfig(
        task=dunes, states=12, steps=2, pairs=2, rulesets=3, variety=MANY, capacity=24, refresh=1
    )
    machine = Machine(backend="torch")
    config = TrainConfig(data, width=4, iterations=3, batch=4)
    run = train(config, tmp_path / "run", machine=machine)
    trained = load_trained(run)
    assert trained.config == config  # variety and all, through run.json
    worlds = TaskWorlds(data, backend="torch")
    assert [one.number for one in worlds.rulesets] == [0, 1, 2]
    later = TaskWorlds(
        replace(data, first_ruleset=1), backend="torch"
    ).rulesets  # seeds may have rulesets of their own
    assert [one.number for one in later] == [1, 2, 3]
    assert later[:2] == worlds.rulesets[1:]
    assert later[2] not in worlds.rulesets
    unseen = unseen_worlds(trained, split="train", rulesets=5, machine=machine)
    assert [one.number for one in unseen.rulesets] == [UNSEEN_RULESETS + number for number in range(5)]
    found = evaluate(trained, split="train", worlds=5, rulesets=5, machine=machine)
    assert found.mean("model") > 0
    plain = unseen_worlds(trained, split="train", machine=machine)
    assert [one.structure for one in plain.rulesets] == [
        ((), ())
    ]  # without being asked, the rules as they are


def test_unknown_properties_and_bad_numbers_are_refused() -> None:
    assert refusal(RulesetSource, RULES, Variety(swaps=("densty",)))[0].helps == ("did you mean `density`?",)
    for wrong in ({"chances": 0.5}, {"leave_out": 1.0}, {"chances": float("nan")}):
        with pytest.raises(ValueError, match=r"chances|leave_out"):
            Variety(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="`rulesets` must be an integer from 0 to 1,024, found 1025"):
        DataConfig(rulesets=1025)
