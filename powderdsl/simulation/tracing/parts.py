"""What a rule read in one cell: the parts of its condition, whether each holds, and the values in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from powderdsl.diagnostics import Span
from powderdsl.model import reference
from powderdsl.model.expressions.operands import look
from powderdsl.model.text import element_name, show_expr, show_offset, show_value
from powderdsl.model.types import FLAG, Expr, Kind, Offset, Ruleset
from powderdsl.simulation.tracing.scenes import Cell, RecordedSubstep, value_at

HERE: Offset = (0, 0)
_LEAVES = ("element", "property", "field", "let", "draw", "coordinate", "param", "inside", "count", "sum")
MAX_NEIGHBORS = 24
"""Cells that a count names, at most."""


@dataclass(frozen=True)
class Read:
    """One value that a condition read. `cell` is where it stands, None for parameters.

    `value` is plain data, `shown` how a rule file would write it. `element` is what the cell is, where it matters.
    `counted` are the cells that a count found.
    """

    text: str
    value: Any
    shown: str
    cell: Cell | None
    element: str | None
    counted: tuple[Cell, ...] = ()


@dataclass(frozen=True)
class Part:
    """One of the things that must all hold for a rule to happen. `of` names the `let` that it comes from."""

    text: str
    span: Span | None
    holds: bool
    reads: tuple[Read, ...]
    of: str = ""
    about_itself: bool = field(default=False, compare=False)
    """Whether it only asks which element the cell is: if not one of them, the rule is about other cells."""


@dataclass(frozen=True)
class Question:
    """A part before it is answered: the expression, and the state that it reads."""

    expr: Expr
    at: reference.Context
    of: str = ""

    def holds(self, cell: Cell) -> bool:
        return bool(value_at(self.expr, self.at, cell))

    @property
    def about_itself(self) -> bool:
        return self.expr.op == "member" and self.expr.args[0].op == "element"


def questions(expr: Expr, scene: RecordedSubstep) -> Iterator[Question]:
    """A condition taken apart at its `and`s; flags fixed by `let` are taken apart too, as they were fixed."""
    yield from _apart(expr, scene.at, scene, "")


def _apart(expr: Expr, at: reference.Context, scene: RecordedSubstep, of: str) -> Iterator[Question]:
    if expr.op == "and":
        for arg in expr.args:
            yield from _apart(arg, at, scene, of)
    elif expr.op == "let" and expr.kind == FLAG:
        let, found = scene.lets[expr.value]
        yield from _apart(let.value, found, scene, _written(expr.value))
    elif not (expr.op == "const" and expr.value):
        yield Question(expr, at, of)


def answer(question: Question, cell: Cell, scene: RecordedSubstep) -> Part:
    """A part of a condition in one cell, with everything it read."""
    reads: dict[str, Read] = {}
    for read in _reads(question.expr, question.at, cell, HERE, scene):
        reads.setdefault(read.text, read)
    return Part(
        show_expr(scene.ruleset, question.expr),
        question.expr.span,
        question.holds(cell),
        tuple(reads.values()),
        question.of,
        question.about_itself,
    )


def _written(name: str) -> str:
    """A let's name as it is written: copies under loops are numbered."""
    return name.partition("#")[0]


def _reads(
    expr: Expr, at: reference.Context, cell: Cell, offset: Offset, scene: RecordedSubstep
) -> Iterator[Read]:
    if expr.op == "look":
        dy, dx = expr.value
        yield from _reads(expr.args[0], at, cell, (offset[0] + dy, offset[1] + dx), scene)
    elif expr.op not in _LEAVES:
        for arg in expr.args:
            yield from _reads(arg, at, cell, offset, scene)
    else:
        place = scene.near(cell, offset)
        yield _leaf(expr, at, place, offset, scene)
        if expr.op == "let" and expr.value in scene.lets:
            let, found = scene.lets[expr.value]
            yield from _reads(let.value, found, cell, offset, scene)


def _leaf(expr: Expr, at: reference.Context, place: Cell, offset: Offset, scene: RecordedSubstep) -> Read:
    ruleset = scene.ruleset
    value = value_at(expr, at, place)
    if expr.op == "element" and offset != HERE:
        text = show_offset(offset)
    else:
        text = _written(show_expr(ruleset, look(expr, offset)))
    located = expr.op not in ("param", "coordinate")
    named = element_name(ruleset, int(value_at(_ELEMENT, at, place))) if located else None
    return Read(
        text,
        plain(ruleset, expr.kind, value),
        show_at_cell(ruleset, expr.kind, value),
        place if located else None,
        named if expr.op == "property" or (expr.op in ("field", "let") and offset != HERE) else None,
        tuple(_counted(expr, at, place, scene)) if expr.op == "count" else (),
    )


_ELEMENT = Expr("element", Kind("element"))


def _counted(expr: Expr, at: reference.Context, place: Cell, scene: RecordedSubstep) -> Iterator[Cell]:
    """The neighbors that a count found: those with a weight where its argument holds."""
    holds = reference.evaluate(expr.args[0], at)
    kernel = expr.value
    for dy, dx, weight in kernel.weights[: 1 << 10]:
        there = (place[0] + dy, place[1] + dx)
        inside = there == scene.near(place, (dy, dx))
        if weight and (inside or kernel.wrap):
            there = scene.near(place, (dy, dx))
            if holds[(0, *there)]:
                yield there


def plain(ruleset: Ruleset, kind: Kind, value: Any) -> Any:
    """A cell's value as plain data: elements by name, directions as rules name them, the rest as numbers."""
    if kind.name == "element":
        return element_name(ruleset, int(value))
    if kind.name == "direction":
        return show_at_cell(ruleset, kind, value)
    if kind.name == "flag":
        return bool(value)
    numbers = np.asarray(value).tolist()
    return [_finite(one) for one in numbers] if isinstance(numbers, list) else _finite(numbers)


def _finite(number: float) -> float | str:
    """JSON has no infinities; the middle of a pass may."""
    return number if np.isfinite(number) else str(number)


def show_at_cell(ruleset: Ruleset, kind: Kind, value: Any) -> str:
    """A cell's value as a rule file would write it; draws in per cent, as chances are."""
    if kind.name in ("element", "flag", "direction"):
        return show_value(ruleset, kind, int(value))
    if kind.name == "chance":
        return show_value(ruleset, kind, float(value))
    if kind.name == "draw":
        return f"{float(value) * 100:.6g}%"
    if kind.name == "vec2":
        return "({:.7g}, {:.7g})".format(*(float(part) for part in value))
    return str(int(value)) if kind.name == "int" else f"{float(value):.7g}"
