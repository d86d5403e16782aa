"""Where two rules meet in one cell, so that their order or the conflict policy decides what comes of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from powderdsl.analysis.changes import HERE, Asked, RuleLine, footprint, is_not, rule_line
from powderdsl.model.logic.satisfy import Facts, satisfiable
from powderdsl.model.types import Assign, Expr, Move, Offset, Pass, Rule, Ruleset, Transform

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


def find_overlaps(ruleset: Ruleset, facts: Facts) -> tuple[Overlap, ...]:
    """Every two lines that could not be shown to keep apart, in the order in which they run."""
    found: dict[Overlap, None] = {}
    for pass_, moment in ruleset.substeps():
        asked = Asked.of(moment, facts)
        live = [rule for rule in moment.rules if rule.mask is None or asked.may(rule)]
        found |= dict.fromkeys(_claims(asked, pass_, found))
        found |= dict.fromkeys(_writes(live, asked, pass_, found))
    found |= dict.fromkeys(_in_turn(ruleset, facts, found))
    return tuple(found)


def _meet(first: Expr, second: Expr, at: Offset, asked: Asked) -> bool:
    return satisfiable(asked.facts, [(first, HERE), (second, at)], asked.lets)


def _claims(asked: Asked, pass_: Pass, known: dict[Overlap, None]) -> Iterator[Overlap]:
    """Rules of one substep that may claim one cell, where a policy decides."""
    if asked.moment.policy == "prove":
        return
    # Rules that are always dropped meet others too: only the conditions count here.
    movers = [rule for rule in asked.moment.rules if not isinstance(rule, Assign)]
    outcome = _BY_POLICY[asked.moment.policy]
    for i, second in enumerate(movers):
        for first in movers[: i + 1]:
            one = first is second
            if one and isinstance(first, Move) and first.leaving is None:
                continue  # cells of one rule that share a place move in rows
            what = "both dropped" if one and outcome != "overwritten" else outcome
            overlap = Overlap(what, rule_line(first, pass_), rule_line(second, pass_))
            same = what == "first wins" and _alike(first, second)
            if overlap in known or same:
                continue
            shifts = dict.fromkeys(
                (a[0] - b[0], a[1] - b[1]) for a in footprint(first) for b in footprint(second)
            )
            if any(_meet(first.mask, second.mask, at, asked) for at in shifts if not (one and at == HERE)):
                yield overlap


def _alike(first: Rule, second: Rule) -> bool:
    """Whether it makes no difference which of two transforms happens."""
    if not isinstance(first, Transform) or not isinstance(second, Transform):
        return False
    return first.target == second.target and first.effects == second.effects


def _writes(rules: list[Rule], asked: Asked, pass_: Pass, known: dict[Overlap, None]) -> Iterator[Overlap]:
    """Writes of one field in one substep whose order makes a difference. Roundings of floats are left out."""
    plain = [(rule, rule) for rule in rules if isinstance(rule, Assign)]
    effects = [(effect, rule) for rule in rules if not isinstance(rule, Assign) for effect in rule.effects]
    for writes in (plain, effects):
        for (a, first), (b, second) in _pairs(writes):
            outcome = order_matters(a, b)
            if not outcome or first.mask is None or second.mask is None:
                continue
            apart = first is not second and asked.moment.policy in ("drop_both", "first_wins")
            if apart and _own_cells(first, a) and _own_cells(second, b):
                continue  # rules that happen never share a cell
            overlap = Overlap(outcome, rule_line(first, pass_), rule_line(second, pass_), a.field)
            at = (a.offset[0] - b.offset[0], a.offset[1] - b.offset[1])
            if overlap not in known and _meet(first.mask, second.mask, at, asked):
                yield overlap


def _pairs(items: Sequence[T]) -> Iterator[tuple[T, T]]:
    """Every two items, by the second one first: the order in which both have run."""
    for number, second in enumerate(items):
        for first in items[:number]:
            yield first, second


def _own_cells(rule: Rule, effect: Assign) -> bool:
    """Whether an effect stays in the cells that its rule claims."""
    return not isinstance(rule, Assign) and effect.offset in footprint(rule)


def order_matters(a: Assign, b: Assign) -> str:
    """The key of OUTCOMES if these two write one cell, or an empty text."""
    if a.field != b.field or (a.op == b.op == ":=" and a.value == b.value):
        return ""
    if ":=" in (a.op, b.op):
        return "last writes"
    (low, high), (other_low, other_high) = (
        (-one.value.kind.hi, -one.value.kind.lo) if one.op == "-=" else (one.value.kind.lo, one.value.kind.hi)
        for one in (a, b)
    )
    opposite = (high > 0 and other_low < 0) or (low < 0 and other_high > 0)
    return "cut off" if a.value.kind.name == "int" and opposite else ""


def _in_turn(ruleset: Ruleset, facts: Facts, known: dict[Overlap, None]) -> Iterator[Overlap]:
    """Transforms of different substeps that could happen to one cell of one world, with different results."""
    rules = [
        (number, pass_, rule, lets, _renamed(rule.mask, number))
        for number, (pass_, moment) in enumerate(ruleset.substeps())
        for lets in [{f"{let.name}@{number}": _renamed(let.value, number) for let in moment.lets}]
        for rule in moment.rules
        if isinstance(rule, Transform)
    ]
    if len({rule.span for _, _, rule, _, _ in rules}) > MAX_LINES:
        return
    seen = set(known)
    for (other, other_pass, earlier, other_lets, other_mask), (number, pass_, rule, lets, mask) in _pairs(
        rules
    ):
        if other == number or (earlier.target == rule.target and rule.target.op == "const"):
            continue
        overlap = Overlap("first in turn", rule_line(earlier, other_pass), rule_line(rule, pass_))
        changing = [is_not(t.value) for t in (rule.target, earlier.target) if t.op == "const"]
        conditions = [(other_mask, HERE), (mask, HERE), *changing]
        if overlap not in seen and satisfiable(facts, conditions, {**other_lets, **lets}):
            seen.add(overlap)
            yield overlap


def _renamed(expr: Expr, number: int) -> Expr:
    """Values under `let` of different substeps may share a name: here they get the substep's number."""
    if expr.op == "let":
        return replace(expr, value=f"{expr.value}@{number}")
    args = tuple(_renamed(arg, number) for arg in expr.args)
    return replace(expr, args=args) if args else expr
