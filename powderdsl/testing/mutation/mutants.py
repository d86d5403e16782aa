"""A mutant: a rule file with one realistic mistake, made by replacing characters of its text."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from powderdsl.diagnostics import Source, Span
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.yaml_tree import Node, Scalar, Sequence

Container = yaml_tree.Mapping | Sequence
Path = tuple[tuple[Container, int], ...]
"""From the file's root to an entry: each container, and which of its entries leads on."""


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


# Cutting entries out of located YAML, and putting some in: the rest of the file stays as it is


def removed(path: Path) -> Edit:
    """The entry at the end of a path cut out; the whole container where it was the only one."""
    container, number = path[-1]
    spans = entry_spans(container)
    if len(spans) == 1 and len(path) > 1:
        return removed(path[:-1])
    text = container.span.source.text
    start, end = spans[number].start, spans[number].end
    if text[container.span.start] in "[{":
        if number + 1 < len(spans):
            return Edit(start, spans[number + 1].start, "")
        return Edit(spans[number - 1].end, end, "")
    line = text.rfind("\n", 0, start) + 1
    stop = text.find("\n", end)
    stop = len(text) if stop < 0 else stop + 1
    before = text[line:start]
    if isinstance(container, yaml_tree.Mapping) and before.strip():
        # The first key of a list's item stands beside the dash, which stays.
        return Edit(start, spans[number + 1].start, "") if number + 1 < len(spans) else Edit(start, end, "")
    return Edit(line, stop, "")


def without_action(path: Path) -> tuple[Edit, ...]:
    """A block without its action: what stood under `then` comes at once, or the block goes."""
    block = path[-1][0]
    assert isinstance(block, yaml_tree.Mapping)
    then = next((key for key, _ in block.entries if key.text == "then"), None)
    if then is None:
        return _without_block(path[:-1])
    return (removed(path), Edit(then.span.start, then.span.end, "do"))


def _without_block(path: Path) -> tuple[Edit, ...]:
    """The block at the end of a path cut out; with its action where it is all that the action does."""
    container, number = path[-1]
    if isinstance(container, Sequence) and len(container.items) == 1:
        return _without_block(path[:-1])
    inside = len(path) > 2  # a pass or block, not the list of all passes
    if isinstance(container, yaml_tree.Mapping) and inside and is_action(container.entries[number][0]):
        return without_action(path)
    return (removed(path),)


def is_action(key: Scalar) -> bool:
    """Whether a key of a pass or block is what it does."""
    return key.text == "do" or key.text.startswith(("for ", "repeat "))


def inserted(path: Path, entry: str) -> Edit:
    """A new entry after one of a mapping's, written as the mapping is: with a comma, or on a line of its own."""
    node, number = path[-1]
    assert isinstance(node, yaml_tree.Mapping)
    end = entry_spans(node)[number].end
    source = node.span.source
    if source.text[node.span.start] == "{":
        return Edit(end, end, f", {entry}")
    column = source.position(node.entries[0][0].span.start)[1]
    return Edit(end, end, "\n" + " " * (column - 1) + entry)


def entry_spans(container: Container) -> list[Span]:
    """Where each entry stands, key and value."""
    if isinstance(container, Sequence):
        return [_whole(item) for item in container.items]
    return [key.span.to(_whole(value)) for key, value in container.entries]


def _whole(node: Node) -> Span:
    """A node with all of its text: a block scalar's own span is its sign alone."""
    span = node.span
    if isinstance(node, Scalar) and node.style == "block":
        content = node.content
        text = content.source.text[span.start : content.end].rstrip()
        return Span(span.source, span.start, span.start + len(text))
    return span
