"""YAML without libyaml: the same trees and positions as with it, and messages that differ only where named here."""

from __future__ import annotations

import random
import re
import time
from pathlib import Path

import pytest

from powderdsl.diagnostics import Diagnostic, Reporter, Source
from powderdsl.syntax import yaml_tree
from tests.diagnostics.test_malformed import FILES as MALFORMED
from tests.diagnostics.test_malformed import SECTIONS

ROOT = Path(__file__).resolve().parents[2]
FILES = [
    path.relative_to(ROOT).as_posix()
    for folder in ("rules", "tasks", "examples", "tests")
    for path in sorted((ROOT / folder).rglob("*.yaml"))
]
WORDS = "---|...|\n---\n|\n  |\r\n|- |? |: |%YAML 1.1\n|%TAG ! a\n|<<|\\x41|\\u12|\\\n|2\n|>+\n|!!a |!<a> |!%C3%A9|!%C0%80|&a |*a "
MIXED = [
    *"?:,[]{}#&*!|>'\"%@`-+ \t\n\r\\~<012aUx_/.é😀\x85\u2028\x01",
    *WORDS.split("|"),
    "|-\n",
    "|2\n",
]
"""What has a meaning in YAML, and a little that has none."""

WORDED_BY_PYYAML = {
    "tabs at the start of a line, or after `|` and tags": r"\t",
    "directives": r"(?m:^%)",
    "tags": "!",
    "a comment, a zero, or other text right after `|` or `>`": r"[|>][-+]?[^-+\s]",
    "a key whose colon is missing, before a bracket": r"[\[{]",
    "a `?` that stands for a key, or for nothing": r"\?\s|\?,",
    "a Unicode line separator": "\u2028",
}
"""Mistakes that PyYAML reports in other words, or at another place, than libyaml; what their texts contain."""


Parsed = tuple[yaml_tree.Node | None, list[Diagnostic]]


def parsed(text: str) -> Parsed:
    reporter = Reporter()
    yaml_tree._parsed.cache_clear()  # of the other parser
    return yaml_tree.parse_yaml(Source("file.yaml", text), reporter), list(reporter.diagnostics)


def without_libyaml(text: str, monkeypatch: pytest.MonkeyPatch) -> Parsed:
    with monkeypatch.context() as patch:
        patch.setattr(yaml_tree, "_LIBYAML", None)
        return parsed(text)


def differs(text: str, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Return True for a difference of the kinds above. Any other difference fails."""
    pure = without_libyaml(text, monkeypatch)
    if pure == parsed(text):
        return False
    assert any(re.search(pattern, text) for pattern in WORDED_BY_PYYAML.values()), repr(text)
    for diagnostic in pure[1]:
        span = diagnostic.primary.span
        assert 0 <= span.start < span.end <= max(len(text), 1) + 1, repr(text)
    return True


def damaged(rng: random.Random, text: str) -> str:
    """A few lines of a file, or of nothing, with something inserted, removed or repeated."""
    start = rng.randrange(len(text))
    text = text[start : start + rng.choice([5, 30, 200])]
    if rng.random() < 0.3:
        text = "".join(rng.choices(MIXED, k=rng.randint(1, 25)))
    for _ in range(rng.randint(0, 6)):
        at, to, what = rng.randrange(len(text) + 1), rng.randrange(len(text) + 1), rng.random()
        if what < 0.6:
            text = text[:at] + rng.choice(MIXED) + text[at:]
        elif what < 0.8:
            text = text[:at] + text[at + rng.randint(1, 4) :]
        else:
            text = text[:at] + text[min(at, to) : max(at, to)] + text[at:]
    return text


@pytest.mark.parametrize("name", FILES)
def test_files(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    tree, diagnostics = parsed(text)
    assert tree is not None
    assert without_libyaml(text, monkeypatch) == (tree, diagnostics)


def test_damaged_texts(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = random.Random(16)
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in FILES]
    differences = sum(differs(damaged(rng, rng.choice(texts)), monkeypatch) for _ in range(5_000))
    assert differences < 50


BROKEN = [
    *(text for _, text, *_ in (*MALFORMED, *SECTIONS) if isinstance(text, str)),
    *("a: !%C0%80 x", "\ufeffa: [", "a: \x01", "a: \ud800", "a: \0b", "[a.row?, b]"),
]


def test_malformed_texts(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in BROKEN:
        assert without_libyaml(text, monkeypatch) == parsed(text), ascii(text)


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        *("[" * 100_000, "{a: " * 5_000, "- " * 5_000, "!" * 1_000_000, "[" + "{}," * 300_000 + "]"),
        *("a: " + "b\n " * 300_000, 'a: "' + "b\n " * 300_000 + '"'),
        *("a: |\n" + " b\n" * 300_000, "\n" * 1_000_000),
    ],
    ids=lambda text: ascii(text[:9]),
)
def test_large_texts(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with_libyaml = parsed(text)
    start = time.process_time()
    assert without_libyaml(text, monkeypatch) == with_libyaml
    assert time.process_time() - start < 10
