"""Loops over words: planes that are empty, and planes that change in few words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from powderdsl.ir.bits import simpler
from powderdsl.ir.ops import FLAG, OPS, Graph, Node, conjuncts, ordered
from powderdsl.schedule.costs import LOGIC, UNIFORM
from powderdsl.schedule.types import (
    ANSWER,
    Compute,
    Guard,
    Move,
    Out,
    Schedule,
    Statement,
    Var,
    combined,
    in_order,
    is_zero,
    loaded,
    made_in,
    map_each,
    read_by,
    read_elsewhere,
    rewritten,
)

MAX_CONDITIONS = 4
"""Maximum number of sets of planes to test."""


def skip_empty(schedule: Schedule) -> Schedule:
    """Add a condition to loops over words without which all their values are 0; separate operations on whole planes.

    `m = a & (b | c[0,1])` → when `any a`; `n = a | b` needs no loop, since it tests its planes itself.
    """

    def change(loop: Compute) -> list[Statement]:
        if loop.over != "words" or loop.region is not None:
            return [loop]
        loops: list[Statement] = []
        rest: list[Out] = []
        for out in loop.outs:
            if is_whole(out.value):
                loops.append(replace(loop, outs=(out,), when=None))
            else:
                rest.append(out)
        return [*loops, _with_condition(replace(loop, outs=tuple(rest)), schedule.graph)] if rest else loops

    return map_each(schedule, Compute, change)


def is_whole(value: Node) -> bool:
    """True if a value is one operation on whole planes: `a`, `0`, `a[dy,dx]`, `a & ~b`, `a | b`."""
    ops = sorted([arg.op for arg in value.args])
    match value.op:
        case "load":
            return True
        case "const":
            return not value.attr
        case "shift":
            return ops == ["load"] and value.attr[2]
        case "or":
            return ops == ["load", "load"]
        case "and":
            return ops == ["load", "not"] and difference(value)[1].op == "load"
    return False


def difference(value: Node) -> tuple[Node, Node]:
    """The planes `a` and `b` of `a & ~b`."""
    first, second = value.args
    return (first, second.args[0]) if second.op == "not" else (second, first.args[0])


def _with_condition(loop: Compute, graph: Graph) -> Compute:
    """The loop with a condition: of some sets of planes, one plane must be non-empty for a value to hold anywhere."""
    holders: dict[Node, frozenset[str]] = {}
    """By flag: planes such that the flag holds nowhere if all of them are empty, if such a set is known."""
    loads: dict[str, Node] = {}
    for node in ordered(loop.results):
        args = node.args[node.op == "select" :]
        known = [holders[arg] for arg in args if arg in holders]
        match node.op:
            case "load":
                holders[node] = frozenset({node.attr})
                loads[node.attr] = node
            case "const" if not node.attr:
                holders[node] = frozenset()
            case "and" | "when" if known:
                holders[node] = min(known, key=lambda names: (len(names), sorted(names)))
            case "shift" | "or" | "xor" | "select" if len(known) == len(args):
                holders[node] = frozenset[str]().union(*known)
    ways: list[list[frozenset[str]]] = []
    for value in loop.results:
        parts = [value.args[0], *conjuncts(value.args[1])] if value.op == "when" else conjuncts(value)
        needs = dict.fromkeys([holders[part] for part in parts if part in holders])
        if not needs:
            return loop
        conditions = sorted(needs, key=len)[:MAX_CONDITIONS]
        # A way with fewer conditions makes a stricter one redundant.
        if not any(set(way) <= set(conditions) for way in ways):
            ways = [*[way for way in ways if not set(conditions) < set(way)], conditions]
    answers = []
    for way in ways:
        flags = [[graph.node("any", ANSWER, (loads[name],)) for name in in_order(names)] for names in way]
        some = [combined("or", nodes, graph, ANSWER) for nodes in flags]
        answers.append(combined("and", some, graph))
    before = [] if loop.when is None else [loop.when]
    return replace(loop, when=combined("and", [*before, combined("or", answers, graph)], graph))


IN_A_WORD = (*LOGIC, *UNIFORM, "load")
"""Operations that read no other word."""


def extract_updates(schedule: Schedule) -> Schedule:
    """Move planes that a guard's masks change out of the guard: a loop over the words where a mask holds needs no guard.

    Outside the guard, most old planes end with the loop, so `release` changes their words in place.
    `if any m: b = a & ~m, else b = a` → `loop words over m: b = a & ~m, else a`.
    """
    return map_each(schedule, Guard, partial(_extract, graph=schedule.graph))


def _extract(guard: Guard, graph: Graph, *, near: bool = True) -> list[Statement]:
    """The loops that leave a guard, and what remains of it. `near`: also loops that read other planes at neighbors."""
    when, olds, inside = guard.when.args, guard.olds, made_in(guard.body).keys()
    if {node.op for node in when} != {"load"}:
        return [guard]
    masks = {node.attr for node in when}
    body: list[Statement] = []
    leaving: dict[bool, list[Out]] = {True: [], False: []}
    """Values by whether they read neighbors; those that do come first, before their neighbors change."""
    for statement in guard.body:
        if not isinstance(statement, Compute) or statement.over != "words" or statement.when is not None:
            body.append(statement)
            continue
        rest = []
        for out in statement.outs:
            old, far = olds.get(out.var.name), bool(read_elsewhere([out.value]))
            stays = old is None or (far and not near) or not inside.isdisjoint(loaded([out.value]))
            if old is None or stays or not _is_update(out.value, masks, old, graph):
                rest.append(out)
            else:
                leaving[far].append(replace(out, otherwise=old))
        body += _limit(replace(statement, outs=tuple(rest)), when, graph)
    region = combined("or", when, graph)
    loops = [Compute(tuple(outs), guard.place, region, over="words") for outs in leaving.values()]
    overwritten = {old.attr for old in loops[0].olds.values()}
    if not overwritten.isdisjoint(read_elsewhere(loops[0].results)):
        return _extract(guard, graph, near=False)  # in place, such a loop would read what it has changed
    loops = [loop for loop in loops if loop.outs]
    names = made_in(loops).keys()
    outs = tuple([out for out in guard.outs if out.var.name not in names])
    left = [replace(guard, body=tuple(body), outs=outs)] if body else []
    return [*left, *loops] if names.isdisjoint(read_by(tuple(body))) else [*loops, *left]


def _limit(loop: Compute, when: Sequence[Node], graph: Graph) -> list[Compute]:
    """Limit a loop in a guard: values that equal another plane where no mask holds are computed only over the masks.

    `if any m: loop words: b = m ? a[0,1] : a` → `if any m: loop words over m: b = m ? a[0,1] : a, else a`.
    """
    masks = {node.attr for node in when}
    whole: list[Out] = []
    partly: list[Out] = []
    for out in loop.outs:
        old = with_zeros(out.value, masks, graph)
        if out.value.op != "load" and _is_update(out.value, masks, old, graph):
            partly.append(replace(out, otherwise=old))
        else:
            whole.append(out)
    region = combined("or", when, graph)
    parts = [replace(loop, outs=tuple(whole)), replace(loop, outs=tuple(partly), region=region)]
    return [part for part in parts if part.outs]


def _is_update(value: Node, masks: set[str], old: Node, graph: Graph) -> bool:
    """True if a flag is computed from stored planes, and equals the old plane where no mask holds."""
    if value.type != FLAG or old.op != "load" or old.attr in masks:
        return False
    for node in ordered([value]):
        at_neighbor = node.op == "shift" and node.args[0].op == "load" and node.attr[2]
        if node.op not in IN_A_WORD and not at_neighbor:
            return False
    return with_zeros(value, masks, graph) is old


def only_clears(out: Out, graph: Graph) -> bool:
    """True if an updated plane can only lose flags."""
    return out.otherwise is not None and is_zero(with_zeros(out.value, {out.otherwise.attr}, graph))


def with_zeros(value: Node, planes: set[str], graph: Graph) -> Node:
    """A flag where some planes are zero."""

    def rule(node: Node) -> Node | None:
        if node.op == "load" and node.attr in planes:
            return graph.flag(False)
        return simpler(graph, node.op, node.args, node.attr) if node.op in OPS else None

    return rewritten([value], graph, rule)(value)


def movement_loop(move: Move, graph: Graph) -> Compute:
    dy, dx = move.offset
    outs = []
    for out in move.outs:
        old = move.olds[out.var.name]
        entering = _at_neighbor(old, -dy, -dx, graph)
        entered = _at_neighbor(move.region, -dy, -dx, graph)
        value = graph.node("select", FLAG, (entered, entering, out.value))
        if move.op == "swap":
            value = graph.node("select", FLAG, (move.region, _at_neighbor(old, dy, dx, graph), value))
        outs.append(Out(out.var, value))
    return Compute(tuple(outs), move.place, over="words")


def target_loop(move: Move, graph: Graph) -> Compute:
    """A loop that computes the cells that movers enter."""
    dy, dx = move.offset
    return Compute((Out(Var("targets", FLAG), _at_neighbor(move.region, -dy, -dx, graph)),), over="words")


def _at_neighbor(plane: Node, dy: int, dx: int, graph: Graph) -> Node:
    return graph.node("shift", FLAG, (plane,), (dy, dx, True))
