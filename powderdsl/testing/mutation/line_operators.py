"""Realistic mistakes in one line: a rule, an expression or the header of a loop."""

from __future__ import annotations

import re
from collections.abc import Iterator

from powderdsl.model.builtins import DIRECTION_SETS, KERNEL_SHAPES
from powderdsl.syntax.ast import Syntax
from powderdsl.testing.mutation.exchangeable import Names
from powderdsl.testing.mutation.mutants import Change, Edit

PLACES = {
    "above": ("below", "left"),
    "below": ("above", "right"),
    "left": ("right", "below"),
    "right": ("left", "above"),
    "here": ("above", "right"),
}
"""Neighbors, and what stands for them by mistake: the opposite, and one around the corner."""

COORDINATES = {"row": "column", "column": "row", "step": "row"}

COMPARISONS = {
    "<": ("<=", ">"),
    "<=": ("<", ">="),
    ">": (">=", "<"),
    ">=": (">", "<="),
    "==": ("!=", ">="),
    "!=": ("==", "<"),
}

UPDATES = {":=": ("+=", "-="), "+=": ("-=", ":="), "-=": ("+=", ":=")}

BETWEEN = {
    # kind of syntax: kind of mistake, the word between its two operands, and what stands for it by mistake
    "is_": ("comparison", "is", "is not"),
    "is_not": ("comparison", "is not", "is"),
    "in_": ("comparison", "in", "not in"),
    "not_in": ("comparison", "not in", "in"),
    "and_": ("connective", "and", "or"),
    "or_": ("connective", "or", "and"),
    "add": ("arithmetic", "+", "-"),
    "subtract": ("arithmetic", "-", "+"),
    "multiply": ("arithmetic", "*", "/"),
    "divide": ("arithmetic", "/", "*"),
    "quotient": ("arithmetic", "div", "*"),
}

UNWRAPPED = {"not_": "negation", "negate": "constant", "any_but": "set"}
"""Kinds of syntax that are replaced by their operand, and the kind of mistake."""


def line_changes(node: Syntax, names: Names, parent: Syntax | None = None) -> Iterator[Change]:
    """All mistakes in a line or a part of it, in the order in which it is read."""
    yield from _own(node, parent, names)
    for child in node.children:
        if node.kind != "binding" or child is not node.children[0]:  # the variable's own name
            yield from line_changes(child, names, node)


def kind_changes(tree: Syntax) -> Iterator[Change]:
    """Other bounds for a declared kind: one off, or half of a large one."""
    for node in _walk(tree):
        if node.kind == "integer":
            number = int(node.text)
            for other in [number + 1, number - 1] if number <= 20 else [number // 2]:
                if other >= 0:
                    yield _change("field", node, str(other))


def chance_changes(node: Syntax) -> Iterator[Change]:
    """A percentage ten times as large or small, and half as large again; nothing above 100 %."""
    number = float(node.text.rstrip("%"))
    for other in (min(number * 10, 100.0), number / 10, min(number * 1.5, 100.0)) if number else (10.0,):
        if other != number:
            yield _change("chance", node, f"{other:.10g}%")


def _walk(node: Syntax) -> Iterator[Syntax]:
    yield node
    for child in node.children:
        yield from _walk(child)


def _change(operator: str, node: Syntax, text: str) -> Change:
    return Change(operator, (Edit(node.span.start, node.span.end, text),))


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


def _only(operator: str, parent: Syntax, child: Syntax) -> Change:
    """The parent replaced by one of its operands."""
    start, end = extent(child, parent)
    return _change(operator, parent, parent.span.source.text[start:end])


def _between(operator: str, parent: Syntax, word: str, other: str, number: int = 0) -> Change:
    """The word between an operand and the next one replaced."""
    first, second = parent.children[number : number + 2]
    begin, end = extent(first, parent)[1], extent(second, parent)[0]
    text = parent.span.source.text[begin:end]
    found = re.search(re.escape(word).replace(r"\ ", r"\s+"), text)
    assert found is not None, f"`{word}` is not in `{text}`"
    return Change(operator, (Edit(begin + found.start(), begin + found.end(), other),))


def _own(node: Syntax, parent: Syntax | None, names: Names) -> Iterator[Change]:
    children = node.children
    kind = node.kind
    if kind == "in_" and _names_kernel(node, parent, names):
        yield _only("kernel", node, children[0])
        return
    if kind in ("and_", "or_"):
        yield _only("connective", node, children[0])
        if children[0].kind != kind:
            yield _only("connective", node, children[1])
    if kind in BETWEEN:
        yield _between(BETWEEN[kind][0], node, *BETWEEN[kind][1:])
    if kind in UNWRAPPED:
        yield _only(UNWRAPPED[kind], node, children[0])
    match kind:
        case "name" | "optional_name":
            yield from _name(node, names)
        case "attribute":
            yield from _attribute(node, names)
        case "integer":
            yield from _integer(node)
        case "decimal":
            number = float(node.text)
            for value in (number / 2, 1 - (1 - number) / 2 if number < 1 else number * 2):
                yield _change("constant", node, _decimal(value))
        case "percent":
            yield from chance_changes(node)
        case "yes" | "no":
            yield _change("constant", node, "no" if kind == "yes" else "yes")
        case "compare":
            for at, sign in enumerate(node.text.split()):
                for other in COMPARISONS[sign]:
                    yield _between("comparison", node, sign, other, at)
        case "choose":
            yield _exchanged("arithmetic", node, children[0], children[2])
        case "call":
            yield from _call(node, names)
        case "any_of" | "all_of":
            start = node.span.start
            yield Change("connective", (Edit(start, start + 3, "all" if kind == "any_of" else "any"),))
        case "tuple":
            yield from _tuple(node, parent)
        case "repeat":
            found = re.search(r"\d+", node.span.text)
            assert found is not None
            at = node.span.start + found.start()
            for count in (int(found[0]) + 1, int(found[0]) - 1):
                if count > 0:
                    yield Change("constant", (Edit(at, at + len(found[0]), str(count)),))
        case "for_" if len(children) > 1:
            yield _exchanged("order", node, children[0], children[1])
        case "transform" | "swap" | "move" | "assign":
            yield from _rule(node, names)
        case "then":
            yield from _effects(node)
        case "update":
            for other in UPDATES[node.text]:
                yield _between("write", node, node.text, other)


def _decimal(number: float) -> str:
    text = f"{number:.6g}"
    return text if re.search(r"[.e]", text) else f"{text}.0"


def _integer(node: Syntax) -> Iterator[Change]:
    number = int(node.text)
    others = [number + 1, number - 1, *([number * 2, number // 2] if number >= 10 else [])]
    for other in others:
        if other >= 0:
            yield _change("constant", node, str(other))


def _name(node: Syntax, names: Names) -> Iterator[Change]:
    name = node.text or node.span.text
    mark = "?" if node.kind == "optional_name" else ""
    for other in PLACES.get(name, ()):
        yield _change("neighbor", node, other)
    for other in DIRECTION_SETS if name in DIRECTION_SETS else ():
        if other != name:
            yield _change("side", node, other)
    if name in COORDINATES:
        yield _change("coordinate", node, COORDINATES[name])
    kind = names.kind(name)
    for other in names.others(name) if kind else ():
        yield _change(str(kind), node, other + mark)
    if name in names.local:
        yield _change("let", node, f"({names.local[name]})")


def _attribute(node: Syntax, names: Names) -> Iterator[Change]:
    tail = Edit(node.span.end - len(node.text), node.span.end, "")
    for other in PLACES.get(node.text, ()):
        yield Change("neighbor", (Edit(tail.start, tail.end, other),))
    kind = names.kind(node.text)
    if node.text in PLACES or (kind is None and node.text not in COORDINATES):
        yield _change("neighbor", node, node.children[0].span.text)
    if node.text in ("row", "column"):
        yield Change("coordinate", (Edit(tail.start, tail.end, COORDINATES[node.text]),))
    elif node.text not in PLACES or node.children[0].span.text in PLACES:
        yield _change("neighbor", node, node.text)
    for other in names.others(node.text) if kind in ("property", "field", "stream", "let") else ():
        yield Change(str(kind), (Edit(tail.start, tail.end, other),))


def _names_kernel(node: Syntax, parent: Syntax | None, names: Names) -> bool:
    """Whether `a in b` says where to count, or is a question."""
    in_call = parent is not None and parent.kind == "call" and parent.text in ("count", "sum")
    return in_call and node.kind == "in_" and names.kind(node.children[1].text) == "kernel"


def _exchanged(operator: str, parent: Syntax, first: Syntax, second: Syntax) -> Change:
    """Two operands in each other's place."""
    text = parent.span.source.text
    (a, b), (c, d) = extent(first, parent), extent(second, parent)
    return Change(operator, (Edit(a, b, text[c:d]), Edit(c, d, text[a:b])))


_LOOSER_THAN_IN = ("compare", "is_", "is_not", "in_", "not_in", "not_", "and_", "or_")
"""Kinds of conditions that stand in parentheses before `in`."""


def _call(node: Syntax, names: Names) -> Iterator[Change]:
    name = node.text.split()[0]
    start = node.span.start
    if name in ("count", "sum") and not any(_names_kernel(part, node, names) for part in node.children):
        last, end = node.children[-1], node.span.end - 1
        opened = last.span.start if last.kind in _LOOSER_THAN_IN and last.span.text[:1] != "(" else None
        for kernel in ("ring", "cross"):
            more = f"{')' if opened is not None else ''} in {kernel}"
            edits = (
                (Edit(end, end, more),)
                if opened is None
                else (Edit(opened, opened, "("), Edit(end, end, more))
            )
            yield Change("kernel", edits)
    if name in ("min", "max"):
        yield Change("arithmetic", (Edit(start, start + 3, "max" if name == "min" else "min"),))
    inner = node.children[0].span.text if node.children else ""
    if name in ("abs", "clamp"):
        yield _change("arithmetic", node, f"({inner})")
    if name in ("opposite", "clockwise", "counterclockwise"):
        yield _change("neighbor", node, inner)
    for shape in KERNEL_SHAPES if name in KERNEL_SHAPES else ():
        if shape != name:
            yield Change("kernel", (Edit(start, start + len(name), shape),))
    if name in ("count", "min", "max") and len(node.children) > 1:
        for number in range(len(node.children)):
            yield Change("set" if name == "count" else "arithmetic", (_without(node, number),))


def _without(node: Syntax, number: int) -> Edit:
    """A list's item cut out with the comma beside it."""
    children = node.children
    if number + 1 < len(children):
        return Edit(_item(node, number)[0], _item(node, number + 1)[0], "")
    return Edit(_item(node, number - 1)[1], _item(node, number)[1], "")


def _item(node: Syntax, number: int) -> tuple[int, int]:
    """An item of a list with its own parentheses, but not those of the list."""
    child = node.children[number]
    start, end = extent(child, node)
    return (start, end) if start > node.span.start else (child.span.start, child.span.end)


def _tuple(node: Syntax, parent: Syntax | None) -> Iterator[Change]:
    loop = parent is not None and parent.kind == "binding"
    operator = "side" if loop and node.children[0].text in PLACES else "set"
    for number, _ in enumerate(node.children):
        if len(node.children) == 2:
            start, end = _item(node, 1 - number)
            yield _change(operator, node, f"({node.span.source.text[start:end]})")
        else:
            yield Change(operator, (_without(node, number),))
    if loop:
        yield _exchanged("order", node, node.children[0], node.children[-1])


def _rule(node: Syntax, names: Names) -> Iterator[Change]:
    """A rule without its condition or its chance, or the other way round, or with a draw that others share."""
    condition, chance = node.child("condition"), node.child("chance")
    stream = next((name for name, kind in names.kinds.items() if kind == "stream"), None)
    if condition is not None and chance is not None and stream is not None:
        asked = f" and {stream} < {chance.children[0].span.text}"
        end = condition.span.end
        yield Change("stream", (Edit(end, end, asked), Edit(chance.span.start, chance.span.end, "")))
    first, second = node.children[:2] if len(node.children) > 1 else (None, None)
    if node.kind == "transform" and first is not None and second is not None:
        words = {"name", "optional_name"}
        if first.kind in words and second.kind in words:
            yield _exchanged("element", node, first, second)
    for part in node.children:
        if part.kind in ("condition", "where", "chance"):
            yield _change("guard", part, "")
        if part.kind in ("condition", "where"):
            for conjunct in _conjuncts(part.children[0]):
                if conjunct.kind in ("name", "optional_name", "attribute", "any_of", "all_of"):
                    yield _change("negation", conjunct, f"not {conjunct.span.text}")


def _conjuncts(node: Syntax) -> Iterator[Syntax]:
    if node.kind in ("and_", "or_"):
        for child in node.children:
            yield from _conjuncts(child)
    else:
        yield node


def _effects(node: Syntax) -> Iterator[Change]:
    updates = [child for child in node.children if child.kind == "update"]
    if len(updates) == 1:
        yield _change("effect", node, "")
        return
    for number in range(len(updates)):
        yield Change("effect", (_without(node, number),))
