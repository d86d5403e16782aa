"""Whatever its density, what has gravity falls through what is lighter and has gravity too."""

from __future__ import annotations

from pathlib import Path

import pytest

import powderdsl
from powderdsl.ir.lower import live_passes

PACK = """pack: weights
needs: core
elements:
{elements}"""


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rows = "".join(
        f'  weight{n}: {{id: {20 + n}, density: {n}, gravity: yes, color: "#10203{n}"}}\n' for n in range(8)
    )
    path = tmp_path_factory.mktemp("weights") / "weights.yaml"
    path.write_text(PACK.format(elements=rows), encoding="utf-8")
    return path


@pytest.mark.parametrize("backend", ["reference", "torch", "wasm"])
def test_every_density_sinks_below_every_lighter_one(weights: Path, backend: str) -> None:
    sim = powderdsl.compile(powderdsl.load(f"core+{weights}"), backend=backend)
    mixed = [25, 20, 27, 23, 26, 21, 24, 22]
    world = sim.world([[[number] for number in (*mixed, 1)]])
    sunk = sim.step(world, steps=20).ids[0, :, 0].tolist()
    assert sunk == [20, 21, 22, 23, 24, 25, 26, 27, 1]


def test_a_heavy_block_falls_in_empty_space(weights: Path) -> None:
    sim = powderdsl.compile(powderdsl.load(f"core+{weights}"))
    for number in (25, 26, 27):
        world = sim.world([[[number], [0], [0], [0], [1]]])
        assert sim.step(world, steps=10).ids[0, :, 0].tolist() == [0, 0, 0, number, 1]


def test_densities_that_nothing_falls_with_cost_nothing() -> None:
    """Seven rounds are written; those in which no loaded element can fall are not compiled."""
    rules = powderdsl.load("powderworld")
    gravity = next(one for one in live_passes(rules) if one.name == "gravity")
    assert [bool(moment.rules) for moment in gravity.moments] == [True] * 4 + [False] * 3
