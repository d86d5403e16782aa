"""Equality of rulesets: rewrites are proven, and what differs is shown by a world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from powderdsl.compiler import load
from powderdsl.prover.equality import Side, differs, why_incomparable
from powderdsl.prover.symbolic import Budget, Renaming, deep_recursion
from powderdsl.simulation.simulator import compile
from powderdsl.testing.generators.cases import Start
from powderdsl.testing.properties.comparison import compare
from powderdsl.testing.properties.running import Oracle
from tests.semantics.texts import load_text


def test_the_start_of_cells_belongs_to_a_ruleset() -> None:
    """A stored property that only fresh cells show: passes are equal, worlds are not."""
    rules = load("powderworld")
    gravity, cloner = rules.property("gravity"), rules.element("cloner").id
    assert gravity is not None
    values = [not value if number == cloner else value for number, value in enumerate(gravity.values)]
    changed = replace(gravity, values=tuple(values))
    mutant = replace(rules, properties=tuple(changed if p is gravity else p for p in rules.properties))
    ids = np.array([[1, 1, 1], [1, cloner, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
    ends = [Oracle(model).states(Start.fresh(ids), 1)[1]["element"] for model in (rules, mutant)]
    assert (ends[0] != ends[1]).any()
    assert why_incomparable(rules, rules) is None
    assert "gravity" in (why_incomparable(rules, mutant) or "")


def test_a_wider_range_is_compared_under_the_narrower_one() -> None:
    pack = """
pack: clock
elements: {tick: {id: 0, color: "#000000"}}
fields: {age: {type: 0..RANGE, at: place}}
passes:
  grow:
    do: age := min(age + 1, 5)
"""
    few, many, more = (load_text(pack.replace("RANGE", most)) for most in ("5", "9", "100"))
    with deep_recursion():
        assert differs(Side.of(few), Side.of(many), Budget.of(10)) is None
        assert differs(Side.of(more), Side.of(few), Budget.of(10)) is None
    short = load_text(pack.replace("RANGE", "4"))
    with deep_recursion():
        assert differs(Side.of(few), Side.of(short), Budget.of(10)) is not None


def test_a_mutant_that_holds_fewer_values_is_not_equal() -> None:
    pack = """
pack: store
elements: {shelf: {id: 0, color: "#000000"}}
fields: {full: {type: 0..MOST, at: place}, mark: {type: flag, at: place}}
passes:
  look:
    do: mark := yes where full > 90
"""
    sims = {most: compile(load_text(pack.replace("MOST", most)), "wasm") for most in ("5", "9")}
    assert compare(sims["5"], sims["9"], 10).status == "equal"
    assert compare(sims["9"], sims["5"], 10).status != "equal"
    shared = compare(sims["9"], sims["5"], 10, names=Renaming())
    assert shared.status == "equal"
    assert shared.given == ("`full` starts with what both can hold",)


def test_passes_that_read_alike_are_compared_where_a_parameter_has_another_value() -> None:
    pack = """
pack: clock
params: {most: {type: 0..9, default: 5}}
elements: {tick: {id: 0, color: "#000000"}}
fields: {age: {type: 0..9, at: place}, old: {type: flag, at: place}}
passes:
  grow:
    do: age := min(age + 1, most)
  judge:
    after: grow
    do: old := yes where age > 3
"""
    rules = load_text(pack)
    renamed = load_text(pack.replace("judge:", "decide:"))
    other = load_text(pack.replace("judge:", "decide:").replace("default: 5", "default: 4"))
    with deep_recursion():
        assert differs(Side.of(rules), Side.of(renamed), Budget.of(10)) is None
        difference = differs(Side.of(rules), Side.of(other), Budget.of(10))
    assert difference is not None
    assert difference.passes == ((0,), (0,))
