"""Transformations that several stages share: rewriting all values, removing unread variables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace

from powderdsl.ir.ops import Graph, Node
from powderdsl.schedule.types import (
    Compute,
    Forget,
    Guard,
    Schedule,
    Statement,
    flat,
    loaded,
    map_blocks,
    rewritten,
)

Rule = Callable[[Node], Node | None]


def map_values(schedule: Schedule, rule: Rule) -> Schedule:
    """The schedule with every value rewritten by a rule, see `types.rewritten`."""

    def change(block: tuple[Statement, ...]) -> tuple[Statement, ...]:
        return tuple(with_values(statement, schedule.graph, rule) for statement in block)

    leaves = tuple(
        (slot, rewritten([node], schedule.graph, rule)[id(node)]) for slot, node in schedule.leaves
    )
    return replace(schedule, body=map_blocks(schedule.body, change), leaves=leaves)


def with_values(statement: Statement, graph: Graph, rule: Rule) -> Statement:
    """One statement with its own values rewritten, without those of nested statements."""
    new = rewritten(statement.values(), graph, rule)
    return statement.with_values(lambda node: new[id(node)])


def without_unread(schedule: Schedule) -> Schedule:
    """The schedule without unread variables; guards keep only what is read after them."""
    while True:
        read = Counter(loaded(node for _, node in schedule.leaves))
        read.update(_reads(schedule.body))
        kept = _keep(schedule.body, read, frozenset())
        finds = tuple((slot, var) for slot, var in schedule.finds if read[var.name])
        if kept == schedule.body and finds == schedule.finds:
            return schedule
        schedule = replace(schedule, body=kept, finds=finds)


def _reads(body: Iterable[Statement]) -> Counter[str]:
    return Counter(loaded(node for statement in flat(body) for node in statement.values()))


def _keep(body: Iterable[Statement], read: Counter[str], outside: frozenset[str]) -> tuple[Statement, ...]:
    """The statements without unread variables. `outside`: names that the guard around them keeps."""
    result: list[Statement] = []
    for statement in body:
        match statement:
            case Compute(outs):
                outs = tuple(out for out in outs if read[out.var.name] or out.var.name in outside)
                if outs:
                    result.append(replace(statement, outs=outs) if outs != statement.outs else statement)
            case Guard(_, inner, keeps):
                own = _reads(inner)
                keeps = tuple(
                    (var, value)
                    for var, value in keeps
                    if read[var.name] > own[var.name] or var.name in outside
                )
                inner = _keep(inner, read, frozenset(var.name for var, _ in keeps))
                if keeps or any(isinstance(one, Forget) for one in inner):
                    same = keeps == statement.keeps and inner == statement.body
                    result.append(statement if same else replace(statement, body=inner, keeps=keeps))
            case _:
                result.append(statement)
    return tuple(result)
