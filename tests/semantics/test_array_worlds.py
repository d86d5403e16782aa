"""Simulators without torch give the worlds of those with torch, bit for bit, whatever is done with them."""

from __future__ import annotations

import numpy as np
import pytest

import powderdsl
from powderdsl.compiler import shipped_tests
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.simulation.simulator import compile as compile_rules
from powderdsl.targets.job import MixedProgram
from powderdsl.targets.wasm.program import WasmState
from powderdsl.testing.generators.cases import Choices, random_start
from tests.semantics.test_mixed import HEAVY
from tests.semantics.texts import load_text
from tests.tiers import tiered

Both = tuple[World, World]


def assert_same(found: World, wanted: World) -> None:
    assert list(found.state) == list(wanted.state)
    for name in (*found.state, "seed", "index", "step"):
        kept = name in found.state
        a = found.state[name] if kept else getattr(found, name)
        b = (wanted.state[name] if kept else getattr(wanted, name)).numpy()
        assert (a.dtype, a.shape) == (b.dtype, b.shape), name
        assert a.tobytes() == b.tobytes(), name


def simulators(ruleset: Ruleset, backend: str = "wasm") -> tuple[Simulator, Simulator]:
    return compile_rules(ruleset, backend, tensors=False), compile_rules(ruleset, backend)


def starts(sims: tuple[Simulator, Simulator], shape: tuple[int, int, int]) -> Both:
    """The same random worlds, on arrays and on tensors."""
    start = random_start(sims[0].ruleset, Choices.seeded(1), shape)
    return start.world(sims[0]), start.world(sims[1])


@pytest.mark.parametrize("name", tiered(shipped_tests(), ["powderworld", "life"]))
def test_shipped_rules_give_the_same_worlds(name: str) -> None:
    sims = simulators(powderdsl.load(name))
    for shape in ((3, 18, 70), (1, 16, 64)):
        found, wanted = starts(sims, shape)
        assert_same(found, wanted)
        for steps in (0, 1, 199):
            found, wanted = sims[0].step(found, steps), sims[1].step(wanted, steps)
            assert_same(found, wanted)


@pytest.fixture(scope="module")
def powderworld() -> tuple[Simulator, Simulator]:
    return simulators(powderdsl.load("powderworld"))


def test_worlds_are_changed_alike(powderworld: tuple[Simulator, Simulator]) -> None:
    shape = (2, 9, 33)
    mask = np.random.default_rng(2).random(shape) < 0.3
    worlds = starts(powderworld, shape)
    for change in (
        lambda sim, world: sim.paint(world, where=mask, element="sand", velocity=(0.1, -2)),
        lambda sim, world: sim.paint(world, where=mask[0], momentum=-3),
        lambda sim, world: sim.replace(world, ids=np.flip(world.ids, 1) if sim is powderworld[0] else world.ids.flip(1)),
        lambda sim, world: sim.replace(world, velocity=(1e-7, 99)),
        lambda sim, world: sim.step(world, 3, reuse=True),
        lambda sim, world: sim.step(world, 2, params={"water.melt": 0.1, "fire.spread": [0.0, 0.7]}),
        lambda sim, world: sim.step(world, 2, passes=sim.passes[1:6:2]),
        lambda sim, world: sim.step(world, random={"movement": mask * 0.3}),
        lambda sim, world: world.select([1]),
        lambda sim, world: sim.step(world, 2),
        lambda sim, world: world.select(slice(0, 1)),
    ):  # fmt: skip
        worlds = tuple(change(sim, world) for sim, world in zip(powderworld, worlds, strict=True))  # type: ignore[no-untyped-call]
        assert_same(*worlds)
    for name in ("density", "velocity", "core.density"):
        first, second = (world[name] for world in worlds)
        assert (first.dtype, first.tobytes()) == (second.numpy().dtype, second.numpy().tobytes())


def test_a_world_stays_as_it_was(powderworld: tuple[Simulator, Simulator]) -> None:
    sim = powderworld[0]
    first = sim.step(starts(powderworld, (2, 8, 40))[0])
    before = {name: value.copy() for name, value in first.state.items()}
    second = sim.step(first, 5)
    assert isinstance(second.state, WasmState)
    assert all((first.state[name] == value).all() for name, value in before.items())
    assert (second.step == first.step + 5).all()
    assert sim.step(first, 5).ids.tobytes() == second.ids.tobytes()


@pytest.mark.parametrize("backend", ["wasm", "reference"])
def test_passes_that_fit_no_planes_run_on_the_oracle(backend: str) -> None:
    sims = simulators(load_text(HEAVY, "heavy.yaml"), backend)
    found, wanted = starts(sims, (2, 7, 40))
    for _ in range(3):
        found, wanted = sims[0].step(found), sims[1].step(wanted)
        assert_same(found, wanted)
    assert isinstance(sims[0]._program.whole, MixedProgram) == (backend == "wasm")
