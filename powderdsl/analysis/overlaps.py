"""Where two rules meet in one cell, so that their order or the conflict policy decides what comes of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from powderdsl.analysis.changes import Asked, RuleLine, is_not, rule_line
from powderdsl.model.logic.satisfy import Conditions, Facts, Lets, satisfiable
from powderdsl.model.types import (
    HERE,
    Assign,
    Expr,
    Move,
    Pass,
    Rule,
    Ruleset,
    Transform,
    alike,
    footprint,
    minus,
    substeps,
    writes_of,
)

T = TypeVar("T")

OUTCOMES = {
    "first wins": "both claim a cell at once: the first one happens",
    "both dropped": "both claim a cell at once: neither happens",
    "overwritten": "both claim a cell at once: the later one overwrites the other",
    "last writes": "both write a field of a cell at once: the last one has the final word",
    "cut off": "both change a number of a cell at once: at the bounds of its range the order matters",
    "first in turn": "both may want to turn a cell into something: the one that runs first does",
}
"""Outcomes for two rules that meet, in words."""

_BY_POLICY = {"first_wins": "first wins", "drop_both": "both dropped", "overwrite": "overwritten"}

MAX_LINES = 64
"""Lines that transform cells, up to which every two of different substeps are compared."""


@dataclass(frozen=True)
class Overlap:
    """Two lines that may meet in one cell. `outcome` is one of OUTCOMES; `field` is what they both write, if any.

    The lines may be one line, of which a loop or a symmetry makes several rules.
    """

    outcome: str
    first: RuleLine
    second: RuleLine
    field: str = ""


Candidate = tuple[Overlap, Iterable[Conditions], Lets]
"""Two lines, and for each way in which they could meet the conditions of that, with the values under `let`."""


def find_overlaps(ruleset: Ruleset, facts: Facts) -> tuple[Overlap, ...]:
    """Every two lines that could not be shown to keep apart, in the order in which they run."""
    found: dict[Overlap, None] = {}
    for overlap, ways, lets in _candidates(ruleset, facts):
        if overlap not in found and any(satisfiable(facts, way, lets) for way in ways):
            found[overlap] = None
    return tuple(found)


def _candidates(ruleset: Ruleset, facts: Facts) -> Iterator[Candidate]:
    for pass_, moment in substeps(ruleset.passes):
        asked = Asked(moment, facts, moment.values)
        live = [rule for rule in moment.rules if asked.may(rule)]
        if moment.policy != "prove":
            yield from _claims(asked, pass_)
        yield from _writes(live, asked, pass_)
    yield from _in_turn(ruleset)


def _claims(asked: Asked, pass_: Pass) -> Iterator[Candidate]:
    """Rules of one substep that may claim one cell, where a policy decides."""
    # Rules that are always dropped meet others too: only the conditions count here.
    movers = [rule for rule in asked.moment.rules if not isinstance(rule, Assign)]
    for i, second in enumerate(movers):
        for first in movers[: i + 1]:
            outcome, same = _BY_POLICY[asked.moment.policy], first is second
            if same and outcome == "first wins":
                outcome = "both dropped"
            if (same and isinstance(first, Move) and first.leaving is None) or (
                outcome == "first wins" and alike(first, second)
            ):
                continue  # cells of one rule that share a place move in rows
            overlap = Overlap(outcome, rule_line(first, pass_), rule_line(second, pass_))
            shifts = {minus(a, b): None for a in footprint(first) for b in footprint(second)}
            ways = (((first.mask, HERE), (second.mask, at)) for at in shifts if not (same and at == HERE))
            yield overlap, ways, asked.lets


def _writes(rules: list[Rule], asked: Asked, pass_: Pass) -> Iterator[Candidate]:
    """Writes of one field in one substep whose order makes a difference. Roundings of floats are left out."""
    settled = asked.moment.policy in ("drop_both", "first_wins")
    for kind in (True, False):
        chosen = [rule for rule in rules if isinstance(rule, Assign) == kind]
        writes = [(write, rule) for rule in chosen for write in writes_of(rule)]
        for (a, first), (b, second) in _pairs(writes):
            outcome = order_matters(a, b)
            if not outcome:
                continue
            own = not kind and a.offset in footprint(first) and b.offset in footprint(second)
            if settled and own and first is not second:
                continue  # rules that happen never share a cell
            overlap = Overlap(outcome, rule_line(first, pass_), rule_line(second, pass_), a.field)
            yield overlap, [((first.mask, HERE), (second.mask, minus(a.offset, b.offset)))], asked.lets


def _pairs(items: Sequence[T]) -> Iterator[tuple[T, T]]:
    """Every two items, by the second one first: the order in which both have run."""
    for number, second in enumerate(items):
        for first in items[:number]:
            yield first, second


def order_matters(a: Assign, b: Assign) -> str:
    """The key of OUTCOMES if these two write one cell, or an empty text."""
    if a.field != b.field or (a.op == b.op == ":=" and a.value == b.value):
        return ""
    if ":=" in (a.op, b.op):
        return "last writes"
    (low, high), (other_low, other_high) = a.change, b.change
    opposite = (high > 0 and other_low < 0) or (low < 0 and other_high > 0)
    return "cut off" if a.value.kind.name == "int" and opposite else ""


def _in_turn(ruleset: Ruleset) -> Iterator[Candidate]:
    """Transforms of different substeps that could happen to one cell of one world, with different results."""
    rules: list[tuple[int, RuleLine, Expr, Expr]] = []
    lets: Lets = {}
    for number, (pass_, moment) in enumerate(substeps(ruleset.passes)):
        lets |= {f"{name}@{number}": _renamed(value, number) for name, value in moment.values.items()}
        for rule in moment.rules:
            if isinstance(rule, Transform):
                rules.append((number, rule_line(rule, pass_), rule.target, _renamed(rule.mask, number)))
    if len({line for _, line, _, _ in rules}) > MAX_LINES:
        return
    for (other, first, earlier, other_mask), (number, second, target, mask) in _pairs(rules):
        if other != number and (earlier != target or target.op != "const"):
            changing = [is_not(end.value) for end in (target, earlier) if end.op == "const"]
            yield (
                Overlap("first in turn", first, second),
                [[(other_mask, HERE), (mask, HERE), *changing]],
                lets,
            )


def _renamed(expr: Expr, number: int) -> Expr:
    """Values under `let` of different substeps may share a name: here they get the substep's number."""
    if expr.op == "let":
        return replace(expr, value=f"{expr.value}@{number}")
    args = tuple(_renamed(arg, number) for arg in expr.args)
    return replace(expr, args=args) if args else expr
