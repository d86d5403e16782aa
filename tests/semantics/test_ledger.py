"""The ledger: what it says of known rules, and samples that try to contradict it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from powderdsl.analysis.ledger import Ledger, NotProven, Proven, ledger, ledger_text, trend_text
from powderdsl.compiler import load
from powderdsl.model.state import slots
from powderdsl.model.types import ELEMENT, Ruleset
from powderdsl.simulation.simulator import World
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.testing.generators.cases import Choices, random_start
from tests.fuzz.rulemaker import random_ruleset
from tests.semantics.test_differential import compositions
from tests.semantics.texts import load_text
from tests.tiers import tiered

GOLDEN = Path(__file__).parent / "golden"

WORLDS = int(os.environ.get("LEDGER_WORLDS", "10000"))
"""Worlds of each shipped ruleset that the campaign holds against its ledger."""

SMALL = """\
pack: small
properties:
  weight: {type: 0..7}
  loose: {type: flag, default: no}
fields:
  age: {type: 0..9, at: element}
elements:
  air: {id: 0, weight: 1, color: "#ECF0F1", glyph: "."}
  brick: {id: 1, weight: 5, color: "#6C7A89", glyph: "#"}
  mud: {id: 2, weight: 2, color: "#6C7A89", glyph: m}
  grass: {id: 3, weight: 2, color: "#6C7A89", glyph: g}
"""


def small(rules: str) -> Ruleset:
    return load_text(SMALL + "passes:\n" + rules, "small.yaml")


# What it says


@pytest.mark.golden
def test_the_ledger_of_powderworld(golden: Callable[[Path, str], None]) -> None:
    golden(GOLDEN / "powderworld.ledger", ledger_text(ledger(load("powderworld"))))


@pytest.mark.parametrize("name", ["margolus", "powderworld"])
def test_editors_show_what_the_ledger_says_of_an_element(name: str) -> None:
    rules = load(name)
    text = ledger_text(ledger(rules, needs=False))
    for element in rules.elements:
        assert f"\n{element.name}: {trend_text(rules, element.id)}\n" in text


def test_what_rules_need_may_be_left_out() -> None:
    rules = load("core+water+sand+lava")
    whole, part = ledger(rules), ledger(rules, needs=False)
    assert any(entry.needs for entry in whole.rules)
    assert part.rules == tuple(replace(entry, needs=(), copies=()) for entry in whole.rules)
    assert part.keeps(["sand"], "constant") == whole.keeps(["sand"], "constant")


def test_verdicts_name_the_lines_that_stand_in_the_way() -> None:
    book = ledger(load("core+water"))
    assert book.conserved({"water": 1, "ice": 1})
    assert book.conserved({"water": 2, "ice": 2, "wall": -1})
    assert book.unchanged("wall")
    assert not book.unchanged("empty")
    verdict = book.conserved({"water": 1, "ice": 2})
    assert isinstance(verdict, NotProven)
    assert {line.pass_name for line in verdict.rules} == {"melt", "freeze"}
    falls = book.never_falls(["ice"])
    assert isinstance(falls, NotProven)
    assert [line.text for line in falls.rules] == ["ice -> water if count(thaws) > 1 and interact < melt"]
    assert isinstance(book.never_appears("ice"), Proven)
    assert book.reach(["empty", "water"]) == ("empty", "water")
    with pytest.raises(KeyError, match="no element `lava`"):
        book.conserved({"lava": 1})


def test_what_only_falls_and_only_rises() -> None:
    book = ledger(small("  rot: {do: grass -> mud with chance 5%}\n"))
    assert book.never_rises(["grass"])
    assert book.never_falls(["mud"])
    assert not book.never_rises({"mud": 1})
    assert book.never_rises({"mud": 1, "grass": 2})
    assert book.constant_sums == (("air",), ("brick",), ("mud", "grass"))
    assert book.rising_sums == (("mud",),)
    assert book.falling_sums == (("grass",),)
    assert not book.never_appears("mud")


def test_moves_that_leave_and_overwrite() -> None:
    book = ledger(small("  go: {do: mud moves right leaving grass if right is not mud}\n"))
    assert book.conserved({"mud": 1})
    verdict = book.never_falls(["brick"])
    assert isinstance(verdict, NotProven)
    assert verdict.reason == "`brick` may become `grass`"
    assert not book.unchanged("brick")


def test_properties_that_cells_override_in_turn() -> None:
    """Only what was made light becomes loose, and only what is loose changes."""
    lighten = "  lighten: {do: weight := 3 where brick}\n  loosen: {do: loose := yes where weight == 3}\n"
    book = ledger(small(lighten + "  fall: {do: any but mud -> mud if loose}\n"))
    assert book.changes.keys() == {("brick", "mud")}


def test_a_draw_may_meet_a_bound_exactly() -> None:
    text = SMALL.replace("fields:", "streams: [luck]\nfields:")
    bound = "0.000762939453125%"  # 1/2¹⁷: half a step of a draw of 16 bits
    text += f"passes:\n  rare: {{do: air -> mud if not (luck < {bound}) and not (luck > {bound})}}\n"
    assert ledger(load_text(text, "rare.yaml")).rules[0].fires


def test_policies_narrow_what_happens() -> None:
    """Under `first_wins` the second rule never gets a cell that the first one does not want."""
    rules = "  go: {conflicts: POLICY, do: [mud -> air, mud -> grass, mud -> brick if count(mud) > 3]}\n"
    wins = ledger(small(rules.replace("POLICY", "first_wins")))
    assert [entry.fires for entry in wins.rules] == [True, False, False]
    assert ledger(small(rules.replace("POLICY", "drop_both"))).changes == {}
    assert {one.outcome for one in wins.overlaps} == {"first wins"}


def test_bounds_of_fields() -> None:
    book = ledger(
        small("  tick: {do: [age := 3 where mud, age += 1 where grass]}\n  tock: {do: age := 0 where air}\n")
    )
    assert book.within("age", 0, 9) == Proven("`age` is declared as 0..9, and every write is clamped to it")
    verdict = book.within("age", 0, 5)
    assert isinstance(verdict, NotProven)
    assert [line.text for line in verdict.rules] == ["age += 1"]
    lazy = ledger(small("  tick: {do: age := 3 where mud}\n")).within("age", 0, 5)
    assert isinstance(lazy, Proven)
    assert lazy.given == "`age` within 0..5"
    with pytest.raises(KeyError, match="no field `weight`"):
        book.within("weight", 0, 9)


def test_writes_whose_order_decides() -> None:
    book = ledger(small("  tick: {do: [age += 3 where mud, age -= 1 where any, age := 5 where grass]}\n"))
    assert {(one.outcome, one.first.text, one.second.text) for one in book.overlaps} == {
        ("cut off", "age += 3", "age -= 1"),
        ("last writes", "age -= 1", "age := 5"),
    }


# Samples that try to contradict it


def contradictions(book: Ledger, ruleset: Ruleset, before: World, after: World) -> list[str]:
    """What a step, or several, did that the ledger says cannot happen."""
    old, new = before.ids.numpy(), after.ids.numpy()
    numbers = {element.name: element.id for element in ruleset.elements}
    found = []
    for sums, wrong in (
        (book.constant_sums, lambda a, b: a != b),
        (book.rising_sums, lambda a, b: b < a),
        (book.falling_sums, lambda a, b: b > a),
    ):
        for names in sums:
            ids = [numbers[name] for name in names]
            counts = [np.isin(part, ids).sum((1, 2)) for part in (old, new)]
            if wrong(*counts).any():
                found.append(f"the sum of {names}")
    fields = [slot.name for slot in slots(ruleset)[1:] if slot.kind == ELEMENT and not slot.resets]
    named = [before.state[name].numpy() for name in fields]
    for name in book.elements:
        if book.unchanged(name) and (new[old == numbers[name]] != numbers[name]).any():
            found.append(f"{name} does not stay")
        if book.never_appears(name):
            lacking = ~np.any([(part == numbers[name]).any((1, 2)) for part in (old, *named)], 0)
            if (new[lacking] == numbers[name]).any():
                found.append(f"{name} appears")
    for world in range(0, len(old), 10):
        parts = [part[world].ravel() for part in (old, *named)]
        start = {name for name in book.elements if any((part == numbers[name]).any() for part in parts)}
        reach = [numbers[name] for name in book.reach(start)]
        if not np.isin(new[world], reach).all():
            found.append(f"{start} reach more")
    for entry in book.fields:
        if entry.name in after.state and entry.bounds is not None:
            values = after.state[entry.name].numpy()
            if values.min() < entry.bounds[0] or values.max() > entry.bounds[1]:
                found.append(f"{entry.name} leaves its bounds")
    return found


def sampled(ruleset: Ruleset, batches: int, worlds: int, side: int, steps: int, backend: str) -> list[str]:
    """Contradictions that random worlds find, after every step and over all of them."""
    book = ledger(ruleset)
    simulator = compile_ruleset(ruleset, backend=backend)
    found: list[str] = []
    for batch in range(batches):
        start = random_start(ruleset, Choices.seeded(batch), (worlds, side, side))
        first = world = start.world(simulator)
        for _ in range(steps):
            last, world = world, simulator.step(world, params=start.params or None)
            found += contradictions(book, ruleset, last, world)
        found += contradictions(book, ruleset, first, world)
    return found


@pytest.mark.parametrize("name", tiered(compositions(), ["core+bird", "core+wind", "life", "powderworld"]))
@pytest.mark.parametrize("worlds", tiered([100, WORLDS], [100]))
def test_random_worlds_do_not_contradict_the_ledger_of_shipped_rules(name: str, worlds: int) -> None:
    assert sampled(load(name), worlds // 100, worlds=100, side=16, steps=3, backend="wasm") == []


def test_random_worlds_do_not_contradict_the_ledger_of_random_rules(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("powderdsl.analysis.ledger.BUDGET", 50_000)  # some exceed it: that is sound too
    rulesets = [*filter(None, map(random_ruleset, range(20)))]
    assert len(rulesets) > 15
    for ruleset in rulesets:
        assert sampled(ruleset, 2, worlds=20, side=6, steps=2, backend="reference") == [], ruleset.name


def test_contradictions_are_seen() -> None:
    """A ledger that promises too much is contradicted by worlds alone."""
    ruleset = load("core+water")
    book = ledger(ruleset)
    hopeful = replace(book, rules=tuple(replace(entry, changes=(), moves=()) for entry in book.rules))
    simulator = compile_ruleset(ruleset, backend="torch")
    before = random_start(ruleset, Choices.seeded(1), (4, 16, 16)).world(simulator)
    after = simulator.step(before, 4)
    found = contradictions(hopeful, ruleset, before, after)
    assert {"the sum of ('ice',)", "water does not stay"} <= set(found)
    assert contradictions(book, ruleset, before, after) == []
