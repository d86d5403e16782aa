"""Native code lays worlds side by side, in strips and for processors with shorter vectors: the worlds are the same."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

from powderdsl.compiler import load
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.targets.cpp.build import (
    ARCHITECTURE,
    Building,
    building,
    find_compiler,
    flags_for,
    processor,
)
from powderdsl.testing.generators.cases import load_text, random_start
from powderdsl.testing.generators.choices import Choices
from tests.compilers import skip_without_compiler
from tests.fuzz.compare import assert_same
from tests.fuzz.rulemaker import random_ruleset_text
from tests.tiers import tiered

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


LEVELS = {"x86-64-v2": "sse4_2", "x86-64-v3": "avx2", "x86-64-v4": "avx512bw"}
"""Levels of processors, and an instruction set that a machine needs for each."""

GROUPS = [(5, 8, 70), (2, 16, 64), (9, 7, 33), (1, 64, 130)]
"""Full groups of worlds and others, strips and none, words that are not full."""


@pytest.fixture(params=tiered(LEVELS, ["x86-64-v3"]))
def level(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    skip_without_compiler()
    name = str(request.param)
    if platform.machine() not in ("x86_64", "AMD64") or LEVELS[name] not in processor():
        pytest.skip(f"this processor is not {name}")
    monkeypatch.setenv(ARCHITECTURE, name)
    return name


@pytest.mark.slow
def test_worlds_do_not_depend_on_vectors(level: str, tmp_path: Path) -> None:
    shipped, drawn = load("core+sand+water+wind"), load_text(random_ruleset_text(61), "seed61.yaml")
    assert any(one.replace("_", "-") == f"-march={level}" for one in flags_for(find_compiler(), "-O0"))
    for ruleset, shapes in ((shipped, GROUPS), (drawn, GROUPS[:1])):  # g++ runs for each number of words
        with building(Building("-O0", tmp_path)):
            simulators = [compile_ruleset(ruleset, backend=backend) for backend in ("torch", "native")]
        for seed, shape in enumerate(shapes):
            start = random_start(ruleset, Choices.seeded(seed), shape)
            assert_same(ruleset, start, steps=3, simulators=simulators)
