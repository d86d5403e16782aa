"""Random damage to rule files: loading raises nothing but CompileError, and what it raises can be printed.

``FUZZ_EXAMPLES=20000 pytest tests/diagnostics/test_fuzz.py`` looks harder.
"""

from __future__ import annotations

import os
import re
from functools import cache
from pathlib import Path

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Source
from powderdsl.diagnostics.render import render_json, render_short, render_text
from powderdsl.model.check import check
from powderdsl.model.declarations import PackDecl, RulesetDecl
from powderdsl.model.packs import read_file
from powderdsl.model.types import Ruleset

ROOT = Path(__file__).resolve().parents[2]
RULES = {path.stem: path.read_text(encoding="utf-8") for path in sorted((ROOT / "rules").glob("*.yaml"))}
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "200"))
TOKEN = re.compile(r"\w+|\s+|.", re.DOTALL)
WORDS = sorted({token for text in RULES.values() for token in TOKEN.findall(text) if not token.isspace()})
FUZZ = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize="FUZZ_EXAMPLES" not in os.environ,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much],
)


@cache
def whole(name: str) -> PackDecl | RulesetDecl:
    """A shipped file, undamaged."""
    found = read_file(Source(f"{name}.yaml", RULES[name]), Reporter())
    assert found is not None
    return found


def needed(text: str) -> list[PackDecl]:
    """The shipped packs that a file says it needs."""
    names = re.search(r"^needs: \[?([\w, ]*)", text, re.MULTILINE)
    words = [word for word in re.findall(r"\w+", names[1] if names else "") if word in RULES]
    return [pack for word in words if isinstance(pack := whole(word), PackDecl)]


def load(text: str, *others: PackDecl) -> Ruleset | None:
    """What `powderdsl.load` does with a file and some packs, or None after printing what is wrong."""
    reporter = Reporter()
    try:
        found = read_file(Source("fuzz.yaml", text), reporter)
        reporter.raise_if_errors()
        assert found is not None
        return check([*others, found], None, reporter) if isinstance(found, PackDecl) else None
    except CompileError as error:
        printable(error.diagnostics)
        return None


def printable(diagnostics: tuple[Diagnostic, ...]) -> None:
    """Fails unless every diagnostic points into its text and can be printed in all three ways."""
    assert diagnostics
    for one in diagnostics:
        span = one.primary.span
        assert span is None or 0 <= span.start < max(span.end, 1) <= max(len(span.source.text), 1) + 1
        assert render_text(one)
        assert "\n" not in render_short(one)
    assert render_json(diagnostics, utf16=True)


@st.composite
def damaged(draw: st.DrawFn, units: str) -> str:
    """A shipped file after some deletions, repetitions, exchanges and insertions of lines or tokens."""
    text = RULES[draw(st.sampled_from(sorted(RULES)))]
    parts = text.splitlines(keepends=True) if units == "lines" else TOKEN.findall(text)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, max(len(parts) - 1, 0)))
        match draw(st.sampled_from(("delete", "repeat", "swap", "word", "character", "indent"))):
            case "delete":
                del parts[place : place + draw(st.integers(1, 3))]
            case "repeat":
                parts[place:place] = parts[place : place + 1] * draw(st.integers(1, 3))
            case "swap" if len(parts) > 1:
                other = draw(st.integers(0, len(parts) - 1))
                parts[place], parts[other] = parts[other], parts[place]
            case "word":
                parts[place : place + draw(st.integers(0, 1))] = [draw(st.sampled_from(WORDS))]
            case "character":
                parts.insert(place, draw(st.characters(codec="utf-8")))
            case "indent":
                parts.insert(place, " " * draw(st.integers(1, 3)))
    return "".join(parts)


@FUZZ
@given(damaged("lines"))
def test_files_with_damaged_lines(text: str) -> None:
    load(text, *needed(text))


@FUZZ
@given(damaged("tokens"))
def test_files_with_damaged_tokens(text: str) -> None:
    load(text, *needed(text))


@FUZZ
@given(st.text(max_size=200))
def test_any_text(text: str) -> None:
    load(text)


@FUZZ
@given(st.lists(st.sampled_from([*WORDS, " ", " ", " ", "\n", "\n  ", "\n    - "]), max_size=60))
def test_any_words(words: list[str]) -> None:
    load("".join(words))


@FUZZ
@given(st.lists(st.sampled_from(WORDS), max_size=14))
def test_any_rule(words: list[str]) -> None:
    rule = " ".join(words).replace("'", "")
    core = whole("core")
    assert isinstance(core, PackDecl)
    load(f"pack: fuzz\nneeds: core\npasses:\n  fuzz:\n    do: '{rule}'\n", core)


@FUZZ
@given(st.text(alphabet="abf019.%()<>=!:+-*/,? \n", max_size=40))
def test_any_expression(text: str) -> None:
    fields = "fields: {f: {type: 0..9, at: place}}\n"
    elements = 'elements: {a: {id: 0, color: "#000000"}, b: {id: 1, color: "#FFFFFF"}}\n'
    load(f"pack: fuzz\n{elements}{fields}passes:\n  fuzz:\n    do: 'a -> b if {text}'\n")


def test_undamaged_files_load() -> None:
    for name, text in RULES.items():
        if isinstance(whole(name), PackDecl) and "elements:" in text:
            assert load(text, *needed(text)) is not None
