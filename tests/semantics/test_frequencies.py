"""Mirrored worlds that use the same numbers in another way agree in how often things happen, on every backend."""

from __future__ import annotations

import pytest

from powderdsl.model.types import Ruleset
from powderdsl.testing.generators.cases import Start, load_text
from powderdsl.testing.properties.breaks import Alike, breaks
from powderdsl.testing.properties.running import Runner
from powderdsl.testing.properties.search import COPIES, InvariantSearch, SearchPlan
from tests.compilers import skip_without_compiler
from tests.fuzz import TARGETS

BACKENDS = ("reference", *TARGETS)

DRIFT = """pack: drift
elements:
  air: {id: 0, color: "#FFFFFF", glyph: "."}
  leaf: {id: 1, color: "#30A030", glyph: y}
streams: [coin]
passes:
  drift:
    conflicts: drop_both
    do:
      - leaf swaps left if left is air and coin < LEFT
      - leaf swaps right if right is air and coin > LEFT
invariants:
  - mirrored worlds agree
"""


def drift(left: str) -> Ruleset:
    return load_text(DRIFT.replace("LEFT", left), "drift.yaml")


def searched(ruleset: Ruleset, backend: str) -> tuple[str, str]:
    skip_without_compiler(backend)
    search = InvariantSearch.of(Runner(ruleset, backend), SearchPlan(examples=256), declared_only=True)
    search.try_random()
    (result,) = search.finish()
    return result.status, result.reason


@pytest.mark.parametrize("backend", BACKENDS[:3])
def test_a_fair_coin_is_fair_though_sides_read_it_differently(backend: str) -> None:
    assert searched(drift("50%"), backend) == ("tested", "in how often things happen")


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_coin_that_prefers_a_side_is_noticed(backend: str) -> None:
    assert searched(drift("40%"), backend) == ("broken", "in how often things happen")


@pytest.mark.parametrize(("left", "differs"), [("50%", False), ("49%", False), ("35%", True)])
def test_backends_see_the_same_frequencies(left: str, differs: bool) -> None:
    """The worlds are the same bit for bit, so the verdict on each cell is; one in a hundred is too little to tell."""
    start: Start = Start.fresh([[0, 0, 1, 0, 0], [0, 1, 0, 0, 0]], seed=3)
    found = []
    for backend in ("reference", "torch", "wasm"):
        verdict = breaks(Alike("mirrored", COPIES), Runner(drift(left), backend), start, 1)
        found.append((bool(verdict.first[0]), verdict.cell[0].tolist()))
    assert found == [found[0]] * 3
    assert found[0][0] is differs
