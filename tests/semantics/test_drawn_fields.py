"""Fields drawn in the tests of packs: start values, expected values, and what is wrong with a drawing."""

from __future__ import annotations

import numpy as np
import pytest

from powderdsl.simulation.draw import to_numpy
from powderdsl.simulation.simulator import compile
from powderdsl.testing.pack_tests.runner import run_examples
from tests.semantics.texts import load_text

FIELDS = """\
pack: load
elements:
  floor: {id: 0, color: "#EDF6F9", glyph: "."}
  crate: {id: 1, color: "#83C5BE"}
  heap: {id: 2, color: "#006D77"}
properties:
  hard: {type: flag, crate: yes}
fields:
  load: {type: 0..9, at: element, of: crate}
  heat: {type: real(0..100), at: place}
  wind: {type: vec2(-10..10), at: place}
  facing: {type: direction, at: element}
  seen: {type: element, at: place}
  open: {type: flag, at: place}
passes:
  wear:
    do: hard := no where crate and load == 5
"""

DRAWN = """\
    given: |
      c . c .
      . c . .
    fields:
      load: |
        2 . 1 .
        . 7 . .
      heat: 0.25
      wind: |
        1,0 (-2.5,3) . .
        . . . 1e-3,0
      facing: |
        left above.right . .
        . below . .
      seen: |
        crate h . floor
        . c . .
      hard: |
        yes . no .
        . . . .
      open: yes
    after: 0 steps
"""


def results(*, expected: str, drawn: str = DRAWN, rules: str = FIELDS):
    body = (drawn + expected).replace("\n", "\n  ").rstrip()
    worlds = []
    rules = load_text(f"{rules}tests:\n  - drawn:\n  {body}\n")
    found = run_examples(rules, sim=compile(rules, "reference", tensors=False), seen=worlds.append)
    return found[0], worlds[0]


def test_every_kind_of_field_starts_as_it_is_drawn():
    result, world = results(expected="    expect_fields: {open: yes}\n")
    assert result.passed
    state = {name: to_numpy(value)[0] for name, value in world.state.items()}
    assert state["load"].tolist() == [[2, 0, 1, 0], [0, 7, 0, 0]]
    assert (state["heat"] == 0.25).all()
    assert state["wind"][:, 0, 1].tolist() == [-2.5, 3]
    assert state["wind"][:, 1, 3].tolist() == [np.float32(1e-3), 0]
    assert state["wind"][:, 1, 0].tolist() == [0, 0]
    assert state["facing"].tolist() == [[4, 7, 0, 0], [0, 2, 0, 0]]
    assert state["seen"].tolist() == [[1, 2, 0, 0], [0, 1, 0, 0]]
    assert state["hard"].tolist() == [[1, 0, 0, 0], [0, 1, 0, 0]]
    assert state["open"].all()


def test_what_is_expected_is_compared_in_every_cell():
    expected = """\
    expect_fields:
      load: |
        2 . 0..3 .
        ? 7 0 .
      heat: 0.2..0.3
      wind: |
        1,0 -3..-2,3 . 0,0
        . . . 0.001,0
      facing: |
        left ? . right
        . below . .
      seen: |
        crate h . floor
        ? crate . .
      hard: |
        . ? no .
        . yes . .
"""
    assert results(expected=expected)[0].passed


WRONG = {
    "load: 7": "`load` in row 0, column 0 is 2, not 7",
    "heat: 0.24..0.249": "`heat` in row 0, column 0 is 0.25, not 0.24..0.249",
    "facing: |\n        left . . .\n        . . . .": "`facing` in row 0, column 1 is above.right, not right, its default",
    "wind: |\n        ? ? . .\n        . . 0,1 .": "`wind` in row 1, column 2 is 0.0,0.0, not 0,1",
    "hard: |\n        yes . ? .\n        . no . .": "`hard` in row 1, column 1 is yes, not no",
    "open: no": "`open` in row 0, column 0 is yes, not no",
}


@pytest.mark.parametrize("expected", WRONG)
def test_a_cell_that_is_not_as_expected_fails_the_test(expected):
    result, _ = results(expected=f"    expect_fields:\n      {expected}\n")
    assert result.problem == WRONG[expected]
    assert result.field == expected.split(":")[0]
    assert len(result.field_after) == 2


def test_one_word_counts_for_the_cells_that_can_have_the_field():
    drawn = "    given: c . c\n    fields: {load: 3}\n    after: 0 steps\n"
    result, world = results(drawn=drawn, expected="    expect_fields: {load: 3}\n")
    assert result.passed
    assert to_numpy(world["load"])[0].tolist() == [[3, 0, 3]]


def test_tests_of_one_size_keep_their_fields_apart():
    tests = "".join(
        f"  - load {load}:\n      given: c . c\n      fields: {{load: {load}}}\n      after: 0 steps\n"
        f"      expect_fields: {{load: {load}}}\n"
        for load in (".", 1, 9)
    )
    assert all(result.passed for result in run_examples(load_text(f"{FIELDS}tests:\n{tests}")))


def test_a_test_waits_for_the_pack_that_declares_its_field():
    test = "  - other:\n      given: c\n      fields: {elsewhere?: 3}\n      expect: c\n"
    assert load_text(f"{FIELDS}tests:\n{test}").tests == ()
