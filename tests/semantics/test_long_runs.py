"""Shipped rulesets over many steps: every backend's worlds equal the reference's, bit for bit, in any batch layout.

The smoke test runs 100 steps of the largest ruleset; the campaign a thousand of every ruleset, for some minutes, which
the reference spends.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pytest

from powderdsl.compiler import load, shipped_rules, shipped_variants
from powderdsl.diagnostics import CompileError
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.testing.generators.cases import random_start
from powderdsl.testing.generators.choices import Choices
from tests.compilers import skip_without_compiler
from tests.fuzz.compare import find_difference

MOMENTS = (1, 2, 5, 10, 100, 1000)
SHAPES = [(2, 9, 130), (3, 33, 17), (9, 16, 64), (1, 24, 128)]
"""Widths that end inside a word, more than two words and less than one; whole words, for which native code has a library
each, in more worlds than lie side by side, and as strips of one world."""


def complete(name: str) -> bool:
    """Whether a shipped file is a ruleset, or a pack that needs no other."""
    try:
        return bool(load(name).passes)
    except CompileError:
        return False


RULESETS = [name for name in shipped_rules() if name not in shipped_variants() and complete(name)]


@pytest.mark.slow
def test_all_backends_stay_equal_for_a_while() -> None:
    run_all_backends("powderworld", SHAPES[0], MOMENTS[:-1])


@pytest.mark.campaign
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: "x".join(map(str, shape)))
@pytest.mark.parametrize("name", RULESETS)
def test_all_backends_stay_equal(name: str, shape: tuple[int, int, int]) -> None:
    run_all_backends(name, shape, MOMENTS)


def run_all_backends(name: str, shape: tuple[int, int, int], moments: Sequence[int]) -> None:
    """Compare all backends with the reference after each of `moments`, in a batch and alone."""
    ruleset = load(name)
    start = random_start(ruleset, Choices.seeded(sum(shape)), shape)
    expected = dict(states(start.world(compile_ruleset(ruleset, backend="reference")), moments))
    for backend in ("torch", "native", "wasm"):
        simulator = compiled(ruleset, backend)
        together = start.world(simulator)
        for step, state in states(together, moments):
            assert find_difference(expected[step], state) is None, (backend, step)
        if backend == "native":
            for step, state in states(start.world(compile_ruleset(ruleset, backend, threads=2)), moments):
                assert find_difference(expected[step], state) is None, (backend, "two threads", step)
        for i in (0, len(together) - 1):
            for step, state in states(together.select([i]), moments):
                wanted = {slot: value[i : i + 1] for slot, value in expected[step].items()}
                assert find_difference(wanted, state) is None, (backend, step, f"world {i} alone")


def states(world: World, moments: Sequence[int]) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """The state after each of `moments`; the steps between two of them are one call."""
    done = 0
    for moment in moments:
        world = world.sim.step(world, moment - done)
        done = moment
        yield moment, dict(world.state)


def compiled(ruleset: Any, backend: str) -> Simulator:
    skip_without_compiler(backend)
    return compile_ruleset(ruleset, backend=backend)


def test_every_shipped_ruleset_is_among_them() -> None:
    assert {"powderworld", "life", "wireworld", "margolus", "langtons_ant"} <= set(RULESETS)
