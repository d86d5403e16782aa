"""Floats on targets with loops: computed where they are used; comparisons only where another one holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from powderdsl.ir.ops import FLAG, REAL, Graph, Node, ordered
from powderdsl.schedule.rewrite import Rule, map_values, with_values
from powderdsl.schedule.types import (
    Compute,
    Guard,
    Namer,
    Out,
    Schedule,
    Statement,
    conjuncts,
    flat,
    load,
    rewritten,
)

COMPARISONS = ("eq", "lt", "le")
AT_NEIGHBORS = ("shift", "swap", "arrive")


def late(schedule: Schedule) -> Schedule:
    """Floats that substeps write are not stored: their users compute them from the pass's inputs and the masks.

    Where a guard's masks fail, the choices in the value give the old one, so the value is right outside the guard too.
    What only moves, more than once, needs not be clamped again.
    `if any m: v2 = select(m, a, v1); … v3 = select(n, b, v2)` → `v3 = select(n, b, select(m, a, v1))`.
    """
    graph = schedule.graph
    known: dict[str, Node] = {}

    def rule(node: Node) -> Node | None:
        return known.get(node.attr) if node.op == "load" else None

    def block(body: tuple[Statement, ...]) -> tuple[Statement, ...]:
        result: list[Statement] = []
        for given in body:
            statement = with_values(given, graph, rule) if known else given
            match statement:
                case Compute(outs):
                    known.update({out.var.name: out.value for out in outs if out.var.type == REAL})
                    outs = tuple(out for out in outs if out.var.type != REAL)
                    if outs:
                        result.append(replace(statement, outs=outs))
                case Guard(_, inner, keeps):
                    inner = block(inner)
                    keeps = tuple(keep for keep in keeps if keep[0].type != REAL)
                    if inner:
                        result.append(replace(statement, body=inner, keeps=keeps))
        return tuple(result)

    body = block(schedule.body)
    namer = Namer(schedule)
    outs: dict[int, Out] = {}
    leaves = []
    found = dict(schedule.finds)
    for slot, node in schedule.leaves:
        value = rewritten([node], graph, rule)[id(node)]
        if value.op == "settle" and slot in found and _only_moves(value.args[0], found[slot].name):
            value = value.args[0]
        if value.type == REAL and value.op != "load":
            out = outs.setdefault(id(value), Out(namer.var(REAL), value))
            value = load(graph, out.var)
        leaves.append((slot, value))
    end = (Compute(tuple(outs.values())),) if outs else ()
    return replace(schedule, body=(*body, *end), leaves=tuple(leaves))


def _only_moves(value: Node, slot: str) -> bool:
    """Whether a float is zero or a slot's value from another cell, after several movements: it is within its bounds already.

    After one movement, `narrow` limits the loop to rows in which something moves.
    """
    stack, seen = [value], set[int]()
    again = False
    while stack:
        node = stack.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
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


def chosen(schedule: Schedule) -> Schedule:
    """A choice between constants at a neighbor asks for the neighbor's flag, so that it is not stored as a field.

    `(m ? 22 : 2)[0,1]` → `m[0,1] ? 22 : 2`, where edges wrap.
    """
    graph = schedule.graph

    def rule(node: Node) -> Node | None:
        at_neighbor = node.op == "shift" and node.type == REAL and node.attr[2]
        return _at_neighbor(node.args[0], node.attr, graph) if at_neighbor else None

    return map_values(schedule, rule)


def _at_neighbor(value: Node, where: tuple[int, int, bool], graph: Graph) -> Node | None:
    """A float at a neighbor, if it is a constant or a choice between such floats, up to its sign."""
    match value.op:
        case "const":
            return value
        case "neg":
            args = [_at_neighbor(value.args[0], where, graph)]
        case "select" if value.args[0].op not in ("param", "const"):
            flag = graph.node("shift", FLAG, (value.args[0],), where)
            args = [flag, *(_at_neighbor(arg, where, graph) for arg in value.args[1:])]
        case _:
            return None
    found = tuple(arg for arg in args if arg is not None)
    return graph.node(value.op, REAL, found) if len(found) == len(args) else None


def led(schedule: Schedule) -> Schedule:
    """A comparison that matters only where another one holds is computed only there.

    `w & (a | b)` → `w & (led(w, a) | led(w, b))`: every path from a value to `a` goes through a conjunction with `w`.
    Draws as floats are costly, so their comparisons follow the condition of a choice, too: `c ? (draw < x ? 1 : 2) : 3`
    → `c ? (led(c, draw < x) ? 1 : 2) : 3`.
    """
    roots = [node for statement in flat(schedule.body) for node in statement.values()]
    comparisons = [node for node in ordered(roots) if is_comparison(node)]
    conjoined = _conjoined(roots, comparisons)
    leaders = _conditions(roots, [node for node in comparisons if _is_drawn(node)])
    leading = {id(part) for leader in leaders.values() for part in ordered([leader])}
    for node in comparisons:
        for number in _bits(conjoined[id(node)]):
            leader = comparisons[number]
            free = id(leader) not in leaders and id(node) not in leaders and id(node) not in leading
            if free and leader.args != node.args:
                leaders[id(node)] = leader
                leading.add(id(leader))
                break
    return map_values(schedule, _rule(leaders, schedule.graph)) if leaders else schedule


def _is_drawn(node: Node) -> bool:
    return any(part.op == "draw" for part in ordered([node]))


def _conditions(roots: list[Node], comparisons: list[Node]) -> dict[int, Node]:
    """By id of a comparison: the condition of a choice that all paths to it take, if one does not depend on draws."""
    found: dict[int, dict[int, Node]] = {id(root): {} for root in roots}
    for node in reversed(ordered(roots)):  # users first
        above = found[id(node)]
        for number, arg in enumerate(node.args):
            paths = {} if node.op in AT_NEIGHBORS else above
            if node.op == "select" and number == 1:
                paths = {**above, id(node.args[0]): node.args[0]}
            known = found.get(id(arg), paths)
            found[id(arg)] = {key: one for key, one in known.items() if key in paths}
    leaders: dict[int, Node] = {}
    for node in comparisons:
        free = [one for one in found[id(node)].values() if one.op != "param" and not _is_drawn(one)]
        if free:
            leaders[id(node)] = free[0]
    return leaders


def _rule(leaders: dict[int, Node], graph: Graph) -> Rule:
    def rule(node: Node) -> Node | None:
        leader = leaders.get(id(node))
        return graph.node("led", FLAG, (leader, node)) if leader is not None else None

    return rule


def is_comparison(node: Node) -> bool:
    """Whether a flag compares floats."""
    return node.op in COMPARISONS and node.args[0].type == REAL


def of_floats(node: Node) -> bool:
    """Whether a node needs a loop over cells: floats, and flags that compare them."""
    return node.type == REAL or node.op == "led" or is_comparison(node)


def _conjoined(roots: list[Node], comparisons: list[Node]) -> dict[int, int]:
    """For each node, by id, the comparisons that every path from a root to it goes through a conjunction with, as bits.

    From a conjunction, paths lead to its conjuncts at once. The path to a conjunct is not one with itself. What holds in
    a cell need not hold at the neighbors that it reads.
    """
    bit = {id(node): 1 << number for number, node in enumerate(comparisons)}
    found: dict[int, int] = {id(root): 0 for root in roots}
    for node in reversed(ordered(roots)):  # users first
        if id(node) not in found:
            continue  # a conjunction inside others
        below = conjuncts(node) if node.op == "and" else node.args
        others = sum(bit.get(id(part), 0) for part in below) if node.op == "and" else 0
        for part in below:
            paths = 0 if node.op in AT_NEIGHBORS else found[id(node)] | (others & ~bit.get(id(part), 0))
            found[id(part)] = found.get(id(part), paths) & paths
    return found


def _bits(number: int) -> Iterator[int]:
    """The places of the bits of a number that are set, lowest first."""
    while number:
        lowest = number & -number
        yield lowest.bit_length() - 1
        number ^= lowest
