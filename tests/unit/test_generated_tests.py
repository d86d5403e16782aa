"""Tests that the tool writes into packs: where they go in a file, and that all else stays."""

from __future__ import annotations

import pytest

from powderdsl.diagnostics import Source
from powderdsl.prover.symbolic import Renaming
from powderdsl.simulation.simulator import compile
from powderdsl.testing.mutation.judging import GeneratedTest, Original, judge, with_tests, written_test
from powderdsl.testing.pack_tests.runner import run_examples
from powderdsl.testing.properties.comparison import distinguish
from tests.semantics.texts import load_text

NEW = GeneratedTest("p", "generated x", "- generated x:\n    given: a\n    expect: a\n")
HEAD = 'pack: p\nelements: {a: {id: 0, color: "#101010", glyph: a}}\n'


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (HEAD, HEAD + "tests:\n  - generated x:\n      given: a\n      expect: a\n"),
        (
            HEAD + "tests:\n- one:  # zero columns in\n    given: a\n    expect: a",
            HEAD
            + "tests:\n- one:  # zero columns in\n    given: a\n    expect: a\n"
            + "- generated x:\n    given: a\n    expect: a\n",
        ),
        (
            "tests:\n    - one:\n        given: a\n        expect: a\n\n# about the pack\n" + HEAD,
            "tests:\n    - one:\n        given: a\n        expect: a\n"
            "    - generated x:\n        given: a\n        expect: a\n\n# about the pack\n" + HEAD,
        ),
        (
            HEAD + "tests:\n  - one:\n      given: |\n        a\n      expect: |\n        a\n\n",
            HEAD
            + "tests:\n  - one:\n      given: |\n        a\n      expect: |\n        a\n"
            + "  - generated x:\n      given: a\n      expect: a\n\n",
        ),
    ],
)
def test_a_test_is_added_at_the_end_of_the_tests(before, after):
    assert with_tests(Source("p.yaml", before), [NEW]) == after
    assert [one.name for one in load_text(after).tests][-1] == "generated x"


def test_a_list_in_brackets_cannot_be_added_to():
    with pytest.raises(ValueError, match="is not a list"):
        with_tests(Source("p.yaml", HEAD + "tests: [{one: {given: a, expect: a}}]\n"), [NEW])


FIELDS = """\
pack: count
elements:
  off: {id: 0, color: "#101010"}
  on: {id: 1, color: "#202020"}
fields:
  charge: {type: 0..9, at: place}
  flow: {type: vec2(-9..9), at: place}
passes:
  one:
    do:
      - charge += 2 where on
      - flow := flow + vector(0.5, 1) where on
      - off -> on if charge == 9 and flow.row > 3
"""


@pytest.mark.parametrize(
    ("old", "new", "drawn"),
    [
        ("charge += 2", "charge += 3", "expect_fields:"),
        ("vector(0.5, 1)", "vector(0.5, 2)", "expect_fields:"),
        ("flow.row > 3", "flow.row < 3", " fields:"),
    ],
)
def test_fields_are_drawn_where_elements_do_not_tell(tmp_path, old, new, drawn):
    path = tmp_path / "count.yaml"
    path.write_text(FIELDS)
    original = Original.of(str(path))
    mutant = original.mutants()[0]
    changed = compile(load_text(FIELDS.replace(old, new)), backend="wasm")
    found = distinguish(original.sim, changed, (), 0, None, Renaming())
    assert found is not None
    text = written_test(mutant, found, original.sim, original.packs).text
    assert drawn in text
    body = "tests:\n" + "".join(f"  {line}\n" for line in text.splitlines())
    assert run_examples(load_text(FIELDS + body))[0].passed
    assert not run_examples(load_text(FIELDS.replace(old, new) + body))[0].passed


def test_a_world_with_other_parameters_is_a_test_that_sets_them():
    forest = Original.of("forest_fire")
    mutant = next(mutant for mutant in forest.mutants() if mutant.operator == "order")
    verdict = judge(forest, mutant)
    assert verdict.status == "survived"
    assert "params: {forest_fire.growth: 50%, forest_fire.lightning: 0%}" in verdict.test.text
    for text, passes in ((mutant.source.text, True), (mutant.text, False)):
        results = run_examples(load_text(with_tests(Source("more.yaml", text), [verdict.test])))
        assert results[-1].passed == passes
