"""Invariants: statements about all worlds, read as words and checked like conditions."""

from __future__ import annotations

from dataclasses import dataclass

from powderdsl.diagnostics import Reporter, Span, suggest
from powderdsl.model.composition.added_packs import CheckAlone
from powderdsl.model.composition.compose import Composition, with_optional
from powderdsl.model.composition.names import words_of
from powderdsl.model.declarations import RulesetDecl
from powderdsl.model.expressions.operators import (
    ELEMENT_HERE,
    FALSE,
    TRUE,
    Absent,
    Poisoned,
    Scope,
    SetOf,
    Unresolved,
    disjunction,
    kind_name,
    member,
)
from powderdsl.model.expressions.symbols import read_bounds
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.text import one_line
from powderdsl.model.types import (
    Bounded,
    Claim,
    Expr,
    Invariant,
    Kernel,
    Local,
    Never,
    Symmetric,
    Total,
    Unchanging,
)
from powderdsl.syntax.parse import Syntax

MAX_STEPS = 1000
"""Steps in a row that `never … for N steps` may ask for: each test runs them all."""

MAX_RADIUS = 1000

TRENDS = {"rises": "never rises", "falls": "never falls", "changes": "constant"}


def check_invariants(
    composition: Composition, typer: Typer, check_alone: CheckAlone
) -> tuple[Invariant, ...]:
    """The invariants of all packs and of the ruleset, except invariants that need a pack which is not loaded.

    Args:
        check_alone: checks the packs of the scope of an invariant that cannot hold.
    """
    written: list[tuple[str, Syntax, RulesetDecl | None]]
    written = [(name, line, None) for name, pack in composition.packs.items() for line in pack.invariants]
    for ruleset in composition.ruleset.lineage:
        for line in ruleset.invariants:
            written.append((ruleset.name.text, with_optional(line, composition.left_out), ruleset))
    invariants = []
    reporter = typer.reporter
    for pack, line, author in written:
        scope = composition.scope(author or pack, words_of(line))
        typer.reporter = Reporter()
        try:
            claim, without = _claim(typer, line, pack)
            invariants.append(Invariant(claim, without, pack, line.span, scope))
        except Poisoned:
            pass
        except Unresolved as missing:
            typer.reporter.report(
                "PD506", f"this invariant is inactive: `{missing.name}` is not loaded", line.span, "left out",
                helps=[f"it becomes active with a pack that defines `{missing.name}`"],
            )  # fmt: skip
        added = [name for name in composition.packs if name not in scope]
        for remark in typer.reporter.diagnostics:
            if remark.code == "PD511" and added and check_alone(scope, Reporter()):
                names = ", ".join(f"`{name}`" for name in added)
                words_there = f"with {names}, `{one_line(line.span)}` can no longer hold"
                reporter.report("PD515", words_there, remark.primary.span, remark.primary.text)
            else:
                reporter.add(remark)
    typer.reporter = reporter
    return tuple(invariants)


def _claim(typer: Typer, line: Syntax, pack: str) -> tuple[Claim, frozenset[int]]:
    """The claim of a line, and the elements that start worlds must not hold. Raises Poisoned or Unresolved."""
    typer.absent.clear()
    typer.start_rule(line.span)
    scope, without = Scope(pack, {}), frozenset[int]()
    if line.kind == "without":
        line, what = line.children
        without = frozenset(typer.set_of(typer.evaluate(what, scope), what.span).ids)
        if without == typer.symbols.names_by_id.keys():
            label = "no world is without all of these"
            raise typer.fail("PD511", "this invariant cannot hold", what.span, label)
        typer.absent.clear()  # a world is without elements of packs that are not loaded
    return _Statement(typer, scope).claim(line), without


_FORMS = (
    "forms: `SET never changes`, `count(SET) is constant`, `count(SET) never rises`, `never CONDITION`, "
    "`FIELD stays in LOW..HIGH`, `nothing reaches beyond N cells`, `mirrored worlds agree`",
)


@dataclass(frozen=True)
class _Statement:
    """Reads the statement of an invariant. Its methods raise Poisoned after reporting, or Unresolved."""

    typer: Typer
    scope: Scope

    def claim(self, line: Syntax) -> Claim:
        typer, scope, parts = self.typer, self.scope, line.children
        match line.kind:
            case "trend":  # `SET never changes`, `count(…) never rises`, `count(…) never falls`
                is_total = parts[0].kind == "call" and parts[0].text in ("count", "sum")
                self.check_words(parts[1:], tuple(TRENDS) if is_total else ("changes",))
                if is_total:
                    return self.total(parts[0], TRENDS[parts[1].text])
                ids = typer.set_of(typer.evaluate(parts[0], scope), parts[0].span).ids
                if not ids:
                    self.report_trivial(parts[0].span, "no element is meant", is_empty=True)
                return Unchanging(frozenset(ids))
            case "total":  # `count(…) is constant`, `sum(…) is constant`
                (what,) = parts
                if what.kind != "is_" or what.children[0].kind != "call" or what.children[1].kind != "name":
                    raise typer.fail("PD201", "this states nothing", what.span, "not an invariant", *_FORMS)
                self.check_words(what.children[1:], ("constant",))
                return self.total(what.children[0], "constant")
            case "never":  # `never CONDITION`, `never CONDITION for N steps`
                duration, steps = line.child("duration"), 1
                if duration is not None:
                    self.check_words(duration.children, ("steps", "step"))
                    steps = self.number(duration, 1, MAX_STEPS)
                condition = typer.condition(parts[0], scope)
                if condition == TRUE:
                    raise typer.fail(
                        "PD511", "this invariant cannot hold", parts[0].span, "every cell fulfills this",
                        "say what no cell may fulfill")  # fmt: skip
                return Never(self.check_open(condition, parts[0].span), steps)
            case "reach":  # `nothing reaches beyond N cells`
                self.check_words(parts, ("nothing",), ("reaches",), ("beyond",), ("cells", "cell"))
                return Local(self.number(line, 0, MAX_RADIUS))
            case "agree":  # `mirrored worlds agree`, `rotated worlds agree`
                self.check_words(parts, ("mirrored", "rotated"), ("worlds",), ("agree",))
                return Symmetric(parts[0].text)
        return self.bounds(line)

    def total(self, call: Syntax, trend: str) -> Total:
        typer, scope = self.typer, self.scope
        if call.text not in ("count", "sum") or not call.children:
            raise typer.fail(
                "PD406", "a total is written `count(SET)` or `sum(VALUE)`", call.span, "not a total", *_FORMS
            )
        for child in call.children:
            if child.kind == "in_" and isinstance(typer.evaluate(child.children[1], scope), Kernel):
                raise typer.fail(
                    "PD406", "an invariant counts the whole world", call.span, "has a neighborhood"
                )
        operands = [(typer.evaluate(child, scope), child.span) for child in call.children]
        if all(isinstance(operand, (SetOf, Absent)) for operand, _ in operands):
            ids = frozenset(
                number for operand, span in operands for number in typer.set_of(operand, span).ids
            )
            if not ids:
                self.report_trivial(call.span, "no element is counted", is_empty=True)
            elif ids == typer.symbols.names_by_id.keys():
                self.report_trivial(call.span, "all cells are counted")
            return Total(member(ELEMENT_HERE, tuple(sorted(ids)), call.span), trend, ids)
        if call.text == "sum" and len(operands) == 1:
            (operand, span), *_ = operands
            value = typer.value(operand, span)
            if value.kind.name == "number":
                raise typer.wrong(value, "something that worlds have", span)
            if value.kind.name not in ("int", "flag"):
                fix = "floats are rounded: their sums are constant for no rule"
                raise typer.wrong(value, "an integer", span, fix)
            return Total(value, trend, None)
        flags = [typer.flag(operand, span) for operand, span in operands]
        return Total(self.check_open(disjunction(flags, call.span), call.span), trend, None)

    def bounds(self, line: Syntax) -> Claim:
        """`FIELD stays in LOW..HIGH`."""
        typer = self.typer
        what, bounds = line.children
        operand = typer.evaluate(what, self.scope)
        if isinstance(operand, Absent):
            raise Unresolved(operand.name)
        numbers = kind_name(operand) in ("int", "real", "vec2")
        if not isinstance(operand, Expr) or operand.op not in ("field", "property") or not numbers:
            raise typer.wrong(
                operand, "a field of numbers", what.span, "for anything else say `never CONDITION`"
            )
        lo, hi = read_bounds(bounds, typer)
        name, kind = str(operand.value), operand.kind
        field = typer.symbols.fields.get(name)
        outside = hi < kind.lo or lo > kind.hi
        defaults = field.defaults if field else ()
        parts = [
            (value, part) for value in defaults for part in (value if isinstance(value, tuple) else (value,))
        ]
        beyond = [value for value, part in parts if not lo <= part <= hi]
        if outside or beyond:
            label = f"`{name}` holds {kind}" if outside else f"a fresh cell has {beyond[0]}"
            raise typer.fail("PD511", "this invariant cannot hold", bounds.span, label, "widen the bounds")
        return Bounded(name, lo, hi)

    def check_open(self, condition: Expr, span: Span) -> Expr:
        """The condition, after reporting one that is always true or always false."""
        if condition == FALSE:
            self.report_trivial(span, "no cell can fulfill this", is_empty=True)
        elif condition == TRUE:
            self.report_trivial(span, "every cell fulfills this")
        return condition

    def report_trivial(self, span: Span, label: str, *, is_empty: bool = False) -> None:
        """Report an invariant that no world can break. Raises Unresolved if an empty one may need an absent pack."""
        if is_empty and self.typer.absent:
            raise Unresolved(", ".join(sorted(self.typer.absent)))
        message = "this invariant is always true"
        self.typer.reporter.report("PD510", message, span, label, helps=["remove it"])

    def check_words(self, words: tuple[Syntax, ...], *wanted: tuple[str, ...]) -> None:
        """Report the first word that is not one of the words wanted in its position."""
        for word, options in zip(words, wanted, strict=True):
            if word.text not in options:
                listed = " or ".join(f"`{option}`" for option in options)
                close = tuple(fix for fix in suggest(word.text, options) if fix.startswith("did"))
                message, label = f"unexpected `{word.text}`", f"expected {listed}"
                raise self.typer.fail("PD201", message, word.span, label, *close or _FORMS)

    def number(self, line: Syntax, least: int, most: int) -> int:
        text = line.text
        if len(text) > 6 or not least <= int(text) <= most:
            message = f"{text[:12]} lies outside {least}..{most}"
            fix = f"write a number from {least} to {most}"
            raise self.typer.fail("PD402", message, line.span, "out of range", fix)
        return int(text)
