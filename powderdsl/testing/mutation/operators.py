"""Realistic mistakes in a rule file: for each kind of syntax and each key, what a hurried author writes instead."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Sequence as Sequence_
from dataclasses import dataclass, replace

from powderdsl.diagnostics import Reporter, Span
from powderdsl.model.builtins import DIRECTION_SETS, KERNEL_SHAPES
from powderdsl.model.declarations import PackDecl
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.parse import parse_scalar
from powderdsl.syntax.yaml_tree import Node, Scalar, Sequence, parse_yaml
from powderdsl.testing.mutation.mutants import (
    Change,
    Mutant,
    Names,
    Path,
    exchanged,
    inserted,
    is_action,
    names_of,
    removed,
    without,
    without_action,
    written,
)

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

TEMPLATES: dict[str, tuple[str, ...]] = {
    "and_": ("connective", "{0}", "{1}", "{0} or {1}"),
    "or_": ("connective", "{0}", "{1}", "{0} and {1}"),
    "any_of": ("connective", "all({0} for {1})"),
    "all_of": ("connective", "any({0} for {1})"),
    "not_": ("negation", "{0}"),
    "is_": ("comparison", "{0} is not {1}"),
    "is_not": ("comparison", "{0} is {1}"),
    "in_": ("comparison", "{0} not in {1}"),
    "not_in": ("comparison", "{0} in {1}"),
    "in_kernel": ("kernel", "{0}"),
    "any_but": ("set", "{0}"),
    "add": ("arithmetic", "{0} - {1}"),
    "sub": ("arithmetic", "{0} + {1}"),
    "mul": ("arithmetic", "{0} / {1}"),
    "div": ("arithmetic", "{0} * {1}"),
    "quotient": ("arithmetic", "{0} * {1}"),
    "choose": ("arithmetic", "{2} if {1} else {0}"),
    "min": ("arithmetic", "max({*})"),
    "max": ("arithmetic", "min({*})"),
    "abs": ("arithmetic", "({*})"),
    "clamp": ("arithmetic", "({0})"),
    "opposite": ("neighbor", "{0}"),
    "clockwise": ("neighbor", "{0}"),
    "counterclockwise": ("neighbor", "{0}"),
    "neg": ("constant", "{0}"),
    "yes": ("constant", "no"),
    "no": ("constant", "yes"),
    **{
        shape: ("kernel", *(f"{other}({{*}})" for other in KERNEL_SHAPES if other != shape)) for shape in KERNEL_SHAPES
    },
}  # fmt: skip
"""The kind of mistake in each kind of syntax or call, and what is written instead: `{0}` is the first operand, `{*}` all."""

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
    mutants: dict[str, Mutant] = {}
    for section in entries_of(root, (), names_of(packs, pack)) if root is not None else ():
        for entry in section.entries():
            for change in SECTIONS.get(section.key.text, nothing)(entry):
                mutant = Mutant(pack.source, pack.name.text, change)
                if mutant.text != pack.source.text:
                    mutants.setdefault(mutant.text, mutant)
    return sorted(mutants.values(), key=lambda mutant: mutant.change.start)


# Lines

Changes = Iterator[Change]


def line_changes(node: Syntax, names: Names) -> Changes:
    """All mistakes in a line or a part of it, in the order in which it is read."""
    kind = node.text.split()[0] if node.kind == "call" else node.kind
    if node.kind == "in_" and names.kind(node.children[1].text) == "kernel":
        kind = "in_kernel"
    operator, *templates = TEMPLATES.get(kind, ("",))
    for template in templates:
        if (
            template != "{1}" or node.children[0].kind != node.kind
        ):  # else the same as a part's second operand
            yield written(operator, node.span, filled(template, node))
    if node.kind in MISTAKES:
        yield from MISTAKES[node.kind](node, names)
    for child in node.children:
        if node.kind != "binding" or child is not node.children[0]:  # the variable's own name
            yield from line_changes(child, names)


def filled(template: str, node: Syntax) -> str:
    """A template with a node's operands."""
    operands = [span.text for span in extents(node)]
    return re.sub(
        r"\{(.)\}",
        lambda hole: ", ".join(operands) if hole[1] == "*" else operands[int(hole[1])],
        template,
    )


def extents(node: Syntax) -> list[Span]:
    """Where operands stand with the parentheses around them, which their own spans leave out."""
    text = node.span.source.text
    first, last = node.span.start, node.span.end
    if node.kind in ("call", "tuple"):
        first, last = text.index("(", first) + 1, last - 1
    found = []
    for child in node.children:
        start, end = child.span.start, child.span.end
        while True:
            before, after = text[first:start].rstrip(), text[end:last].lstrip()
            if before[-1:] != "(" or after[:1] != ")":
                break
            start, end = first + len(before) - 1, last - len(after) + 1
        found.append(Span(node.span.source, start, end))
    return found


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
        digits = f"{other:.6g}"
        yield digits if re.search(r"[.e]", digits) else f"{digits}.0"


def near_chances(text: str) -> Iterator[str]:
    """A percentage ten times as large or small, and half as large again; nothing above 100 %."""
    number = float(text.rstrip("%"))
    for other in (min(number * 10, 100.0), number / 10, min(number * 1.5, 100.0)) if number else (10.0,):
        yield f"{other:.10g}%"


Mistake = Callable[[Syntax, Names], Iterable[Change]]


def values(operator: str, others: Callable[[str], Iterable[str]]) -> Mistake:
    """Other values in its place."""
    return lambda node, names: [written(operator, node.span, other) for other in others(node.text)]


def _name(node: Syntax, names: Names) -> Changes:
    name = node.text or node.span.text
    mark = "?" if node.kind == "optional_name" else ""
    operator, *others = SIMILAR.get(name, ("",))
    for other in others:
        yield written(operator, node.span, other)
    for other in names.others(name):
        yield written(names.kind(name), node.span, other + mark)
    if name in names.local:
        yield written("let", node.span, f"({names.local[name]})")


def _attribute(node: Syntax, names: Names) -> Changes:
    """Another value of the neighbor, the neighbor alone, the value here."""
    kind, before = names.kind(node.text), node.children[0].span.text
    operator, *others = SIMILAR.get(node.text, ("",))
    for other in others if node.text != "step" else ():
        yield written(operator, node.span, filled(f"{{0}}.{other}", node))
    if not (kind or operator == "coordinate"):
        yield written("neighbor", node.span, before)
    if operator == "" or (operator == "neighbor" and SIMILAR.get(before, ("",))[0] == "neighbor"):
        yield written("neighbor", node.span, node.text)
    for other in names.others(node.text) if kind in ("property", "field", "stream", "let") else ():
        yield written(kind, node.span, filled(f"{{0}}.{other}", node))


def _signs(node: Syntax, names: Names) -> Changes:
    """Other comparisons, another update."""
    signs = node.text.split()
    for number, sign in enumerate(signs):
        operator, *others = SIMILAR[sign]
        for other in others:
            changed = [*signs[:number], other, *signs[number + 1 :]]
            parts = [f" {word} {{{place}}}" for place, word in enumerate(changed, 1)]
            yield written(operator, node.span, filled("{0}" + "".join(parts), node))


def _call(node: Syntax, names: Names) -> Changes:
    """Another neighborhood to count in, a missing argument."""
    name, operands = node.text.split()[0], extents(node)
    in_kernel = any(
        child.kind == "in_" and names.kind(child.children[1].text) == "kernel" for child in node.children
    )
    if name in ("count", "sum") and not in_kernel:
        last = operands[-1]
        is_open = node.children[-1].kind in LOOSER_THAN_IN and last == node.children[-1].span
        for kernel in ("ring", "cross"):
            yield written(
                "kernel", last, f"({last.text}) in {kernel}" if is_open else f"{last.text} in {kernel}"
            )
    if name in ("count", "min", "max") and len(operands) > 1:
        for number in range(len(operands)):
            yield without("set" if name == "count" else "arithmetic", operands, number)


def _tuple(node: Syntax, names: Names) -> Changes:
    """A missing member."""
    for number in range(len(node.children)):
        yield without("set", extents(node), number)


def _binding(node: Syntax, names: Names) -> Changes:
    """A loop over fewer neighbors, or in another order."""
    domain = node.children[1]
    if domain.kind == "tuple":
        for change in _tuple(domain, names):
            yield (
                replace(change, operator="side")
                if SIMILAR.get(domain.children[0].text, ("",))[0] == "neighbor"
                else change
            )
        yield exchanged("order", extents(domain)[0], extents(domain)[-1])


def _loops(node: Syntax, names: Names) -> Changes:
    """The first two loops exchanged."""
    for first, second in itertools.pairwise(node.children[:2]):
        yield exchanged("order", first.span, second.span)


def _repeat(node: Syntax, names: Names) -> Changes:
    for count in (int(node.text) + 1, int(node.text) - 1):
        if count > 0:
            yield written("constant", node.span, f"repeat {count}")


def _rule(node: Syntax, names: Names) -> Changes:
    """A rule without its condition or its chance, or the other way round, or with a draw that others share."""
    condition, chance = node.child("condition"), node.child("chance")
    stream = next((name for name, kind in names.kinds.items() if kind == "stream"), None)
    if condition is not None and chance is not None and stream is not None:
        text = f"{condition.span.text} and {stream} < {chance.children[0].span.text}"
        yield written("stream", condition.span.to(chance.span), text)
    if node.kind == "transform" and {child.kind for child in node.children[:2]} <= {"name", "optional_name"}:
        yield exchanged("element", node.children[0].span, node.children[1].span)
    for clause in node.children:
        if clause.kind in ("condition", "where", "chance"):
            yield written("guard", clause.span, "")
        if clause.kind in ("condition", "where"):
            for conjunct in _conjuncts(clause.children[0]):
                if conjunct.kind in ("name", "optional_name", "attribute", "any_of", "all_of"):
                    yield written("negation", conjunct.span, f"not {conjunct.span.text}")


def _conjuncts(node: Syntax) -> Iterator[Syntax]:
    if node.kind in ("and_", "or_"):
        for child in node.children:
            yield from _conjuncts(child)
    else:
        yield node


def _effects(node: Syntax, names: Names) -> Changes:
    updates = [child.span for child in node.children]
    if len(updates) == 1:
        yield written("effect", node.span, "")
        return
    for number in range(len(updates)):
        yield without("effect", updates, number)


MISTAKES: dict[str, Mistake] = {
    "compare": _signs,
    "update": _signs,
    "call": _call,
    "integer": values("constant", near_integers),
    "decimal": values("constant", near_decimals),
    "percent": values("chance", near_chances),
    "name": _name,
    "optional_name": _name,
    "attribute": _attribute,
    "tuple": _tuple,
    "binding": _binding,
    "repeat": _repeat,
    "for_": _loops,
    "transform": _rule,
    "swap": _rule,
    "move": _rule,
    "assign": _rule,
    "then": _effects,
}
"""The mistakes in each kind of syntax besides its templates. Mistakes in its parts come on top."""


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
        return removed(operator, self.path)

    def instead(self, operator: str, text: str) -> Change:
        """Another value for its scalar."""
        assert isinstance(self.node, Scalar)
        return written(operator, self.node.content, text)

    def added(self, operator: str, line: str) -> Change:
        """One more entry at the end of its mapping."""
        assert isinstance(self.node, yaml_tree.Mapping)
        return inserted(operator, (*self.path, (self.node, len(self.node.entries) - 1)), line)


EntryMistake = Callable[[Entry], Iterable[Change]]


def entries_of(node: Node, path: Path, names: Names) -> Iterator[Entry]:
    """The entries of a mapping; none of anything else."""
    if isinstance(node, yaml_tree.Mapping):
        for number, (key, value) in enumerate(node.entries):
            yield Entry(key, value, (*path, (node, number)), names)


def by_key(table: Mapping[str, EntryMistake], otherwise: EntryMistake) -> EntryMistake:
    """Mistakes in the entries of a mapping, by key."""
    return lambda entry: itertools.chain.from_iterable(
        table.get(part.key.text, otherwise)(part) for part in entry.entries()
    )


def nothing(entry: Entry) -> Iterable[Change]:
    """No mistakes: it changes nothing of what happens."""
    return ()


def _numbers(operator: str, span: Span, pattern: str, others: Callable[[str], Iterable[str]]) -> Changes:
    """Other values for each number in a text."""
    for found in re.finditer(pattern, span.text):
        place = Span(span.source, span.start + found.start(), span.start + found.end())
        for other in others(found[0]):
            yield written(operator, place, other)


def _bounds(entry: Entry) -> Changes:
    """Other bounds of a declared kind."""
    if isinstance(entry.node, Scalar):
        yield from _numbers("field", entry.node.content, r"(?<!\d\.)(?<!\w)\d+(?!\d|\.\d)", near_bounds)


def _value(entry: Entry, name: str) -> Changes:
    """A property's value: one or two off, the other flag, another chance, or not said."""
    tree = entry.parsed()
    if tree is None:
        return
    if re.fullmatch(r"-?\d+", tree.span.text):
        low, high = entry.names.ranges.get(name, (-(10**6), 10**6))
        number = int(tree.span.text)
        for other in (number - 1, number + 1, number - 2, number + 2):
            if low <= other <= high:
                yield entry.instead("property", str(other))
    else:
        yield from line_changes(tree, entry.names)
    yield entry.lost("property")


def _property(entry: Entry) -> Changes:
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
        yield inserted("field", entry.path, "resets: step")


def _default(entry: Entry) -> Changes:
    """`default`, `of`, the default of an element."""
    if isinstance(entry.node, Scalar):
        yield from entry.line()
        yield entry.lost("field")


def _kernel(entry: Entry) -> Changes:
    node = entry.node
    parts = {part.key.text: part for part in entry.entries()}
    if "shape" in parts:
        yield from parts["shape"].line()
    for row in parts.get("rows", entry).items():
        if isinstance(row.node, Scalar):
            yield from _numbers("kernel", row.node.content, r"-?\d+", near_weights)
    if "edges" in parts:
        edges = parts["edges"].node
        yield parts["edges"].instead("kernel", "nothing" if edges.span.text == "wrap" else "wrap")
    elif parts:
        yield entry.added("kernel", "edges: wrap")
    elif node.span.text[:1] == "[":
        yield written("kernel", node.span, f"{{rows: {node.span.text}, edges: wrap}}")


def near_weights(text: str) -> tuple[str, ...]:
    """None where there was one, or twice as much; one where there was none."""
    return ("0", str(2 * int(text))) if int(text) else ("1",)


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
        elif part.key.text == "override":
            yield part.instead("override", "no" if part.node.span.text in ("yes", "true") else "yes")
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
            if isinstance(node, Scalar):
                yield written("tag", node.span, f"[{node.text}, {other}?]")
            elif number == 0 and node.span.text[0] == "[":
                yield written("tag", node.span, f"[{other}?, {node.span.text[1:]}")


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
            span = first.key.span.to(second.node.span)
            indent = " " * (span.source.position(span.start)[1] - 1)
            rules = [" ".join(rule.span.text.split()) for rule in (*first_rules, *second_rules)]
            yield written("order", span, "do:" + "".join(f"\n{indent}  - {rule}" for rule in rules))


def _option(operator: str, *words: str) -> EntryMistake:
    """Another word for a key that takes one of a few, or none."""

    def changes(entry: Entry) -> Changes:
        for other in words:
            if other != entry.node.span.text:
                yield entry.instead(operator, other)
        yield entry.lost(operator)

    return changes


def _order(entry: Entry) -> Changes:
    for item in entry.items():
        yield item.lost("order")
    other = "before" if entry.key.text == "after" else "after"
    if other not in entry.siblings:
        yield written("order", entry.key.span, other)


def _action(entry: Entry) -> Changes:
    """What a block does, or does then: a rule, a list of rules, or blocks."""
    if entry.key.text == "then":
        yield entry.lost("rule")
    else:
        if entry.key.text != "do":
            yield from replace(entry, node=entry.key).line("header")
        yield without_action("rule", entry.path)
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
        yield exchanged("order", first, second)
    if rules and entry.node.span.text[:1] != "[":  # one after the other instead of at once
        yield written("order", rules[0].span.to(rules[-1].span), _in_turn([rule.span for rule in rules]))


def _in_turn(rules: list[Span]) -> str:
    """The text from the first to the last of some rules, each of which is a block of its own."""
    text = rules[0].source.text
    gaps = [text[first.end : second.start] for first, second in itertools.pairwise(rules)]
    blocks = [f"do: {' '.join(rule.text.split())}" for rule in rules]
    return "".join(itertools.chain.from_iterable(zip(blocks, [*gaps, ""], strict=True)))


BLOCK: dict[str, EntryMistake] = {
    "after": _order,
    "before": _order,
    "scratch": by_key({}, _bounds),
    "let": by_key({}, Entry.line),
    "symmetry": _option("side", "mirror", "rotations", "all"),
    "conflicts": _option("conflicts", "drop_both", "first_wins", "overwrite"),
    "then": _action,
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
    "params": lambda entry: [*entry.line(), *by_key({"default": Entry.line}, nothing)(entry)],
    "kernels": _kernel,
    "sets": Entry.line,
    "elements": _element,
    "also": _also,
    "passes": _pass,
}
"""The mistakes in each entry of a section."""


def lines_of(node: Node) -> list[Scalar]:
    """The rules of a body: itself or the items of a list; none where there are blocks."""
    items = node.items
    scalars = [item for item in items if isinstance(item, Scalar)]
    return scalars if len(scalars) == len(items) else []
