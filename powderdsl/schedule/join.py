"""Loops over cells: the cells in which each has work, and which run as one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from powderdsl.ir.ops import FLAG, OPS, REAL, Graph, Node, ordered
from powderdsl.ir.single import single
from powderdsl.schedule.types import (
    ANSWER,
    Compute,
    Guard,
    Namer,
    Out,
    Schedule,
    Statement,
    Sweeps,
    combined,
    flat,
    in_order,
    is_zero,
    load,
    loaded,
    map_blocks,
    map_computes,
    over_variables,
    planes_at_neighbors,
    rewritten,
)


def narrow(schedule: Schedule) -> Schedule:
    """Loops over cells get a region and their values outside it.

    `v' = settle(m ? a : v)`, where v was clamped → over `m`, else `v`; `w = 0.1 < v*v` → over `live(v)`, else 0.
    """
    schedule = _where_read(schedule)
    found = {slot: var.name for slot, var in schedule.finds}
    olds = {str(node.attr): found[slot] for slot, node in schedule.leaves if slot in found}

    def change(loop: Compute) -> list[Statement]:
        cells = loop.over in ("cells", "choices")
        return [_narrowed(loop, schedule.graph, olds) if cells else loop]

    return map_computes(schedule, change)


def _where_read(schedule: Schedule) -> Schedule:
    """Fields that are only read where a flag holds, there or at the neighbor that reads them, are zero elsewhere.

    `b = f(a)`, `c = m[0,1] ? x + b[0,1] : x` → `b = m ? f(a) : 0`.
    """
    graph = schedule.graph
    statements = list(flat(schedule.body))
    shifted = planes_at_neighbors(schedule)
    asking: dict[str, set[str]] = {}  # by field: the flags that hold wherever it is read
    roots = [node for one in statements for node in one.values()] + [node for _, node in schedule.leaves]
    for name, where, masks in _field_reads(roots):
        flags = {shifted[mask][0] for mask in masks if mask in shifted and shifted[mask][1] == where}
        if where == HERE:
            flags |= masks
        asking[name] = asking[name] & flags if name in asking else flags
    there = {var.name for _, var in schedule.finds}

    def change(loop: Compute) -> list[Statement]:
        outs = []
        for out in loop.outs:
            flags = in_order(asking.get(out.var.name, set()) & there)
            if loop.over == "cells" and out.var.type == REAL and out.var.means is None and flags:
                mask = graph.node("load", FLAG, (), flags[0])
                zero = graph.node("const", REAL, (), 0.0)
                out = replace(out, value=graph.node("select", REAL, (mask, out.value, zero)))
            outs.append(out)
        there.update(out.var.name for out in outs)
        return [replace(loop, outs=tuple(outs))]

    return map_computes(schedule, change)


HERE = (0, 0, True)


def _field_reads(roots: Sequence[Node]) -> Iterator[tuple[str, tuple[int, int, bool], set[str]]]:
    """Where values read fields: the field, the neighbor, and the flags under which all that need it choose it."""
    under: dict[int, set[str]] = {id(root): set() for root in roots}
    for node in reversed(ordered(roots)):  # users first
        masks = under.get(id(node))
        if masks is None:  # read at neighbors only
            continue
        field = node.args[0] if node.op == "shift" else node
        if field.op == "load" and field.type == REAL:
            yield str(field.attr), node.attr if node.op == "shift" else HERE, masks
            continue
        for number, arg in enumerate(node.args):
            chosen = node.op == "select" and number == 1 and node.args[0].op == "load"
            found = masks | {str(node.args[0].attr)} if chosen else masks
            under[id(arg)] = under[id(arg)] & found if id(arg) in under else found


def ask_regions(schedule: Schedule) -> Schedule:
    """Loops with a region are put into guards that test whether the region holds anywhere.

    `loop over m: x = …, else 0` → `if any m: loop over m: x = …, else x = 0`.
    """
    namer, graph = Namer(schedule), schedule.graph

    def change(loop: Compute) -> list[Statement]:
        if loop.region is None:
            return [loop]
        question = Out(namer.var(ANSWER), graph.node("any", ANSWER, (_anywhere(loop.region, graph),)))
        keeps = tuple((out.var, out.otherwise) for out in loop.outs if out.otherwise is not None)
        asking = Compute((question,), loop.place, "words")
        return [asking, Guard((load(graph, question.var),), (loop,), keeps, loop.place)]

    return map_computes(schedule, change)


def _narrowed(loop: Compute, graph: Graph, slots: Mapping[str, str]) -> Compute:
    """A loop with its region, if it has one. `slots`: the variable that a slot's new value replaces, by the new one's name.

    Only a slot's own old value has been clamped to the bounds of that slot.
    """
    values = [out.value for out in loop.outs]
    kept = [
        unchanged(out.value, {slots[out.var.name]}) if out.var.name in slots else None for out in loop.outs
    ]
    if all(kept) and loop.over == "cells":
        olds = [old for old, _ in kept if old is not None]  # type: ignore[misc]
        masks = [mask for _, chosen in kept for mask in chosen]  # type: ignore[misc]
        region = _any_of(masks, graph)
        return _with_region(loop, region, olds)
    calm = _calm(values)
    if calm is None:
        return loop
    numbers, masks = calm
    if any(mask.op == "param" for mask in masks):
        return loop
    flags = [*masks, *(_live(field, dy, dx, graph) for field, dy, dx in _reads(values))]
    rest = [
        graph.node("const", out.var.type, (), bool(number) if out.var.type == FLAG else 0.0)
        for out, number in zip(loop.outs, numbers, strict=True)
    ]
    return _with_region(loop, _any_of(flags, graph), rest)


def _with_region(loop: Compute, region: Node, rest: Iterable[Node]) -> Compute:
    outs = (replace(out, otherwise=other) for out, other in zip(loop.outs, rest, strict=True))
    return replace(loop, outs=tuple(outs), region=region)


def _any_of(flags: Iterable[Node], graph: Graph) -> Node:
    found = dict.fromkeys(flags)
    return combined("or", found, graph) if found else graph.node("const", FLAG, (), False)


def _live(field: Node, dy: int, reach: int, graph: Graph) -> Node:
    return graph.node("live", FLAG, (field,), (dy, reach))


def _anywhere(region: Node, graph: Graph) -> Node:
    """A flag that holds somewhere if a region does; fields are tested in the cell itself only."""

    def rule(node: Node) -> Node | None:
        return _live(node.args[0], 0, 0, graph) if node.op == "live" else None

    return rewritten([region], graph, rule)[id(region)]


def unchanged(value: Node, found: set[str]) -> tuple[Node, list[Node]] | None:
    """For a clamped slot under choices: its old value, and the masks without which it keeps it (it was clamped)."""
    masks = []
    if value.op not in ("settle", "select"):
        return None
    node = value.args[0] if value.op == "settle" else value
    while node.op == "select":
        masks.append(node.args[0])
        node = node.args[2]
    known = node.op == "load" and node.attr in found and all(mask.op != "param" for mask in masks)
    return (node, masks) if known else None


def _calm(values: list[Node]) -> tuple[list[float | bool], list[Node]] | None:
    """The values where all floats are zero and no mask holds, and the masks. None if a float is not zero there, or if
    values depend on draws or parameters."""
    memo: dict[int, Any] = {}
    masks: dict[int, Node] = {}

    def visit(node: Node) -> Any:
        if id(node) in memo:
            return memo[id(node)]
        if node.op == "load":
            result: Any = 0.0
        elif node.op == "led" and node.args[0].op == "load":
            try:
                result = visit(node.args[1])
            except LookupError:
                result = True
            if result:  # the result depends on the flag
                masks[id(node.args[0])] = node.args[0]
                result = False
        elif node.op == "const":
            result = single(node.attr)
        elif node.op == "select":
            masks[id(node.args[0])] = node.args[0]
            result = visit(node.args[2])
        elif node.op in ("param", "draw"):
            raise LookupError
        elif node.op == "led":
            result = visit(node.args[0]) and visit(node.args[1])
        elif node.op == "shift":
            result = visit(node.args[0])
            if result and not node.attr[2]:
                raise LookupError
        else:
            result = OPS[node.op].value(node.attr, *map(visit, node.args))
        memo[id(node)] = result
        return result

    try:
        found = [visit(value) for value in values]
    except LookupError:
        return None
    if any(isinstance(number, float) and number != 0 for number in found):
        return None
    return found, list(masks.values())


def _reads(values: list[Node]) -> list[tuple[Node, int, int]]:
    """Fields that values read where no mask holds: field, rows down, and the largest distance in columns."""
    reach: dict[tuple[int, int], int] = {}
    fields: dict[int, Node] = {}
    below = [(value, 0, 0) for value in values]
    seen: set[tuple[int, int, int]] = set()
    while below:
        node, dy, dx = below.pop()
        if (id(node), dy, dx) in seen:
            continue
        seen.add((id(node), dy, dx))
        if node.op == "load" and node.type == REAL:
            fields[id(node)] = node
            reach[id(node), dy] = max(reach.get((id(node), dy), 0), abs(dx))
        elif node.op == "shift":
            below.append((node.args[0], dy + node.attr[0], dx + node.attr[1]))
        elif node.op == "select":
            below.append((node.args[2], dy, dx))
        else:
            below += [(arg, dy, dx) for arg in node.args]
    order = [node for node in ordered(values) if id(node) in fields]
    found = [(node, dy, dx) for node in order for (key, dy), dx in reach.items() if key == id(node)]
    return sorted(found, key=lambda one: (order.index(one[0]), one[1]))


FEW = 8
"""The most operations that are applied to the result of choices while it is in registers."""


@dataclass(frozen=True)
class Read:
    """A field that is read at an offset in rows and columns, or asked whether it is zero there (`live`)."""

    name: str
    dy: int
    dx: int
    wraps: bool
    live: bool


def join(schedule: Schedule) -> Schedule:
    """Every run of consecutive loops over cells, also a single one, becomes a `Sweeps`.

    `loop cells: a = …`, `loop cells: b = a[0,1|0] + …` → one loop over the rows of a world, in which `b` follows `a`
    one row behind. Where a loop only continues the choices before it, it becomes one with them.
    """
    everything = [node for _, node in schedule.leaves]
    everything += [node for statement in flat(schedule.body) for node in statement.values()]
    reads: dict[str, int] = {}
    for name in loaded(everything):
        reads[name] = reads.get(name, 0) + 1

    def change(block: tuple[Statement, ...]) -> tuple[Statement, ...]:
        result: list[Statement] = []
        run: list[Compute] = []
        for statement in (*block, None):
            if isinstance(statement, Compute) and statement.over in ("cells", "choices"):
                if run and (_asks_masks_of(statement, run) or keeps(statement) or keeps(run[-1])):
                    result += [_joined(part, reads) for part in _components(run)]
                    run = []
                if run and (one := _continued(run[-1], statement, reads, schedule.graph)):
                    run[-1] = one
                else:
                    run.append(statement)
                continue
            if run:
                result += [_joined(part, reads) for part in _components(run)]
                run = []
            if statement is not None:
                result.append(statement)
        return tuple(result)

    return replace(schedule, body=map_blocks(schedule.body, change))


def keeps(loop: Compute) -> bool:
    """Whether values outside the region are old ones. Such a loop runs alone, so that rows outside cost nothing."""
    return any(out.otherwise is not None and out.otherwise.op == "load" for out in loop.outs)


def _asks_masks_of(loop: Compute, run: Sequence[Compute]) -> bool:
    """Whether choices are made by flags of a run, which must be there in all rows before."""
    flags = {out.var.name for one in run for out in one.outs if out.var.type == FLAG}
    return loop.over == "choices" and not flags.isdisjoint(loaded(loop.values()))


def _continued(first: Compute, second: Compute, reads: dict[str, int], graph: Graph) -> Compute | None:
    """Choices and a few operations on their results as one loop, if nothing else reads these results.

    `loop choices: a = m ? x : y`, `loop cells: b = 0.9 * a` → `loop choices: b = 0.9 * (m ? x : y)`.
    """
    made = {out.var.name: out.value for out in first.outs}
    if first.over != "choices" or first.region is None or second.region is None:
        return None
    asked = list(loaded([second.region]))
    if any(
        out.var.type != REAL or out.otherwise is None or not is_zero(out.otherwise) for out in second.outs
    ):
        return None
    nodes = ordered(out.value for out in second.outs)
    names = [str(node.attr) for node in nodes if node.op == "load"]
    simple = all(node.type == REAL and node.op in CONTINUING for node in nodes)
    bases = {_base(value) for value in made.values()}
    operations = [node for node in nodes if node.args]
    if not simple or len(operations) > FEW or not bases | made.keys() >= {*names, *asked}:
        return None
    inside = list(loaded(second.values()))
    if any(reads.get(name, 0) != inside.count(name) for name in made):
        return None

    def known(node: Node) -> Node | None:
        return made.get(str(node.attr)) if node.op == "load" else None

    outs = tuple(
        Out(out.var, over_variables(out.value, graph, known), None, out.otherwise) for out in second.outs
    )
    return replace(first, outs=outs)


def _base(value: Node) -> str:
    """The field that choices begin with."""
    while value.op == "select":
        value = value.args[2]
    return str(value.attr)


CONTINUING = ("load", "const", "param", "add", "sub", "mul", "neg", "abs")
"""Operations that are applied to the results of choices in registers."""


def _components(run: Sequence[Compute]) -> list[list[Compute]]:
    """The loops of a run, apart where none reads what another one of them computes."""
    found: list[tuple[set[str], list[Compute]]] = []
    for loop in run:
        names = {out.var.name for out in loop.outs} | set(loaded(loop.values()))
        joined = [part for part in found if any(out.var.name in names for one in part[1] for out in one.outs)]
        found = [part for part in found if part not in joined]
        found.append((names, [*(one for _, loops in joined for one in loops), loop]))
    order = {id(loop): number for number, loop in enumerate(run)}
    parts = [sorted(loops, key=lambda loop: order[id(loop)]) for _, loops in found]
    return sorted(parts, key=lambda loops: order[id(loops[0])])


def _joined(run: Sequence[Compute], reads: dict[str, int]) -> Sweeps:
    parts, lags = _places(run)
    written = {
        out.var.name: part
        for loop, part in zip(run, parts, strict=True)
        for out in loop.outs
        if out.var.type == REAL
    }
    inside = dict.fromkeys(written, 0)
    for loop, part in zip(run, parts, strict=True):
        for name in loaded(loop.values()):
            if written.get(name) == part:
                inside[name] += 1
    passing = (name for name in written if reads.get(name, 0) == inside[name])
    return Sweeps(tuple(run), tuple(parts), tuple(lags), tuple(passing))


def field_reads(loop: Compute) -> Iterator[Read]:
    """The fields that a loop or its region reads."""
    for node in ordered(loop.values()):
        if node.op == "load" and node.type == REAL:
            yield Read(str(node.attr), 0, 0, True, False)
        elif node.op in ("shift", "live") and node.args[0].op == "load" and node.args[0].type == REAL:
            dy, dx, *wraps = node.attr
            live = node.op == "live"
            yield Read(str(node.args[0].attr), dy, 0 if live else dx, bool(wraps and wraps[0]), live)


def _places(run: Sequence[Compute]) -> tuple[list[int], list[int]]:
    """The part of each loop and its lag.

    A row that is read at other columns was stored a row earlier: a processor waits for what it has just stored if a load
    does not begin where the store did.
    """
    parts: list[int] = []
    lags: list[int] = []
    made: dict[str, tuple[int, int]] = {}
    for loop in run:
        reads = [read for read in field_reads(loop) if read.name in made]
        around = [made[read.name][0] + 1 for read in reads if read.wraps and read.dy]
        parts.append(max([*around, *parts[-1:]], default=0))
        behind = [
            made[read.name][1] + read.dy + (read.dx != 0) for read in reads if made[read.name][0] == parts[-1]
        ]
        lags.append(max([0, *behind]))
        made |= {out.var.name: (parts[-1], lags[-1]) for out in loop.outs if out.var.type == REAL}
    return parts, lags
