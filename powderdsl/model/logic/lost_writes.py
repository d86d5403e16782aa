"""Writes to a field that no cell has where they land: `of:` limits the field to other elements."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.expressions.operands import ELEMENT_HERE, look, member
from powderdsl.model.logic.budget import Budget, Exhausted
from powderdsl.model.logic.satisfy import Facts
from powderdsl.model.logic.undecided import settled
from powderdsl.model.types import Assign, Expr, Field, Moment, Move, Offset, Pass, Rule, Swap, Transform

HERE: Offset = (0, 0)

BUDGET = 100_000
"""Nodes evaluated for these warnings. After that nothing more is found, and a note says so."""


def report_lost_writes(
    passes: tuple[Pass, ...], fields: dict[str, Field], facts: Facts, known: list[Span], reporter: Reporter
) -> list[Span]:
    """Warn of assignments and effects that are lost wherever their rule happens, in all its copies.

    Args:
        known: rules about which more has been said already.

    Returns:
        The writes that may be lost: to tell takes too much work.
    """
    limited = {name: field for name, field in fields.items() if field.of is not None}
    quick = replace(facts, budget=Budget(BUDGET, BUDGET // 4))
    lost: dict[tuple[Span, str], bool | None] = {}
    for moment in (moment for one in passes for moment in one.moments) if limited else ():
        lets = {let.name: let.value for let in moment.lets}
        for rule in moment.rules:
            for write in [rule] if isinstance(rule, Assign) else rule.effects:
                key = write.span, write.field
                if write.field in limited and lost.get(key, True) is not False and rule.span not in known:
                    ids = limited[write.field].of or frozenset()
                    try:
                        here = not _arrives(write, rule, ids, moment, quick, lets)
                    except Exhausted:
                        here = None
                    lost[key] = None if here and lost.get(key, True) is None else here
    for (span, name), always in lost.items():
        if always:
            reporter.report(
                "PD516", f"this write to `{name}` is always lost", span, f"no cell that it reaches has a `{name}`",
                secondary=[Label(limited[name].span, "`of:` says which elements have it")],
                helps=["widen `of:`, or write to a cell that holds one of its elements"],
            )  # fmt: skip
    return [span for (span, _), always in lost.items() if always is None]


def _arrives(
    write: Assign, rule: Rule, ids: frozenset[int], moment: Moment, facts: Facts, lets: dict[str, Expr]
) -> bool:
    """Whether the cell may hold one of these elements when the write lands. Effects come after all that moves.

    Raises Exhausted if to tell takes too much work.
    """
    if rule.mask is None:
        return True

    def may(mask: Expr, what: Expr) -> bool:
        return settled(facts, [(mask, HERE), (member(what, tuple(sorted(ids))), HERE)], lets)

    if isinstance(rule, Assign):
        return may(rule.mask, look(ELEMENT_HERE, write.offset))
    if isinstance(rule, Transform) and write.offset == HERE:
        return may(rule.mask, rule.target)
    if isinstance(rule, Swap) and write.offset in (HERE, rule.offset):
        other = rule.offset if write.offset == HERE else HERE
        return may(rule.mask, look(ELEMENT_HERE, other))
    if isinstance(rule, Move) and write.offset == rule.offset:
        return may(rule.mask, ELEMENT_HERE)
    if any(may(mask, what) for mask, what in _brought(moment)):
        return True
    if isinstance(rule, Move) and write.offset == HERE:
        return False  # what leaves is gone, and nothing brings one
    return may(rule.mask, look(ELEMENT_HERE, write.offset))


def _brought(moment: Moment) -> Iterator[tuple[Expr, Expr]]:
    """What the rules of a substep may bring into some cell, with the condition under which they do."""
    for rule in moment.rules:
        if isinstance(rule, Transform):
            yield rule.mask, rule.target
        elif isinstance(rule, Swap):
            yield rule.mask, ELEMENT_HERE
            yield rule.mask, look(ELEMENT_HERE, rule.offset)
        elif isinstance(rule, Move):
            yield rule.mask, ELEMENT_HERE
            yield rule.mask, rule.leaving
