"""What storing a value costs against computing it again at a neighbor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from powderdsl.ir.ops import Node, Offset
from powderdsl.schedule.floats import of_floats

FAR = 100
"""The cost of what cannot be computed again."""

UNIFORM = ("const", "param", "coordinate", "inside")
LOGIC = ("not", "and", "or", "xor", "select", "when")
ARITHMETIC = ("add", "sub", "mul", "neg")

Have = Callable[[Node], bool]


@dataclass(frozen=True)
class Costs:
    """What storing costs a target. `gates`: summed over all neighbors that ask, up to which a flag is computed again;
    `floats`: operations up to which a float is."""

    gates: int
    floats: int


def sources_of(node: Node) -> list[tuple[Node, Offset]]:
    """What a node asks for at neighbors, and where."""
    if node.op == "shift":
        return [(node.args[0], node.attr[:2])]
    if node.op in ("swap", "arrive"):
        (dy, dx), (content, movers, _) = node.attr, node.args
        back = [(content, (-dy, -dx)), (movers, (-dy, -dx))]
        return [*back, (content, (dy, dx))] if node.op == "swap" else back
    return []


def movable(node: Node, have: Have, most: int) -> bool:
    """Whether a flag can be computed at a neighbor with at most so many gates."""
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
    """Operations that computing a float at a neighbor takes; FAR if it cannot be done there."""
    if have(node) or node.op in ("const", "param"):
        return 0
    if node.op in ARITHMETIC:
        total = 1
        for arg in node.args:
            total += float_cost(arg, have)
            if total >= FAR:  # graphs share nodes: counting on would take forever
                return FAR
        return total
    return float_cost(node.args[0], have) if node.op == "shift" and node.attr[2] else FAR


def stored_parts(source: Node, have: Have, most: int) -> list[Node]:
    """What must be stored so that a float can be computed at a neighbor: itself, or the costly things in it."""
    if float_cost(source, have) <= most:
        return []
    if source.op in ARITHMETIC:
        parts = [part for arg in source.args for part in stored_parts(arg, have, most)]
        ids = {id(part) for part in parts}
        if float_cost(source, lambda node: have(node) or id(node) in ids) <= most:
            return parts
    return [source]
