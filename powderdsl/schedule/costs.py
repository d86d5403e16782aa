"""The costs of storing a value and of recomputing it at a neighbor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from powderdsl.ir.ops import Node, Offset
from powderdsl.schedule.floats import of_floats

FAR = 100
"""The cost of a value that cannot be recomputed."""

UNIFORM = ("const", "param", "coordinate", "inside")
LOGIC = ("not", "and", "or", "xor", "select", "when")
ARITHMETIC = ("add", "sub", "mul", "neg")

Have = Callable[[Node], bool]


@dataclass(frozen=True)
class Costs:
    """Limits of recomputation on a target: `gates` for a flag, summed over all neighbors that read it; operations
    (`floats`) for a float."""

    gates: int
    floats: int


def sources_of(node: Node) -> list[tuple[Node, Offset]]:
    """The nodes that a node reads at neighbors, with the offsets."""
    if node.op == "shift":
        return [(node.args[0], node.attr[:2])]
    if node.op in ("swap", "arrive"):
        (dy, dx), (content, movers, _) = node.attr, node.args
        back = [(content, (-dy, -dx)), (movers, (-dy, -dx))]
        return [*back, (content, (dy, dx))] if node.op == "swap" else back
    return []


def movable(node: Node, have: Have, most: int) -> bool:
    """Whether a flag can be recomputed at a neighbor with at most `most` gates."""
    seen: set[tuple[int, Offset]] = set()
    stack = [(node, (0, 0))]
    while stack:
        top, (dy, dx) = stack.pop()
        if (id(top), (dy, dx)) in seen or is_constant(top):
            continue
        seen.add((id(top), (dy, dx)))
        if len(seen) > most:
            return False
        if have(top):
            continue
        if top.op == "shift" and top.attr[2]:
            stack.append((top.args[0], (dy + top.attr[0], dx + top.attr[1])))
        elif top.op in LOGIC and not of_floats(top):
            stack.extend((arg, (dy, dx)) for arg in top.args)
        else:
            return False
    return True


def is_constant(node: Node) -> bool:
    """Whether a value is the same in all cells of a world."""
    return node.op in ("const", "param") or (node.op == "coordinate" and node.attr[0] == "step")


def float_cost(node: Node, have: Have) -> int:
    """The number of operations that recompute a float at a neighbor; FAR if that is impossible."""
    if have(node) or node.op in ("const", "param"):
        return 0
    if node.op in ARITHMETIC:
        total = 1
        for arg in node.args:
            total += float_cost(arg, have)
            if total >= FAR:  # graphs share nodes: counting all paths would take forever
                return FAR
        return total
    return float_cost(node.args[0], have) if node.op == "shift" and node.attr[2] else FAR


def stored_parts(source: Node, have: Have, most: int) -> list[Node]:
    """The nodes to store so that a float can be recomputed at a neighbor: itself, or its costly parts."""
    if float_cost(source, have) <= most:
        return []
    if source.op in ARITHMETIC:
        parts = [part for arg in source.args for part in stored_parts(arg, have, most)]
        ids = {id(part) for part in parts}
        if float_cost(source, lambda node: have(node) or id(node) in ids) <= most:
            return parts
    return [source]
