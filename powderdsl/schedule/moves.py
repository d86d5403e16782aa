"""Movements: planes with the same movers and the same direction move together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from powderdsl.ir.ops import FLAG, Graph, Node, Offset
from powderdsl.schedule.types import (
    Carried,
    Compute,
    Move,
    Namer,
    Out,
    Schedule,
    Statement,
    Var,
    load,
    map_computes,
    ordered,
    over_variables,
)


def moves(schedule: Schedule) -> Schedule:
    """Every `swap` and `arrive` of a plane becomes part of a `Move`; a movement comes after those that it reads.

    `x = swap(a, m, a); y = swap(b, m, b)` → `swap by m: x = a, y = b`.
    """
    namer = Namer(schedule)
    return map_computes(schedule, lambda statement: _moved(statement, schedule.graph, namer))


def is_movement(node: Node) -> bool:
    return node.op in ("swap", "arrive") and node.type == FLAG


def _moved(statement: Compute, graph: Graph, namer: Namer) -> list[Statement]:
    """A statement split into the inputs of movements, the movements, and what reads them."""
    nodes = ordered(out.value for out in statement.outs)
    movements = [node for node in nodes if is_movement(node)]
    if not movements:
        return [statement]
    vars: dict[int, Var] = {}
    result: list[Statement] = []
    own = {id(out.value): out.var for out in reversed(statement.outs) if is_movement(out.value)}

    def value(root: Node) -> Node:
        return over_variables(
            root, graph, lambda node: load(graph, vars[id(node)]) if id(node) in vars else None
        )

    def store(wanted: Iterable[Node]) -> None:
        """Store in variables what movements read in other cells."""
        outs = []
        for node in dict.fromkeys(wanted):
            if id(node) not in vars and value(node).op != "load":
                outs.append((node, Out(namer.var(node.type), value(node))))
        if outs:
            result.append(Compute(tuple(out for _, out in outs), statement.place))
            vars.update((id(node), out.var) for node, out in outs)

    for group in _groups(nodes, movements):
        first = group[0]
        store(arg for node in group for arg in node.args[:2])
        carried = []
        for node in group:
            content, _, stays = node.args
            old = value(content)
            leaves = old if stays is content else value(stays)
            var = own.get(id(node)) or namer.var(FLAG)
            carried.append((node, Carried(var, old, leaves)))
        result.append(
            Move(first.op, first.attr, value(first.args[1]), tuple(c for _, c in carried), statement.place)
        )
        vars.update((id(node), one.new) for node, one in carried)
    moved = {var.name for var in own.values()}
    rest = tuple(replace(out, value=value(out.value)) for out in statement.outs if out.var.name not in moved)
    return [*result, replace(statement, outs=rest)] if rest else result


def _groups(nodes: list[Node], movements: list[Node]) -> list[list[Node]]:
    """Groups of movements that can be done together; each comes after the groups that it reads."""
    wanted = set(map(id, movements))
    depth: dict[int, int] = {}
    groups: dict[tuple[int, str, int, Offset], list[Node]] = {}
    for node in nodes:
        below = max((depth[id(arg)] for arg in node.args), default=0)
        depth[id(node)] = below + (id(node) in wanted)
        if id(node) in wanted:
            groups.setdefault((depth[id(node)], node.op, id(node.args[1]), node.attr), []).append(node)
    return [group for _, group in sorted(groups.items(), key=lambda item: item[0][0])]
