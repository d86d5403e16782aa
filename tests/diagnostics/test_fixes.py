"""Forty mistakes of newcomers: each is found at its place, and what the help prints leads to a file without it."""

from __future__ import annotations

from pathlib import Path

import pytest

from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import CompileError, Diagnostic

PACK = """pack: hill
needs: [core, sand]
fields:
  age: {{type: 0..100, at: element, of: ant}}
elements:
  ant: {{density: 2, color: "#1B1B1E"}}
passes:
  walk:
    do:
      - {}
"""

# The rule; the text under the caret; a part of the help; the rule as the help has it.
# fmt: off
MISTAKES = [
    ("ant swaps right with 50%", "50%", "write `with chance 50%`", "ant swaps right if right is wall with chance 50%"),
    ("ant swaps right with chance 50% if right is empty", "if", "the chance comes last", "ant swaps right if right is empty with chance 50%"),
    ("ant -> empty 50%", "50%", "write `with chance 50%`", "ant -> empty with chance 50%"),
    ("ant -> empty with probability 50%", "probability", "write `with chance`", "ant -> empty with chance 50%"),
    ("ant -> empty with chance 5", "5", "did you mean `5%`?", "ant -> empty with chance 5%"),
    ("ant -> empty if random() < 0.5", "random", "write `with chance 5%` at the end of the rule", "ant -> empty with chance 5%"),
    ("ant -> empty if count(age > 0 in ring) > 1", "in", "`count((CONDITION) in ring)`", "ant -> empty if count((age > 0) in ring) > 1"),
    ("ant -> empty if count(empty) in disc(3) > 4", ">", "`count(SET in ring)`", "ant -> empty if count(empty in disc(3)) > 4"),
    ("ant -> empty if sum(age) > 3 of ring", "of", "`sum(SET in ring)`", "ant -> empty if sum(age in ring) > 3"),
    ("ant -> empty if neighbors(ant) > 2", "neighbors", "`count(SET in ring)`", "ant -> empty if count(ant in ring) > 2"),
    ("ant -> empty if any neighbor is wall", "neighbor", "any(side is SET for side in sides)", "ant -> empty if any(side is wall for side in sides)"),
    ("ant -> empty if all(sides) is wall", ")", "all(side is SET for side in sides)", "ant -> empty if all(side is wall for side in sides)"),
    ("ant -> empty if above(2) is empty", "above", "here `at(-2, 0)`", "ant -> empty if at(-2, 0) is empty"),
    ("ant -> empty if right(2) is empty", "right", "here `at(0, 2)`", "ant -> empty if at(0, 2) is empty"),
    ("ant -> empty if distance(wall) < 3", "distance", "count(SET in disc(3)) > 0", "ant -> empty if count(wall in disc(3)) > 0"),
    ("ant -> empty if up is empty", "up", "write `above`", "ant -> empty if above is empty"),
    ("ant -> empty if below is wall or sand", "below is wall or sand", "write `below is (wall, sand)`", "ant -> empty if below is (wall, sand)"),
    ("ant -> empty if left is not a wall", "wall", "leave out `a`", "ant -> empty if left is not wall"),
    ("ant -> empty if below.wall", "wall", "write `below is wall`", "ant -> empty if below is wall"),
    ("ant -> empty if above = empty", "=", "ask for an element with `is`", "ant -> empty if above is empty"),
    ("ant -> empty if age = 3", "=", "compare with `==`", "ant -> empty if age == 3"),
    ("ant -> empty if age > 2 && above is empty", "&", "write `and`", "ant -> empty if age > 2 and above is empty"),
    ("ant -> empty if age => 3", "=", "write `>=`", "ant -> empty if age >= 3"),
    ("ant => empty", "=", "write `->`", "ant -> empty"),
    ("ant becomes empty", "becomes", "write `->`", "ant -> empty"),
    ("ant -> empty when left is empty", "when", "write `if`", "ant -> empty if left is empty"),
    ("ant -> empty unless left is empty", "unless", "write `if not`", "ant -> empty if not left is empty"),
    ("if age > 2 then ant -> empty", "if", "`this -> that if …`", "ant -> empty if age > 2"),
    ("spawn ant in empty", "ant", "write `empty -> ant with chance 1%`", "empty -> ant with chance 1%"),
    ("ant moves right", "\n", "`SET moves below leaving ELEMENT if …`", "ant moves right leaving empty if right is empty"),
    ("ant -> empty after 3 steps", "after", "`age += 1 where SET`, and `… if age > 3`", "ant -> empty if age > 3"),
    ("age = age + 1 where ant", "=", "assign with `:=`", "age := age + 1 where ant"),
    ("age := age + 1 if ant", "\n", "`field := value where condition`", "age := age + 1 where ant"),
    ("set age to 3 where ant", "age", "write `age := VALUE where …`", "age := 3 where ant"),
    ("ant -> empty, age := 0", "age", "`…, then field := value`", "ant -> empty, then age := 0"),
    ("ant -> empty if age > 200", "ant -> empty if age > 200", "change the underlined conditions", "ant -> empty if age > 99"),
    ("ant -> empty if density > 10 and left is empty", "ant -> empty if density > 10 and left is empty", "change the underlined conditions", "ant -> empty if density > 1 and left is empty"),
    ("ant -> empty if count(ant) > 9", "ant -> empty if count(ant) > 9", "change the underlined conditions", "ant -> empty if count(ant) > 8"),
    ("ant -> empty if count(antt) > 2", "antt", "did you mean `ant`?", "ant -> empty if count(ant) > 2"),
    ("ant -> empty if count(fire) > 2", "fire", "or write `fire?`", "ant -> empty if count(fire?) > 2"),
    ("ant -> empty if interacts < 5%", "interacts", "did you mean `interact`?", "ant -> empty if interact < 5%"),
]
# fmt: on


def diagnosed(rule: str, folder: Path) -> list[Diagnostic]:
    """The errors in a pack with one rule, or else what is said of the rule."""
    path = folder / "hill.yaml"
    path.write_text(PACK.format(rule), encoding="utf-8")
    try:
        remarks = load_with_diagnostics(path)[1]
    except CompileError as error:
        return list(error.diagnostics)
    return [remark for remark in remarks if remark.code == "PD503"]


@pytest.mark.parametrize(("rule", "caret", "fix", "fixed"), MISTAKES, ids=[row[0] for row in MISTAKES])
def test_the_fix_of_a_mistake_works_as_printed(
    rule: str, caret: str, fix: str, fixed: str, tmp_path: Path
) -> None:
    (found,) = diagnosed(rule, tmp_path)
    assert found.primary.span is not None
    assert found.primary.span.line == 10
    assert found.primary.span.text == caret
    assert any(fix in line for line in (*found.helps, *found.notes)), found.helps
    assert diagnosed(fixed, tmp_path) == []


def test_conditions_that_exclude_each_other_are_underlined(tmp_path: Path) -> None:
    (found,) = diagnosed("ant -> empty if left is wall and age > 3 and left is (sand, empty)", tmp_path)
    assert [label.span.text for label in found.secondary] == ["left is wall", "left is (sand, empty)"]
    (found,) = diagnosed("ant -> empty if age > 200 and left is wall", tmp_path)
    assert [label.span.text for label in found.secondary] == ["age > 200"]
    assert found.notes == ("`age` is in 0..100",)
