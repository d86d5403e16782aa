"""Malformed rule files: each gives a CompileError with the expected code and caret, soon, and nothing else.

Three tables: whole files, sections of a small pack, and single rules. A row is a name, the text, the code and
the text under the caret (its first line; None where it does not matter, or there is none).
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from time import process_time

import pytest

import powderdsl
from powderdsl.diagnostics import Diagnostic
from powderdsl.diagnostics.diagnostic import diagnostic_data, render_text
from tests.diagnostics.malformed_details import DETAILS
from tests.refusals import refusal

SECONDS = 2.0
"""Processor time that the worst input may take."""

ELEMENTS = """pack: yard
elements:
  empty: {id: 0, color: "#FFFFFF"}
  soil: {id: 1, color: "#806040"}
  weed: {id: 2, color: "#30A030"}
"""
PACK = f"""{ELEMENTS}properties:
  weight: {{type: 0..7, default: 1}}
  loose: flag
fields:
  age: {{type: 0..9, at: element}}
  wind: {{type: vec2(-9..9), at: place}}
  wet: {{type: flag, at: place}}
  seed: {{type: element, default: empty, at: place}}
streams: [coin]
params: {{growth: 5%}}
kernels: {{row_of_3: ["1 1 1"]}}
tags: {{green: "grows"}}
"""


def passes(rule: str) -> str:
    return f"{PACK}passes:\n  grow:\n    do:\n      - {rule}\n"


def deep(opening: str, middle: str, closing: str, times: int) -> str:
    return opening * times + middle + closing * times


# fmt: off
FILES: list[tuple[str, str | bytes, str, str | None]] = [
    # YAML that is none
    ("an empty file", "", "PD107", None),
    ("a word", "pack\n", "PD107", "pack"),
    ("a list", "- pack: yard\n- about: x\n", "PD107", "- pack: yard"),
    ("a tab as indentation", "pack: yard\nelements:\n\tsoil: {id: 0}\n", "PD103", "\t"),
    ("a NUL", "pack: ya\0rd\n", "PD103", "\0"),
    ("an open brace", "pack: yard\nelements: {soil: {id: 0}\npasses:\n", "PD103", "{"),
    ("a closing bracket too many", "pack: yard]\nneeds: ]\n", "PD103", "]"),
    ("an open quote", 'pack: yard\nabout: "never closed\nneeds: core\n', "PD103", '"'),
    ("an unknown escape", 'about: "\\q"\n', "PD103", "\\q"),
    ("two colons", "about: this: that\n", "PD103", ":"),
    ("a line too far in", "pack: yard\n  about: x\n", "PD103", "about"),
    ("a line without a colon", "pack: yard\nabout\nneeds: core\n", "PD103", "about"),
    ("a list beside its key", "needs: - core\n", "PD103", "-"),
    ("text after a bar", "about: | text\n  more\n", "PD103", "text"),
    ("a value that starts with @", "about: @home\n", "PD103", "@"),
    ("parameters of a ruleset as a list", "ruleset: yard\npacks: core\nparams: [a]\n", "PD107", "[a]"),
    ("two commas", "a: {b: 1, , c: 2}\n", "PD103", ","),
    ("a directive", "%YAML 9.9\n---\npack: yard\n", "PD103", "%YAML 9.9"),
    ("text after the end", "pack: yard\n...\nabout: x\n", "PD103", "about: x"),
    ("an unquoted color in braces", "elements: {soil: {id: 0, color: #806040}}\nx: 1\n", "PD103", "#806040}}"),
    ("an unquoted color in a block", "pack: p\nelements:\n  a:\n    id: 0\n    color: #806040\n", "PD109", "#806040"),
    ("a byte-order mark and little else", "\ufeffpack: yard\n", "PD109", "yard"),
    # YAML that rule files do without
    ("an alias bomb", "a: &a [x]\nb: &b [*a, *a]\nc: [*b, *b]\n", "PD105", "&a"),
    ("an alias", "pack: *yard\n", "PD105", "*yard"),
    ("a merge key", "pack: yard\nelements:\n  soil: {<<: {id: 0}}\n", "PD105", "<<"),
    ("a tag", "pack: !!python/object:os.system yard\n", "PD105", "!!python/object:os.system"),
    ("a second document", "pack: yard\n---\npack: shed\n", "PD105", "---"),
    ("a duplicate key", "pack: yard\nneeds: a\nneeds: b\n", "PD104", "needs"),
    ("a duplicate key deep down", "pack: p\nelements: {a: {id: 0, id: 1}}\n", "PD104", "id"),
    ("a list as a key", "? [a, b]\n: c\n", "PD107", "[a, b]"),
    ("a key without a value", "pack: p\nelements: {a: {id: 0, glyph}}\n", "PD107", "glyph"),
    ("100,000 open brackets", "[" * 100_000, "PD106", "["),
    ("100,000 dashes", "- " * 100_000 + "x", "PD106", "-"),
    ("100,000 keys", "".join(f"k{i}: 1\n" for i in range(50_000)), "PD106", "1"),
    ("1 MB without a line break", "about: " + "x" * (1 << 20), "PD102", None),
    ("10 MB", b"# " + b"x" * 10_000_000, "PD102", None),
    # Bytes that are not text
    ("Latin-1", "about: Stra\xdfe\n".encode("latin-1"), "PD101", None),
    ("a PNG", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "PD101", None),
    # Files of another kind
    ("no pack", "elements: {a: {id: 0, color: '#000000'}}\n", "PD109", "e"),
    ("a pack without elements", "pack: yard\n", "PD109", "yard"),
    ("a name that is not a word", "pack: 1st\nelements: {}\n", "PD111", "1st"),
    ("a name of a mile", f"pack: {'x' * 5000}\n", "PD111", "x" * 5000),
    ("a ruleset without packs", "ruleset: yard\n", "PD109", "r"),
    ("a ruleset of nothing", "ruleset: yard\npacks: []\n", "PD109", None),
    ("a ruleset of nobody", "ruleset: yard\npacks: [nobody]\n", "PD304", "nobody"),
    ("a ruleset with too few slots", "ruleset: y\npacks: [core]\nslots: 1\n", "PD402", "wall"),
    ("a ruleset with 9,999 slots", "ruleset: y\npacks: [core]\nslots: 9999\n", "PD402", "9999"),
]

SECTIONS: list[tuple[str, str, str, str | None]] = [
    # Keys and shapes
    ("an unknown section", "rules: {}\n", "PD108", "rules"),
    ("a section at home elsewhere", "symmetry: mirror\n", "PD108", "symmetry"),
    ("elements as a list", "fields: [age]\n", "PD107", "[age]"),
    ("a pass that does nothing", "passes:\n  grow: {about: x}\n", "PD109", "{about: x}"),
    ("a misspelled do", "passes:\n  grow:\n    doo: soil -> weed\n", "PD108", "doo"),
    ("two actions", "passes:\n  g:\n    do: soil -> weed\n    repeat 2: weed -> soil\n", "PD107", "repeat 2"),
    ("rules and blocks", "passes:\n  g:\n    do:\n    - soil -> weed\n    - do: x\n", "PD204", "do: x"),
    ("a loop without a colon", "passes:\n  g:\n    for e in any\n", "PD107", "for e in any"),
    ("a flow comma", "passes:\n  g:\n    let: {n: count(soil, weed) > 0}\n    do: soil -> weed\n", "PD107", "weed) > 0"),
    ("a comma in a flow list", "passes:\n  g:\n    do: [soil -> weed, then age := 1]\n", "PD201", "then"),
    # Elements
    ("an id too large", 'elements: {a: {id: 256, color: "#000000"}}\n', "PD402", "256"),
    ("an id with a fraction", 'elements: {a: {id: 1.5, color: "#000000"}}\n', "PD110", "1.5"),
    ("an id of many digits", f'elements: {{a: {{id: {"9" * 5000}, color: "#000000"}}}}\n', "PD402", "9" * 5000),
    ("an id twice", 'elements: {a: {id: 2, color: "#000000"}, b: {id: 2, color: "#000000"}}\n', "PD303", "2"),
    ("a color by name", "elements: {a: {id: 9, color: red}}\n", "PD110", "red"),
    ("a long glyph", 'elements: {a: {id: 9, color: "#000000", glyph: ab}}\n', "PD110", "ab"),
    ("a glyph twice", 'elements: {a: {id: 0, color: "#000000", glyph: x}, b: {id: 1, color: "#000000", glyph: x}}\n', "PD302", "b"),
    ("an unknown tag", 'elements: {a: {id: 9, color: "#000000", tags: [gren]}}\n', "PD301", "gren"),
    ("an unknown property", 'elements: {a: {id: 9, color: "#000000", wieght: 3}}\n', "PD108", "wieght"),
    ("a tag for nobody", "also: {nobody: green}\n", "PD301", "nobody"),
    ("an override of nothing", 'elements: {a: {id: 9, color: "#000000", override: yes}}\n', "PD301", "a"),
    # Reserved, double and hidden names
    ("a keyword as a name", "sets: {if: any}\n", "PD311", "if"),
    ("a function as a name", "fields: {count: {type: flag, at: place}}\n", "PD311", "count"),
    ("a field twice", "sets: {weed: any}\n", "PD302", "weed"),
    ("a parameter that hides", "params: {weed: 5%}\n", "PD308", "weed"),
    ("a let twice", "passes:\n  g:\n    let: {n: soil}\n    then:\n    - let: {n: weed}\n      do: soil -> weed if n\n", "PD308", "n"),
    ("a scratch field that hides", "passes:\n  g:\n    scratch: {age: 0..3}\n    do: age := 1\n", "PD308", "age"),
    # Kinds, ranges and defaults
    ("a kind of another language", "fields: {f: {type: int, at: place}}\n", "PD401", "int"),
    ("a real without bounds", "fields: {f: {type: real, at: place}}\n", "PD401", "real"),
    ("a range backwards", "fields: {f: {type: 9..0, at: place}}\n", "PD402", "9..0"),
    ("a range of fractions", "fields: {f: {type: 0..0.5, at: place}}\n", "PD405", "0.5"),
    ("a range of millions", "fields: {f: {type: 0..9999999, at: place}}\n", "PD402", "9999999"),
    ("a default outside", "fields: {f: {type: 0..3, at: place, default: 4}}\n", "PD402", "4"),
    ("a field nowhere", "fields: {f: {type: flag, at: home}}\n", "PD110", "home"),
    ("a field without a kind", "fields: {f: {at: place}}\n", "PD109", "{"),
    ("of without element", "fields: {f: {type: flag, at: place, of: weed}}\n", "PD401", "weed"),
    ("a digit of another script", "properties: {p: {type: 0..3, weed: ٣}}\n", "PD201", "٣"),
    ("a wide digit", "properties: {p: {type: 0..3, weed: ３}}\n", "PD201", "３"),
    ("a property outside", "properties: {p: {type: 0..3, weed: 7}}\n", "PD402", "7"),
    ("a parameter that is a vector", "params: {p: {type: vec2(0..1), default: 0}}\n", "PD401", "vec2(0..1)"),
    ("a parameter without a kind", "params: {p: 0.2}\n", "PD401", "0.2"),
    ("a chance above 1", "params: {p: 101%}\n", "PD403", "101%"),
    ("a percent sign apart", "params: {p: 5 %}\n", "PD201", "%"),
    ("bits of 24", "streams: {coin: {bits: 24}}\n", "PD110", "24"),
    # Kernels and sets
    *DETAILS,
    ("a pack that needs itself", "needs: yard\n", "PD307", "yard"),
    ("a pack that conflicts with itself", "conflicts: yard\n", "PD306", "yard"),
    ("a pack that provides itself", "provides: yard\n", "PD306", "yard"),
    ("a pack that needs what it provides", "provides: soil\nneeds: soil\n", "PD307", "soil"),
    ("a set of itself", "sets: {s: s}\n", "PD307", "s"),
    ("sets of each other", "sets:\n  s: t\n  t: (s, weed)\n", "PD307", "s"),
    ("a chain of 1,000 sets", "sets:\n" + "".join(f"  s{i}: s{i + 1}\n" for i in range(1000)) + "  s1000: weed\n", "PD508", None),
    # Passes
    ("a pass after itself", "passes:\n  g: {after: g, do: soil -> weed}\n", "PD307", "g"),
    ("passes after each other", "passes:\n  a: {after: b, do: soil -> weed}\n  b: {after: a, do: weed -> soil}\n", "PD307", "a"),
    ("an unknown symmetry", "passes:\n  g: {symmetry: spin, do: soil -> weed}\n", "PD110", "spin"),
    ("a loop of 1,000 rounds", "passes:\n  g:\n    for i in 1..1000:\n    - soil -> weed\n", "PD508", "1..1000"),
    ("a repeat of 0", "passes:\n  g:\n    repeat 0: soil -> weed\n", "PD508", "repeat 0"),
    ("a loop over 262,144 things", "passes:\n  g:\n    for i in 0..63, j in 0..63, k in 0..63:\n    - soil -> weed\n", "PD508", None),
    ("a loop over a number", "passes:\n  g:\n    for i in 5:\n    - soil -> weed\n", "PD401", "5"),
    ("a loop without in", "passes:\n  g:\n    for i 0..5:\n    - soil -> weed\n", "PD201", "0"),
    ("a variable twice", "passes:\n  g:\n    for i in any, i in any:\n    - i -> weed\n", "PD308", "i"),
    ("1,000 passes", "passes:\n" + "".join(f"  p{i}: {{after: p{i + 1}, do: soil -> weed}}\n" for i in range(999)) + "  p999: {do: soil -> weed}\n", "PD508", None),
    # Tests of packs
    ("a test of text", "tests: [grow]\n", "PD107", "grow"),
    ("a test without a world", "tests:\n- grows: {after: 5 steps}\n", "PD109", "grows"),
    ("a ragged world", "tests:\n- grows: {given: 's s', always: 'yes'}\n- bad: {given: \"ss\\ns\", always: 'yes'}\n", "PD110", '"ss\\ns"'),
    ("an unknown character", "tests:\n- grows:\n    given: |\n      sxs\n    always: yes\n", "PD301", "x"),
    ("five step", "tests:\n- grows: {given: s, after: five, always: yes}\n", "PD110", "five"),
    # Invariants
    ("an invariant of a stranger", "invariants: [rock never changes]\n", "PD301", "rock"),
    ("an invariant that is a mapping", "invariants: {soil: constant}\n", "PD107", "{soil: constant}"),
    ("an invariant that is a rule", "invariants: [soil -> weed]\n", "PD201", "->"),
    ("an invariant that states nothing", "invariants: [soil]\n", "PD201", "soil"),
    ("a number that never changes", "invariants: [1 never changes]\n", "PD401", "1"),
    ("a total that is something else", "invariants: [count(soil) is steady]\n", "PD201", "steady"),
    ("a total in a neighborhood", "invariants: [count(soil in ring) is constant]\n", "PD406", "count(soil in ring)"),
    ("a total of a vector", "invariants: [sum(wind) is constant]\n", "PD401", "wind"),
    ("a mean", "invariants: [min(soil) is constant]\n", "PD406", "min(soil)"),
    ("never a number", "invariants: [never age]\n", "PD401", "age"),
    ("never for no steps", "invariants: [never wet for 0 steps]\n", "PD402", "for 0 steps"),
    ("never for some years", "invariants: [never wet for 9 years]\n", "PD201", "years"),
    ("never what is always", "invariants: [never yes]\n", "PD511", "yes"),
    ("bounds of a flag", "invariants: [wet stays in 0..1]\n", "PD401", "wet"),
    ("bounds without the default", "invariants: [age stays in 3..9]\n", "PD511", "3..9"),
    ("reaching beyond the sky", "invariants: [nothing reaches beyond 5000 cells]\n", "PD402", None),
]

RULES: list[tuple[str, str, str, str | None]] = [
    # Syntax
    ("nothing", '""', "PD201", None),
    ("an arrow of another language", "soil => weed", "PD201", "="),
    ("a pretty arrow", "soil → weed", "PD201", "→"),
    ("a swap that is if first", "if wet swap below", "PD201", "if"),
    ("a rule with two arrows", "soil -> weed -> soil", "PD201", "->"),
    ("and and", "soil -> weed if wet and and wet", "PD201", "and"),
    ("an assignment to a sum", "age + 1 := 3", "PD407", "age + 1"),
    ("10,000 parentheses", "soil -> weed if " + deep("(", "wet", ")", 10_000), "PD202", "s"),
    ("10,000 nots", "soil -> weed if " + "not " * 10_000 + "wet", "PD202", "s"),
    ("a rule of 1 MB", "soil -> weed if " + "wet or " * 140_000 + "wet", "PD202", "s"),
    ("a chain of 200 ors", "soil -> weed if " + "wet or " * 200 + "wet", "PD202", "s"),
    # Names
    ("an unknown element", "soil -> wed", "PD301", "wed"),
    ("an unknown function", "soil -> weed if sqrt(age) > 1", "PD301", "sqrt"),
    # Kinds
    ("a flag compared with a number", "soil -> weed if wet == 1", "PD401", "1"),
    ("a flag that is more", "soil -> weed if wet > wet", "PD401", "wet > wet"),
    ("an element that is more", "soil -> weed if below > weed", "PD401", "below > weed"),
    ("an element equal to a set", "soil -> weed if below == green", "PD401", "green"),
    ("a number as a condition", "soil -> weed if age", "PD401", "age"),
    ("a place as a condition", "soil -> weed if below", "PD401", "below"),
    ("two draws", "soil -> weed if coin < coin", "PD401", "coin < coin"),
    ("a draw that equals", "soil -> weed if coin == 0.5", "PD401", "coin == 0.5"),
    ("a vector compared", "soil -> weed if wind > 3", "PD401", "wind > 3"),
    ("a vector and a number", "wind := wind + 1", "PD401", "wind + 1"),
    ("a set as a target", "soil -> green", "PD401", "green"),
    ("an element as a place", "weed swaps soil", "PD401", "soil"),
    ("a swap with itself", "weed swaps here", "PD401", "here"),
    ("a dot after an element", "soil -> weed if weed.age > 3", "PD401", "weed"),
    ("an element after a dot", "soil -> weed if below.weed", "PD401", "weed"),
    ("a push of a number", "push age by 2 away from weed", "PD401", "age"),
    ("a range of subtraction", "soil -> weed if age in 1-3", "PD401", "1-3"),
    ("a length of a number", "soil -> weed if length(age) > 1", "PD401", "age"),
    # Numbers
    ("a chance of 150%", "soil -> weed with chance 150%", "PD403", "150%"),
    ("a draw below 20", "soil -> weed if coin < 20", "PD403", "20"),
    ("a huge number", "soil -> weed if age > 99999999999999999999", "PD402", "99999999999999999999"),
    ("a number of 1,900 digits", "soil -> weed if age > " + "9" * 1900, "PD402", "9" * 1900),
    ("a leading zero", "soil -> weed if age > 007", "PD110", "007"),
    ("constants out of reach", "age := 1000000 * 1000000", "PD402", "1000000 * 1000000"),
    ("a value outside", "age := 10", "PD402", "10"),
    ("a fraction", "age := 1.5", "PD401", "1.5"),
    ("a remainder of zero", "soil -> weed if age mod 0 == 1", "PD405", "0"),
    ("a look too far", "soil -> weed if at(99, 0) is weed", "PD409", "at(99, 0)"),
    ("a set after a test of a neighbor", "soil -> weed if below is soil or weed", "PD410", "below is soil or weed"),
    ("sets after a test", "soil -> weed if age > 1 or left is not soil or (weed, soil)", "PD410", "left is not soil or (weed, soil)"),
    ("a look that varies", "soil -> weed if at(age, 0) is weed", "PD405", "age"),
    # Calls and assignments
    ("too few values", "soil -> weed if at(1) is weed", "PD406", "at(1)"),
    ("a function without values", "soil -> weed if count > 1", "PD406", "count"),
    ("a coordinate without mod", "soil -> weed if row > 1", "PD406", "row"),
    ("an assignment to a parameter", "growth := 3%", "PD407", "growth"),
    ("an assignment to half a vector", "wind.row := 3", "PD407", "wind.row"),
    ("an assignment to an element's field", "weed.age := 3", "PD401", "weed"),
    ("more of a flag", "wet += 1", "PD407", "wet += 1"),
    # Logic
    ("a swap that can meet itself", "weed swaps below if below is weed or below is soil", "PD501", "weed swaps below"),
    ("two moves into one cell", "weed swaps below if below is soil\n      - weed swaps above if above is soil", "PD501", "weed swaps above"),
    ("two transforms of one cell", "soil -> weed if wet\n      - soil -> empty if age > 1", "PD502", "soil -> empty"),
    ("two assignments of one field", "age := 1 where wet\n      - age := 2 where weed", "PD502", "age := 2"),
    ("quantifiers in quantifiers", "soil -> weed if " + "any(" * 9 + "a is weed" + "".join(f" for {c} in octants)" for c in "abcdefghi"), "PD508", None),
]
# fmt: on


def failure(text: str | bytes, path: Path) -> tuple[Diagnostic, ...]:
    """What is wrong with a file, found within the time that is left for it."""
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    start = process_time()
    errors = refusal(powderdsl.load, path)
    assert process_time() - start < SECONDS
    return errors


def check(text: str | bytes, code: str, caret: str | None, path: Path) -> None:
    first, *others = failure(text, path)
    assert [first.code, *(one.code for one in others)] == [code], render_text(first)
    span = first.primary.span
    if caret is not None:
        assert span.text.split("\n")[0].strip(" \r") == caret.split("\n")[0]
    for one in (first, *others):
        assert len(render_text(one)) < 3000
        assert one.message[:1] == one.message[:1].lower() or one.message.startswith("`")
        assert not one.message.endswith(".")
    assert json.dumps([diagnostic_data(one, utf16=True) for one in (first, *others)])


def rows(table: list) -> list:  # type: ignore[type-arg]
    return [pytest.param(*row[1:], id=row[0]) for row in table]


@pytest.mark.parametrize(("text", "code", "caret"), rows(FILES))
def test_a_malformed_file(text: str | bytes, code: str, caret: str | None, tmp_path: Path) -> None:
    check(text, code, caret, tmp_path / "yard.yaml")


@pytest.mark.parametrize(("text", "code", "caret"), rows(SECTIONS))
def test_a_malformed_section(text: str, code: str, caret: str | None, tmp_path: Path) -> None:
    section = text.partition(":")[0]
    base = (
        ELEMENTS
        if section in PACK.partition("properties")[2] or section in ("elements", "properties")
        else PACK
    )
    if section == "elements":
        base = "pack: yard\ntags: {green: grows}\n"
        text += "  # and so on\n"
    elif base is ELEMENTS and section not in ("tags",):
        base += 'tags: {green: "grows"}\n'
    check(base + text, code, caret, tmp_path / "yard.yaml")


@pytest.mark.parametrize(("rule", "code", "caret"), rows(RULES))
def test_a_malformed_rule(rule: str, code: str, caret: str | None, tmp_path: Path) -> None:
    check(passes(rule), code, caret, tmp_path / "yard.yaml")


def test_the_pack_around_the_rules_is_well_formed(tmp_path: Path) -> None:
    path = tmp_path / "yard.yaml"
    path.write_text(
        passes("soil -> weed if coin < growth and count(green in row_of_3) < 3"), encoding="utf-8"
    )
    assert powderdsl.load(path).name == "yard"


# Files that are not files, and line ends of other systems


def test_names_that_cannot_be_files() -> None:
    for name in ("nobody.yaml", "a/b/c.yaml", "x" * 5000 + ".yaml", "a\0b.yaml", "/dev/null/x.yaml"):
        assert refusal(powderdsl.load, name)[0].code == "PD101", name
    for name in ("", "nobody", "x" * 5000, "core+", "+", "-", "core-nobody", "core+nobody", "\0", "é"):
        assert {one.code for one in refusal(powderdsl.load, name)} <= {"PD304", "PD109"}, name


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="needs files that cannot be read")
def test_a_file_that_may_not_be_read(tmp_path: Path) -> None:
    path = tmp_path / "yard.yaml"
    path.write_text(ELEMENTS, encoding="utf-8")
    path.chmod(0)
    assert refusal(powderdsl.load, path)[0].code == "PD101"


@pytest.mark.parametrize("end", ["\r\n", "\n"])
@pytest.mark.parametrize("start", ["", "\ufeff"])
def test_line_ends_and_byte_order_marks_are_harmless(start: str, end: str, tmp_path: Path) -> None:
    path = tmp_path / "yard.yaml"
    text = start + passes("soil -> weed if wet").replace("\n", end)
    path.write_bytes(text.encode())
    assert powderdsl.load(path).name == "yard"
    path.write_bytes(text.replace("if wet", "if wett").encode())
    (found,) = refusal(powderdsl.load, path)
    assert found.primary.span.text == "wett"
    assert found.primary.span.column == 25


def test_one_mistake_in_a_loop_is_one_diagnostic(tmp_path: Path) -> None:
    text = f"{PACK}passes:\n  grow:\n    for e in any, side in (left, right):\n      - e -> wed if side is weed\n"
    (found,) = failure(text, tmp_path / "yard.yaml")
    assert found.code == "PD301"


def test_a_wrong_declaration_is_one_diagnostic_however_often_it_is_used(tmp_path: Path) -> None:
    text = passes("soil -> weed if age > 1 and wet\n      - age := age where weed").replace(
        "type: 0..9", "type: number"
    )
    (found,) = failure(text, tmp_path / "yard.yaml")
    assert found.code == "PD401"


def test_an_unknown_name_is_one_diagnostic_with_all_its_places(tmp_path: Path) -> None:
    text = passes("soil -> weed if aeg > 1\n      - weed -> soil if aeg > 2")
    (found,) = failure(text, tmp_path / "yard.yaml")
    assert [label.span.text for label in found.secondary if label.span] == ["aeg"]


def test_thousands_of_mistakes_end_soon(tmp_path: Path) -> None:
    rules = "".join(f"      - soil -> weed if name{i} > {i}\n" for i in range(2000))
    found = failure(f"{PACK}passes:\n  grow:\n    do:\n{rules}", tmp_path / "yard.yaml")
    assert 100 <= len(found) <= 200
