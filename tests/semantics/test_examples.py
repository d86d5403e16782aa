"""Packs do what they say: the tests inside shipped packs, and the example packs of the documentation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import powderdsl
from powderdsl.ir.lower import live_passes
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import Simulator, World, compile
from powderdsl.testing.pack_tests.runner import run_examples
from powderdsl.worlds.ascii import read_ascii, write_ascii

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.yaml"))


@cache
def simulator(name: str, *packs: str) -> Simulator:
    return powderdsl.compile(powderdsl.load(*packs, EXAMPLES / f"{name}.yaml"), backend="wasm")


def drawn(sim: Simulator, art: str) -> World:
    return sim.world(read_ascii(art, sim.ruleset.elements)[None])


def ids_of(sim: Simulator) -> dict[str, int]:
    return {element.name: element.id for element in sim.ruleset.elements}


def shown(world: World) -> list[str]:
    return write_ascii(world.ids[0], world.sim.ruleset.elements).split()


def failures(rules: Ruleset, *packs: str) -> list[str]:
    """The tests of these packs that fail with all of these rules; changes by packs beside them are not failures."""
    own = tuple(example for example in rules.tests if example.pack in packs)
    assert {example.pack for example in own} >= {*packs} - {"salt"}
    results = run_examples(replace(rules, tests=own), sim=compile(rules, "wasm", tensors=False))
    return [f"{result.example.name}: {result.problem}" for result in results if result.failed]


CLASSICS = [
    "life", "wireworld", "forest_fire", "margolus", "brians_brain", "cyclic", "langtons_ant",
]  # fmt: skip
ALONE = [
    "core+sand", "core+water", "core+fire", "core+water+plant", "core+water+stone+lava",
    "core+gas", "core+stone",
]  # fmt: skip


@pytest.mark.parametrize("rules", [*ALONE, *CLASSICS])
def test_packs_hold_their_tests_alone(rules: str) -> None:
    loaded = powderdsl.load(rules)
    assert failures(loaded, loaded.packs[-1]) == []


@pytest.mark.slow
def test_packs_and_examples_hold_their_tests_together() -> None:
    rules = powderdsl.load("powderworld", *(EXAMPLES / f"{name}.yaml" for name in NAMES))
    assert rules.packs[-len(NAMES) :] == tuple(NAMES)
    assert failures(rules, *rules.packs) == []


def test_tests_that_need_an_absent_pack_are_left_out() -> None:
    few, many = (
        {example.name for example in powderdsl.load(rules).tests if example.pack == "lava"}
        for rules in ("core+lava", "core+water+lava+stone")
    )
    assert few < many


# What goes on for many steps


def test_beetles_turn_at_walls_and_walk_on_after_a_fall() -> None:
    sim = simulator("beetle", "core")
    world = drawn(sim, "#.B..# \n ######")
    columns = []
    for _ in range(12):
        world = sim.step(world)
        columns.append(shown(world)[0].index("B"))
    assert columns == [3, 4, 3, 2, 1, 2, 3, 4, 3, 2, 1, 2]
    world = drawn(sim, "B.... \n ##... \n ##... \n #####")
    assert shown(sim.step(world, 8)) == [".....", "##...", "##.B.", "#####"]


def test_pulses_travel_along_wires_and_make_lamps_flicker() -> None:
    sim = simulator("electricity", "core")
    whole, cut = drawn(sim, "...... \n +====L \n ......"), drawn(sim, "...... \n +==.=L \n ......")
    assert sim.step(whole, 4)["charge"][0, 1].tolist() == [0, 0, 1, 2, 3, 0]
    seen = set()
    for _ in range(60):
        whole, cut = sim.step(whole), sim.step(cut)
        seen.add(shown(whole)[1][-1])
        assert shown(cut)[1] == "+==.=L"
    assert seen == {"L", "*"}


def test_water_boils_over_lava_and_rains_from_the_roof() -> None:
    sim = simulator("steam", "core", "water", "lava")
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


# Salt, the second example of the README


def boxes(sim: Simulator, worlds: int, *layers: str) -> np.ndarray:
    """Walled boxes with a row of each of these elements from the top, ids uint8 [worlds, layers + 2, 10]."""
    ids = np.full((worlds, len(layers) + 2, 10), ids_of(sim)["wall"], np.uint8)
    for row, layer in enumerate(layers, 1):
        ids[:, row, 1:-1] = ids_of(sim)[layer]
    return ids


def test_salt_is_ten_lines_of_yaml() -> None:
    text = (EXAMPLES / "salt.yaml").read_text(encoding="utf-8")
    lines = text[: text.index("invariants:")].splitlines()
    assert len([line for line in lines if line.strip()]) <= 10
    assert max(map(len, lines)) <= 100
    assert set(yaml.safe_load("\n".join(lines))) == {"pack", "about", "needs", "elements", "passes"}


def test_salt_falls_melts_ice_and_dissolves_in_water() -> None:
    sim = simulator("salt", "core", "sand", "water")

    def share(worlds: World, element: str) -> float:
        return float((worlds.ids == ids_of(sim)[element]).float().mean() * worlds.ids[0].numel() / 8)

    fallen = sim.step(sim.world(boxes(sim, 1, "salt", "empty", "empty")), 4)
    assert torch.equal(fallen.ids, torch.from_numpy(boxes(sim, 1, "empty", "empty", "salt")))
    left = {
        beside: share(sim.step(sim.world(boxes(sim, 8, beside, "ice")), 12), "ice")
        for beside in ("salt", "empty", "sand")
    }
    assert left["salt"] < 0.25
    assert 0.6 < left["empty"] < 1, "2 % a step"
    assert left["sand"] == 1, "nothing melts it there"
    assert 0 < share(sim.step(sim.world(boxes(sim, 8, "salt", "water", "water")), 60), "salt") < 0.75
    dry = sim.world(boxes(sim, 8, "salt", "sand", "wall"))
    assert torch.equal(sim.step(dry, 60).ids, dry.ids)


# Densities


def test_every_density_sinks_below_every_lighter_one(tmp_path: Path) -> None:
    rows = "".join(
        f'  weight{n}: {{id: {20 + n}, density: {n}, gravity: yes, color: "#10203{n}"}}\n' for n in range(8)
    )
    (tmp_path / "weights.yaml").write_text(f"pack: weights\nneeds: core\nelements:\n{rows}")
    sim = powderdsl.compile(powderdsl.load("core", tmp_path / "weights.yaml"), backend="wasm")
    world = sim.world([[[number] for number in (25, 20, 27, 23, 26, 21, 24, 22, 1)]])
    assert sim.step(world, steps=20).ids[0, :, 0].tolist() == [20, 21, 22, 23, 24, 25, 26, 27, 1]
    world = sim.world([[[number] for number in (27, 0, 0, 0, 1)]])
    assert sim.step(world, steps=10).ids[0, :, 0].tolist() == [0, 0, 0, 27, 1]


def test_densities_that_nothing_falls_with_cost_nothing() -> None:
    """Seven rounds are written; those in which no loaded element can fall are not compiled."""
    gravity = next(pass_ for pass_ in live_passes(powderdsl.load("powderworld")) if pass_.name == "gravity")
    assert [bool(moment.rules) for moment in gravity.moments] == [True] * 4 + [False] * 3
