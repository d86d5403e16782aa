"""Planes that change only where one of a few masks holds: words elsewhere are not touched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from powderdsl.ir.ops import FLAG, Graph, Node, ordered
from powderdsl.schedule.release import made_in, reads
from powderdsl.schedule.types import (
    Compute,
    Guard,
    Out,
    Schedule,
    Statement,
    combined,
    loaded,
    map_blocks,
    read_elsewhere,
    rewritten,
)

IN_A_WORD = ("and", "or", "xor", "not", "select", "load", "const", "param", "coordinate", "inside")
"""Operations that read the word itself."""


def updates(schedule: Schedule) -> Schedule:
    """Planes that a guard's masks change leave the guard: a loop over the words where a mask holds tests for that itself.

    Outside the guard, `release` finds out that most old planes end there, so that the words are changed in place.
    `if any m: b = a & ~m, else b = a` → `loop words over m: b = a & ~m, else a`.
    """
    graph = schedule.graph

    def change(block: tuple[Statement, ...]) -> tuple[Statement, ...]:
        return tuple(
            new for one in block for new in (_taken_out(one, graph) if isinstance(one, Guard) else [one])
        )

    return replace(schedule, body=map_blocks(schedule.body, change))


def _taken_out(guard: Guard, graph: Graph, *, near: bool = True) -> list[Statement]:
    """The loops that leave a guard, and what remains of it. `near`: also loops that read other planes at neighbors."""
    if not all(node.op == "load" for node in guard.when) or guard.otherwise:
        return [guard]
    masks = {str(node.attr) for node in guard.when}
    inside, olds = made_in(guard.body), {var.name: value for var, value in guard.keeps}
    body: list[Statement] = []
    found: tuple[list[Out], list[Out]] = [], []  # those that read neighbors come first, before these change
    for statement in guard.body:
        if not isinstance(statement, Compute) or statement.over != "words" or statement.when is not None:
            body.append(statement)
            continue
        rest = []
        for out in statement.outs:
            old = olds.get(out.var.name)
            elsewhere = read_elsewhere([out.value])
            if (
                old is None
                or (elsewhere and not near)
                or inside & set(loaded([out.value]))
                or not _is_update(out.value, masks, old, graph)
            ):
                rest.append(out)
            else:
                found[not elsewhere].append(replace(out, otherwise=old))
        if rest:
            body += _partly(replace(statement, outs=tuple(rest)), guard.when, graph)
    elsewhere = read_elsewhere(out.value for out in found[0])
    if any(out.otherwise is not None and out.otherwise.attr in elsewhere for out in found[0]):
        return _taken_out(guard, graph, near=False)  # in place, such a loop would read what it has changed
    if not found[0] and not found[1]:
        return [replace(guard, body=tuple(body))]
    region = combined("or", guard.when, graph)
    loops = [Compute(tuple(outs), guard.place, "words", region) for outs in found if outs]
    names = {out.var.name for outs in found for out in outs}
    keeps = tuple((var, value) for var, value in guard.keeps if var.name not in names)
    if not body:
        return [*loops]
    left = replace(guard, body=tuple(body), keeps=keeps)
    first = any(names & reads(statement) for statement in body)
    return [*loops, left] if first else [left, *loops]


def _partly(loop: Compute, when: Sequence[Node], graph: Graph) -> list[Compute]:
    """A loop in a guard, of which values that are those of another plane where no mask holds are computed only elsewhere.

    `if any m: loop words: b = m ? a[0,1] : a` → `if any m: loop words over m: b = m ? a[0,1] : a, else a`.
    """
    masks = {str(node.attr) for node in when}
    outs: tuple[list[Out], list[Out]] = [], []
    for out in loop.outs:
        stays = without(out.value, masks, graph) if out.value.op != "load" else None
        partly = stays is not None and _is_update(out.value, masks, stays, graph)
        outs[partly].append(replace(out, otherwise=stays) if partly else out)
    region = combined("or", when, graph)
    parts = [replace(loop, outs=tuple(outs[0])), replace(loop, outs=tuple(outs[1]), region=region)]
    return [part for part in parts if part.outs]


def _is_update(value: Node, masks: set[str], old: Node, graph: Graph) -> bool:
    """Whether a flag is computed from stored planes, and is the old one where no mask holds."""
    if value.type != FLAG or old.op != "load" or old.attr in masks:
        return False
    for node in ordered([value]):
        at_neighbor = node.op == "shift" and node.args[0].op == "load" and node.attr[2]
        if node.op not in IN_A_WORD and not at_neighbor:
            return False
    return without(value, masks, graph) is old


def is_cleared(out: Out, graph: Graph) -> bool:
    """Whether an updated plane can only lose flags."""
    assert out.otherwise is not None
    value = without(out.value, {str(out.otherwise.attr)}, graph)
    return value.op == "const" and not value.attr


def without(value: Node, planes: set[str], graph: Graph) -> Node:
    """A flag where some planes are zero."""

    def rule(node: Node) -> Node | None:
        if node.op == "load" and node.attr in planes:
            return graph.node("const", FLAG, (), False)
        return _folded(node, node.args, graph)

    return rewritten([value], graph, rule)[id(value)]


def _folded(node: Node, args: Sequence[Node], graph: Graph) -> Node | None:
    """A simpler node, if some arguments are constants."""
    known = [bool(arg.attr) if arg.op == "const" else None for arg in args]
    match node.op:
        case "and" | "or":
            ends = node.op == "or"
            if ends in known:
                return graph.node("const", FLAG, (), ends)
            rest = [arg for arg, value in zip(args, known, strict=True) if value is None]
            if len(rest) < 2:
                return rest[0] if rest else graph.node("const", FLAG, (), not ends)
        case "xor" if False in known:
            return args[1 - known.index(False)]
        case "not" if known[0] is not None:
            return graph.node("const", FLAG, (), not known[0])
        case "select" if known[0] is not None:
            return args[1] if known[0] else args[2]
        case "select" if known[1] is False and known[2] is False:
            return graph.node("const", FLAG, (), False)
    return None


def asked(loop: Compute) -> list[Node]:
    """The masks of an update."""
    assert loop.region is not None
    return [node for node in ordered([loop.region]) if node.op == "load"]


__all__ = ["asked", "is_cleared", "updates", "without"]
