"""Native code and WebAssembly cut large or few worlds into strips that lie side by side: the worlds are the same."""

from __future__ import annotations

import pytest

from powderdsl.compiler import load
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.testing.generators.cases import random_start
from powderdsl.testing.generators.choices import Choices
from tests.compilers import skip_without_compiler
from tests.fuzz.compare import assert_same

STRIPS = [(1, 8, 8), (2, 16, 70), (1, 64, 64), (3, 128, 65), (1, 256, 256), (9, 520, 20), (2, 8, 1)]
"""Strips of one row, of more rows than one list of active rows has, of words that are not full; large and many."""


BACKENDS = ("native", "wasm")


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["powderworld", "forest_fire", "langtons_ant", "margolus", "wireworld"])
def test_shipped_rulesets_in_strips(name: str, backend: str) -> None:
    """With edges that wrap and with nothing outside, parities of rows, floats, draws, and parameters by world."""
    skip_without_compiler(backend)
    ruleset = load(name)
    simulators = [compile_ruleset(ruleset, backend=one) for one in ("torch", backend)]
    for seed, shape in enumerate(STRIPS):
        assert_same(
            ruleset, random_start(ruleset, Choices.seeded(seed), shape), steps=3, simulators=simulators
        )
