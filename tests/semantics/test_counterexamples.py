"""Counterexamples are small, say everything by name, and are the same in every run; mirrored worlds agree in frequencies."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import powderdsl
from powderdsl.model.types import Ruleset
from powderdsl.testing.properties.running import Runner
from powderdsl.testing.properties.search import InvariantSearch, SearchPlan, quick_results, refuted
from tests.semantics.texts import load_text

WISHES = """pack: wishes
elements:
  air: {id: 0, color: "#FFFFFF", glyph: "."}
  nut: {id: 1, color: "#806040"}
  oak: {id: 2, color: "#30A030"}
fields:
  wish: {type: element, default: air, at: element}
  facing: {type: direction, default: above, at: element}
  awake: {type: flag, at: place}
  age: {type: 0..9, default: 5, at: place}
  drift: {type: vec2(-9..9), at: place}
passes:
  grow:
    do: nut -> wish if wish is oak and facing is left and awake and right is air RULE
  wander:
    after: grow
    do:
      - nut swaps right if right is air and age > 7 and drift.row > 100 with chance 10%
      - age += 1 where awake and oak
      - wish := nut where oak and awake
      - facing := left where air and awake
      - drift := vector(1, 0) where awake and oak
      - awake := no where oak
invariants:
  - count(oak) is constant
"""


def load(tmp_path: Path, rule: str) -> Ruleset:
    path = tmp_path / "wishes.yaml"
    path.write_text(WISHES.replace("RULE", rule), encoding="utf-8")
    return powderdsl.load(path)


NUT_FIRST = (
    "column 0",
    ["n .      o .", ". air, n nut, o oak", "wish: oak air", "facing: left right", "awake: yes no"],
)
NUT_LAST = (
    "column 1",
    [". n      . o", ". air, n nut, o oak", "wish: air oak", "facing: right left", "awake: no yes"],
)


@pytest.mark.parametrize("rule", ["", "with chance 20%"])
def test_values_have_names_and_what_decides_nothing_is_left_out(tmp_path: Path, rule: str) -> None:
    rules = load(tmp_path, rule)
    (broken,) = refuted(rules, quick_results(rules))
    place, heading, *drawn = broken.notes
    # The world wraps around, so that either cell can be the nut; the shrinker keeps the one with the smaller seed.
    match = re.fullmatch(r"broken at row 0, (column \d), after 1 step with seed (\d+)", place)
    assert match is not None, place
    column, seed = match.groups()
    assert int(seed) < 24
    assert heading == "before   after"
    assert (column, drawn) in (NUT_FIRST, NUT_LAST)


def test_a_slow_machine_finds_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rules = load(tmp_path, "with chance 20%")
    first = refuted(rules, quick_results(rules))
    clock = iter(range(0, 10**9, 1000))
    monkeypatch.setattr("time.monotonic", lambda: float(next(clock)))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(clock)))
    assert refuted(rules, quick_results(rules)) == first


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


def searched(ruleset: Ruleset) -> tuple[str, str]:
    search = InvariantSearch.of(Runner(ruleset, "wasm"), SearchPlan(examples=256), ["mirrored worlds agree"])
    search.try_random()
    (result,) = search.finish()
    return result.status, result.reason


@pytest.mark.parametrize(("left", "status"), [("50%", "tested"), ("40%", "broken")])
def test_a_coin_that_prefers_a_side_is_noticed(left: str, status: str) -> None:
    """A fair coin is fair though the sides read it differently."""
    assert searched(drift(left)) == (status, "in how often things happen")
