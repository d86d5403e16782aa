"""Realistic mistakes in a whole rule file: in its rules, and in the tables of elements, fields and kernels."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from collections.abc import Sequence as Sequence_
from dataclasses import dataclass

from powderdsl.diagnostics import Reporter, Source
from powderdsl.model.declarations import PackDecl
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.parse import parse_scalar
from powderdsl.syntax.yaml_tree import Mapping, Node, Scalar, Sequence, parse_yaml
from powderdsl.testing.mutation.exchangeable import Names, names_of
from powderdsl.testing.mutation.line_operators import chance_changes, kind_changes, line_changes
from powderdsl.testing.mutation.mutants import Change, Edit, Mutant
from powderdsl.testing.mutation.removal import Path, inserted, lines_of, removed, without_action

SYMMETRIES = ("mirror", "rotations", "all")
POLICIES = ("drop_both", "first_wins")
UNCHANGED = ("id", "color", "color_by", "glyph", "about")
"""Keys of an element that say nothing of what it does."""


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
        parts = {
            "properties": self._property,
            "fields": self._field,
            "params": self._param,
            "kernels": self._kernel,
            "sets": self._set,
            "elements": self._element,
            "also": self._also,
            "passes": self._pass,
        }
        for number, (key, node) in enumerate(root.entries):
            part = parts.get(key.text)
            if part is None or not isinstance(node, Mapping):
                continue
            for place, (name, value) in enumerate(node.entries):
                yield from part(name.text, value, ((root, number), (node, place)))

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
        for number, (key, value) in enumerate(node.entries):
            entry = (*path, (node, number))
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
        keys = {key.text for key, _ in node.entries}
        for number, (key, value) in enumerate(node.entries):
            if not isinstance(value, Scalar):
                continue
            match key.text:
                case "type":
                    yield from self._kind(value)
                case "at":
                    yield self._replaced("field", value, "place" if value.text == "element" else "element")
                    if "resets" not in keys:
                        yield Change("field", (inserted(node, number, "resets: step"),))
                case "default" | "of":
                    yield from self._line(value)
                    yield from self._lost("field", (*path, (node, number)))
                case "resets":
                    yield from self._lost("field", (*path, (node, number)))
                case "about":
                    continue
                case _:  # the default of an element
                    yield from self._line(value)
                    yield from self._lost("field", (*path, (node, number)))

    def _param(self, name: str, node: Node, path: Path) -> Iterator[Change]:
        yield from self._line(node.get("default") if isinstance(node, Mapping) else node)

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
            yield Change("kernel", (inserted(node, len(node.entries) - 1, "edges: wrap"),))

    def _set(self, name: str, node: Node, path: Path) -> Iterator[Change]:
        yield from self._line(node)

    def _element(self, name: str, node: Node, path: Path) -> Iterator[Change]:
        if not isinstance(node, Mapping):
            return
        said = {key.text.removesuffix("?") for key, _ in node.entries}
        for number, (key, value) in enumerate(node.entries):
            entry = (*path, (node, number))
            if key.text == "tags":
                yield from self._tags(value, entry)
            elif key.text == "override" and isinstance(value, Scalar):
                yield self._replaced("override", value, "no" if value.text in ("yes", "true") else "yes")
            elif key.text not in UNCHANGED:
                yield from self._value(key.text.removesuffix("?"), value, entry)
        last = len(node.entries) - 1
        for flag in sorted(self.names.flags - said):
            yield Change("property", (inserted(node, last, f"{flag}: yes"),))
        if "tags" not in said:
            tag = next((n for n, kind in self.names.kinds.items() if kind == "tag"), None)
            if tag is not None:
                yield Change("tag", (inserted(node, last, f"tags: {tag}?"),))

    def _tags(self, node: Node, path: Path) -> Iterator[Change]:
        """A word of a list of tags gone, another one, one more."""
        words = node.items if isinstance(node, Sequence) else (node,)
        here = [word.text.removesuffix("?") for word in words if isinstance(word, Scalar)]
        for number, word in enumerate(words):
            if not isinstance(word, Scalar) or self.names.kind(word.text.removesuffix("?")) != "tag":
                continue
            if isinstance(node, Sequence):
                yield from self._lost("tag", (*path, (node, number)))
            else:
                yield from self._lost("tag", path)
            other = next((n for n in self.names.others(here[number]) if n not in here), None)
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
        for number, (key, value) in enumerate(node.entries):
            entry = (*path, (node, number))
            if key.text == "tags":
                yield from self._tags(value, entry)
            elif key.text not in UNCHANGED:
                yield from self._value(key.text.removesuffix("?"), value, entry)

    # Passes

    def _pass(self, name: str, node: Node, path: Path) -> Iterator[Change]:
        if not isinstance(node, Mapping):
            return
        lets: dict[str, str] = {}
        _collect_lets(node, lets)
        names = self.names.with_lets(lets)
        for number, (key, value) in enumerate(node.entries):
            entry = (*path, (node, number))
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
        keys = {key.text for key, _ in node.entries}
        for number, (key, value) in enumerate(node.entries):
            entry = (*path, (node, number))
            if key.text == "let" and isinstance(value, Mapping):
                for _, line in value.entries:
                    yield from self._line(line, "expression", names)
            elif key.text == "symmetry" and isinstance(value, Scalar):
                for other in SYMMETRIES:
                    if other != value.text:
                        yield self._replaced("side", value, other)
                yield from self._lost("side", entry)
            elif key.text == "conflicts" and isinstance(value, Scalar):
                for other in POLICIES:
                    if other != value.text:
                        yield self._replaced("conflicts", value, other)
                yield from self._lost("conflicts", entry)
            elif key.text == "do" or key.text.startswith(("for ", "repeat ")):
                if key.text != "do":
                    yield from self._line(key, "header", names)
                yield Change("rule", without_action(self.source, (*path, (node, number))))
                yield from self._body(value, entry, names)
            elif key.text == "then":
                yield from self._lost("rule", entry)
                yield from self._body(value, entry, names)
        if "do" in keys and "then" in keys:
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
        entries = {key.text: (key, value) for key, value in node.entries}
        _, first = entries["do"]
        key, second = entries["then"]
        rules = [*lines_of(first), *lines_of(second)]
        if not rules or not lines_of(first) or not lines_of(second):
            return
        start = next(k.span.start for k, _ in node.entries if k.text == "do")
        end = second.span.end
        if not start < key.span.start:
            return
        indent = " " * (self.source.position(start)[1] - 1)
        between = [k for k, _ in node.entries if start < k.span.start < key.span.start]
        if between:
            return
        listed = "".join(f"\n{indent}  - {' '.join(rule.span.text.split())}" for rule in rules)
        yield Change("order", (Edit(start, end, f"do:{listed}"),))


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
