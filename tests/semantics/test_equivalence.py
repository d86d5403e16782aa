"""Mutants that are proven to mean the same: what is provable, and that nothing is proven that a world refutes."""

from __future__ import annotations

import pytest

from powderdsl.diagnostics import CompileError
from powderdsl.simulation.simulator import compile
from powderdsl.testing.generators.cases import load_text
from powderdsl.testing.mutation.equivalence import proven_equal
from powderdsl.testing.mutation.judging import Original, meaning
from powderdsl.testing.properties.running import first_difference, run_sample

HEAD = """\
pack: two
elements:
  soil: {id: 0, color: "#101010", weight: 1}
  moss: {id: 1, color: "#202020", weight: 2, tags: green}
  rock: {id: 2, color: "#303030", weight: 3}
tags: {green: grows}
properties: {weight: 0..7}
streams: [luck]
fields:
  damp: {type: 0..9, at: place}
  age: {type: 0..3, at: element, of: moss}
  heat: {type: real(0..9), at: place}
passes:
  one:
"""


def body(text: str) -> str:
    return HEAD + "".join(f"    {line}\n" for line in text.splitlines())


SAME = {
    "the cell itself is not what is counted": (
        "do: soil -> moss if count(moss in ring) == 2",
        "do: soil -> moss if count(moss) == 2",
    ),
    "a condition that another one contains": (
        "do: soil -> rock if weight < 2 and above is moss",
        "do: soil -> rock if above is moss",
    ),
    "coordinates": (
        "do: soil -> moss if (row + step) mod 2 == 0",
        "do: soil -> moss if (row - step) mod 2 == 0",
    ),
    "a draw between the same thresholds": (
        "do: soil -> moss if luck < 20% or luck < 50%",
        "do: soil -> moss if luck < 50%",
    ),
    "fields that only some have": ("do: soil -> rock if age == 0", "do: soil -> rock"),
    "a value that is fixed in the same substep": (
        "let: {wet: damp > 2}\ndo: soil -> moss if wet",
        "let: {wet: damp > 2}\ndo: soil -> moss if damp > 2 or wet",
    ),
    "a property that cells of other elements hold one at a time": (
        "do: rock -> soil if weight == 3 and above is moss\nthen: weight := 1 where moss",
        "do: rock -> soil if above is moss\nthen: weight := 1 where moss",
    ),
    "the cell itself is not what is counted, of more than can be tried": (
        "do: soil -> moss if count(damp > 4 and age == 1) == 2",
        "do: soil -> moss if count((damp > 4 and age == 1) in ring) == 2",
    ),
    "rules whose counts exclude each other": (
        "do:\n  - soil -> moss if count(damp > age) in 1..3\n  - soil -> rock if count(damp > age) > 3",
        "do:\n  - soil -> rock if count(damp > age) > 3\n  - soil -> moss if count(damp > age) in 1..3",
    ),
}

OTHER = {
    "the cell itself is counted, among more than can be tried": (
        "do: moss -> soil if count((damp > 4 and age == 1) in ring) == 2",
        "do: moss -> soil if count(damp > 4 and age == 1) == 2",
    ),
    "a property that cells hold one at a time": (
        "do: moss -> soil if weight == 2\nthen: weight := 1 where moss and above is rock",
        "do: moss -> soil\nthen: weight := 1 where moss and above is rock",
    ),
    "a count of more than can be tried": (
        "do: moss -> soil if count(damp > 4 and age == 1) == 2",
        "do: moss -> soil if count(damp > 4 and age == 2) == 2",
    ),
    "edges": ("do: soil -> moss if left is rock", "do: soil -> moss if left is rock and inside(left)"),
    "floats": ("do: heat := heat * 0.5", "do: heat := heat * 0.25"),
    "an effect": (
        "do: moss swaps below if below is soil, then below.damp += 1",
        "do: moss swaps below if below is soil, then damp += 1",
    ),
}


@pytest.mark.parametrize("name", SAME)
def test_what_means_the_same_is_proven(name):
    first, second = (load_text(body(text)) for text in SAME[name])
    assert meaning(first) != meaning(second)
    assert proven_equal(first, second)


@pytest.mark.parametrize("name", OTHER)
def test_what_does_not_is_not(name):
    first, second = (load_text(body(text)) for text in OTHER[name])
    assert not proven_equal(first, second)
    assert not proven_equal(second, first)


def claimed(rules: str, most: int):
    """Proofs that mutants of some rules are equal, and whether a world says otherwise."""
    original = Original.of(rules)
    for mutant in original.mutants()[::-1][:most]:
        try:
            mutated = original.mutated(mutant)
        except CompileError:
            continue
        if mutated is None:
            continue
        ruleset, _ = mutated
        if meaning(ruleset) != meaning(original.ruleset) and proven_equal(original.ruleset, ruleset):
            sim = compile(ruleset, backend="wasm")
            wrong = any(
                first_difference(batch.states, run_sample(sim, batch.sample, batch.steps)[0]).any()
                for batch in original.batches()
            )
            yield mutant, wrong


@pytest.mark.parametrize("rules", ["life", "wireworld", "brians_brain"])
def test_no_world_refutes_a_proof(rules):
    found = list(claimed(rules, 1000))
    assert found
    assert not [mutant.key for mutant, wrong in found if wrong]


@pytest.mark.campaign
@pytest.mark.parametrize(
    "rules", ["cyclic", "forest_fire", "langtons_ant", "margolus", "core+water+sand", "core+fire+lava"]
)
def test_no_world_refutes_a_proof_of_larger_rules(rules):
    assert not [mutant.key for mutant, wrong in claimed(rules, 1000) if wrong]
