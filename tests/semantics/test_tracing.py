"""Why a cell holds what it holds: on worlds drawn by hand, for each kind of rule, and on random rules for all of them."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from powderdsl.compiler import load
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import World, compile
from powderdsl.simulation.tracing import Attempt, RecordedStep, Trace, pick, trace, trace_data, trace_text
from powderdsl.testing.generators.cases import Choices, random_start
from tests.fuzz.rulemaker import random_ruleset
from tests.semantics.texts import load_text
from tests.tiers import tiered

HEAD = """\
pack: lab
properties: {{weight: 0..9}}
params: {{luck: 0%}}
fields:
  heat: {{type: 0..9, at: element}}
  mark: {{type: 0..9, at: place, resets: step}}
  gale: {{type: vec2(-9..9), at: place}}
streams: [coin]
elements:
  void: {{id: 0, color: "#000000", glyph: ".", weight: 1}}
  rock: {{id: 1, color: "#111111", glyph: "o", weight: 5}}
  bomb: {{id: 2, color: "#222222", glyph: "b", weight: 5}}
  moth: {{id: 3, color: "#333333", glyph: "m"}}
passes:
  work:
    {body}
"""


@cache
def lab(body: str) -> Ruleset:
    return load_text(HEAD.format(body="\n    ".join(body.splitlines())), "lab.yaml")


def line_of(ruleset: Ruleset, text: str) -> int:
    """The line of the file that has this text; there must be one."""
    lines = ruleset.elements[0].span.source.text.splitlines()
    return next(number for number, line in enumerate(lines, 1) if text in line)


def world_of(ruleset: Ruleset, drawing: str, **fields: int) -> World:
    sim = compile(ruleset, backend="reference")
    numbers = {element.glyph: element.id for element in ruleset.elements}
    world = sim.world([[numbers[char] for char in row] for row in drawing.split("/")])
    return sim.replace(world, **fields)


def traced(body: str, drawing: str, row: int, column: int, of: str = "element", **fields: int) -> Trace:
    return trace(world_of(lab(body), drawing, **fields), row, column, of=[of])


def only_miss(found: Trace) -> Attempt:
    assert len(found.misses) == 1, found.misses
    return found.misses[0]


def values(miss_or_parts: object) -> dict[str, object]:
    return {read.text: read.value for part in miss_or_parts for read in part.reads}  # type: ignore[attr-defined]


# What happened


def test_a_swap_names_its_rule_and_both_sources():
    body = "do:\n  - swap below if rock and weight > below.weight and below is void"
    read = {"element": "rock", "weight": 5, "below.weight": 1, "below": "void"}
    for row, source in ((1, (0, 0)), (0, (1, 0))):
        found = traced(body, "o/.", row, 0)
        (write,) = found.writes
        assert (write.how, write.source, write.attempt.cell) == ("arrive", source, (0, 0))
        assert write.attempt.rule.span.line == line_of(lab(body), "swap below")
        assert values(write.attempt.parts) == read
        assert found.writer() is write.attempt.rule


def test_content_that_moves_brings_its_fields_as_assignments_left_them():
    body = "do:\n  - heat := 7 where rock\n  - rock moves right leaving moth if right is void"
    found = traced(body, "o.m", 0, 1, "heat")
    (write,) = found.writes
    assert (write.source, int(write.before), int(write.after)) == ((0, 0), 0, 7)
    left = traced(body, "o.m", 0, 0, "heat")
    assert [(one.how, int(one.after)) for one in left.writes] == [("assign", 7), ("leave", 0)]


def test_a_push_and_an_effect_name_the_cell_whose_condition_held():
    found = traced("do: push gale by 3 away from bomb", ".b.", 0, 0, "gale")
    (write,) = found.writes
    assert write.attempt.cell == (0, 1)
    assert write.after.tolist() == [0, -3]
    found = traced("do: rock -> void, then right.mark += 2", "o.", 0, 1, "mark")
    (effect,) = [one for one in found.writes if one.attempt]
    assert (effect.how, effect.attempt.cell, int(effect.after)) == ("effect", (0, 0), 2)


def test_what_no_rule_does_is_told_too():
    ruleset = lab("do: heat += 1 where rock")
    start = replace(world_of(ruleset, "o"))
    start = start.sim.replace(start, mark=4)
    found = trace(start, 0, 0)
    assert [(one.slot.name, one.how) for one in found.writes] == [("mark", "reset"), ("heat", "assign")]
    assert found.writer("mark") is None


# What nearly happened


def test_a_chance_that_failed_shows_the_draw_and_the_chance():
    miss = only_miss(traced("do: rock -> bomb if coin < luck", "o", 0, 0))
    (part,) = miss.failed
    read = values([part])
    assert read["lab.luck"] == 0
    clock = world_of(lab("do: rock -> bomb if coin < luck"), "o")
    step = RecordedStep(clock, (0, 0))
    assert read["draw(coin)"] == float(step.substeps[0].at.draws["coin"][0, 0, 0])
    assert part.expr.span.text == "coin < luck"


def test_a_count_names_the_neighbors_it_found():
    miss = only_miss(traced("do: rock -> moth if count(bomb) > 2", "b../.ob/...", 1, 1))
    (part,) = miss.failed
    (read,) = part.reads
    assert (read.value, read.counted) == (2, ((0, 0), (1, 2)))
    found = traced("do: rock -> moth if count(bomb) > 2", "b../bob/...", 1, 1)
    assert not found.misses
    asked = found.writes[0].attempt
    assert asked.parts[1].reads[0].counted == ((0, 0), (1, 0), (1, 2))


def test_a_let_is_taken_apart_as_it_was_fixed():
    body = "let: {ready: rock and count(bomb) > 0 and below is void}\ndo: bomb -> void\nthen: rock -> moth if ready"
    found = traced(body, "ob/..", 0, 0)
    asked = found.writes[0].attempt  # the bomb was still there when it was fixed
    assert {part.let for part in asked.parts} == {None, "ready"}
    miss = only_miss(traced(body, "ob/oo", 0, 0))
    (part,) = miss.failed
    assert (part.let, values([part])) == ("ready", {"below": "rock"})
    assert part.expr.span.line == line_of(lab(body), "let:")


def test_a_rule_about_other_elements_is_no_near_miss_unless_all_are_asked_for():
    body = "do:\n  - rock -> bomb if below is void\n  - moth -> bomb if below is rock and right is rock"
    world = world_of(lab(body), "m./..")
    assert trace(world, 0, 0).misses == ()
    every = trace(world, 0, 0, every_rule=True)
    assert [len(one.failed) for one in every.misses] == [1, 2]


def test_a_rule_that_gave_way_says_so():
    body = "conflicts: drop_both\ndo:\n  - rock -> bomb\n  - swap right if rock"
    miss = trace(world_of(lab(body), "o.."), 0, 0, of=["element"]).misses
    assert [(one.failed, one.gave_way) for one in miss] == [((), "drop_both")] * 2


# Random rules and worlds


@pytest.mark.parametrize("name", ["powderworld", "langtons_ant", "margolus", "cyclic"])
def test_shipped_rules_are_explained(name):
    assert explained(load(name), (1, 5, 6), 1) > 0


@pytest.mark.parametrize("first", tiered([0, 10], [0]))
def test_random_rules_are_explained(first):
    """Writes follow on each other, end in what the step left, and every change has one; so does every shape."""
    rulesets = filter(None, map(random_ruleset, range(first, first + 10)))
    assert sum(explained(one, shape, first) for one in rulesets for shape in ((2, 3, 4), (1, 1, 2))) > 100


def test_whatever_happens_can_be_printed():
    """Text and JSON of random cells under random rules; a failed part never holds, a happening has none."""
    printed = 0
    for seed, ruleset in enumerate(filter(None, map(random_ruleset, range(60, 70)))):
        sim = compile(ruleset, backend="reference")
        world = replace(random_start(ruleset, Choices.seeded(seed), (1, 3, 4)), params={}).world(sim)
        found = trace(world, seed % 3, seed % 4, 2, every_rule=True)
        data = json.loads(json.dumps(trace_data(found), allow_nan=False))
        assert len(data["writes"]) == len(found.writes)
        assert all(part.holds for write in found.writes if write.attempt for part in write.attempt.parts)
        text = trace_text(found)
        assert text.startswith(f"cell {seed % 3},{seed % 4} in step")
        assert text.count("but for") == len(found.misses)
        printed += len(found.misses)
    assert printed > 20


def explained(ruleset: Ruleset, shape: tuple[int, int, int], seed: int) -> int:
    """Check every cell of random worlds; how many writes by rules there were."""
    sim = compile(ruleset, backend="reference")
    world = replace(random_start(ruleset, Choices.seeded(seed), shape), params={}).world(sim)
    count = 0
    for number in range(len(world)):
        after = sim.step(world).select([number]).state
        for cell in np.ndindex(*shape[1:]):
            step = RecordedStep(world.select([number]), cell)
            writes = step.writes
            for name in step.end:
                held = pick(step.begin[name], cell)
                for write in writes:
                    if write.slot.name == name:
                        assert np.array_equal(write.before, held), (name, cell, write)
                        assert write.changed or write.attempt is not None
                        held = write.after
                assert np.array_equal(held, pick(after[name].numpy(), cell)), (name, cell)
            for write in writes:
                if write.attempt is not None:
                    assert write.attempt.happened
                    count += 1
    return count
