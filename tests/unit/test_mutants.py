"""Mutants as text: which mistakes are made, where, and that nothing else of the file changes."""

from __future__ import annotations

from functools import cache

import pytest

from powderdsl.compiler import read, shipped_tests, shipped_variants
from powderdsl.diagnostics import Reporter, Source
from powderdsl.model.declarations import read_file
from powderdsl.testing.mutation.operators import mutants_of, names_of
from tests.tiers import tiered

PACK = """\
pack: moss
elements:
  soil: {id: 0, color: "#101010", weight: 2}  # a comment
  moss: {id: 1, color: "#202020", weight: 3, tags: [green, soft]}
  rock: {id: 2, color: "#303030"}
tags: {green: grows, soft: bends}
properties:
  weight: {type: 0..7, default: 1}
  heavy: {type: flag, default: no}
fields:
  damp: {type: 0..9, at: place, resets: step}
streams: [luck, fate]
params: {growth: 5%}
kernels: {far: ["1 0 1"]}
passes:
  creep:
    let: {crowd: count(moss in far)}
    do:
      - soil -> moss if above is moss and crowd < 3 and luck < growth
      - moss -> soil if crowd >= 3 or not soft
      - rock -> soil if count(moss) > 1 with chance 4%
    then:
      for side in (left, right):
        - moss swaps below.side if weight > below.side.weight, then damp += 1
  dry:
    after: creep
    symmetry: mirror
    do: damp := 0 where left is rock with chance 2%
"""


@cache
def mutants():
    reporter = Reporter()
    pack = read_file(Source("moss.yaml", PACK), reporter)
    assert not reporter.diagnostics
    return mutants_of(pack, [pack])


@pytest.mark.parametrize(
    ("operator", "line"),
    [
        ("neighbor", "- soil -> moss if below is moss and crowd < 3 and luck < growth"),
        ("neighbor", "- moss swaps below if weight > below.side.weight, then damp += 1"),
        ("comparison", "- soil -> moss if above is moss and crowd <= 3 and luck < growth"),
        ("comparison", "- soil -> moss if above is not moss and crowd < 3 and luck < growth"),
        ("constant", "- moss -> soil if crowd >= 4 or not soft"),
        ("chance", "params: {growth: 50%}"),
        ("chance", "params: {growth: 0.5%}"),
        ("chance", "do: damp := 0 where left is rock with chance 3%"),
        ("connective", "- soil -> moss if above is moss and luck < growth"),
        ("connective", "- moss -> soil if crowd >= 3 and not soft"),
        ("negation", "- moss -> soil if crowd >= 3 or soft"),
        ("guard", "- moss -> soil"),
        ("guard", "do: damp := 0 where left is rock"),
        ("effect", "- moss swaps below.side if weight > below.side.weight"),
        ("write", "- moss swaps below.side if weight > below.side.weight, then damp -= 1"),
        ("element", "- moss -> soil if above is moss and crowd < 3 and luck < growth"),
        ("tag", 'moss: {id: 1, color: "#202020", weight: 3, tags: [green]}'),
        ("kernel", "let: {crowd: count(moss)}"),
        ("kernel", "- rock -> soil if count(moss in ring) > 1 with chance 4%"),
        ("kernel", 'kernels: {far: {rows: ["1 0 1"], edges: wrap}}'),
        ("kernel", 'kernels: {far: ["1 1 1"]}'),
        ("stream", "- soil -> moss if above is moss and crowd < 3 and fate < growth"),
        ("let", "- moss -> soil if (count(moss in far)) >= 3 or not soft"),
        ("property", 'soil: {id: 0, color: "#101010", weight: 3} # a comment'),
        ("property", 'soil: {id: 0, color: "#101010"} # a comment'),
        ("property", 'rock: {id: 2, color: "#303030", heavy: yes}'),
        ("field", "damp: {type: 0..9, at: element, resets: step}"),
        ("field", "damp: {type: 0..9, at: place}"),
        ("side", "for side in (right):"),
        ("side", "symmetry: rotations"),
        ("side", "(nothing)"),
        ("order", "for side in (right, left):"),
        ("order", "before: creep"),
        ("rule", "(nothing)"),
    ],
)
def test_a_mistake_of_each_kind(operator, line):
    assert (operator, line) in [(one.operator, one.diff.split("  ⇒  ")[1]) for one in mutants()]


def test_mutants_differ_and_each_says_where():
    found = mutants()
    assert len({one.text for one in found}) == len(found) > 100
    for one in found:
        file, line, column = one.place.split(":")
        assert file == "moss.yaml"
        assert 1 <= int(line) <= len(PACK.splitlines())
        assert int(column) >= 1
        assert one.text != PACK
        assert PACK[: one.change.start] + one.change.text + PACK[one.change.end :] == one.text


@pytest.mark.parametrize("every", tiered([1, 10], [10]))
@pytest.mark.parametrize(
    "rules", tiered(sorted(set(shipped_tests()) - shipped_variants()), ["life", "powderworld"])
)
def test_shipped_mutants_are_rule_files(rules, every):
    packs, _ = read([rules], Reporter())
    for pack in packs:
        unreadable = []
        for mutant in mutants_of(pack, packs)[::every]:
            reporter = Reporter()
            read_file(Source(mutant.source.name, mutant.text), reporter)
            if reporter.has_errors:
                unreadable.append(mutant.diff)
        assert not unreadable


def test_a_name_stands_only_for_names_that_hold_the_same() -> None:
    text = """\
pack: kinds
elements: {soil: {id: 0, color: "#101010"}}
fields:
  damp: {type: 0..9, at: place}
  wet: {type: flag, at: place}
  warm: {type: -3..3, at: place}
  wind: {type: vec2(-1..1), at: place}
  storm: {type: vec2(-5..5), at: place}
params: {growth: 5%, decay: 10%, limit: 3}
"""
    pack = read_file(Source("kinds.yaml", text), Reporter())
    names = names_of([pack], pack)
    others = {name: names.others(name) for name in ("damp", "wet", "warm", "wind", "growth", "limit")}
    assert others == {
        "damp": ["warm"],
        "wet": [],
        "warm": ["damp"],
        "wind": ["storm"],
        "growth": ["decay"],
        "limit": [],
    }
