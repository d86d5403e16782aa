"""Parts of masks that are known before the first of several masks are computed together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from powderdsl.ir.ops import FLAG, Node, ordered
from powderdsl.schedule.costs import LOGIC
from powderdsl.schedule.draws import DRAWS
from powderdsl.schedule.floats import is_comparison
from powderdsl.schedule.presence import when_present
from powderdsl.schedule.types import (
    Compute,
    Guard,
    Namer,
    Out,
    Schedule,
    Statement,
    combined,
    conjuncts,
    flat,
    is_movement,
    load,
    loaded,
    map_computes,
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
