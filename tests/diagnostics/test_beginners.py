"""Slips of people who are new to the language: a true message, the caret where it belongs, a fix that works.

A row has a mistake, the code, the text under the caret, and the mistake as it looks once the fix is followed. What the
fix says must contain what was written instead.
"""

from __future__ import annotations

from pathlib import Path

import pytest

import powderdsl
from powderdsl.diagnostics import CompileError
from tests.cli.commands import powderdsl as command

PACK = """\
pack: yard
needs: [core]
elements:
  soil: {id: 31, color: "#806040", density: 4}
  weed: {id: 32, color: "#30A030", density: 4}
fields:
  heat: {type: 0..99, at: place}
  warm: {type: real(0..1), at: place}
passes:
  grow:
    do: RULE
"""
TEST = """\
tests:
  - drawn:
      given: GIVEN
      after: 0 steps
      expect: EXPECT
"""

# fmt: off
RULES = [
    # mistake, code, caret, what it should be, part of the fix
    ("heat += heat / 8 where soil", "PD401", "heat / 8", "heat += heat div 8 where soil", "`heat div 8`"),
    ("heat := heat * 0.9 where soil", "PD401", "heat * 0.9", "heat := heat * 9 div 10 where soil", "`heat * 9 div 10`"),
    ("heat := heat * 0.5 where soil", "PD401", "heat * 0.5", "heat := heat div 2 where soil", "`heat div 2`"),
    ("heat := heat // 2 where soil", "PD201", "/", "heat := heat div 2 where soil", "`a div b`"),
    ("heat := heat ** 2 where soil", "PD201", "*", "heat := heat * heat where heat < 9", "`x * x`"),
    ("heat := heat % 2 where soil", "PD201", "%", "heat := heat mod 2 where soil", "`mod`"),
    ("heat++ where soil", "PD201", "+", "heat += 1 where soil", "`heat += 1`"),
    ("set heat to 3 where soil", "PD201", "heat", "heat := 3 where soil", "`heat := VALUE where …`"),
    ("heat = 3 where soil", "PD201", "=", "heat := 3 where soil", "`:=`"),
    ("heat += 1 if soil", "PD201", "\n", "heat += 1 where soil", "where"),
    ("soil -> weed if count soil > 2", "PD201", "soil", "soil -> weed if count(soil) > 2", "`count(soil)`"),
    ("soil -> weed if below soil", "PD201", "soil", "soil -> weed if below is soil", "`below is soil`"),
    ("soil -> weed if below.soil", "PD401", "soil", "soil -> weed if below is soil", "`below is soil`"),
    ("soil -> weed if up is soil", "PD301", "up", "soil -> weed if above is soil", "`above`"),
    ("soil moves down leaving weed if below is weed", "PD301", "down", "soil moves below leaving weed if below is weed", "`below`"),
    ("soil swaps with below", "PD201", "with", "soil swaps below if below is weed", "swaps PLACE"),
    ("soil moves below", "PD201", "\n", "soil moves below leaving weed if below is weed", "leaving ELEMENT"),
    ("soil -> weed with chance .5", "PD201", ".", "soil -> weed with chance 0.5", "`0.5`"),
    ("soil -> weed with chance 5", "PD403", "5", "soil -> weed with chance 5%", "`5%`"),
    ("soil -> weed if random < 0.5", "PD301", "random", "soil -> weed with chance 50%", "with chance"),
    ("soil -> weed if neighbors(soil) > 2", "PD301", "neighbors", "soil -> weed if count(soil) > 2", "`count(SET)`"),
    ("heat := round(warm) where soil", "PD301", "round", "heat := heat div 2 where soil", "`a div b`"),
    ("soil -> weed if True", "PD301", "True", "soil -> weed if yes", "`yes`"),
    ("soil -> none", "PD301", "none", "soil -> empty", "`empty`"),
    ("soil -> weed if count(soil in box 2) > 2", "PD201", "2", "soil -> weed if count(soil in box(2)) > 2", "`box(2)`"),
    ("soil -> weed if count(soil in disc) > 2", "PD406", "disc", "soil -> weed if count(soil in disc(3)) > 2", "`disc(3)`"),
    # characters that only look right
    ("soil -> weed if count(s\u043eil) > 1", "PD201", "\u043e", "soil -> weed if count(soil) > 1", "`o`"),
    ("soil\u00a0-> weed", "PD201", "\u00a0", "soil -> weed", "a plain space"),
    ("heat := heat \u2212 1 where soil", "PD201", "\u2212", "heat := heat - 1 where heat > 0", "`-`"),
    ("soil \u2013> weed", "PD201", "\u2013", "soil -> weed", "`-`"),
    ("so\u200bil -> weed", "PD201", "\u200b", "soil -> weed", "remove it"),
    ("soil -> weed if count(soil) \uff1e 1", "PD201", "\uff1e", "soil -> weed if count(soil) > 1", "`>`"),
]
DRAWN = [
    # given, expect, code, caret, given and expect as they should be
    ("s w", "? ?", "PD103", "?", "s w", '"? ?"'),
    ("s w", "?", "PD103", "?", "s w", '"? ?"'),
    ("# s #", '"# s #"', "PD110", "# s #", '"# s #"', '"# s #"'),
    ("s # w", "s # w", "PD110", "# w", '"s # w"', '"s # w"'),
    ("* s", "w w", "PD103", "*", '". s"', '". s"'),
    ("! s", "w w", "PD105", "!", '". s"', '". s"'),
    ("- s", "w w", "PD103", "-", '". s"', '". s"'),
    ("> s", "w w", "PD103", "s", '". s"', '". s"'),
    ("[ s", "w w", "PD103", "[", '". s"', '". s"'),
]
WORDS = [
    # text, what stands there instead, code, caret, part of the fix
    ("density: 4}\n  weed", "density: 4, gravity: maybe}\n  weed", "PD110", "maybe", "`yes`"),
    ("density: 4}\n  weed", "density: 4, gravity: Yes}\n  weed", "PD110", "Yes", "write `yes`"),
    ("density: 4}\n  weed", "density: heavy}\n  weed", "PD110", "heavy", "from 0 to 7"),
    ("do: RULE", "repeat 0: RULE", "PD508", "repeat 0", "1 to 64"),
    ("do: RULE", "repeat: RULE", "PD108", "repeat", "`repeat 3:`"),
    ("do: RULE", "rules: RULE", "PD108", "rules", "`do`"),
    ("weed: {", "w\u0435ed: {", "PD111", "w\u0435ed", "U+0435 CYRILLIC SMALL LETTER IE"),
]
# fmt: on


def load(text: str, folder: Path) -> tuple:
    path = folder / "yard.yaml"
    path.write_text(text, encoding="utf-8")
    try:
        powderdsl.load("core", path)
    except CompileError as error:
        return tuple(error.diagnostics)
    return ()


def check(text: str, code: str, caret: str, fix: str, folder: Path) -> None:
    (found,) = load(text, folder)
    assert found.code == code
    assert found.primary.span.text == caret
    assert any(fix in one for one in found.helps), found.helps


@pytest.mark.parametrize(("rule", "code", "caret", "mended", "fix"), RULES, ids=[row[0] for row in RULES])
def test_a_rule(rule: str, code: str, caret: str, mended: str, fix: str, tmp_path: Path) -> None:
    check(PACK.replace("RULE", rule), code, caret, fix, tmp_path)
    assert load(PACK.replace("RULE", mended), tmp_path) == ()


@pytest.mark.parametrize(("given", "expect", "code", "caret", "good_given", "good_expect"), DRAWN)
def test_a_drawing_on_the_line_of_its_key(
    given: str, expect: str, code: str, caret: str, good_given: str, good_expect: str, tmp_path: Path
) -> None:
    pack = PACK.replace("RULE", "soil -> weed")
    found = load(pack + TEST.replace("GIVEN", given).replace("EXPECT", expect), tmp_path)
    assert {one.code for one in found} == {code}
    assert found[0].primary.span.text == caret
    assert any("quotes" in one for one in found[0].helps)
    assert load(pack + TEST.replace("GIVEN", good_given).replace("EXPECT", good_expect), tmp_path) == ()


@pytest.mark.parametrize(("text", "wrong", "code", "caret", "fix"), WORDS, ids=[row[3] for row in WORDS])
def test_a_word(text: str, wrong: str, code: str, caret: str, fix: str, tmp_path: Path) -> None:
    check(PACK.replace(text, wrong, 1).replace("RULE", "soil -> weed"), code, caret, fix, tmp_path)


@pytest.mark.parametrize("end", ["", "\n"])
@pytest.mark.parametrize(
    "entry", ["{id: 1, color: #123456}", "{id: 1, color: #123456", "\n    id: 1\n    color: #123456"]
)
def test_a_color_without_quotes_on_the_last_line(entry: str, end: str, tmp_path: Path) -> None:
    found = load(f"pack: yard\nelements:\n  soil: {entry}{end}", tmp_path)
    assert len(found) == 1
    assert found[0].code in ("PD103", "PD109")
    assert found[0].primary.span.text.startswith("#123456")
    assert any('"#123456"' in one for one in found[0].helps)


def test_a_pack_that_others_need_is_missed_once() -> None:
    result = command("check", "powderworld-core", "--quick", exits=2)
    assert result.output.count("error[") == 1
    assert "which is not loaded" in result.output
    assert "did you mean" not in result.output
    assert "also leave out the packs that need it: `-sand`, " in result.output


@pytest.mark.parametrize("setting", ["500%", "2", "-5%"])
def test_a_chance_of_the_command_line_is_shown_as_it_was_written(setting: str) -> None:
    result = command("run", "core+water", "--set", f"water.melt={setting}", "--steps", "1", exits=2)
    assert f"cannot be `{setting}`" in result.stderr
    assert "0% to 100%" in result.stderr


BAD_READING = """
pack: hill
needs: core
fields:
  age: {type: int, at: element}
  heat: {type: float}
elements:
  ant: {density: 9, color: "black", burn: 30%}
  bee: {density: 2, color: "#101010"}
passes:
  walk:
    after: fire
    do:
      - bee -> empty if count(bee) = 3
      - bee -> empty if below.wall
      - bee -> ant if age > 3 and heat > 2
  sleep: {do: bee -> empty with chance 5}
"""
BAD_NAMES = """
pack: hill
needs: core
elements:
  bee: {density: 2, gravity: maybe, color: "#101010", tags: [fluid, flamable]}
passes:
  burn:
    after: flwo
    do: bee -> empty if count(bee in rnig) > 2
"""


@pytest.mark.parametrize(
    ("text", "places"),
    [
        (BAD_READING, ["int", "{", "float", "9", '"black"', "burn", "fire", "=", "wall", "5"]),
        (BAD_NAMES, ["maybe", "flamable", "flwo", "rnig"]),
    ],
)
def test_mistakes_of_all_stages_are_found_at_once(text: str, places: list[str], tmp_path: Path) -> None:
    assert [found.primary.span.text for found in load(text, tmp_path)] == places
