"""Choices of floats on arrays: where few cells change, only those are touched."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from powderdsl.ir.ops import REAL, Graph, Node
from powderdsl.schedule.types import CELLS, PLACES, Compute, Schedule, map_computes, ordered, with_args

_UPDATES = ("add", "sub", "mul")


def choices(schedule: Schedule) -> Schedule:
    """Choices of floats as operations on arrays.

    `select(m, a, b)` → `choose(cells(m), a, b)`; `select(m, b + c, b)` → `update(places(m), b, c)`; where mask and
    change are read at the same neighbor, `select(m[o], b + c[o], b)` → `carry(places(m), moved(places(m)), b, c)`.
    """
    return map_computes(schedule, lambda statement: [_changed(statement, schedule.graph)])


def _changed(statement: Compute, graph: Graph) -> Compute:
    roots = [out.value for out in statement.outs]
    nodes = ordered(roots)
    if not any(_is_choice(node) for node in nodes):
        return statement
    users = Counter([*map(id, roots), *(id(arg) for node in nodes for arg in node.args)])
    done: dict[int, Node] = {}
    for node in nodes:
        if _is_choice(node):
            done[id(node)] = _choice(node, done, users, graph)
            continue
        done[id(node)] = with_args(node, tuple(done[id(arg)] for arg in node.args), graph)
    return replace(statement, outs=tuple(replace(out, value=done[id(out.value)]) for out in statement.outs))


def _is_choice(node: Node) -> bool:
    return node.op == "select" and node.type == REAL


def _choice(node: Node, done: dict[int, Node], users: Counter[int], graph: Graph) -> Node:
    flag, yes, no = node.args
    old = done[id(no)]
    other = _change_of(yes, no) if users[id(yes)] == 1 else None
    if other is None:
        cells = graph.node("cells", CELLS, (done[id(flag)],))
        return graph.node("choose", REAL, (cells, done[id(yes)], old), None, node.places)
    if other.op == "const" and other.attr == 0.0 and yes.op != "mul":
        return old
    if flag.op == other.op == "shift" and flag.attr == other.attr and flag.attr[2]:
        offset = flag.attr[:2]
        source = graph.node("places", PLACES, (done[id(flag.args[0])],))
        target = graph.node("moved", PLACES, (source,), offset)
        args = (source, target, old, done[id(other.args[0])])
        return graph.node("carry", REAL, args, (yes.op, *offset), node.places)
    places = graph.node("places", PLACES, (done[id(flag)],))
    return graph.node("update", REAL, (places, old, done[id(other)]), yes.op, node.places)


def _change_of(yes: Node, no: Node) -> Node | None:
    """The operand that is added to, subtracted from or multiplied with `no` to give `yes`; None if there is none."""
    if yes.op not in _UPDATES:
        return None
    left, right = yes.args
    if left is no and right is not no:
        return right
    return left if right is no and left is not no and yes.op != "sub" else None
