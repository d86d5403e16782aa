"""Realistic mistakes in a rule file: for each kind of syntax and each key, what a hurried author writes instead."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Sequence as Sequence_
from dataclasses import dataclass, replace

from powderdsl.diagnostics import Reporter
from powderdsl.model.builtins import DIRECTION_SETS, KERNEL_SHAPES
from powderdsl.model.declarations import PackDecl
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.parse import parse_scalar
from powderdsl.syntax.yaml_tree import Node, Scalar, Sequence, parse_yaml
from powderdsl.testing.mutation.mutants import (
    Change,
    Edit,
    Mutant,
    Path,
    inserted,
    is_action,
    removed,
    without_action,
)
from powderdsl.testing.mutation.names import Names, names_of

SIMILAR = {
    **{place: ("neighbor", *others) for place, others in {
        "above": ("below", "left"), "below": ("above", "right"), "left": ("right", "below"), "right": ("left", "above"),
        "here": ("above", "right"),
    }.items()},
    **{name: ("side", *(other for other in DIRECTION_SETS if other != name)) for name in DIRECTION_SETS},
    "row": ("coordinate", "column"), "column": ("coordinate", "row"), "step": ("coordinate", "row"),
    "<": ("comparison", "<=", ">"), "<=": ("comparison", "<", ">="), ">": ("comparison", ">=", "<"),
    ">=": ("comparison", ">", "<="), "==": ("comparison", "!=", ">="), "!=": ("comparison", "==", "<"),
    ":=": ("write", "+=", "-="), "+=": ("write", "-=", ":="), "-=": ("write", "+=", ":="),
}  # fmt: skip
"""Words and signs of the language: the kind of mistake, and what stands for them. A neighbor: the opposite, and one around
the corner."""

LOOSER_THAN_IN = ("compare", "is_", "is_not", "in_", "not_in", "not_", "and_", "or_")
"""Kinds of conditions that stand in parentheses before `in`."""

UNCHANGED = ("id", "color", "color_by", "glyph", "about")
"""Keys of an element that do not change what it does."""


def mutants_of(pack: PackDecl, packs: Sequence_[PackDecl]) -> list[Mutant]:
    """All mutants of a pack's file, each text once, in the order of the file.

    Args:
        packs: all packs of the composition in which it is mutated.
    """
    root = parse_yaml(pack.source, Reporter())
    if not isinstance(root, yaml_tree.Mapping):
        return []
    mutants: dict[str, Mutant] = {}
    for section in entries_of(root, (), names_of(packs, pack)):
        for entry in section.entries():
            for change in SECTIONS.get(section.key.text, nothing)(entry):
                mutant = Mutant(pack.source, pack.name.text, change.operator, change.edits)
                if mutant.text != pack.source.text:
                    mutants.setdefault(mutant.text, mutant)
    return sorted(mutants.values(), key=lambda mutant: min(edit.start for edit in mutant.edits))


# Lines


@dataclass(frozen=True)
class Part:
    """A part of a line: its syntax, what it is a part of, and the names that may stand there by mistake."""

    node: Syntax
    parent: Syntax | None
    names: Names

    def instead(self, operator: str, text: str) -> Change:
        """Another text in its place."""
        return Change(operator, (Edit(self.node.span.start, self.node.span.end, text),))

    def only(self, operator: str, number: int) -> Change:
        """One of its operands in its place."""
        return self.instead(operator, cut(self.node, extent(self.node.children[number], self.node)))

    def between(self, operator: str, word: str, other: str, number: int = 0) -> Change:
        """Another word between an operand and the next one."""
        first, second = self.node.children[number : number + 2]
        begin, end = extent(first, self.node)[1], extent(second, self.node)[0]
        text = cut(self.node, (begin, end))
        found = re.search(re.escape(word).replace(r"\ ", r"\s+"), text)
        assert found is not None, f"`{word}` is not in `{text}`"
        return Change(operator, (Edit(begin + found.start(), begin + found.end(), other),))

    def exchanged(self, operator: str, first: int, second: int) -> Change:
        """Two operands in each other's place."""
        (a, b), (c, d) = (extent(self.node.children[number], self.node) for number in (first, second))
        edits = Edit(a, b, cut(self.node, (c, d))), Edit(c, d, cut(self.node, (a, b)))
        return Change(operator, edits)

    def without(self, operator: str, number: int) -> Change:
        """An item of a list cut out with the comma beside it."""
        if number + 1 < len(self.node.children):
            return Change(operator, (Edit(self.item(number)[0], self.item(number + 1)[0], ""),))
        return Change(operator, (Edit(self.item(number - 1)[1], self.item(number)[1], ""),))

    def item(self, number: int) -> tuple[int, int]:
        """An item of a list with its own parentheses, but not those of the list."""
        child = self.node.children[number]
        start, end = extent(child, self.node)
        return (start, end) if start > self.node.span.start else (child.span.start, child.span.end)


Changes = Iterator[Change]
Mistake = Callable[[Part], Iterable[Change]]


def line_changes(node: Syntax, names: Names, parent: Syntax | None = None) -> Changes:
    """All mistakes in a line or a part of it, in the order in which it is read."""
    part = Part(node, parent, names)
    for mistake in MISTAKES.get(node.kind, ()):
        yield from mistake(part)
    for child in node.children:
        if node.kind != "binding" or child is not node.children[0]:  # the variable's own name
            yield from line_changes(child, names, node)


def cut(node: Syntax, place: tuple[int, int]) -> str:
    """The text at a place of the line."""
    return node.span.source.text[place[0] : place[1]]


def extent(child: Syntax, parent: Syntax) -> tuple[int, int]:
    """Where an operand stands with the parentheses around it, which its own span leaves out."""
    text = child.span.source.text
    start, end = child.span.start, child.span.end
    while True:
        left, right = start - 1, end
        while left >= parent.span.start and text[left].isspace():
            left -= 1
        while right < parent.span.end and text[right].isspace():
            right += 1
        inside = left >= parent.span.start and right < parent.span.end
        if not (inside and text[left] == "(" and text[right] == ")"):
            return start, end
        start, end = left, right + 1


def only(operator: str) -> Mistake:
    """Its operand in its place."""
    return lambda part: [part.only(operator, 0)]


def between(operator: str, word: str, other: str) -> Mistake:
    """Another word between its operands."""
    return lambda part: [part.between(operator, word, other)]


def beginning(operator: str, word: str, other: str) -> Mistake:
    """Another first word."""
    return lambda part: [
        Change(operator, (Edit(part.node.span.start, part.node.span.start + len(word), other),))
    ]


def values(operator: str, others: Callable[[str], Iterable[str]]) -> Mistake:
    """Other values in its place."""
    return lambda part: [part.instead(operator, other) for other in others(part.node.text)]


def near_integers(text: str) -> Iterator[str]:
    """One off; of a large one twice as large and half."""
    number = int(text)
    for other in (number + 1, number - 1, *((number * 2, number // 2) if number >= 10 else ())):
        if other >= 0:
            yield str(other)


def near_bounds(text: str) -> Iterator[str]:
    """Other bounds for a declared kind: one off, or half of a large one."""
    number = int(text)
    for other in (number + 1, number - 1) if number <= 20 else (number // 2,):
        if other >= 0:
            yield str(other)


def near_decimals(text: str) -> Iterator[str]:
    """Half of it, and twice as far from 1 or from 0."""
    number = float(text)
    for other in (number / 2, 1 - (1 - number) / 2 if number < 1 else number * 2):
        written = f"{other:.6g}"
        yield written if re.search(r"[.e]", written) else f"{written}.0"


def near_chances(text: str) -> Iterator[str]:
    """A percentage ten times as large or small, and half as large again; nothing above 100 %."""
    number = float(text.rstrip("%"))
    for other in (min(number * 10, 100.0), number / 10, min(number * 1.5, 100.0)) if number else (10.0,):
        if other != number:
            yield f"{other:.10g}%"


def _operands(part: Part) -> Changes:
    yield part.only("connective", 0)
    if part.node.children[0].kind != part.node.kind:
        yield part.only("connective", 1)


def _membership(part: Part) -> Changes:
    is_kernel = _names_kernel(part.node, part.parent, part.names)
    yield part.only("kernel", 0) if is_kernel else part.between("comparison", "in", "not in")


def _names_kernel(node: Syntax, parent: Syntax | None, names: Names) -> bool:
    """Whether `a in b` says where to count, or is a question."""
    in_call = parent is not None and parent.kind == "call" and parent.text in ("count", "sum")
    return in_call and node.kind == "in_" and names.kind(node.children[1].text) == "kernel"


def _name(part: Part) -> Changes:
    names = part.names
    name = part.node.text or part.node.span.text
    mark = "?" if part.node.kind == "optional_name" else ""
    operator, *others = SIMILAR.get(name, ("",))
    for other in others:
        yield part.instead(operator, other)
    for other in names.others(name):
        yield part.instead(names.kind(name), other + mark)
    if name in names.local:
        yield part.instead("let", f"({names.local[name]})")


def _attribute(part: Part) -> Changes:
    node, names = part.node, part.names
    start, end, before = node.span.end - len(node.text), node.span.end, node.children[0].span.text
    kind = names.kind(node.text)
    operator, *others = SIMILAR.get(node.text, ("",))
    for other in others if node.text != "step" else ():
        yield Change(operator, (Edit(start, end, other),))
    if not (kind or operator == "coordinate"):
        yield part.instead("neighbor", before)
    if operator == "" or (operator == "neighbor" and SIMILAR.get(before, ("",))[0] == "neighbor"):
        yield part.instead("neighbor", node.text)
    for other in names.others(node.text) if kind in ("property", "field", "stream", "let") else ():
        yield Change(kind, (Edit(start, end, other),))


def _signs(part: Part) -> Changes:
    """Other comparisons, another update."""
    for number, sign in enumerate(part.node.text.split()):
        operator, *others = SIMILAR[sign]
        for other in others:
            yield part.between(operator, sign, other, number)


def _call(part: Part) -> Changes:
    node, names = part.node, part.names
    name = node.text.split()[0]
    if name in ("count", "sum") and not any(_names_kernel(child, node, names) for child in node.children):
        last, end = node.children[-1], node.span.end - 1
        is_open = last.kind in LOOSER_THAN_IN and last.span.text[:1] != "("
        opened = (Edit(last.span.start, last.span.start, "("),) if is_open else ()
        for kernel in ("ring", "cross"):
            yield Change("kernel", (*opened, Edit(end, end, f"{')' if is_open else ''} in {kernel}")))
    if name in ("min", "max"):
        yield from beginning("arithmetic", name, "max" if name == "min" else "min")(part)
    inner = node.children[0].span.text if node.children else ""
    if name in ("abs", "clamp"):
        yield part.instead("arithmetic", f"({inner})")
    if name in ("opposite", "clockwise", "counterclockwise"):
        yield part.instead("neighbor", inner)
    for shape in KERNEL_SHAPES if name in KERNEL_SHAPES else ():
        if shape != name:
            yield from beginning("kernel", name, shape)(part)
    if name in ("count", "min", "max") and len(node.children) > 1:
        for number in range(len(node.children)):
            yield part.without("set" if name == "count" else "arithmetic", number)


def _tuple(part: Part) -> Changes:
    children = part.node.children
    is_loop = part.parent is not None and part.parent.kind == "binding"
    operator = "side" if is_loop and SIMILAR.get(children[0].text, ("",))[0] == "neighbor" else "set"
    for number in range(len(children)):
        if len(children) == 2:
            yield part.instead(operator, f"({cut(part.node, part.item(1 - number))})")
        else:
            yield part.without(operator, number)
    if is_loop:
        yield part.exchanged("order", 0, len(children) - 1)


def _repeat(part: Part) -> Changes:
    found = re.search(r"\d+", part.node.span.text)
    assert found is not None
    start = part.node.span.start + found.start()
    for count in (int(found[0]) + 1, int(found[0]) - 1):
        if count > 0:
            yield Change("constant", (Edit(start, start + len(found[0]), str(count)),))


def _rule(part: Part) -> Changes:
    """A rule without its condition or its chance, or the other way round, or with a draw that others share."""
    node, names = part.node, part.names
    condition, chance = node.child("condition"), node.child("chance")
    stream = next((name for name, kind in names.kinds.items() if kind == "stream"), None)
    if condition is not None and chance is not None and stream is not None:
        drawn = f" and {stream} < {chance.children[0].span.text}"
        end = condition.span.end
        yield Change("stream", (Edit(end, end, drawn), Edit(chance.span.start, chance.span.end, "")))
    if node.kind == "transform" and {child.kind for child in node.children[:2]} <= {"name", "optional_name"}:
        yield part.exchanged("element", 0, 1)
    for clause in node.children:
        if clause.kind in ("condition", "where", "chance"):
            yield replace(part, node=clause).instead("guard", "")
        if clause.kind in ("condition", "where"):
            for conjunct in _conjuncts(clause.children[0]):
                if conjunct.kind in ("name", "optional_name", "attribute", "any_of", "all_of"):
                    yield replace(part, node=conjunct).instead("negation", f"not {conjunct.span.text}")


def _conjuncts(node: Syntax) -> Iterator[Syntax]:
    if node.kind in ("and_", "or_"):
        for child in node.children:
            yield from _conjuncts(child)
    else:
        yield node


def _effects(part: Part) -> Changes:
    updates = [child for child in part.node.children if child.kind == "update"]
    if len(updates) == 1:
        yield part.instead("effect", "")
        return
    for number in range(len(updates)):
        yield part.without("effect", number)


MISTAKES: dict[str, tuple[Mistake, ...]] = {
    "and_": (_operands, between("connective", "and", "or")),
    "or_": (_operands, between("connective", "or", "and")),
    "not_": (only("negation"),),
    "is_": (between("comparison", "is", "is not"),),
    "is_not": (between("comparison", "is not", "is"),),
    "in_": (_membership,),
    "not_in": (between("comparison", "not in", "in"),),
    "compare": (_signs,),
    "any_of": (beginning("connective", "any", "all"),),
    "all_of": (beginning("connective", "all", "any"),),
    "any_but": (only("set"),),
    "add": (between("arithmetic", "+", "-"),),
    "subtract": (between("arithmetic", "-", "+"),),
    "multiply": (between("arithmetic", "*", "/"),),
    "divide": (between("arithmetic", "/", "*"),),
    "quotient": (between("arithmetic", "div", "*"),),
    "negate": (only("constant"),),
    "choose": (lambda part: [part.exchanged("arithmetic", 0, 2)],),
    "call": (_call,),
    "integer": (values("constant", near_integers),),
    "decimal": (values("constant", near_decimals),),
    "percent": (values("chance", near_chances),),
    "yes": (values("constant", lambda text: ("no",)),),
    "no": (values("constant", lambda text: ("yes",)),),
    "name": (_name,),
    "optional_name": (_name,),
    "attribute": (_attribute,),
    "tuple": (_tuple,),
    "repeat": (_repeat,),
    "for_": (lambda part: [part.exchanged("order", 0, 1)] if len(part.node.children) > 1 else [],),
    "transform": (_rule,),
    "swap": (_rule,),
    "move": (_rule,),
    "assign": (_rule,),
    "then": (_effects,),
    "update": (_signs,),
}
"""The mistakes that are made in each kind of syntax. Mistakes in its parts come on top."""


# Entries of the file


@dataclass(frozen=True)
class Entry:
    """An entry of the file: its key, its value and the way to it, and the names that its lines can say."""

    key: Scalar
    node: Node
    path: Path
    names: Names

    @property
    def siblings(self) -> set[str]:
        """The keys of the mapping to which it belongs."""
        container = self.path[-1][0]
        assert isinstance(container, yaml_tree.Mapping)
        return {key.text for key, _ in container.entries}

    def entries(self) -> Iterator[Entry]:
        """The entries of a mapping; none of anything else."""
        return entries_of(self.node, self.path, self.names)

    def items(self) -> list[Entry]:
        """The items of a list; the entry itself for anything else."""
        if not isinstance(self.node, Sequence):
            return [self]
        return [
            replace(self, node=item, path=(*self.path, (self.node, number)))
            for number, item in enumerate(self.node.items)
        ]

    def parsed(self, start: str = "expression") -> Syntax | None:
        """The line that it is."""
        node = self.node
        return parse_scalar(node, start, Reporter()) if isinstance(node, Scalar) and node.text else None

    def line(self, start: str = "expression") -> Changes:
        """The mistakes in its line."""
        tree = self.parsed(start)
        if tree is not None:
            yield from line_changes(tree, self.names)

    def lost(self, operator: str) -> Change:
        """The file without it."""
        return Change(operator, (removed(self.path),))

    def instead(self, operator: str, text: str) -> Change:
        """Another value for its scalar."""
        assert isinstance(self.node, Scalar)
        return Change(operator, (Edit(self.node.content.start, self.node.content.end, text),))

    def added(self, operator: str, line: str) -> Change:
        """One more entry at the end of its mapping."""
        assert isinstance(self.node, yaml_tree.Mapping)
        last = (*self.path, (self.node, len(self.node.entries) - 1))
        return Change(operator, (inserted(last, line),))


EntryMistake = Callable[[Entry], Iterable[Change]]


def entries_of(node: Node, path: Path, names: Names) -> Iterator[Entry]:
    """The entries of a mapping; none of anything else."""
    if isinstance(node, yaml_tree.Mapping):
        for number, (key, value) in enumerate(node.entries):
            yield Entry(key, value, (*path, (node, number)), names)


def by_key(table: Mapping[str, EntryMistake], otherwise: EntryMistake) -> EntryMistake:
    """Mistakes in the entries of a mapping, by key."""

    def changes(entry: Entry) -> Changes:
        for part in entry.entries():
            yield from table.get(part.key.text, otherwise)(part)

    return changes


def nothing(entry: Entry) -> Iterable[Change]:
    """No mistakes: it changes nothing of what happens."""
    return ()


def _bounds(entry: Entry) -> Changes:
    """Other bounds of a declared kind."""

    def integers(node: Syntax) -> Iterator[Syntax]:
        if node.kind == "integer":
            yield node
        for child in node.children:
            yield from integers(child)

    tree = entry.parsed()
    for node in integers(tree) if tree is not None else ():
        yield from values("field", near_bounds)(Part(node, None, entry.names))


def _value(entry: Entry, name: str) -> Changes:
    """A property's value: one or two off, the other flag, another chance, or not said."""
    tree = entry.parsed()
    if tree is None:
        return
    whole = Part(tree, None, entry.names)
    sign, inner = (-1, tree.children[0]) if tree.kind == "negate" else (1, tree)
    if inner.kind == "integer":
        low, high = entry.names.ranges.get(name, (-(10**6), 10**6))
        number = sign * int(inner.text)
        for other in (number - 1, number + 1, number - 2, number + 2):
            if low <= other <= high:
                yield whole.instead("property", str(other))
    elif inner.kind == "percent":
        yield from values("chance", near_chances)(replace(whole, node=inner))
    elif inner.kind in ("yes", "no"):
        yield replace(whole, node=inner).instead("property", "no" if inner.kind == "yes" else "yes")
    else:
        yield from line_changes(tree, entry.names)
    yield entry.lost("property")


def _property(entry: Entry) -> Changes:
    if isinstance(entry.node, Scalar):
        yield from _bounds(entry)
    for part in entry.entries():
        if part.key.text == "type":
            yield from _bounds(part)
        elif part.key.text != "about":
            yield from _value(part, entry.key.text)


def _at(entry: Entry) -> Changes:
    assert isinstance(entry.node, Scalar)
    yield entry.instead("field", "place" if entry.node.text == "element" else "element")
    if "resets" not in entry.siblings:
        yield Change("field", (inserted(entry.path, "resets: step"),))


def _default(entry: Entry) -> Changes:
    """`default`, `of`, the default of an element."""
    if isinstance(entry.node, Scalar):
        yield from entry.line()
        yield entry.lost("field")


def _param(entry: Entry) -> Changes:
    if isinstance(entry.node, Scalar):
        yield from entry.line()
    for part in entry.entries():
        if part.key.text == "default":
            yield from part.line()


def _kernel(entry: Entry) -> Changes:
    node = entry.node
    parts = {part.key.text: part for part in entry.entries()}
    if "shape" in parts:
        yield from parts["shape"].line()
    rows = parts.get("rows") if isinstance(node, yaml_tree.Mapping) else entry
    for row in rows.items() if rows is not None else ():
        if not isinstance(row.node, Scalar):
            continue
        content = row.node.content
        for found in re.finditer(r"-?\d+", content.text):
            weight, (start, end) = int(found[0]), found.span()
            for other in (1,) if weight == 0 else (0, 2 * weight):
                yield Change("kernel", (Edit(content.start + start, content.start + end, str(other)),))
    if isinstance(node, yaml_tree.Mapping):
        edges = parts["edges"].node if "edges" in parts else None
        if isinstance(edges, Scalar):
            yield parts["edges"].instead("kernel", "nothing" if edges.text == "wrap" else "wrap")
        else:
            yield entry.added("kernel", "edges: wrap")
    elif node.span.text[:1] == "[":
        text = f"{{rows: {node.span.text}, edges: wrap}}"
        yield Change("kernel", (Edit(node.span.start, node.span.end, text),))


def _element(entry: Entry) -> Changes:
    if not isinstance(entry.node, yaml_tree.Mapping):
        return
    yield from _also(entry)
    words = {part.key.word for part in entry.entries()}
    for flag in sorted(entry.names.flags - words):
        yield entry.added("property", f"{flag}: yes")
    tag = next((name for name, kind in entry.names.kinds.items() if kind == "tag"), None)
    if "tags" not in words and tag is not None:
        yield entry.added("tag", f"tags: {tag}?")


def _also(entry: Entry) -> Changes:
    if not isinstance(entry.node, yaml_tree.Mapping):
        yield from _tags(entry)
    for part in entry.entries():
        if part.key.text == "tags":
            yield from _tags(part)
        elif part.key.text == "override" and isinstance(part.node, Scalar):
            yield part.instead("override", "no" if part.node.text in ("yes", "true") else "yes")
        elif part.key.text not in UNCHANGED:
            yield from _value(part, part.key.word)


def _tags(entry: Entry) -> Changes:
    """A word of a list of tags gone, another one, one more."""
    node = entry.node
    words = [(item, item.node) for item in entry.items() if isinstance(item.node, Scalar)]
    listed = [word.word for _, word in words]
    for number, (item, word) in enumerate(words):
        if entry.names.kind(word.word) != "tag":
            continue
        yield item.lost("tag")
        other = next((name for name in entry.names.others(word.word) if name not in listed), None)
        if other is not None:
            yield item.instead("tag", f"{other}?")
            start, end = node.span.start, node.span.end
            if isinstance(node, Scalar):
                yield Change("tag", (Edit(start, end, f"[{node.text}, {other}?]"),))
            elif number == 0 and node.span.text[0] == "[":
                yield Change("tag", (Edit(start + 1, start + 1, f"{other}?, "),))


# Passes


def _pass(entry: Entry) -> Changes:
    if isinstance(entry.node, yaml_tree.Mapping):
        lets: dict[str, str] = {}
        _collect_lets(entry.node, lets)
        yield from _block(replace(entry, names=entry.names.with_lets(lets)))


def _collect_lets(node: Node, lets: dict[str, str]) -> None:
    """The `let` values of a pass and its blocks, with their text on one line."""
    if isinstance(node, yaml_tree.Mapping):
        for key, value in node.entries:
            if key.text == "let" and isinstance(value, yaml_tree.Mapping):
                for name, line in value.entries:
                    if isinstance(line, Scalar):
                        lets[name.text] = " ".join(line.content.text.split())
            _collect_lets(value, lets)
    elif isinstance(node, Sequence):
        for item in node.items:
            _collect_lets(item, lets)


def _block(entry: Entry) -> Changes:
    """A pass or block: its keys, and its action and what comes then at once: one substep where there were two."""
    for part in entry.entries():
        yield from (_action if is_action(part.key) else BLOCK.get(part.key.text, nothing))(part)
    for first, second in itertools.pairwise(entry.entries()):
        first_rules, second_rules = lines_of(first.node), lines_of(second.node)
        keys = first.key.text, second.key.text
        if keys == ("do", "then") and first_rules and second_rules:
            start = first.key.span.start
            indent = " " * (entry.key.span.source.position(start)[1] - 1)
            rules = [" ".join(rule.span.text.split()) for rule in (*first_rules, *second_rules)]
            listed = "".join(f"\n{indent}  - {rule}" for rule in rules)
            yield Change("order", (Edit(start, second.node.span.end, f"do:{listed}"),))


def _option(operator: str, *words: str) -> EntryMistake:
    """Another word for a key that takes one of a few, or none."""

    def changes(entry: Entry) -> Changes:
        if isinstance(entry.node, Scalar):
            for other in words:
                if other != entry.node.text:
                    yield entry.instead(operator, other)
            yield entry.lost(operator)

    return changes


def _order(entry: Entry) -> Changes:
    for item in entry.items():
        yield item.lost("order")
    other = "before" if entry.key.text == "after" else "after"
    if other not in entry.siblings:
        yield Change("order", (Edit(entry.key.span.start, entry.key.span.end, other),))


def _action(entry: Entry) -> Changes:
    if entry.key.text != "do":
        yield from replace(entry, node=entry.key).line("header")
    yield Change("rule", without_action(entry.path))
    yield from _body(entry)


def _then(entry: Entry) -> Changes:
    yield entry.lost("rule")
    yield from _body(entry)


def _body(entry: Entry) -> Changes:
    """A rule, a list of rules, or blocks."""
    items = entry.items()
    for item in items:
        if len(items) > 1:
            yield item.lost("rule")
        if isinstance(item.node, yaml_tree.Mapping):
            yield from _block(item)
        else:
            yield from item.line("rule")
    rules = lines_of(entry.node)
    if len(items) == 1 or any(rule.style == "block" for rule in rules):
        return
    for first, second in itertools.pairwise(rule.span for rule in rules):  # neighbors exchanged
        edits = Edit(first.start, first.end, second.text), Edit(second.start, second.end, first.text)
        yield Change("order", edits)
    if rules and entry.node.span.text[:1] != "[":  # one after the other instead of at once
        texts = [(rule.span, " ".join(rule.span.text.split())) for rule in rules]
        yield Change("order", tuple(Edit(span.start, span.end, f"do: {text}") for span, text in texts))


BLOCK: dict[str, EntryMistake] = {
    "after": _order,
    "before": _order,
    "scratch": by_key({}, _bounds),
    "let": by_key({}, Entry.line),
    "symmetry": _option("side", "mirror", "rotations", "all"),
    "conflicts": _option("conflicts", "drop_both", "first_wins", "overwrite"),
    "then": _then,
}
"""The mistakes in each key of a pass or block, besides its action."""

FIELD: dict[str, EntryMistake] = {
    "type": _bounds,
    "at": _at,
    "resets": lambda entry: [entry.lost("field")],
    "about": nothing,
}
"""The mistakes in keys of a field; its other keys are elements and their values."""

SECTIONS: dict[str, EntryMistake] = {
    "properties": _property,
    "fields": by_key(FIELD, _default),
    "params": _param,
    "kernels": _kernel,
    "sets": Entry.line,
    "elements": _element,
    "also": _also,
    "passes": _pass,
}
"""The mistakes in each entry of a section."""


def lines_of(node: Node) -> list[Scalar]:
    """The rules of a body: itself or the items of a list; none where there are blocks."""
    items = node.items if isinstance(node, Sequence) else (node,)
    scalars = [item for item in items if isinstance(item, Scalar)]
    return scalars if len(scalars) == len(items) else []
