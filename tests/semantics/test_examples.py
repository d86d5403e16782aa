"""Packs do what they say: the tests inside shipped packs, and the example packs of the documentation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

import powderdsl
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import Simulator, World, compile
from powderdsl.testing.pack_tests.runner import run_examples
from powderdsl.worlds.ascii import read_ascii, write_ascii

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.yaml"))

backends = pytest.mark.parametrize("backend", ["reference", "wasm"])


@cache
def simulator(name: str, backend: str, *packs: str) -> Simulator:
    return powderdsl.compile(powderdsl.load(*packs, EXAMPLES / f"{name}.yaml"), backend=backend)


def drawn(sim: Simulator, art: str) -> World:
    return sim.world(read_ascii(art, sim.ruleset.elements)[None])


def ids_of(sim: Simulator) -> dict[str, int]:
    return {element.name: element.id for element in sim.ruleset.elements}


def shown(world: World) -> list[str]:
    return write_ascii(world.ids[0], world.sim.ruleset.elements).split()


def test_all_of_them_load_together() -> None:
    rules = powderdsl.load("powderworld", *(EXAMPLES / f"{name}.yaml" for name in NAMES))
    assert rules.packs[-len(NAMES) :] == tuple(NAMES)


def failures(rules: Ruleset, pack: str, backend: str) -> list[str]:
    """The tests of one pack that fail with all of these rules; changes by packs beside it are not failures."""
    own = tuple(example for example in rules.tests if example.pack == pack)
    assert own, f"{pack} has no tests"
    results = run_examples(replace(rules, tests=own), sim=compile(rules, backend, tensors=False))
    return [f"{result.example.name}: {result.problem}" for result in results if result.failed]


@pytest.mark.parametrize("name", [name for name in NAMES if name != "salt"])
def test_their_own_tests_hold(name: str) -> None:
    rules = powderdsl.load("powderworld", EXAMPLES / f"{name}.yaml")
    assert failures(rules, name, "wasm") == []


# Shipped packs. Those of Powderworld are tested all together, and each with no more than it needs.

POWDERWORLD = powderdsl.load("powderworld").packs
CLASSICS = [
    "life", "wireworld", "forest_fire", "margolus", "brians_brain", "cyclic", "langtons_ant",
]  # fmt: skip
ALONE = [
    "core+sand", "core+water", "core+fire", "core+water+plant", "core+water+stone+lava",
    "core+gas", "core+stone",
]  # fmt: skip


@pytest.mark.parametrize("pack", POWDERWORLD)
def test_packs_hold_their_tests_among_all_others(pack: str) -> None:
    assert failures(powderdsl.load("powderworld"), pack, "wasm") == []


@pytest.mark.parametrize("rules", [*ALONE, *CLASSICS])
def test_packs_hold_their_tests_alone(rules: str) -> None:
    loaded = powderdsl.load(rules)
    assert failures(loaded, loaded.packs[-1], "wasm") == []


def test_tests_that_need_an_absent_pack_are_left_out() -> None:
    few, many = (
        {example.name for example in powderdsl.load(rules).tests if example.pack == "lava"}
        for rules in ("core+lava", "core+water+lava+stone")
    )
    assert few < many


# A beetle


@backends
def test_a_beetle_turns_round_at_each_wall(backend: str) -> None:
    sim = simulator("beetle", backend, "core")
    world = drawn(sim, "#.B..# \n ######")
    columns = []
    for _ in range(12):
        world = sim.step(world)
        columns.append(shown(world)[0].index("B"))
    assert columns == [3, 4, 3, 2, 1, 2, 3, 4, 3, 2, 1, 2]


@backends
def test_a_beetle_falls_off_a_ledge_and_walks_on(backend: str) -> None:
    sim = simulator("beetle", backend, "core")
    world = drawn(sim, "B.... \n ##... \n ##... \n #####")
    assert shown(sim.step(world, 8)) == [".....", "##...", "##.B.", "#####"]


@backends
def test_beetles_do_not_walk_into_each_other(backend: str) -> None:
    sim = simulator("beetle", backend, "core")
    beetle = ids_of(sim)["beetle"]
    ids = np.where(np.random.default_rng(1).random((4, 12, 12)) < 0.3, beetle, 0)
    ids[:, -1] = ids_of(sim)["wall"]
    world = sim.world(ids)
    for _ in range(20):
        world = sim.step(world)
        assert (world.ids == beetle).sum((1, 2)).tolist() == (ids == beetle).sum((1, 2)).tolist()


# Electricity


@backends
def test_pulses_travel_one_cell_a_step_and_follow_each_other(backend: str) -> None:
    sim = simulator("electricity", backend, "core")
    world = drawn(sim, "........ \n +======. \n ........")
    seen = []
    for _ in range(5):
        world = sim.step(world)
        seen.append(world["charge"][0, 1].tolist())
    assert seen == [
        [0, 3, 0, 0, 0, 0, 0, 0],
        [0, 2, 3, 0, 0, 0, 0, 0],
        [0, 1, 2, 3, 0, 0, 0, 0],
        [0, 0, 1, 2, 3, 0, 0, 0],
        [0, 3, 0, 1, 2, 3, 0, 0],
    ]


@backends
def test_a_lamp_flickers_and_a_cut_wire_keeps_it_dark(backend: str) -> None:
    sim = simulator("electricity", backend, "core")
    whole, cut = drawn(sim, "...... \n +====L \n ......"), drawn(sim, "...... \n +==.=L \n ......")
    seen = set()
    for _ in range(60):
        whole, cut = sim.step(whole), sim.step(cut)
        seen.add(shown(whole)[1][-1])
        assert shown(cut)[1] == "+==.=L"
        assert int(cut["charge"][0, 1, 4]) == 0
    assert seen == {"L", "*"}


# Steam


@backends
def test_water_boils_over_lava_and_rains_from_the_roof(backend: str) -> None:
    sim = simulator("steam", backend, "core", "water", "lava")
    id_of = ids_of(sim)
    ids = np.full((4, 16, 10), id_of["wall"], np.uint8)
    ids[:, 1:-1, 1:-1] = id_of["empty"]
    ids[:, -3, 1:-1] = id_of["water"]
    ids[:, -2, 1:-1] = id_of["lava"]
    world = sim.world(ids)
    most_steam, most_rain, highest = 0, 0, 16
    for _ in range(60):
        world = sim.step(world)
        drops, mist = world.ids == id_of["water"], world.ids == id_of["steam"]
        assert int(drops.sum() + mist.sum()) == 4 * 8, "water and steam are one thing"
        most_steam = max(most_steam, int(mist.sum()))
        most_rain = max(most_rain, int(drops[:, :6].sum()))
        highest = min([highest, *mist.nonzero()[:, 1].tolist()])
    assert most_steam > 4 * 8 // 2
    assert highest == 1, "steam rises to the roof"
    assert most_rain > 0, "and comes down as rain"


@backends
def test_cold_water_stays_water(backend: str) -> None:
    sim = simulator("steam", backend, "core", "water", "lava")
    world = drawn(sim, "#..# \n #~~# \n ####")
    assert torch.equal(sim.step(world, 20).ids, world.ids)
