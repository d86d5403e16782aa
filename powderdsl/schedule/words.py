"""Loops over words: parts of masks that are shared, planes that are empty, and planes that change in few words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from powderdsl.ir.ops import FLAG, Graph, Node, ordered
from powderdsl.schedule.costs import DRAWS, LOGIC, UNIFORM
from powderdsl.schedule.floats import is_comparison
from powderdsl.schedule.presence import when_present
from powderdsl.schedule.types import (
    ANSWER,
    Compute,
    Guard,
    Move,
    Namer,
    Out,
    Schedule,
    Statement,
    Var,
    asked_masks,
    combined,
    conjuncts,
    constant,
    in_order,
    is_movement,
    is_zero,
    load,
    loaded,
    made_in,
    map_each,
    read_by,
    read_elsewhere,
    rewritten,
    taken,
    with_values,
)

WORTH = 3
"""How many gates of a mask must be shared with others for a plane of their own, and how many masks must share gates."""


@dataclass(frozen=True)
class _Mask:
    """A mask, and its conjuncts that are known early."""

    place: int
    value: Node
    parts: tuple[Node, ...]


def early(schedule: Schedule) -> Schedule:
    """Masks that share gates, which no statement between them changes, get planes with those gates, from one loop.

    `m = a & b & c; if any m: a' = …; n = a' & ~b & c` → `s = b & c, t = ~b & c; m = a & s; …; n = a' & t`.
    """
    graph, namer = schedule.graph, Namer(schedule)
    known = {name: i for i, statement in enumerate(schedule.body) for name in statement.vars}
    users: dict[Node, int] = {}
    """The first statement that computes each value."""
    for i, statement in reversed([*enumerate(schedule.body)]):
        users |= dict.fromkeys(ordered(statement.values), i)
    groups: dict[int, list[_Mask]] = {}
    """Masks with the conjuncts that depend on the same statement last."""
    for i, masks in asked_masks(schedule.body):
        for out in masks:
            parts: dict[int, list[Node]] = {}
            for part in conjuncts(out.value):
                if not any(node.op in DRAWS or is_movement(node) for node in ordered([part])):
                    since = max((known.get(name, -1) for name in loaded([part])), default=-1)
                    parts.setdefault(since, []).append(part)
            for since, nodes in parts.items():
                groups.setdefault(since, []).append(_Mask(i, out.value, tuple(nodes)))
    before: dict[int, list[Out]] = {}
    planes: dict[Node, dict[Node, Node]] = {}
    """By mask: the loads of planes, by the parts that they replace."""
    for group in filter(None, map(_shared, groups.values())):
        outs: dict[frozenset[Node], Out] = {}
        for mask in group:
            if (key := frozenset(mask.parts)) not in outs:
                outs[key] = Out(namer.var(FLAG), combined("and", mask.parts, graph))
            plane = load(graph, outs[key].var)
            planes.setdefault(mask.value, {}).update(dict.fromkeys(mask.parts, plane))
        before.setdefault(min(users[mask.value] for mask in group), []).extend(outs.values())
    if not planes:
        return schedule
    new: dict[Node, Node] = {}
    for node in ordered(schedule.values):
        new[node] = graph.node(node.op, node.type, tuple(new[arg] for arg in node.args), node.attr)
        if node in planes:
            rest = [new[part] for part in conjuncts(node) if part not in planes[node]]
            new[node] = combined("and", dict.fromkeys([*planes[node].values(), *rest]), graph)
    changed = with_values(schedule, new.__getitem__)
    body: list[Statement] = []
    for i, statement in enumerate(changed.body):
        if i in before:
            loop = Compute(tuple(before[i]))
            body.append(replace(loop, when=when_present(loop.results, schedule)))
        body.append(statement)
    return replace(changed, body=tuple(body))


def _gates(parts: Iterable[Node]) -> Iterator[Node]:
    """The operations on flags in the cell itself, and comparisons. What is read at neighbors is stored anyway."""
    stack = [*parts]
    for node in taken(stack):
        if is_comparison(node):
            yield node
        elif node.op in LOGIC:
            yield node
            stack += node.args


def _shared(group: Sequence[_Mask]) -> list[_Mask]:
    """The masks of a group with the parts that share gates with other masks, if these are worth a plane."""
    count = Counter(gate for mask in group for gate in _gates(mask.parts))
    shared = []
    for mask in group:
        parts = tuple(part for part in mask.parts if any(count[gate] > 1 for gate in _gates([part])))
        if sum(count[gate] > 1 for gate in _gates(parts)) >= WORTH:
            shared.append(replace(mask, parts=parts))
    return shared if len({mask.place for mask in shared}) >= WORTH else []


MAX_CONDITIONS = 4
"""More sets of planes than this are not worth testing."""


def empty(schedule: Schedule) -> Schedule:
    """Loops over words get a condition without which all their values are 0; operations on whole planes stand alone.

    `m = a & (b | c[0,1])` → when `any a`; `n = a | b` needs no loop, since it tests its planes itself.
    """

    def change(loop: Compute) -> list[Statement]:
        if loop.over != "words" or loop.region is not None:
            return [loop]
        alone = [replace(loop, outs=(out,), when=None) for out in loop.outs if is_whole(out.value)]
        rest = replace(loop, outs=tuple(out for out in loop.outs if not is_whole(out.value)))
        return [*alone, _with_condition(rest, schedule.graph)] if rest.outs else [*alone]

    return map_each(schedule, Compute, change)


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


def difference(value: Node) -> tuple[Node, Node]:
    """The planes `a` and `b` of `a & ~b`."""
    first, second = value.args
    return (first, second.args[0]) if second.op == "not" else (second, first.args[0])


def _with_condition(loop: Compute, graph: Graph) -> Compute:
    """The loop with a condition: of some sets of planes, one plane must be non-empty for a value to hold anywhere."""
    nodes = ordered(loop.results)
    holders: dict[Node, frozenset[str] | None] = {}
    """For each flag: planes such that it holds nowhere if all of them are empty; None if none are known."""
    for node in nodes:
        sets = [holders[arg] for arg in node.args[node.op == "select" :]]
        known = [names for names in sets if names is not None]
        holders[node] = None
        match node.op:
            case "load":
                holders[node] = frozenset({node.attr})
            case "const" if not node.attr:
                holders[node] = frozenset()
            case "and" | "when":
                holders[node] = min(known, key=lambda names: (len(names), sorted(names)), default=None)
            case "shift" | "or" | "xor" | "select" if len(known) == len(sets):
                holders[node] = frozenset[str]().union(*known)
    ways: list[list[frozenset[str]]] = []
    for value in loop.results:
        parts = [value.args[0], *conjuncts(value.args[1])] if value.op == "when" else conjuncts(value)
        needs = dict.fromkeys(names for part in parts if (names := holders[part]) is not None)
        if not needs:
            return loop
        conditions = sorted(needs, key=len)[:MAX_CONDITIONS]
        if not any(set(way) <= set(conditions) for way in ways):
            ways = [*(way for way in ways if not set(conditions) < set(way)), conditions]
    loads = {node.attr: node for node in nodes if node.op == "load"}

    def some(names: frozenset[str]) -> Node:
        flags = [graph.node("any", ANSWER, (loads[name],)) for name in in_order(names)]
        return combined("or", flags, graph, ANSWER)

    answers = [combined("and", [*map(some, way)], graph) for way in ways]
    before = [] if loop.when is None else [loop.when]
    return replace(loop, when=combined("and", [*before, combined("or", answers, graph)], graph))


IN_A_WORD = (*LOGIC, *UNIFORM, "load")
"""Operations that read the word itself."""


def updates(schedule: Schedule) -> Schedule:
    """Planes that a guard's masks change leave the guard: a loop over the words where a mask holds tests for that itself.

    Outside the guard, `release` finds out that most old planes end there, so that the words are changed in place.
    `if any m: b = a & ~m, else b = a` → `loop words over m: b = a & ~m, else a`.
    """
    return map_each(schedule, Guard, lambda guard: _taken_out(guard, schedule.graph))


def _taken_out(guard: Guard, graph: Graph, *, near: bool = True) -> list[Statement]:
    """The loops that leave a guard, and what remains of it. `near`: also loops that read other planes at neighbors."""
    when = guard.when.args
    if not all(node.op == "load" for node in when):
        return [guard]
    masks = {node.attr for node in when}
    inside, olds = made_in(guard.body), guard.olds
    body: list[Statement] = []
    taken: dict[bool, list[Out]] = {True: [], False: []}
    """Values by whether they read neighbors; those come first, before these change."""
    for statement in guard.body:
        if not isinstance(statement, Compute) or statement.over != "words" or statement.when is not None:
            body.append(statement)
            continue
        rest = []
        for out in statement.outs:
            old, far = olds.get(out.var.name), bool(read_elsewhere([out.value]))
            stays = old is None or (far and not near) or any(name in inside for name in loaded([out.value]))
            if old is None or stays or not _is_update(out.value, masks, old, graph):
                rest.append(out)
            else:
                taken[far].append(replace(out, otherwise=old))
        body += _partly(replace(statement, outs=tuple(rest)), when, graph) if rest else []
    elsewhere = read_elsewhere(out.value for out in taken[True])
    if any(olds[out.var.name].attr in elsewhere for out in taken[True]):
        return _taken_out(guard, graph, near=False)  # in place, such a loop would read what it has changed
    region = combined("or", when, graph)
    loops = [Compute(tuple(outs), guard.place, region, over="words") for outs in taken.values() if outs]
    names = made_in(loops)
    outs = tuple(out for out in guard.outs if out.var.name not in names)
    left = [replace(guard, body=tuple(body), outs=outs)] if body else []
    return [*left, *loops] if names.keys().isdisjoint(read_by(tuple(body))) else [*loops, *left]


def _partly(loop: Compute, when: Sequence[Node], graph: Graph) -> list[Compute]:
    """A loop in a guard, of which values that are those of another plane where no mask holds are computed only elsewhere.

    `if any m: loop words: b = m ? a[0,1] : a` → `if any m: loop words over m: b = m ? a[0,1] : a, else a`.
    """
    masks = {node.attr for node in when}
    outs: dict[bool, list[Out]] = {False: [], True: []}
    for out in loop.outs:
        old = without(out.value, masks, graph)
        partly = out.value.op != "load" and _is_update(out.value, masks, old, graph)
        outs[partly].append(replace(out, otherwise=old) if partly else out)
    region = combined("or", when, graph)
    parts = [replace(loop, outs=tuple(outs[False])), replace(loop, outs=tuple(outs[True]), region=region)]
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
    return out.otherwise is not None and is_zero(without(out.value, {out.otherwise.attr}, graph))


def without(value: Node, planes: set[str], graph: Graph) -> Node:
    """A flag where some planes are zero."""

    def rule(node: Node) -> Node | None:
        known = [bool(arg.attr) if arg.op == "const" else None for arg in node.args]
        match node.op:
            case "load" if node.attr in planes:
                return constant(graph, FLAG)
            case "and" | "or":
                if (ends := node.op == "or") in known:
                    return constant(graph, FLAG, ends)
                return combined(node.op, [arg for arg in node.args if arg.op != "const"], graph)
            case "xor" if False in known:
                return node.args[1 - known.index(False)]
            case "not" if known[0] is not None:
                return constant(graph, FLAG, not known[0])
            case "select" if known[0] is not None:
                return node.args[1] if known[0] else node.args[2]
            case "select" if known[1:] == [False, False]:
                return constant(graph, FLAG)
        return None

    return rewritten([value], graph, rule)(value)


def moved(move: Move, graph: Graph) -> Compute:
    """A movement as a loop over words."""
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


def targets(move: Move, graph: Graph) -> Compute:
    """A loop that computes the cells which movers enter."""
    dy, dx = move.offset
    return Compute((Out(Var("targets", FLAG), _at_neighbor(move.region, -dy, -dx, graph)),), over="words")


def _at_neighbor(plane: Node, dy: int, dx: int, graph: Graph) -> Node:
    return graph.node("shift", FLAG, (plane,), (dy, dx, True))
