"""A mutant: a rule file with one realistic mistake, made by replacing characters of its text."""

from __future__ import annotations

import re
from collections.abc import Iterable
from collections.abc import Sequence as Sequence_
from dataclasses import dataclass, field, replace
from itertools import takewhile

from powderdsl.diagnostics import Source, Span
from powderdsl.model.builtins import KERNELS
from powderdsl.model.declarations import PackDecl, TypedDecl
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.yaml_tree import Node, Scalar, Sequence

Container = yaml_tree.Mapping | Sequence
Path = tuple[tuple[Container, int], ...]
"""From the file's root to an entry: each container, and which of its entries leads on."""


@dataclass(frozen=True)
class Change:
    """A mistake: the kind of it (docs/testing.md has a table), and characters `start` to `end` (exclusive) that become `text`."""

    operator: str
    start: int
    end: int
    text: str


@dataclass(frozen=True)
class Mutant:
    """One file of a composition with one mistake. `source` is the file as it was."""

    source: Source
    pack: str
    change: Change

    @property
    def operator(self) -> str:
        """The kind of the mistake."""
        return self.change.operator

    @property
    def text(self) -> str:
        """The whole file with the mistake."""
        text = self.source.text
        return text[: self.change.start] + self.change.text + text[self.change.end :]

    @property
    def place(self) -> str:
        """`file:line:column` of what is replaced."""
        start, text = self.change.start, self.source.text
        while start < min(self.change.end, len(text) - 1) and text[start].isspace():
            start += 1  # what is cut out may begin with the blanks before it
        return Span(self.source, start, start).place

    @property
    def diff(self) -> str:
        """The lines that differ, before and after, each on one line; `(nothing)` where there are none."""
        old, new = self.source.text.splitlines(), self.text.splitlines()
        before, after = (" ".join(" ".join(lines).split()) for lines in split_common_ends(old, new)[1:])
        return f"{before or '(nothing)'}  ⇒  {after or '(nothing)'}"

    @property
    def key(self) -> str:
        """The mutant's identity from run to run: place, kind and the new text."""
        return f"{self.place} {self.operator} {self.diff}"


def split_common_ends(old: list[str], new: list[str]) -> tuple[list[str], list[str], list[str]]:
    """Split two lists into their common beginning and the parts of each before their common end."""
    head = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(old, new, strict=False)))
    ends = zip(reversed(old[head:]), reversed(new[head:]), strict=False)
    tail = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], ends))
    return old[:head], old[head : len(old) - tail], new[head : len(new) - tail]


def replace_text(operator: str, span: Span, text: str) -> Change:
    """Another text at a place; words that stay the same at its ends are left alone."""
    old, new = (re.findall(r"[\w.%]+|\s+|[^\w\s.%]+", words) for words in (span.text, text))
    head, before, after = ("".join(words) for words in split_common_ends(old, new))
    start = span.start + len(head)
    return Change(operator, start, start + len(before), after)


def exchange_texts(operator: str, first: Span, second: Span) -> Change:
    """Two texts in each other's place."""
    between = first.source.text[first.end : second.start]
    return replace_text(operator, first.to(second), f"{second.text}{between}{first.text}")


# Cutting entries out of located YAML, and putting some in: the rest of the file stays as it is


def removed(operator: str, path: Path) -> Change:
    """The entry at the end of a path cut out; the whole container where it was the only one."""
    container, number = path[-1]
    spans = entry_spans(container)
    if len(spans) == 1 and len(path) > 1:
        return removed(operator, path[:-1])
    text = container.span.source.text
    start, end = spans[number].start, spans[number].end
    if text[container.span.start] in "[{":
        return without(operator, spans, number)
    line = text.rfind("\n", 0, start) + 1
    if isinstance(container, yaml_tree.Mapping) and text[line:start].strip():
        # The first key of a list's item stands beside the dash, which stays.
        return Change(operator, start, spans[number + 1].start if number + 1 < len(spans) else end, "")
    stop = text.find("\n", end)
    return Change(operator, line, len(text) if stop < 0 else stop + 1, "")


def without(operator: str, items: list[Span], number: int) -> Change:
    """An item of a list cut out with the comma beside it."""
    if number + 1 < len(items):
        return Change(operator, items[number].start, items[number + 1].start, "")
    return Change(operator, items[number - 1].end, items[number].end, "")


def inserted(operator: str, path: Path, entry: str) -> Change:
    """A new entry after one of a mapping's, written as the mapping is: with a comma, or on a line of its own."""
    node, number = path[-1]
    assert isinstance(node, yaml_tree.Mapping)
    end = entry_spans(node)[number].end
    source = node.span.source
    column = source.position(node.entries[0][0].span.start)[1]
    before = ", " if source.text[node.span.start] == "{" else "\n" + " " * (column - 1)
    return Change(operator, end, end, before + entry)


def entry_spans(container: Container) -> list[Span]:
    """Return the span of each entry, from key to value."""
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


# Names that a hurried author might write instead


@dataclass(frozen=True)
class Names:
    """Names by kind, in the order of the files. `own` are those of the mutated pack; `local` are its `let` values."""

    kinds: dict[str, str]
    own: frozenset[str]
    ranges: dict[str, tuple[int, int]]
    """Bounds of properties that are integers."""
    flags: frozenset[str]
    """Properties that are flags."""
    local: dict[str, str] = field(default_factory=dict)
    """`let` values of the pass at hand, with their text."""

    def kind(self, name: str) -> str:
        """The kind of a name without what it holds, or nothing: `property:int` is a `property`."""
        return self.kinds.get(name, "").partition(":")[0]

    def others(self, name: str) -> list[str]:
        """The next and the last name of the same kind: those of the same pack first, then others."""
        if name not in self.kinds:
            return []
        same = [other for other, kind in self.kinds.items() if kind == self.kinds[name]]
        place = same.index(name)
        ring = same[place + 1 :] + same[:place]
        if name in self.own:
            ring.sort(key=lambda other: other not in self.own)
        return [*dict.fromkeys([*ring[:1], *ring[-1:]])]

    def with_lets(self, lets: dict[str, str]) -> Names:
        """The same names with the `let` values of a pass."""
        kinds = {**self.kinds, **dict.fromkeys(lets, "let")}
        return replace(self, kinds=kinds, own=self.own | frozenset(lets), local=lets)


def names_of(packs: Sequence_[PackDecl], pack: PackDecl) -> Names:
    """The names that rules of a pack can say."""
    kinds: dict[str, str] = dict.fromkeys(KERNELS, "kernel")
    own: set[str] = set()
    types: dict[str, str] = {}
    for other in packs:
        names = {
            decl.name.text: kind
            for kind in ("tag", "set", "element", "stream", "kernel")
            for decl in getattr(other, f"{kind}s")
        }
        names |= _typed(other.properties, "property") | _typed(other.fields, "field")
        if other is pack:
            names |= _typed(other.params, "parameter")
            own |= set(names)
        kinds |= names
        types |= {decl.name.text: decl.type.span.text.strip() for decl in other.properties if decl.type}
    bounds = {name: re.fullmatch(r"(-?\d+)\s*\.\.\s*(-?\d+)", text) for name, text in types.items()}
    ranges = {name: (int(match[1]), int(match[2])) for name, match in bounds.items() if match}
    flags = frozenset(name for name, text in types.items() if text == "flag")
    return Names(kinds, frozenset(own), ranges, flags)


def _typed(decls: Iterable[TypedDecl], kind: str) -> dict[str, str]:
    """Declared names with their kind and what they hold: a number never stands for a flag by mistake."""
    kinds = {}
    for decl in decls:
        declared = decl.type or decl.default
        text = declared.span.text.strip() if declared else ""
        is_range = re.match(r"-?\d+\s*\.\.", text)
        content = "int" if is_range else "chance" if "%" in text else text.partition("(")[0]
        kinds[decl.name.text] = f"{kind}:{content}"
    return kinds
