"""A mutant: a rule file with one realistic mistake, made by replacing characters of its text."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from powderdsl.diagnostics import Source, Span


@dataclass(frozen=True)
class Edit:
    """Characters `start` to `end` (exclusive) of a file become `text`."""

    start: int
    end: int
    text: str


@dataclass(frozen=True)
class Change:
    """A mistake: the kind of it (see `OPERATORS`), and the edits that make it, which do not overlap."""

    operator: str
    edits: tuple[Edit, ...]


@dataclass(frozen=True)
class Mutant:
    """One file of a composition with one mistake. `source` is the file as it was."""

    source: Source
    pack: str
    operator: str
    edits: tuple[Edit, ...]

    @property
    def text(self) -> str:
        """The whole file with the mistake."""
        return applied(self.source.text, self.edits)

    @property
    def place(self) -> str:
        """`file:line:column` of the first edit."""
        first = min(self.edits, key=lambda edit: edit.start)
        start = first.start
        text = self.source.text
        while start < min(first.end, len(text) - 1) and text[start].isspace():
            start += 1  # what is cut out may begin with the blanks before it
        return Span(self.source, start, start).place

    @property
    def diff(self) -> str:
        """The lines that differ, before and after, each on one line; `(nothing)` where there are none."""
        before, after = changed_lines(self.source.text, self.text)
        return f"{before or '(nothing)'}  ⇒  {after or '(nothing)'}"

    @property
    def key(self) -> str:
        """Identifies the mutant from run to run: place, kind and the new text."""
        return f"{self.place} {self.operator} {self.diff}"


OPERATORS: dict[str, str] = {
    "neighbor": "another neighbor: `below` for `above`, `left` for `below.left`",
    "comparison": "`<=` for `<`, `!=` for `==`, `is not` for `is`",
    "constant": "a number that is one off, or twice as large",
    "chance": "a chance ten times as large or small, or half as large again",
    "connective": "`or` for `and`, or a part of a condition that is missing",
    "negation": "a `not` too much or too few",
    "guard": "a missing `if`, `where` or `with chance`",
    "effect": "a missing effect after `then`",
    "write": "`+=` for `:=`, `-=` for `+=`",
    "arithmetic": "`-` for `+`, `max` for `min`, the other branch of a choice",
    "coordinate": "`column` for `row`",
    "element": "another element, or source and target exchanged",
    "set": "another set, a missing member, `any but` forgotten",
    "tag": "a missing tag, another tag, a tag too much",
    "kernel": "another kernel, another weight, other edges",
    "stream": "another stream",
    "let": "another `let` value, or one that is not fixed in time",
    "parameter": "another parameter",
    "property": "another property, or another value of an element",
    "field": "another field; `at`, `resets`, `of`, default or range changed",
    "side": "a missing direction or symmetry",
    "order": "passes, rounds or rules in another order",
    "conflicts": "another policy for conflicts, or none",
    "rule": "a missing rule or block",
    "override": "an element that does not override, or does",
}
"""Kinds of mistakes, and a line about each."""


def applied(text: str, edits: Iterable[Edit]) -> str:
    """A text with edits that do not overlap."""
    for edit in sorted(edits, key=lambda edit: edit.start, reverse=True):
        text = text[: edit.start] + edit.text + text[edit.end :]
    return text


def changed_lines(before: str, after: str) -> tuple[str, str]:
    """The lines of two texts that differ, each text's joined to one line without the blanks around them."""
    old, new = before.splitlines(), after.splitlines()
    head = 0
    while head < min(len(old), len(new)) and old[head] == new[head]:
        head += 1
    tail = 0
    while tail < min(len(old), len(new)) - head and old[-1 - tail] == new[-1 - tail]:
        tail += 1
    return tuple(" ".join(" ".join(lines[head : len(lines) - tail]).split()) for lines in (old, new))  # type: ignore[return-value]
