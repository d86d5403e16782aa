"""Reward and end expressions: syntax -> `Expr` of whole worlds. Conditions on cells are checked as in rules."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise

from powderdsl.diagnostics import Span, suggest
from powderdsl.model.expressions.operators import Operand, Poisoned, Scope, SetOf, Unresolved, number
from powderdsl.model.expressions.symbols import read_number
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.operations import COMPARISONS
from powderdsl.model.types import FLAG, REAL, Expr
from powderdsl.syntax.parse import Syntax
from powderdsl.tasks.task import Goal, Measure

MEASURES = {
    "count": "count(CELLS in REGION)",
    "share": "share(CELLS in REGION)",
    "sum": "sum(NUMBER in REGION)",
    "mean": "mean(NUMBER in REGION)",
    "highest": "highest(CELLS in REGION)",
    "match": "match(TARGET)",
}
"""Numbers of a whole world, and their syntax."""

MEMORIES = {"start": "start(VALUE)", "change": "change(VALUE)"}
ARITHMETIC = {"min": "min(A, B, …)", "max": "max(A, B, …)", "abs": "abs(A)"}
MAX_VALUES = 8
"""Numbers of arguments of `min` and `max`, as in rules."""
FUNCTIONS = {**MEASURES, **MEMORIES, **ARITHMETIC}

ACTION_WORDS = ("taken", "left", "painted", "placed", "blown")
"""Numbers that describe the last action, and the numbers of actions taken and left."""

REGION_LET = "in "
"""The prefix of regions among the values that conditions on cells read."""


@dataclass
class GoalChecker:
    """Checks the expressions of one task."""

    typer: Typer
    regions: frozenset[str]
    targets: frozenset[str]
    knobs: Mapping[str, int]

    def __post_init__(self) -> None:
        names: dict[str, Operand] = {name: number(value) for name, value in self.knobs.items()}
        names |= {name: Expr("let", FLAG, value=REGION_LET + name) for name in sorted(self.regions)}
        self.scope = Scope("", names)

    def number(self, syntax: Syntax) -> Expr | None:
        """A reward, or None after a report."""
        scalar = self._checked(syntax)
        if scalar is not None and not any(part.op in ("measure", "action") for part in parts_of(scalar)):
            label = "it has the same value in every world"
            self.typer.reporter.report("PD805", "this never changes", syntax.span, label)
        return scalar

    def condition(self, syntax: Syntax) -> Expr | None:
        """A condition that ends an episode, or None after a report."""
        scalar = self.number(syntax)
        if scalar is None or scalar.kind == FLAG:
            return scalar
        self._not_a_condition(syntax)
        return None

    def measured(self, how: str, cells: Syntax) -> Measure | None:
        """A measure of the cells of an expression, or None after a report."""
        scalar = self._checked(cells, lambda: Expr("measure", REAL, value=self.measure(how, cells)))
        return None if scalar is None else scalar.value

    def _checked(self, syntax: Syntax, check: Callable[[], Expr] | None = None) -> Expr | None:
        self.typer.start_rule(syntax.span)
        try:
            return self.scalar(syntax) if check is None else check()
        except Poisoned:
            return None
        except Unresolved as missing:
            self.typer.fail("PD301", f"`{missing.name}` is not loaded", syntax.span, "depends on it")
            return None

    # Arithmetic on numbers of the whole world

    def scalar(self, syntax: Syntax) -> Expr:
        """The checked expression of a number or a flag. Raises Poisoned after a report, Unresolved without a pack."""
        kind, parts = syntax.kind, syntax.children
        match kind:
            case "integer" | "decimal" | "percent":
                return Expr("const", REAL, value=float(read_number(syntax, self.typer)))
            case "yes" | "no":
                return Expr("const", FLAG, value=float(kind == "yes"))
            case "name":
                return self.name(syntax)
            case "call":
                return self.call(syntax)
            case "compare":
                return self.compare(syntax)
            case "choose":
                yes, condition, no = parts
                return Expr("choose", REAL, (self.truth(condition), self.scalar(yes), self.scalar(no)))
            case "and_" | "or_" | "not_":
                return Expr(kind.rstrip("_"), FLAG, tuple(map(self.truth, parts)))
            case "neg" | "add" | "sub" | "mul" | "div" | "quotient" | "mod":
                values = tuple(map(self.scalar, parts))
                if kind in ("div", "mod") and values[1].op == "const" and not values[1].value:
                    fix = "divide by another number"
                    raise self.typer.fail("PD402", "division by zero", parts[1].span, "this is 0", fix)
                return Expr(kind, REAL, values)
        raise self._needs_measure(syntax)

    def truth(self, syntax: Syntax) -> Expr:
        scalar = self.scalar(syntax)
        if scalar.kind != FLAG:
            raise self._not_a_condition(syntax)
        return scalar

    def _not_a_condition(self, syntax: Syntax) -> Poisoned:
        message = "expected a condition, found a number"
        return self.typer.fail("PD401", message, syntax.span, "compare it: `… > 0`")

    def compare(self, syntax: Syntax) -> Expr:
        values = [self.scalar(part) for part in syntax.children]
        tests = []
        for sign, (left, right) in zip(syntax.text.split(), pairwise(values), strict=True):
            if sign in (">", ">="):
                left, right, sign = right, left, sign.replace(">", "<")
            test = Expr(COMPARISONS.get(sign, "eq"), FLAG, (left, right))
            tests.append(Expr("not", FLAG, (test,)) if sign == "!=" else test)
        return reduce(lambda a, b: Expr("and", FLAG, (a, b)), tests)

    def name(self, syntax: Syntax) -> Expr:
        if syntax.text in self.knobs:
            return Expr("const", REAL, value=float(self.knobs[syntax.text]))
        if syntax.text in ACTION_WORDS:
            return Expr("action", REAL, value=syntax.text)
        raise self._needs_measure(syntax)

    def _needs_measure(self, syntax: Syntax) -> Poisoned:
        """Report a per-cell value, or an unknown name, where one number of the whole world is needed."""
        names = [*ACTION_WORDS, *FUNCTIONS, *self.knobs]
        text = syntax.span.text
        if syntax.kind == "name" and self.typer.find(syntax.text, syntax.span, self.scope) is None:
            symbols = self.typer.symbols
            known = (*names, *symbols.constants, *symbols.properties, *symbols.fields, *symbols.streams)
            helps = suggest(syntax.text, known)
            message = f"unknown name `{syntax.text}`"
            return self.typer.fail("PD301", message, syntax.span, "not defined", *helps)
        message, label = "expected one number of the whole world", "this is a value of each cell"
        fix = f"write `count({text})`, or `share({text})`"
        return self.typer.fail("PD401", message, syntax.span, label, fix)

    # Numbers of the whole world

    def call(self, syntax: Syntax) -> Expr:
        name, parts = syntax.text, syntax.children
        span = Span(syntax.span.source, syntax.span.start, syntax.span.start + len(name))
        if name not in FUNCTIONS:
            helps = suggest(name, FUNCTIONS, "functions")
            raise self.typer.fail("PD301", f"unknown function `{name}`", span, "not a function", *helps)
        least, most = (2, MAX_VALUES) if name in ("min", "max") else (1, 1)
        if not least <= len(parts) <= most:
            expected = "1 value" if most == 1 else f"{least} to {most} values"
            message = f"`{name}` takes {expected}, found {len(parts)}"
            raise self.typer.fail("PD406", message, syntax.span, "", f"write `{FUNCTIONS[name]}`")
        if name in ARITHMETIC:
            values = [self.scalar(part) for part in parts]
            if name == "abs":
                return Expr(name, REAL, (values[0],))
            return reduce(lambda a, b: Expr(name, REAL, (a, b)), values)
        if name in MEMORIES:
            inner = self.scalar(parts[0])
            if any(part.op in ("start", "before", "action") for part in parts_of(inner)):
                raise self.typer.fail(
                    "PD406", f"the argument of `{name}` must be a number of a world", parts[0].span
                )
            if name == "start":
                return Expr("start", REAL, (inner,))
            return Expr("sub", REAL, (inner, Expr("before", REAL, (inner,))))
        return Expr("measure", REAL, value=self.measure(name, parts[0]))

    def measure(self, how: str, cells: Syntax) -> Measure:
        """The measure of a call such as ``count(SET in REGION)``. Raises Poisoned after a report."""
        if how == "match":
            if cells.kind != "name" or cells.text not in self.targets:
                raise self._unknown("target", cells, self.targets)
            return Measure("match", None, None, cells.text)
        region = None
        if cells.kind == "in_" and cells.children[1].kind == "name":
            word = cells.children[1]
            if word.text in self.regions:
                region, cells = word.text, cells.children[0]
            elif self.typer.find(word.text, word.span, self.scope) is None:
                raise self._unknown("region", word, self.regions)
        return Measure(how, self.cells(how, cells), region)

    def _unknown(self, what: str, word: Syntax, known: frozenset[str]) -> Poisoned:
        helps = suggest(word.text, known, f"{what}s") or (f"the task defines no {what}s",)
        return self.typer.fail("PD802", f"unknown {what} `{word.text}`", word.span, "not defined", *helps)

    def cells(self, how: str, syntax: Syntax) -> Expr:
        """The per-cell expression of a measure."""
        operand = self.typer.evaluate(self.within(syntax), self.scope)
        if how in ("count", "share", "highest"):
            condition = self.typer.flag(operand, syntax.span)
        else:
            value = self.typer.value(operand, syntax.span)
            if value.kind.name not in ("int", "flag", "real"):
                raise self.typer.wrong(value, "a number of each cell", syntax.span, "such as a field")
            condition = value
        if any(part.op == "draw" for part in condition.walk()):
            raise self.typer.fail("PD406", "rewards cannot use random numbers", syntax.span, "a draw")
        if condition.op == "const" or (isinstance(operand, SetOf) and not operand.ids):
            label = "every cell fulfills this" if condition.value else "no cell can fulfill this"
            self.typer.reporter.report("PD805", "this never changes", syntax.span, label)
        return condition

    def within(self, syntax: Syntax) -> Syntax:
        """The syntax with `CELLS in REGION` written as `CELLS and REGION`."""
        parts = tuple(self.within(part) for part in syntax.children)
        right = parts[1] if syntax.kind in ("in_", "not_in") else None
        if right is None or right.kind != "name" or right.text not in self.regions:
            return Syntax(syntax.kind, parts, syntax.text, syntax.span)
        if syntax.kind == "not_in":
            parts = (parts[0], Syntax("not_", (right,), "", right.span))
        return Syntax("and_", parts, "", syntax.span)


def parts_of(scalar: Expr) -> list[Expr]:
    """The expression and its parts, in the order of measures."""
    parts, stack = [], [scalar]
    while stack:
        part = stack.pop()
        parts.append(part)
        stack += part.args
    return parts


def scalars_of(goal: Goal) -> list[Expr]:
    """Every part of a goal's expressions."""
    scalars = [scalar for scalar in (goal.each, goal.final, goal.success, goal.failure) if scalar is not None]
    return [part for scalar in scalars for part in parts_of(scalar)]


def measures_in(scalars: Iterable[Expr]) -> tuple[Measure, ...]:
    """Every measure among parts of expressions, once."""
    return tuple(dict.fromkeys(part.value for part in scalars if part.op == "measure"))
