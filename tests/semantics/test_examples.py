"""Packs do what they say: the tests inside shipped packs, and the example packs of the documentation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

import powderdsl
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import compile
from powderdsl.testing.pack_tests.runner import run_examples

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.yaml"))


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


def test_salt_in_the_readme_is_ten_lines_of_yaml() -> None:
    text = (EXAMPLES / "salt.yaml").read_text(encoding="utf-8")
    lines = text[: text.index("invariants:")].splitlines()
    assert len([line for line in lines if line.strip()]) <= 10
    assert max(map(len, lines)) <= 100
    assert set(yaml.safe_load("\n".join(lines))) == {"pack", "about", "needs", "elements", "passes"}


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
