"""The cost of recomputing values, and the conditions of draws."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

from powderdsl.ir.ops import FLAG, Graph, Node, Offset, ordered, taken
from powderdsl.schedule.floats import of_floats
from powderdsl.schedule.types import (
    Compute,
    Facts,
    Schedule,
    Statement,
    combined,
    is_movement,
    map_each,
    map_values,
    on_all_paths,
    rewritten,
)

FAR = 100
"""The cost of a value that cannot be recomputed."""

UNIFORM = ("const", "param", "coordinate", "inside")
LOGIC = ("not", "and", "or", "xor", "select", "when")
ARITHMETIC = ("add", "sub", "mul", "neg")

IsStored = Callable[[Node], bool]


@dataclass(frozen=True)
class Costs:
    """Limits of recomputation on a target: gates for a flag, summed over its readers, and operations for a float."""

    gates: int
    floats: int
    by_rows: bool = False
    """True if the target processes whole planes row by row, and tracks which of them are empty."""


def sources_of(node: Node) -> list[tuple[Node, Offset]]:
    """The nodes that a node reads at neighbors, with the offsets."""
    if node.op == "shift":
        return [(node.args[0], node.attr[:2])]
    if node.op in ("swap", "arrive"):
        (dy, dx), (content, movers, _) = node.attr, node.args
        back = [(content, (-dy, -dx)), (movers, (-dy, -dx))]
        return [*back, (content, (dy, dx))] if node.op == "swap" else back
    return []


def is_recomputable(node: Node, is_stored: IsStored, most: int) -> bool:
    """True if a flag can be recomputed at a neighbor with at most `most` gates."""
    stack = [(node, 0, 0)]
    for top, dy, dx in taken(stack):
        if is_constant(top):
            continue
        most -= 1
        shifted, plain = top.op == "shift" and top.attr[2], top.op in LOGIC and not of_floats(top)
        if most < 0 or not (is_stored(top) or shifted or plain):
            return False
        if not is_stored(top):
            y, x = top.attr[:2] if shifted else (0, 0)
            stack += [(arg, dy + y, dx + x) for arg in top.args]
    return True


def is_constant(node: Node) -> bool:
    """True if a value is the same in all cells of a world."""
    return node.op in ("const", "param") or (node.op == "coordinate" and node.attr[0] == "step")


def gate_cost(node: Node, is_stored: IsStored, limit: int) -> int:
    """The number of gates that recompute a flag in another row, at most `limit`; `limit` if that is impossible."""
    if is_stored(node) or is_constant(node):
        return 0
    if node.op in (*UNIFORM, *DRAWS) or is_movement(node) or of_floats(node):
        return limit
    if node.op == "shift":
        _, dx, wraps = node.attr
        return gate_cost(node.args[0], is_stored, limit) if wraps and not dx else limit
    total = 2 if node.op == "select" else 1
    for arg in node.args:
        total += gate_cost(arg, is_stored, limit)
        if total >= limit:
            return limit
    return total


def float_cost(node: Node, is_stored: IsStored) -> int:
    """The number of operations that recompute a float at a neighbor; FAR if that is impossible."""
    if is_stored(node) or node.op in ("const", "param"):
        return 0
    if node.op in ARITHMETIC:
        total = 1
        for arg in node.args:
            total += float_cost(arg, is_stored)
            if total >= FAR:  # graphs share nodes: counting all paths would take forever
                return FAR
        return total
    return float_cost(node.args[0], is_stored) if node.op == "shift" and node.attr[2] else FAR


def stored_parts(source: Node, is_stored: IsStored, most: int) -> tuple[Node, ...]:
    """The nodes to store so that a float can be recomputed at a neighbor: the float, or its costly parts."""

    @cache  # graphs share nodes: following all paths would take forever
    def parts_of(node: Node) -> tuple[Node, ...]:
        if float_cost(node, is_stored) <= most:
            return ()
        if node.op in ARITHMETIC:
            parts = tuple(dict.fromkeys(part for arg in node.args for part in parts_of(arg)))
            if float_cost(node, lambda inner: is_stored(inner) or inner in parts) <= most:
                return parts
        return (node,)

    return parts_of(source)


FEW_BITS = 2
"""Draws of at most this many bits are made unconditionally."""

MAX_CONDITIONS = 8
"""The largest number of flags in the condition of a draw."""

DRAWS = ("chance", "below_planes", "below_param")
_POINTWISE = ("and", "or", "xor", "not", "select")


def compare_parameters(schedule: Schedule) -> Schedule:
    """Replace draws below all planes of one parameter by draws below the parameter, usually one number for all worlds.

    `below_planes(p:16, p:15, …, p:0)` → `below_param(p)`.
    """

    def rule(node: Node) -> Node | None:
        if node.op != "below_planes" or node.args[0].op != "param":
            return None
        (stream, bits), (name, view, _) = node.attr, node.args[0].attr
        if [arg.attr for arg in node.args] != [(name, view, i) for i in range(bits, -1, -1)]:
            return None
        return schedule.graph.node("below_param", FLAG, (), (stream, bits, name, view))

    return map_values(schedule, rule)


def condition_draws(schedule: Schedule) -> Schedule:
    """Add a last argument to draws: the condition under which their result is read. Elsewhere the result is undefined.

    `busy & chance(s)` → `busy & chance(s, busy)`; `busy ? chance(s) : a` → `busy ? chance(s, busy) : a`.
    """
    graph = schedule.graph

    def change(statement: Compute) -> list[Statement]:
        roots = statement.results
        random: set[Node] = set()
        for node in ordered(roots):
            if takes_bits(node) or not random.isdisjoint(node.args):
                random.add(node)

        def below(node: Node, facts: Facts) -> Iterator[tuple[Node, Facts]]:
            """The random arguments of a node, each with the flags that hold where the node reads it."""
            for arg in node.args:
                if arg in random:
                    flags = facts if node.op in _POINTWISE else {}
                    others = [other for other in node.args if other not in random] if node.op == "and" else []
                    if node.op == "select" and node.args[0] not in random:
                        others = [_choice_condition(node, arg, graph)]
                    yield arg, flags | dict.fromkeys(others[: MAX_CONDITIONS - len(flags)])

        where = on_all_paths(roots, below)  # a variable's value is read everywhere

        def rule(node: Node) -> Node | None:
            facts = where.get(node) if node.op in DRAWS else None
            args = (*node.args, combined("and", facts or (), graph))
            return graph.node(node.op, FLAG, args, node.attr) if facts else None

        return [statement.with_values(rewritten(statement.values, graph, rule))]

    return map_each(schedule, Compute, change)


def _choice_condition(node: Node, arg: Node, graph: Graph) -> Node:
    """The flag under which a choice reads `arg`: its condition or the opposite, or true if both values are `arg`."""
    condition, yes, no = node.args
    if yes is no:
        return graph.flag(True)
    return condition if arg is yes else graph.node("not", FLAG, (condition,))


def draw_under(draw: Node, condition: Node, graph: Graph) -> Node:
    count = draw.attr[1] + 1 if draw.op == "below_planes" else 0
    return graph.node(draw.op, FLAG, (*draw.args[:count], condition), draw.attr)


def is_coin(node: Node) -> bool:
    """True if a node is a draw that its highest bit decides."""
    return node.op == "chance" and node.attr[2] == 1 << node.attr[1] - 1


def takes_bits(node: Node) -> bool:
    """True if a node is a draw of more than FEW_BITS random bits."""
    if node.op == "chance":
        _, bits, limit = node.attr
        return bits - ((limit & -limit).bit_length() - 1) > FEW_BITS
    return node.op in ("below_planes", "below_param", "draw")
