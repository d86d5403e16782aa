"""Realistic mistakes in a whole rule file: in its rules, and in the tables of elements, fields and kernels."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator
from collections.abc import Sequence as Sequence_
from dataclasses import dataclass

from powderdsl.diagnostics import Reporter, Source, Span
from powderdsl.model.declarations import PackDecl
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.parse import parse_scalar
from powderdsl.syntax.yaml_tree import Mapping, Node, Scalar, Sequence, parse_yaml
from powderdsl.testing.mutation.exchangeable import Names, names_of
from powderdsl.testing.mutation.line_operators import chance_changes, kind_changes, line_changes
from powderdsl.testing.mutation.mutants import Change, Edit, Mutant

Container = Mapping | Sequence
Path = tuple[tuple[Container, int], ...]
"""From the file's root to an entry: each container, and which of its entries leads on."""

OPTIONS = {
    "symmetry": ("side", ("mirror", "rotations", "all")),
    "conflicts": ("conflicts", ("drop_both", "first_wins", "overwrite")),
}
"""Keys of a block with a word as their value: the kind of mistake, and the words."""

UNCHANGED = ("id", "color", "color_by", "glyph", "about")
"""Keys of an element that do not change what it does."""


def mutants_of(pack: PackDecl, packs: Sequence_[PackDecl]) -> list[Mutant]:
    """All mutants of a pack's file, each text once, in the order of the file.

    Args:
        packs: all packs of the composition in which it is mutated.
    """
    root = parse_yaml(pack.source, Reporter())
    if not isinstance(root, Mapping):
        return []
    found: dict[str, Mutant] = {}
    for change in _FileChanges(pack.source, names_of(packs, pack)).of(root):
        mutant = Mutant(pack.source, pack.name.text, change.operator, change.edits)
        if mutant.text != pack.source.text:
            found.setdefault(mutant.text, mutant)
    return sorted(found.values(), key=lambda one: min(edit.start for edit in one.edits))


@dataclass
class _FileChanges:
    """Walks through the located tree of a pack's file."""

    source: Source
    names: Names

    def of(self, root: Mapping) -> Iterator[Change]:
        parts: dict[str, Callable[[str, Node, Path], Iterator[Change]]] = {
            "properties": self._property,
            "fields": self._field,
            "params": lambda name, node, path: self._line(
                node.get("default") if isinstance(node, Mapping) else node
            ),
            "kernels": self._kernel,
            "sets": lambda name, node, path: self._line(node),
            "elements": self._element,
            "also": self._also,
            "passes": self._pass,
        }
        for key, node, path in entries_of(root):
            part = parts.get(key.text)
            if part is not None and isinstance(node, Mapping):
                for name, value, entry in entries_of(node, path):
                    yield from part(name.text, value, entry)

    # Lines

    def _line(
        self, node: Node | None, start: str = "expression", names: Names | None = None
    ) -> Iterator[Change]:
        tree = self._parsed(node, start)
        if tree is not None:
            yield from line_changes(tree, names or self.names)

    def _parsed(self, node: Node | None, start: str = "expression") -> Syntax | None:
        return parse_scalar(node, start, Reporter()) if isinstance(node, Scalar) and node.text else None

    def _kind(self, node: Node | None) -> Iterator[Change]:
        tree = self._parsed(node)
        if tree is not None:
            yield from kind_changes(tree)

    def _lost(self, operator: str, path: Path) -> Iterator[Change]:
        yield Change(operator, (removed(self.source, path),))

    def _replaced(self, operator: str, node: Scalar, text: str) -> Change:
        return Change(operator, (Edit(node.content.start, node.content.end, text),))

    # Tables

    def _property(self, name: str, node: Node, path: Path) -> Iterator[Change]:
        if not isinstance(node, Mapping):
            yield from self._kind(node)
            return
        for key, value, entry in entries_of(node, path):
            if key.text == "type":
                yield from self._kind(value)
            elif key.text != "about":
                yield from self._value(name, value, entry)

    def _value(self, name: str, node: Node, path: Path) -> Iterator[Change]:
        """A property's value: one or two off, the other flag, another chance, or not said."""
        tree = self._parsed(node)
        if tree is None:
            return
        sign = -1 if tree.kind == "negate" else 1
        inner = tree.children[0] if tree.kind == "negate" else tree
        if inner.kind == "integer":
            low, high = self.names.ranges.get(name, (-(10**6), 10**6))
            number = sign * int(inner.text)
            for other in (number - 1, number + 1, number - 2, number + 2):
                if low <= other <= high:
                    yield Change("property", (Edit(tree.span.start, tree.span.end, str(other)),))
        elif inner.kind == "percent":
            yield from chance_changes(inner)
        elif inner.kind in ("yes", "no"):
            other_word = "no" if inner.kind == "yes" else "yes"
            yield Change("property", (Edit(inner.span.start, inner.span.end, other_word),))
        else:
            yield from line_changes(tree, self.names)
        yield from self._lost("property", path)

    def _field(self, name: str, node: Node, path: Path) -> Iterator[Change]:
        if not isinstance(node, Mapping):
            return
        for key, value, entry in entries_of(node, path):
            if not isinstance(value, Scalar):
                continue
            match key.text:
                case "type":
                    yield from self._kind(value)
                case "at":
                    yield self._replaced("field", value, "place" if value.text == "element" else "element")
                    if node.get("resets") is None:
                        yield Change("field", (inserted(entry, "resets: step"),))
                case "resets":
                    yield from self._lost("field", entry)
                case "about":
                    continue
                case _:  # `default`, `of`, the default of an element
                    yield from self._line(value)
                    yield from self._lost("field", entry)

    def _kernel(self, name: str, node: Node, path: Path) -> Iterator[Change]:
        if isinstance(node, Mapping):
            yield from self._line(node.get("shape"))
        rows = node.get("rows") if isinstance(node, Mapping) else node
        for row in rows.items if isinstance(rows, Sequence) else (rows,):
            if not isinstance(row, Scalar):
                continue
            for found in re.finditer(r"-?\d+", row.content.text):
                weight = int(found[0])
                start, end = row.content.start + found.start(), row.content.start + found.end()
                for other in (1,) if weight == 0 else (0, 2 * weight):
                    yield Change("kernel", (Edit(start, end, str(other)),))
        if not isinstance(node, Mapping):
            start, end = node.span.start, node.span.end
            text = self.source.text
            if text[start] == "[":
                yield Change("kernel", (Edit(start, end, f"{{rows: {text[start:end]}, edges: wrap}}"),))
            return
        edges = node.get("edges")
        if isinstance(edges, Scalar):
            yield self._replaced("kernel", edges, "nothing" if edges.text == "wrap" else "wrap")
        else:
            last = (*path, (node, len(node.entries) - 1))
            yield Change("kernel", (inserted(last, "edges: wrap"),))

    def _element(self, name: str, node: Node, path: Path) -> Iterator[Change]:
        if not isinstance(node, Mapping):
            return
        yield from self._also(name, node, path)
        said = {key.word for key, _ in node.entries}
        last = (*path, (node, len(node.entries) - 1))
        for flag in sorted(self.names.flags - said):
            yield Change("property", (inserted(last, f"{flag}: yes"),))
        if "tags" not in said:
            tag = next((n for n, kind in self.names.kinds.items() if kind == "tag"), None)
            if tag is not None:
                yield Change("tag", (inserted(last, f"tags: {tag}?"),))

    def _tags(self, node: Node, path: Path) -> Iterator[Change]:
        """A word of a list of tags gone, another one, one more."""
        words = node.items if isinstance(node, Sequence) else (node,)
        here = [word.word for word in words if isinstance(word, Scalar)]
        for number, word in enumerate(words):
            if not isinstance(word, Scalar) or self.names.kind(word.word) != "tag":
                continue
            yield from self._lost("tag", (*path, (node, number)) if isinstance(node, Sequence) else path)
            other = next((n for n in self.names.others(word.word) if n not in here), None)
            if other is not None:
                yield self._replaced("tag", word, f"{other}?")
                start, end = node.span.start, node.span.end
                if isinstance(node, Scalar):
                    yield Change("tag", (Edit(start, end, f"[{node.text}, {other}?]"),))
                elif number == 0 and self.source.text[start] == "[":
                    yield Change("tag", (Edit(start + 1, start + 1, f"{other}?, "),))

    def _also(self, name: str, node: Node, path: Path) -> Iterator[Change]:
        if not isinstance(node, Mapping):
            yield from self._tags(node, path)
            return
        for key, value, entry in entries_of(node, path):
            if key.text == "tags":
                yield from self._tags(value, entry)
            elif key.text == "override" and isinstance(value, Scalar):
                yield self._replaced("override", value, "no" if value.text in ("yes", "true") else "yes")
            elif key.text not in UNCHANGED:
                yield from self._value(key.word, value, entry)

    # Passes

    def _pass(self, name: str, node: Node, path: Path) -> Iterator[Change]:
        if not isinstance(node, Mapping):
            return
        lets: dict[str, str] = {}
        _collect_lets(node, lets)
        names = self.names.with_lets(lets)
        for key, value, entry in entries_of(node, path):
            if key.text in ("after", "before"):
                yield from self._order(key, value, entry, node)
            elif key.text == "scratch" and isinstance(value, Mapping):
                for _, kind in value.entries:
                    yield from self._kind(kind)
        yield from self._block(node, path, names)

    def _order(self, key: Scalar, node: Node, path: Path, pass_: Mapping) -> Iterator[Change]:
        if isinstance(node, Sequence):
            for number, _ in enumerate(node.items):
                yield from self._lost("order", (*path, (node, number)))
        else:
            yield from self._lost("order", path)
        other = "before" if key.text == "after" else "after"
        if pass_.get(other) is None:
            yield Change("order", (Edit(key.span.start, key.span.end, other),))

    def _block(self, node: Mapping, path: Path, names: Names) -> Iterator[Change]:
        """A pass or block: its values, its action, what comes then."""
        for key, value, entry in entries_of(node, path):
            if key.text == "let" and isinstance(value, Mapping):
                for _, line in value.entries:
                    yield from self._line(line, "expression", names)
            elif key.text in OPTIONS and isinstance(value, Scalar):
                operator, options = OPTIONS[key.text]
                for other in options:
                    if other != value.text:
                        yield self._replaced(operator, value, other)
                yield from self._lost(operator, entry)
            elif is_action(key):
                if key.text != "do":
                    yield from self._line(key, "header", names)
                yield Change("rule", without_action(self.source, entry))
                yield from self._body(value, entry, names)
            elif key.text == "then":
                yield from self._lost("rule", entry)
                yield from self._body(value, entry, names)
        yield from self._merged(node)

    def _body(self, node: Node, path: Path, names: Names) -> Iterator[Change]:
        """A rule, a list of rules, or blocks."""
        items = node.items if isinstance(node, Sequence) else (node,)
        for number, item in enumerate(items):
            here = (*path, (node, number)) if isinstance(node, Sequence) else path
            if isinstance(node, Sequence) and len(items) > 1:
                yield from self._lost("rule", here)
            if isinstance(item, Mapping):
                yield from self._block(item, here, names)
            elif isinstance(item, Scalar):
                yield from self._line(item, "rule", names)
        if isinstance(node, Sequence) and len(items) > 1:
            yield from self._reordered(node)

    def _reordered(self, node: Sequence) -> Iterator[Change]:
        """Two neighbors of a list exchanged; a list of rules one after the other instead of at once."""
        text = self.source.text
        scalars = [item for item in node.items if isinstance(item, Scalar)]
        if len(scalars) < len(node.items) or any(item.style == "block" for item in scalars):
            return
        for first, second in itertools.pairwise(scalars):
            a, b = first.span, second.span
            yield Change("order", (Edit(a.start, a.end, b.text), Edit(b.start, b.end, a.text)))
        if text[node.span.start] != "[":
            blocks = [(one.span, " ".join(one.span.text.split())) for one in scalars]
            yield Change("order", tuple(Edit(at.start, at.end, f"do: {words}") for at, words in blocks))

    def _merged(self, node: Mapping) -> Iterator[Change]:
        """`do` and `then` at once: one substep where there were two."""
        for (first_key, first), (second_key, second) in itertools.pairwise(node.entries):
            if (first_key.text, second_key.text) == ("do", "then") and lines_of(first) and lines_of(second):
                start = first_key.span.start
                indent = " " * (self.source.position(start)[1] - 1)
                rules = [" ".join(rule.span.text.split()) for rule in (*lines_of(first), *lines_of(second))]
                listed = "".join(f"\n{indent}  - {rule}" for rule in rules)
                yield Change("order", (Edit(start, second.span.end, f"do:{listed}"),))


def _collect_lets(node: Node, found: dict[str, str]) -> None:
    """The `let` values of a pass and its blocks, with their text on one line."""
    if isinstance(node, Mapping):
        for key, value in node.entries:
            if key.text == "let" and isinstance(value, Mapping):
                for name, line in value.entries:
                    if isinstance(line, Scalar):
                        found[name.text] = " ".join(line.content.text.split())
            _collect_lets(value, found)
    elif isinstance(node, Sequence):
        for item in node.items:
            _collect_lets(item, found)


# Cutting entries out of located YAML, and putting some in: the rest of the file stays as it is


def entries_of(node: Mapping, path: Path = ()) -> Iterator[tuple[Scalar, Node, Path]]:
    """Keys and values of a mapping, and the path to each."""
    for number, (key, value) in enumerate(node.entries):
        yield key, value, (*path, (node, number))


def removed(source: Source, path: Path) -> Edit:
    """The entry at the end of a path cut out; the whole container where it was the only one."""
    container, number = path[-1]
    spans = entry_spans(container)
    if len(spans) == 1 and len(path) > 1:
        return removed(source, path[:-1])
    text = source.text
    start, end = spans[number].start, spans[number].end
    if text[container.span.start] in "[{":
        if number + 1 < len(spans):
            return Edit(start, spans[number + 1].start, "")
        return Edit(spans[number - 1].end, end, "")
    line = text.rfind("\n", 0, start) + 1
    stop = text.find("\n", end)
    stop = len(text) if stop < 0 else stop + 1
    before = text[line:start]
    if isinstance(container, Mapping) and before.strip():
        # The first key of a list's item stands beside the dash, which stays.
        return Edit(start, spans[number + 1].start, "") if number + 1 < len(spans) else Edit(start, end, "")
    return Edit(line, stop, "")


def without_action(source: Source, path: Path) -> tuple[Edit, ...]:
    """A block without its action: what stood under `then` comes at once, or the block goes."""
    block = path[-1][0]
    assert isinstance(block, Mapping)
    then = next((key for key, _ in block.entries if key.text == "then"), None)
    if then is None:
        return _without_block(source, path[:-1])
    return (removed(source, path), Edit(then.span.start, then.span.end, "do"))


def _without_block(source: Source, path: Path) -> tuple[Edit, ...]:
    """The block at the end of a path cut out; with its action where it is all that the action does."""
    container, number = path[-1]
    if isinstance(container, Sequence) and len(container.items) == 1:
        return _without_block(source, path[:-1])
    inside = isinstance(container, Mapping) and len(path) > 2  # a pass or block, not the list of all passes
    if inside and is_action(container.entries[number][0]):  # type: ignore[union-attr]  # a mapping
        return without_action(source, path)
    return (removed(source, path),)


def is_action(key: Scalar) -> bool:
    """Whether a key of a pass or block is what it does."""
    return key.text == "do" or key.text.startswith(("for ", "repeat "))


def inserted(path: Path, entry: str) -> Edit:
    """A new entry after one of a mapping's, written as the mapping is: with a comma, or on a line of its own."""
    node, number = path[-1]
    assert isinstance(node, Mapping)
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
        text = node.content.source.text
        end = node.content.end
        while end > span.start and text[end - 1].isspace():
            end -= 1
        return Span(span.source, span.start, end)
    return span


def lines_of(node: Node) -> list[Scalar]:
    """The rules of a body: itself or the items of a list; none where there are blocks."""
    items = node.items if isinstance(node, Sequence) else (node,)
    scalars = [item for item in items if isinstance(item, Scalar)]
    return scalars if len(scalars) == len(items) else []
