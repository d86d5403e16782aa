"""Floats on targets with loops: computed where they are used; comparisons only where another one holds."""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import replace

from powderdsl.ir.ops import FLAG, REAL, Graph, Node, conjuncts, ordered, taken
from powderdsl.schedule.types import (
    Compute,
    Facts,
    Namer,
    Out,
    Schedule,
    choices,
    drop_unread,
    flat,
    load,
    map_values,
    on_all_paths,
    rewritten,
)

COMPARISONS = ("eq", "lt", "le")
AT_NEIGHBORS = ("shift", "swap", "arrive")


def inline_floats(schedule: Schedule) -> Schedule:
    """Compute floats that substeps write where they are used, from the pass's inputs and the masks, without storing them.

    Where a guard's masks fail, the choices in the value give the old one, so the value is right outside the guard too.
    Floats that only move, more than once, need no second clamp.
    `if any m: v2 = select(m, a, v1); … v3 = select(n, b, v2)` → `v3 = select(n, b, select(m, a, v1))`.
    """
    known: dict[str, Node] = {}

    def rule(node: Node) -> Node | None:
        return known.get(node.attr)

    for statement in flat(schedule.body):
        new = rewritten(statement.values, schedule.graph, rule)
        for out in statement.outs if isinstance(statement, Compute) else ():
            if out.var.type == REAL:
                known[out.var.name] = new(out.value)
    schedule = map_values(schedule, rule)
    namer, slots = Namer(schedule), dict(schedule.inputs)
    outs: dict[Node, Out] = {}
    outputs = []
    for slot, value in schedule.outputs:
        if value.op == "clamp" and slot in slots and _only_moves(value.args[0], slots[slot].name):
            value = value.args[0]
        if value.type == REAL and value.op != "load":
            out = outs.setdefault(value, Out(namer.var(REAL), value))
            value = load(schedule.graph, out.var)
        outputs.append((slot, value))
    end = (Compute(tuple(outs.values())),) if outs else ()
    return drop_unread(replace(schedule, body=(*schedule.body, *end), outputs=tuple(outputs)))


def _only_moves(value: Node, slot: str) -> bool:
    """True if a float is zero or a slot's value from another cell, after several movements: it is within its bounds.

    After one movement, `narrow` limits the loop to rows in which something moves.
    """
    stack, again = [value], False
    for node in taken(stack):
        match node.op:
            case "select":
                stack += node.args[1:]
            case "shift":
                again |= node.args[0].op != "load"
                stack += node.args
            case "const" if not node.attr:
                pass
            case "load" if node.attr == slot:
                pass
            case _:
                return False
    return again


def shift_choices(schedule: Schedule) -> Schedule:
    """Replace a choice between constants at a neighbor by a choice on the neighbor's flag, so that no field is stored.

    `(m ? 22 : 2)[0,1]` → `m[0,1] ? 22 : 2`, where edges wrap.
    """

    def rule(node: Node) -> Node | None:
        at_neighbor = node.op == "shift" and node.type == REAL and node.attr[2]
        return _at_neighbor(node.args[0], node.attr, schedule.graph) if at_neighbor else None

    return map_values(schedule, rule)


def _at_neighbor(value: Node, where: tuple[int, int, bool], graph: Graph) -> Node | None:
    """A float at a neighbor, if it is a constant or a choice between such floats, up to its sign."""
    if value.op == "const":
        return value
    if value.op not in ("neg", "select") or value.args[0].op in ("param", "const"):
        return None
    args = []
    for arg in value.args:
        flag = arg.type == FLAG
        new = graph.node("shift", FLAG, (arg,), where) if flag else _at_neighbor(arg, where, graph)
        if new is None:
            return None
        args.append(new)
    return graph.node(value.op, REAL, tuple(args))


def lead_comparisons(schedule: Schedule) -> Schedule:
    """Compute comparisons that matter only where another comparison holds only there.

    `w & (a | b)` → `w & (led(w, a) | led(w, b))`: every path from a value to `a` goes through a conjunction with `w`.
    Draws as floats are costly, so their comparisons follow the condition of a choice, too: `c ? (draw < x ? 1 : 2) : 3`
    → `c ? (led(c, draw < x) ? 1 : 2) : 3`.
    """
    roots = schedule.values
    comparisons = {node: number for number, node in enumerate(filter(is_comparison, ordered(roots)))}
    choices, conjunctions = on_all_paths(roots, _choices), on_all_paths(roots, _conjunctions)
    leaders: dict[Node, Node] = {}
    for node in filter(_is_drawn, comparisons):
        free = (flag for flag in choices[node] if flag.op != "param" and not _is_drawn(flag))
        if leader := next(free, None):
            leaders[node] = leader
    # A comparison with a leader leads no other: chains of leaders would be tested one by one.
    leading = set(ordered(leaders.values()))
    for node in comparisons:
        for leader in sorted(conjunctions[node], key=comparisons.__getitem__):
            fixed = leader in leaders or node in leaders or node in leading
            if not fixed and leader.args != node.args:
                leaders[node] = leader
                leading.add(leader)

    def rule(node: Node) -> Node | None:
        leader = leaders.get(node)
        return schedule.graph.node("led", FLAG, (leader, node)) if leader is not None else None

    return map_values(schedule, rule) if leaders else schedule


def _is_drawn(node: Node) -> bool:
    return any(part.op == "draw" for part in ordered([node]))


def _choices(node: Node, facts: Facts) -> Iterator[tuple[Node, Facts]]:
    """The arguments of a node, with the conditions of choices on the path; a neighbor does not inherit them."""
    here = {} if node.op in AT_NEIGHBORS else facts
    for number, arg in enumerate(node.args):
        yield arg, here | {node.args[0]: None} if node.op == "select" and number == 1 else here


def _conjunctions(node: Node, facts: Facts) -> Iterator[tuple[Node, Facts]]:
    """The conjuncts or arguments of a node, each with the comparisons that a conjunction joins with it."""
    here = {} if node.op in AT_NEIGHBORS else facts
    parts = conjuncts(node) if node.op == "and" else node.args
    joined = dict.fromkeys(filter(is_comparison, parts)) if node.op == "and" else {}
    for part in parts:
        yield part, here | {other: None for other in joined if other is not part}


def match_slot_choices(value: Node, names: Container[str]) -> tuple[Node, list[Node]] | None:
    """Match choices on a clamped slot: its old value, and the masks without which it keeps that value."""
    if value.op not in ("clamp", "select"):
        return None
    chain, node = choices(value.args[0] if value.op == "clamp" else value)
    masks = [choice.args[0] for choice in chain]
    matches = node.op == "load" and node.attr in names and all(mask.op != "param" for mask in masks)
    return (node, masks) if matches else None


def is_comparison(node: Node) -> bool:
    return node.op in COMPARISONS and node.args[0].type == REAL


def of_floats(node: Node) -> bool:
    """True if a node needs a loop over cells: floats, and flags that compare them."""
    return node.type == REAL or node.op == "led" or is_comparison(node)
