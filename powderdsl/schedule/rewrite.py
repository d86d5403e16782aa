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
    Move,
    Schedule,
    Statement,
    flat,
    loaded,
    map_blocks,
    rewritten,
    values_of,
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
    new = rewritten(values_of(statement), graph, rule)
    match statement:
        case Compute(outs):
            changed = (
                replace(
                    out,
                    value=new[id(out.value)],
                    otherwise=None if out.otherwise is None else new[id(out.otherwise)],
                )
                for out in outs
            )
            region = None if statement.region is None else new[id(statement.region)]
            when = None if statement.when is None else new[id(statement.when)]
            return replace(statement, outs=tuple(changed), region=region, when=when)
        case Move(_, _, movers, planes):
            moved = (replace(p, old=new[id(p.old)], leaves=new[id(p.leaves)]) for p in planes)
            return replace(statement, movers=new[id(movers)], planes=tuple(moved))
        case Guard(when, _, keeps):
            kept = tuple((var, new[id(value)]) for var, value in keeps)
            return replace(statement, when=tuple(new[id(node)] for node in when), keeps=kept)
    return statement


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
    return Counter(loaded(node for statement in flat(body) for node in values_of(statement)))


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
