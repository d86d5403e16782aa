"""Shipped rulesets over many steps: every backend's worlds equal the reference's, bit for bit, in any batch layout.

Here 100 steps; all thousand take some minutes, which the reference spends:

    POWDERDSL_LONG_STEPS=1000 pytest tests/semantics/test_long_runs.py
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from powderdsl.compiler import load, shipped_rules
from powderdsl.diagnostics import CompileError
from powderdsl.simulator import Simulator, World
from powderdsl.simulator import compile as compile_ruleset
from powderdsl.testing.cases import random_start
from powderdsl.testing.choices import Choices
from powderdsl.testing.compare import find_difference
from tests.compilers import skip_without_compiler

LAST = int(os.environ.get("POWDERDSL_LONG_STEPS", "100"))
MOMENTS = [step for step in (1, 2, 5, 10, 100, 1000) if step <= LAST]
SHAPES = [(2, 9, 130), (3, 33, 17)]
"""Widths that end inside a word: more than two words, less than one."""


def complete(name: str) -> bool:
    """Whether a shipped file is a ruleset, or a pack that needs no other."""
    try:
        return bool(load(name).passes)
    except CompileError:
        return False


RULESETS = [name for name in shipped_rules() if complete(name)]


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: "x".join(map(str, shape)))
@pytest.mark.parametrize("name", RULESETS)
def test_all_backends_stay_equal(name: str, shape: tuple[int, int, int]) -> None:
    ruleset = load(name)
    start = random_start(ruleset, Choices.seeded(sum(shape)), shape)
    expected = dict(states(start.world(compile_ruleset(ruleset, backend="reference"))))
    for backend in ("dense", "planes", "native"):
        simulator = compiled(ruleset, backend)
        together = start.world(simulator)
        for step, state in states(together):
            assert find_difference(expected[step], state) is None, (backend, step)
        for i in (0, len(together) - 1):
            for step, state in states(together.select([i])):
                wanted = {slot: value[i : i + 1] for slot, value in expected[step].items()}
                assert find_difference(wanted, state) is None, (backend, step, f"world {i} alone")


def states(world: World) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """The state after each of MOMENTS; the steps between two of them are one call."""
    done = 0
    for moment in MOMENTS:
        world = world.sim.step(world, moment - done)
        done = moment
        yield moment, dict(world.state)


def compiled(ruleset: Any, backend: str) -> Simulator:
    skip_without_compiler(backend)
    return compile_ruleset(ruleset, backend=backend)


def test_every_shipped_ruleset_is_among_them() -> None:
    assert {"powderworld", "life", "wireworld", "margolus", "langtons_ant"} <= set(RULESETS)
