"""Invariants: statements about all worlds, read as words and checked like conditions."""

from __future__ import annotations

from collections.abc import Callable

from powderdsl.diagnostics import Reporter, Span, suggest
from powderdsl.model.composition.claim_scopes import names_left_out, with_optional, words_of
from powderdsl.model.composition.compose import Composition
from powderdsl.model.declarations import RulesetDecl
from powderdsl.model.expressions.operators import (
    ELEMENT_HERE,
    FALSE,
    TRUE,
    Absent,
    Number,
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
from powderdsl.syntax.ast import Syntax

MAX_STEPS = 1000
"""Steps in a row that `never … for N steps` may ask for: each test runs them all."""

MAX_RADIUS = 1000

TRENDS = {"rises": "never rises", "falls": "never falls", "changes": "constant"}


def check_invariants(
    composition: Composition, typer: Typer, typer_of: Callable[[tuple[str, ...]], Typer | None]
) -> tuple[Invariant, ...]:
    """The invariants of all packs and of the ruleset, except invariants that need a pack which is not loaded.

    Args:
        typer_of: what checks expressions against the names of some packs alone; None if they make no ruleset.
    """
    written: list[tuple[str, Syntax, RulesetDecl | None]]
    written = [(pack.name.text, line, None) for pack in composition.packs for line in pack.invariants]
    gone = names_left_out(composition.ruleset) - composition.names.owners.keys()
    for ruleset in composition.lineage:
        written += [(ruleset.name.text, with_optional(line, gone), ruleset) for line in ruleset.invariants]
    found = []
    reporter = typer.reporter
    for pack, line, author in written:
        words, scopes = words_of(line), composition.scopes
        scope = scopes.of_ruleset(author, words) if author else scopes.of_pack(pack, words)
        typer.reporter = Reporter()
        try:
            claim, without = _claim(typer, line, pack)
            found.append(Invariant(claim, without, pack, line.span, scope))
        except Poisoned:
            pass
        except Unresolved as missing:
            typer.reporter.report(
                "PD506", f"this invariant is inactive: `{missing.name}` is not loaded", line.span, "left out",
                helps=[f"it becomes active with a pack that defines `{missing.name}`"],
            )  # fmt: skip
        added = [one.name.text for one in composition.packs if one.name.text not in scope]
        for remark in typer.reporter.diagnostics:
            if remark.code == "PD511" and added and _can_hold(typer_of(scope), line, pack):
                names = ", ".join(f"`{name}`" for name in added)
                words_there = f"with {names}, `{one_line(line.span)}` can no longer hold"
                reporter.report("PD515", words_there, remark.primary.span, remark.primary.text)
            else:
                reporter.add(remark)
    typer.reporter = reporter
    return tuple(found)


def _claim(typer: Typer, line: Syntax, pack: str) -> tuple[Claim, frozenset[int]]:
    """The claim of a line, and the elements that start worlds must not hold. Raises Poisoned or Unresolved."""
    typer.absent.clear()
    typer.start_rule(line.span)
    where = Scope(pack, {})
    without = _without(typer, line.children[1], where) if line.kind == "without" else frozenset()
    typer.absent.clear()
    said = line.children[0] if line.kind == "without" else line
    return _CLAIMS[said.kind](typer, said, where), without


def _can_hold(typer: Typer | None, line: Syntax, pack: str) -> bool:
    """Whether nothing is wrong with an invariant where only the packs of its scope are loaded."""
    try:
        return typer is not None and bool(_claim(typer, line, pack))
    except Poisoned:
        return False
    except Unresolved:
        return True


def _without(typer: Typer, what: Syntax, scope: Scope) -> frozenset[int]:
    """The elements that a world starts without; elements of packs that are not loaded are ignored."""
    ids = frozenset(typer.set_of(typer.evaluate(what, scope), what.span).ids)
    if ids == frozenset(typer.symbols.ids):
        raise typer.fail("PD511", "this invariant cannot hold", what.span, "no world is without all of these")
    return ids


def _words(typer: Typer, words: tuple[Syntax, ...], wanted: tuple[tuple[str, ...], ...]) -> None:
    """Report the first word that is not one of the words wanted in its position."""
    for word, options in zip(words, wanted, strict=True):
        if word.text not in options:
            listed = " or ".join(f"`{option}`" for option in options)
            close = [fix for fix in suggest(word.text, options) if fix.startswith("did")]
            raise typer.fail(
                "PD201", f"unexpected `{word.text}`", word.span, f"expected {listed}",
                *tuple(close) or _FORMS)  # fmt: skip


_FORMS = (
    "forms: `SET never changes`, `count(SET) is constant`, `count(SET) never rises`, `never CONDITION`, "
    "`FIELD stays in LOW..HIGH`, `nothing reaches beyond N cells`, `mirrored worlds agree`",
)


def _number(typer: Typer, text: str, span: Span, least: int, most: int) -> int:
    if len(text) > 6 or not least <= int(text) <= most:
        raise typer.fail(
            "PD402", f"{text[:12]} lies outside {least}..{most}", span, "out of range",
            f"write a number from {least} to {most}")  # fmt: skip
    return int(text)


def _trend(typer: Typer, line: Syntax, scope: Scope) -> Claim:
    """`SET never changes`, `count(…) never rises`, `count(…) never falls`."""
    what, word = line.children
    total = what.kind == "call" and what.text in ("count", "sum")
    _words(typer, (word,), (tuple(TRENDS) if total else ("changes",),))
    if total:
        return _total_of(typer, what, TRENDS[word.text], scope)
    return Unchanging(frozenset(_elements(typer, what, scope)))


def _elements(typer: Typer, what: Syntax, scope: Scope) -> tuple[int, ...]:
    ids = typer.set_of(typer.evaluate(what, scope), what.span).ids
    if not ids:
        _says_nothing(typer, what.span, "no element is meant", is_empty=True)
    return ids


def _total(typer: Typer, line: Syntax, scope: Scope) -> Claim:
    """`count(…) is constant`, `sum(…) is constant`."""
    (what,) = line.children
    if what.kind != "is_" or what.children[0].kind != "call" or what.children[1].kind != "name":
        raise typer.fail("PD201", "this states nothing", what.span, "not an invariant", *_FORMS)
    _words(typer, (what.children[1],), (("constant",),))
    return _total_of(typer, what.children[0], "constant", scope)


def _total_of(typer: Typer, call: Syntax, trend: str, scope: Scope) -> Total:
    if call.text not in ("count", "sum") or not call.children:
        raise typer.fail(
            "PD406", "a total is written `count(SET)` or `sum(VALUE)`", call.span, "not a total", *_FORMS
        )
    for child in call.children:
        if child.kind == "in_" and isinstance(typer.evaluate(child.children[1], scope), Kernel):
            raise typer.fail("PD406", "an invariant counts the whole world", call.span, "has a neighborhood")
    operands = [(typer.evaluate(child, scope), child.span) for child in call.children]
    if all(isinstance(operand, (SetOf, Absent)) for operand, _ in operands):
        ids = frozenset(number for operand, span in operands for number in typer.set_of(operand, span).ids)
        if not ids:
            _says_nothing(typer, call.span, "no element is counted", is_empty=True)
        elif ids == frozenset(typer.symbols.ids):
            _says_nothing(typer, call.span, "all cells are counted")
        return Total(member(ELEMENT_HERE, tuple(sorted(ids)), call.span), trend, ids)
    if call.text == "sum" and len(operands) == 1:
        (operand, span), *_ = operands
        value = typer.value(operand, span)
        if isinstance(value, Expr) and value.kind.name not in ("int", "flag"):
            fix = "floats are rounded: their sums are constant for no rule"
            raise typer.wrong(value, "an integer", span, fix)
        if isinstance(value, Number):
            raise typer.wrong(value, "something that worlds have", span)
        return Total(value, trend, None)
    flags = [typer.flag(operand, span) for operand, span in operands]
    return Total(_asked(typer, disjunction(flags, call.span), call.span), trend, None)


def _never(typer: Typer, line: Syntax, scope: Scope) -> Claim:
    """`never CONDITION`, `never CONDITION for N steps`."""
    duration = line.child("duration")
    steps = 1
    if duration is not None:
        _words(typer, duration.children, (("steps", "step"),))
        steps = _number(typer, duration.text, duration.span, 1, MAX_STEPS)
    condition = typer.condition(line.children[0], scope)
    if condition == TRUE:
        raise typer.fail(
            "PD511", "this invariant cannot hold", line.children[0].span, "every cell fulfills this",
            "say what no cell may fulfill")  # fmt: skip
    return Never(_asked(typer, condition, line.children[0].span), steps)


def _asked(typer: Typer, condition: Expr, span: Span) -> Expr:
    """The condition, unless it is not a question: it may depend on a pack that is not loaded, or be false by its words."""
    if condition == FALSE:
        _says_nothing(typer, span, "no cell can fulfill this", is_empty=True)
    elif condition == TRUE:
        _says_nothing(typer, span, "every cell fulfills this")
    return condition


def _stays(typer: Typer, line: Syntax, scope: Scope) -> Claim:
    """`FIELD stays in LOW..HIGH`."""
    what, bounds = line.children
    operand = typer.evaluate(what, scope)
    if isinstance(operand, Absent):
        raise Unresolved(operand.name)
    numbers = kind_name(operand) in ("int", "real", "vec2")
    if not isinstance(operand, Expr) or operand.op not in ("field", "property") or not numbers:
        raise typer.wrong(operand, "a field of numbers", what.span, "for anything else say `never CONDITION`")
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
        found = f"`{name}` holds {kind}" if outside else f"a fresh cell has {beyond[0]}"
        raise typer.fail("PD511", "this invariant cannot hold", bounds.span, found, "widen the bounds")
    return Bounded(name, lo, hi)


def _reach(typer: Typer, line: Syntax, scope: Scope) -> Claim:
    """`nothing reaches beyond N cells`."""
    _words(typer, line.children, (("nothing",), ("reaches",), ("beyond",), ("cells", "cell")))
    return Local(_number(typer, line.text, line.span, 0, MAX_RADIUS))


def _agree(typer: Typer, line: Syntax, scope: Scope) -> Claim:
    """`mirrored worlds agree`, `rotated worlds agree`."""
    _words(typer, line.children, (("mirrored", "rotated"), ("worlds",), ("agree",)))
    return Symmetric(line.children[0].text)


def _says_nothing(typer: Typer, span: Span, label: str, *, is_empty: bool = False) -> None:
    """Report an invariant that no world can break. What is empty may need a pack that is not loaded: Unresolved."""
    if is_empty and typer.absent:
        raise Unresolved(", ".join(sorted(typer.absent)))
    typer.reporter.report("PD510", "this invariant is always true", span, label, helps=["remove it"])


_CLAIMS: dict[str, Callable[[Typer, Syntax, Scope], Claim]] = {
    "trend": _trend,
    "total": _total,
    "never": _never,
    "stays": _stays,
    "reach": _reach,
    "agree": _agree,
}
