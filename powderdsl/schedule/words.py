"""Loops over words: parts of masks that are shared, planes that are empty, and planes that change in few words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from powderdsl.ir.ops import FLAG, Graph, Node, ordered
from powderdsl.schedule.costs import DRAWS, LOGIC
from powderdsl.schedule.floats import is_comparison
from powderdsl.schedule.lifetimes import made_in, reads
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
    combined,
    conjuncts,
    flat,
    in_order,
    is_movement,
    load,
    loaded,
    map_blocks,
    map_computes,
    read_elsewhere,
    rewritten,
    with_args,
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
    known = {var.name: -1 for _, var in schedule.finds}
    for i, statement in enumerate(schedule.body):
        known |= {var.name: i for var in statement.defined()}
    users: dict[int, int] = {}  # the first statement that computes a value
    for i, statement in enumerate(schedule.body):
        for node in ordered(statement.values()):
            users.setdefault(id(node), i)
    groups: dict[int, list[_Mask]] = {}
    for i, (masks, guard) in enumerate(zip(schedule.body, schedule.body[1:], strict=False)):
        if isinstance(masks, Compute) and isinstance(guard, Guard):
            asked = {node.attr for node in guard.when if node.op == "load"}
            for out in masks.outs:
                if out.var.name in asked:
                    for since, parts in _known_parts(out.value, known).items():
                        groups.setdefault(since, []).append(_Mask(i, out.value, parts))
    before: dict[int, list[Out]] = {}
    planes: dict[int, dict[int, Node]] = {}  # by mask: the loads of planes, by the parts that they replace
    for group in groups.values():
        found: dict[frozenset[int], Out] = {}
        masks_of_group = _shared(group)
        for mask in masks_of_group:
            key = frozenset(map(id, mask.parts))
            if key not in found:
                found[key] = Out(namer.var(FLAG), combined("and", mask.parts, graph))
            plane = load(graph, found[key].var)
            planes.setdefault(id(mask.value), {}).update({id(part): plane for part in mask.parts})
        if found:
            first = min(users[id(mask.value)] for mask in masks_of_group)
            before.setdefault(first, []).extend(found.values())
    if not planes:
        return schedule
    done: dict[int, Node] = {}
    for node in ordered(node for statement in flat(schedule.body) for node in statement.values()):
        done[id(node)] = with_args(node, tuple(done[id(arg)] for arg in node.args), graph)
        if id(node) in planes:
            known_parts = planes[id(node)]
            rest = [done[id(part)] for part in conjuncts(node) if id(part) not in known_parts]
            done[id(node)] = combined("and", dict.fromkeys([*known_parts.values(), *rest]), graph)

    def renewed(statement: Compute) -> list[Statement]:
        return [replace(statement, outs=tuple(replace(o, value=done[id(o.value)]) for o in statement.outs))]

    body: list[Statement] = []
    for i, statement in enumerate(map_computes(schedule, renewed).body):
        if i in before:
            when = when_present([out.value for out in before[i]], schedule)
            body.append(Compute(tuple(before[i]), when=when))
        body.append(statement)
    return replace(schedule, body=tuple(body))


def _known_parts(mask: Node, known: dict[str, int]) -> dict[int, tuple[Node, ...]]:
    """The conjuncts of a mask without draws and movements, by the last statement that they depend on."""
    found: dict[int, list[Node]] = {}
    for part in conjuncts(mask):
        if not any(node.op in DRAWS or is_movement(node) for node in ordered([part])):
            found.setdefault(max((known[name] for name in loaded([part])), default=-1), []).append(part)
    return {since: tuple(parts) for since, parts in found.items()}


def _gates(parts: Sequence[Node]) -> list[Node]:
    """The operations on flags in the cell itself, and comparisons. What is read at neighbors is stored anyway."""
    found: dict[int, Node] = {}
    stack = [*parts]
    while stack:
        node = stack.pop()
        if (node.op in LOGIC or is_comparison(node)) and id(node) not in found:
            found[id(node)] = node
            stack.extend(() if is_comparison(node) else node.args)
    return list(found.values())


def _shared(group: Sequence[_Mask]) -> list[_Mask]:
    """The masks of a group with the parts that share gates with other masks, if these are worth a plane."""
    count = Counter(id(gate) for mask in group for gate in _gates(mask.parts))
    found = []
    for mask in group:
        parts = tuple(part for part in mask.parts if any(count[id(gate)] > 1 for gate in _gates([part])))
        if sum(count[id(gate)] > 1 for gate in _gates(parts)) >= WORTH:
            found.append(replace(mask, parts=parts))
    return found if len({mask.place for mask in found}) >= WORTH else []


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


def difference(value: Node) -> tuple[Node, Node]:
    """The planes `a` and `b` of `a & ~b`."""
    first, second = value.args
    return (first, second.args[0]) if second.op == "not" else (second, first.args[0])


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


def moved(move: Move, graph: Graph) -> Compute:
    """A movement as a loop over words."""
    dy, dx = move.offset
    outs = []
    for plane in move.planes:
        entering = _at_neighbor(plane.old, -dy, -dx, graph)
        entered = _at_neighbor(move.movers, -dy, -dx, graph)
        value = graph.node("select", FLAG, (entered, entering, plane.leaves))
        if move.op == "swap":
            value = graph.node("select", FLAG, (move.movers, _at_neighbor(plane.old, dy, dx, graph), value))
        outs.append(Out(plane.new, value))
    return Compute(tuple(outs), move.place, "words")


def targets(move: Move, graph: Graph) -> Compute:
    """A loop that computes the cells which movers enter."""
    dy, dx = move.offset
    return Compute((Out(Var("targets", FLAG), _at_neighbor(move.movers, -dy, -dx, graph)),), "", "words")


def _at_neighbor(plane: Node, dy: int, dx: int, graph: Graph) -> Node:
    return graph.node("shift", FLAG, (plane,), (dy, dx, True))


def asked(loop: Compute) -> list[Node]:
    """The masks of an update."""
    assert loop.region is not None
    return [node for node in ordered([loop.region]) if node.op == "load"]
