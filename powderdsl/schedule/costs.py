"""What values cost, and draws: where the result of each matters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from powderdsl.ir.ops import FLAG, Graph, Node, Offset, ordered
from powderdsl.schedule.floats import of_floats
from powderdsl.schedule.rewrite import map_values
from powderdsl.schedule.types import Compute, Schedule, combined, map_computes, with_args

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


FEW_BITS = 2
"""Draws of at most this many bits are made unconditionally."""

MAX_CONDITIONS = 8
"""The largest number of flags in the condition of a draw."""

DRAWS = ("chance", "below_planes", "below_param")
_POINTWISE = ("and", "or", "xor", "not", "select")


def thresholds(schedule: Schedule) -> Schedule:
    """A draw below all planes of one parameter becomes a draw below the parameter, usually one number for all worlds.

    `below_planes(p:16, p:15, …, p:0)` → `below_param(p)`.
    """

    def rule(node: Node) -> Node | None:
        if node.op != "below_planes" or node.args[0].op != "param":
            return None
        (stream, bits), (name, view, _) = node.attr, node.args[0].attr
        if [arg.attr for arg in node.args] != [(name, view, i) for i in range(bits, -1, -1)]:
            return None
        return schedule.graph.node("below_param", FLAG, (), (stream, bits, name, view), node.places)

    return map_values(schedule, rule)


def conditions(schedule: Schedule) -> Schedule:
    """Draws get a last argument: the condition under which their result is read. Elsewhere the result is undefined.

    `busy & chance(s)` → `busy & chance(s, busy)`; `busy ? chance(s) : a` → `busy ? chance(s, busy) : a`.
    """
    return map_computes(schedule, lambda statement: [_with_conditions(statement, schedule.graph)])


def _with_conditions(statement: Compute, graph: Graph) -> Compute:
    roots = [out.value for out in statement.outs]
    nodes = ordered(roots)
    random: dict[int, bool] = {}
    for node in nodes:
        random[id(node)] = takes_bits(node) or any(random[id(arg)] for arg in node.args)
    if not any(random.values()):
        return statement
    fixed = set(map(id, roots))
    where: dict[int, dict[int, Node]] = {}
    for node in reversed(nodes):
        own = {} if id(node) in fixed else where.get(id(node), {})
        for arg in node.args:
            if random[id(arg)]:
                flags = dict(own) if node.op in _POINTWISE else {}
                for other in node.args:
                    if node.op == "and" and not random[id(other)] and len(flags) < MAX_CONDITIONS:
                        flags[id(other)] = other
                if node.op == "select" and not random[id(node.args[0])] and len(flags) < MAX_CONDITIONS:
                    chosen = _chosen(node, arg, graph)
                    flags[id(chosen)] = chosen
                known = where.get(id(arg), flags)
                where[id(arg)] = {key: flag for key, flag in known.items() if key in flags}
    done: dict[int, Node] = {}
    for node in nodes:
        args = [done[id(arg)] for arg in node.args]
        flags = {} if id(node) in fixed else where.get(id(node), {})  # a variable's value is read everywhere
        asked = list(flags.values())
        if node.op in DRAWS and takes_bits(node) and asked:
            args.append(combined("and", asked, graph))
        done[id(node)] = with_args(node, tuple(args), graph)
    return replace(statement, outs=tuple(replace(out, value=done[id(out.value)]) for out in statement.outs))


def _chosen(node: Node, arg: Node, graph: Graph) -> Node:
    """Where a choice reads one of its two values: its condition or the opposite; everywhere, if both are that value."""
    condition, yes, no = node.args
    if yes is no:
        return graph.node("const", FLAG, (), True)
    return condition if arg is yes else graph.node("not", FLAG, (condition,))


def asked_for(draw: Node, where: Node, graph: Graph) -> Node:
    """The same draw under another condition."""
    count = draw.attr[1] + 1 if draw.op == "below_planes" else 0
    return graph.node(draw.op, FLAG, (*draw.args[:count], where), draw.attr, draw.places)


def is_coin(node: Node) -> bool:
    """Whether a node is a draw that its highest bit decides."""
    return node.op == "chance" and node.attr[2] == 1 << node.attr[1] - 1


def takes_bits(node: Node) -> bool:
    """Whether a node is a draw of more than FEW_BITS random bits."""
    if node.op == "chance":
        _, bits, limit = node.attr
        return bits - ((limit & -limit).bit_length() - 1) > FEW_BITS
    return node.op in ("below_planes", "below_param", "draw")
