"""What is kept between calls of a simulator never shows: worlds are those of the backend `wasm`, whatever a user does."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
import torch

from powderdsl.simulation.simulator import Simulator, World
from powderdsl.simulation.simulator import compile as compile_rules
from powderdsl.targets.cpp.build import Building, building
from powderdsl.targets.cpp.program import KEPT_INPUTS
from tests.compilers import skip_without_compiler
from tests.semantics.texts import load_text

RULES = """\
pack: rain
elements:
  air: {id: 0, color: "#102030"}
  drop: {id: 1, color: "#FEDCBA"}
  moss: {id: 2, color: "#20A020"}
fields:
  heat: {type: real(-9..9), at: place}
streams: [coin]
params: {rate: 30%, gain: {type: real(0..2), default: 0.5}}
passes:
  fall:
    do: drop swaps below if below is air and coin < rate
  warm:
    after: fall
    do: heat := heat * 0.7 + gain where drop
  grow:
    after: warm
    do: drop -> moss if step mod 4 == 3 and coin < 0.2
"""


@pytest.fixture(scope="module")
def sims(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Simulator, Simulator]]:
    """Native code, and the WebAssembly that it is compared with."""
    skip_without_compiler("native")
    ruleset = load_text(RULES, "rain.yaml")
    with building(Building("-O0", tmp_path_factory.mktemp("native"))):
        yield compile_rules(ruleset, "native"), compile_rules(ruleset, "wasm")


def start(sim: Simulator, batch: int = 1, size: tuple[int, int] = (16, 24)) -> World:
    cells = np.random.default_rng(batch).integers(0, 3, (batch, *size)).astype(np.uint8)
    return sim.world(cells, seed=5)


def assert_equal(found: World, wanted: World) -> None:
    for name in ("seed", "index", "step"):
        assert torch.equal(getattr(found, name), getattr(wanted, name)), name
    for name, value in wanted.state.items():
        assert torch.equal(found.state[name], value), name


Pair = tuple[Simulator, Simulator]


@pytest.mark.slow
def test_old_worlds_stay(sims: Pair) -> None:
    native, plain = sims
    kept = [start(native, 3)]
    for steps in (1, 2, 1, 3):
        kept.append(native.step(kept[-1], steps))
    again = native.step(kept[1], 5)
    wanted = start(plain, 3)
    for world, steps in zip(kept, (1, 2, 1, 3, 0), strict=True):
        assert_equal(world, wanted)
        wanted = plain.step(wanted, steps)
    assert_equal(again, plain.step(start(plain, 3), 6))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["seed", "index"])
def test_numbers_written_to_count_for_the_worlds_that_have_them(sims: Pair, name: str) -> None:
    """Those of a world that a simulator made, written to by torch and by NumPy."""
    found: list[list[World]] = []
    for sim in sims:
        world = sim.step(sim.step(start(sim, 2)))
        after = sim.step(world)
        getattr(world, name)[1] = 40
        by_torch = sim.step(world)
        getattr(by_torch, name).numpy()[0] = 7
        found.append([after, world, by_torch, sim.step(by_torch, 5)])
    for one, other in zip(*found, strict=True):
        assert_equal(one, other)
    assert int(getattr(found[0][3], name)[1]) == 40


def test_arguments_may_be_written_to_after_the_call(sims: Pair) -> None:
    native, plain = sims
    rate, seeds = torch.tensor([0.9, 0.1], dtype=torch.float64), np.array([3, 4])
    cells = torch.ones(2, 8, 8, dtype=torch.uint8)
    world = native.world(cells, seeds)
    first = native.step(world, params={"rain.rate": rate})
    rate.fill_(0.5)
    seeds[:] = 0
    cells.zero_()
    second = native.step(first, params={"rain.rate": rate})
    wanted = plain.world(np.ones((2, 8, 8), np.uint8), [3, 4])
    wanted = plain.step(wanted, params={"rain.rate": [0.9, 0.1]})
    assert_equal(second, plain.step(wanted, params={"rain.rate": 0.5}))


def test_parameters_change_from_call_to_call(sims: Pair) -> None:
    given: list[Mapping[str, Any] | None] = [
        None, {"rain.rate": 1}, {}, {"rain.rate": 0.0, "rain.gain": 2}, None, {"rain.gain": [0.0, 1.0]}, {"rain.rate": 1}, None,
    ]  # fmt: skip
    found = []
    for sim in sims:
        world = start(sim, 2)
        for params in given:
            world = sim.step(world, params=params)
        found.append(world)
    assert_equal(*found)


def test_batch_sizes_alternate(sims: Pair) -> None:
    """More of them than are kept, in strips and in lanes."""
    native, plain = sims
    sizes = [1, 9, 2, 1, 9, *range(1, KEPT_INPUTS + 3), 1, 9]
    worlds = {batch: start(native, batch) for batch in set(sizes)}
    for batch in sizes:
        worlds[batch] = native.step(worlds[batch])
    for batch, world in sorted(worlds.items()):
        assert_equal(world, plain.step(start(plain, batch), sizes.count(batch)))


def test_one_world_in_two_simulators(sims: Pair) -> None:
    """A simulator of the same rules takes it on, and the first one again; neither sees what the other keeps."""
    native, plain = sims
    other = compile_rules(native.ruleset, "native")
    world = native.step(start(native, 2), 2)
    left, right = native.step(world, 3), other.step(world, 3)
    assert_equal(left, right)
    for sim in (plain, native, other, native):
        right = sim.step(right)
        left = native.step(left)
        assert right.sim is sim
    assert_equal(left, right)
    assert_equal(world, plain.step(start(plain, 2), 2))


def test_edited_worlds(sims: Pair) -> None:
    """Elements that were not present before; a run knows which are."""
    found = []
    for sim in sims:
        world = sim.step(sim.world(np.zeros((1, 16, 16), np.uint8)), 2)
        world = sim.step(sim.paint(world, where=torch.eye(16) > 0, element="drop", heat=1.0), 2)
        world = sim.step(sim.replace(world, ids=torch.full((1, 16, 16), 2)), 1)
        found.append(sim.step(sim.paint(world, where=torch.eye(16) > 0, element="drop"), 4))
    assert_equal(*found)


def test_reuse_takes_the_memory_and_nothing_else(sims: Pair) -> None:
    native, plain = sims
    world = native.step(start(native, 2))
    spent = native.step(world)
    later = native.step(spent, 2, reuse=True)
    assert_equal(later, plain.step(start(plain, 2), 4))
    assert_equal(world, plain.step(start(plain, 2), 1))
    assert spent.step.tolist() == [2, 2]
    with pytest.raises(RuntimeError, match="reuse"):
        native.step(spent)
