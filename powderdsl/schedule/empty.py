"""Skips loops over words whose values are all zero because the planes that they depend on are empty."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from powderdsl.ir.ops import FLAG, Graph, Node, ordered
from powderdsl.schedule.types import (
    ANSWER,
    Compute,
    Schedule,
    Statement,
    combined,
    conjuncts,
    in_order,
    map_computes,
)

MAX_CONDITIONS = 4
"""More sets of planes than this are not worth testing."""


def empty(schedule: Schedule) -> Schedule:
    """Loops over words get a condition without which all their values are 0; operations on whole planes stand alone.

    `m = a & (b | c[0,1])` → when `any a`; `n = a | b` needs no loop, since it tests its planes itself.
    """
    graph = schedule.graph

    def change(loop: Compute) -> list[Statement]:
        if loop.over != "words" or loop.region is not None:
            return [loop]
        whole = [out for out in loop.outs if is_whole(out.value)]
        rest = tuple(out for out in loop.outs if not is_whole(out.value))
        alone = [replace(loop, outs=(out,), when=None) for out in whole]
        return [*alone, _asked(replace(loop, outs=rest), graph)] if rest else [*alone]

    return map_computes(schedule, change)


def is_whole(value: Node) -> bool:
    """Whether a value is one operation on whole planes: `a`, `0`, `a[dy,dx]`, `a & ~b`, `a | b`."""
    args = value.args
    match value.op:
        case "load":
            return True
        case "const":
            return not value.attr
        case "shift":
            return args[0].op == "load" and value.attr[2]
        case "or":
            return all(arg.op == "load" for arg in args)
        case "and":
            gone = [arg for arg in args if arg.op == "not" and arg.args[0].op == "load"]
            return len(gone) == 1 and any(arg.op == "load" for arg in args)
    return False


def _asked(loop: Compute, graph: Graph) -> Compute:
    memo: dict[int, frozenset[str] | None] = {}
    loads = {str(node.attr): node for node in ordered(out.value for out in loop.outs) if node.op == "load"}
    ways: list[list[frozenset[str]]] = []
    for out in loop.outs:
        conditions = _conditions(out.value, memo)
        if not conditions:
            return loop
        if not any(set(way) <= set(conditions) for way in ways):
            ways = [*(way for way in ways if not set(conditions) < set(way)), conditions]
    found = [combined("and", [_any(names, loads, graph) for names in way], graph) for way in ways]
    asked = combined("or", found, graph)
    return replace(loop, when=asked if loop.when is None else combined("and", [loop.when, asked], graph))


def _conditions(value: Node, memo: dict[int, frozenset[str] | None]) -> list[frozenset[str]]:
    """Sets of planes; of each set one plane must be non-empty for the value to hold anywhere."""
    parts = [value.args[0], *conjuncts(value.args[1])] if value.op == "when" else conjuncts(value)
    found = dict.fromkeys(names for part in parts if (names := holders(part, memo)) is not None)
    return sorted(found, key=len)[:MAX_CONDITIONS]


def _any(names: Iterable[str], loads: dict[str, Node], graph: Graph) -> Node:
    found = [graph.node("any", ANSWER, (loads[name],)) for name in in_order(names)]
    return combined("or", found, graph) if found else graph.node("const", ANSWER, (), False)


def holders(node: Node, memo: dict[int, frozenset[str] | None]) -> frozenset[str] | None:
    """Planes such that the flag holds nowhere if all of them are empty; None if none are known."""
    for inner in ordered([node]):
        if id(inner) not in memo and inner.type == FLAG:
            memo[id(inner)] = _holders(inner, memo)
    return memo[id(node)]


def _holders(node: Node, memo: dict[int, frozenset[str] | None]) -> frozenset[str] | None:
    match node.op:
        case "load":
            return frozenset({str(node.attr)})
        case "const":
            return None if node.attr else frozenset()
        case "shift":
            return memo[id(node.args[0])]
        case "and" | "when":
            found = [names for arg in node.args if (names := memo[id(arg)]) is not None]
            return min(found, key=lambda names: (len(names), sorted(names)), default=None)
        case "or" | "xor" | "select":
            parts = [memo[id(arg)] for arg in node.args[node.op == "select" :]]
            known = [part for part in parts if part is not None]
            return frozenset[str]().union(*known) if len(known) == len(parts) else None
    return None
