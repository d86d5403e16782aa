"""Loops over cells: the cells in which each has work, and which run as one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from powderdsl.ir.ops import FLAG, OPS, REAL, Graph, Node, ordered, single, taken
from powderdsl.schedule.floats import match_slot_choices
from powderdsl.schedule.types import (
    ANSWER,
    Block,
    Compute,
    Facts,
    Guard,
    Namer,
    Out,
    Schedule,
    Statement,
    Sweeps,
    choices,
    combined,
    connected,
    field_reads,
    flat,
    in_order,
    is_zero,
    load,
    loaded,
    made_in,
    map_blocks,
    map_each,
    on_all_paths,
    planes_at_neighbors,
    rewritten,
)


def narrow(schedule: Schedule) -> Schedule:
    """Add a region, and the values outside it, to loops over cells.

    `v' = clamp(m ? a : v)`, where v was clamped → over `m`, else `v`; `w = 0.1 < v*v` → over `live(v)`, else 0.
    """
    schedule = _mask_fields(schedule)
    inputs = {slot: var.name for slot, var in schedule.inputs}
    olds = {node.attr: (inputs[slot],) for slot, node in schedule.outputs if slot in inputs}
    return map_each(schedule, Compute, lambda loop: [_with_region(loop, schedule.graph, olds)])


def _mask_fields(schedule: Schedule) -> Schedule:
    """Set fields to zero where no flag holds without which nothing reads them, there or at a neighbor.

    `b = f(a)`, `c = m[0,1] ? x + b[0,1] : x` → `b = m ? f(a) : 0`.
    """
    graph, shifted = schedule.graph, planes_at_neighbors(schedule)

    def field_of(node: Node) -> Node | None:
        """The field that a node reads, here or at a neighbor."""
        field = node.args[0] if node.op == "shift" else node
        return field if field.op == "load" and field.type == REAL else None

    def below(node: Node, masks: Facts) -> Iterator[tuple[Node, Facts]]:
        for number, arg in enumerate(() if field_of(node) else node.args):
            chosen = node.op == "select" and number == 1 and node.args[0].op == "load"
            yield arg, masks | {node.args[0]: None} if chosen else masks

    masks_of: dict[str, set[str]] = {}
    """By field: the flags that hold wherever it is read."""
    for node, masks in on_all_paths(schedule.values, below).items():
        if field := field_of(node):
            names, where = {mask.attr for mask in masks}, node.attr if node.op == "shift" else HERE
            flags = {shifted[name][0] for name in names if name in shifted and shifted[name][1] == where}
            flags |= names if where == HERE else set()
            masks_of[field.attr] = masks_of.get(field.attr, flags) & flags
    place_of = dict.fromkeys(schedule.input_slots, -1)
    """By variable: the number of the statement that computes it, nested or not."""
    for number, statement in enumerate(flat(schedule.body)):
        if not isinstance(statement, Guard):  # which only passes on what its body computes
            place_of |= dict.fromkeys(statement.vars, number)

    def change(loop: Compute) -> list[Statement]:
        outs = []
        for out in loop.outs:
            earlier = {name for name, place in place_of.items() if place < place_of[out.var.name]}
            flags = in_order(masks_of.get(out.var.name, set()) & earlier)
            if loop.over == "cells" and out.var.type == REAL and out.var.means is None and flags:
                args = graph.node("load", FLAG, (), flags[0]), out.value, graph.real(0.0)
                out = replace(out, value=graph.node("select", REAL, args))
            outs.append(out)
        return [replace(loop, outs=tuple(outs))]

    return map_each(schedule, Compute, change)


HERE = (0, 0, True)


def guard_regions(schedule: Schedule) -> Schedule:
    """Put loops with a region into guards that test whether the region holds anywhere.

    `loop over m: x = …, else 0` → `if any m: loop over m: x = …, else x = 0`.
    """
    namer, graph = Namer(schedule), schedule.graph

    def anywhere(node: Node) -> Node | None:
        """Test a field in the cell itself only: neighbors of live cells cannot be live if no cell is."""
        return graph.node("live", FLAG, node.args, (0, 0)) if node.op == "live" else None

    def change(loop: Compute) -> list[Statement]:
        if loop.region is None:
            return [loop]
        region = rewritten([loop.region], graph, anywhere)(loop.region)
        question = Out(namer.var(ANSWER), graph.node("any", ANSWER, (region,)))
        outs = tuple([replace(out, value=out.otherwise or out.value) for out in loop.outs])
        guard = Guard(outs, loop.place, when=load(graph, question.var), body=(loop,))
        return [Compute((question,), loop.place, over="words"), guard]

    return map_each(schedule, Compute, change)


def _with_region(loop: Compute, graph: Graph, slots: Mapping[str, tuple[str]]) -> Compute:
    """The loop with its region, if it has one.

    `slots` maps the new variable of a slot to the old one: only that has been clamped to the bounds of the slot.
    """
    if loop.over == "words":
        return loop
    rest: list[Node] = []
    flags: list[Node] = []
    for out in loop.outs:
        if match := match_slot_choices(out.value, slots.get(out.var.name, ())):
            rest.append(match[0])
            flags += match[1]
    # Unless all outputs keep old values outside their masks, they must be constant where nothing is live.
    if loop.over != "cells" or len(rest) < len(loop.outs):
        at_rest = _values_at_rest(loop.results)
        if at_rest is None:
            return loop
        numbers, flags = at_rest
        reads = _reads_at_rest(loop.results)
        flags += [graph.node("live", FLAG, (field,), (dy, reach)) for field, dy, reach in reads]
        types = [out.var.type for out in loop.outs]
        values = zip(numbers, types, strict=True)
        rest = [graph.const(bool(number) and type == FLAG, type) for number, type in values]
    outs = tuple(replace(out, otherwise=other) for out, other in zip(loop.outs, rest, strict=True))
    return replace(loop, outs=outs, region=combined("or", dict.fromkeys(flags), graph))


def _values_at_rest(values: list[Node]) -> tuple[list[float | bool], list[Node]] | None:
    """The values where all fields are zero and no mask holds, and the masks.

    None if a float is not zero there, or if values depend on draws or parameters.
    """
    memo: dict[Node, Any] = {}
    masks: Facts = {}

    def visit(node: Node) -> Any:
        if node not in memo:
            memo[node] = evaluated(node)
        return memo[node]

    def evaluated(node: Node) -> Any:
        match node.op:
            case "load":
                return 0.0
            case "const":
                return single(node.attr)
            case "led" if node.args[0].op == "load":
                try:
                    result = visit(node.args[1])
                except LookupError:
                    result = True
                if result:  # the result depends on the flag
                    masks[node.args[0]] = None
                return False
            case "led":
                return visit(node.args[0]) and visit(node.args[1])
            case "select" if node.args[0].op != "param":
                masks[node.args[0]] = None
                return visit(node.args[2])
            case "shift" if node.attr[2] or not visit(node.args[0]):
                return visit(node.args[0])
        return OPS[node.op].value(node.attr, *map(visit, node.args))

    try:
        numbers = [visit(value) for value in values]
    except LookupError:
        return None
    if any(isinstance(number, float) and number != 0 for number in numbers):
        return None
    return numbers, list(masks)


def _reads_at_rest(values: list[Node]) -> list[tuple[Node, int, int]]:
    """The fields that values read where no mask holds: field, rows down, and the largest distance in columns."""
    reach: dict[tuple[Node, int], int] = {}
    stack = [(value, 0, 0) for value in values]
    for node, dy, dx in taken(stack):
        if node.op == "load" and node.type == REAL:
            reach[node, dy] = max(reach.get((node, dy), 0), abs(dx))
        elif node.op == "shift":
            stack.append((node.args[0], dy + node.attr[0], dx + node.attr[1]))
        else:
            stack += [(arg, dy, dx) for arg in node.args[2 if node.op == "select" else 0 :]]
    order = ordered(values)
    reads = [(field, dy, dx) for (field, dy), dx in reach.items()]
    return sorted(reads, key=lambda read: (order.index(read[0]), read[1]))


FEW = 8
"""The most operations that are applied to the result of choices while it is in registers."""


def join(schedule: Schedule) -> Schedule:
    """Replace every run of consecutive loops over cells, also a single loop, by a `Sweeps`.

    `loop cells: a = …`, `loop cells: b = a[0,1|0] + …` → one loop over the rows of a world, in which `b` follows `a`
    one row behind. A loop that only continues the choices before it is fused with them.
    """
    reads = Counter(loaded(schedule.values))

    def change(block: Block) -> Block:
        result: list[Statement] = []
        run: list[Compute] = []
        for statement in (*block, None):
            loop = statement if isinstance(statement, Compute) and statement.over != "words" else None
            if run and (loop is None or _ends(run, loop)):
                result += [_sweeps(loops, reads) for loops in _components(run)]
                run = []
            if loop is None:
                result += [] if statement is None else [statement]
            elif run and (fused := _fuse(run[-1], loop, reads, schedule.graph)):
                run[-1] = fused
            else:
                run.append(loop)
        return tuple(result)

    return map_blocks(schedule, change)


def _ends(run: Sequence[Compute], loop: Compute) -> bool:
    """True if a loop does not join a run; choices are made by flags that must be complete before."""
    flags = {name for part in run for name, var in part.vars.items() if var.type == FLAG}
    chooses = loop.over == "choices" and not flags.isdisjoint(loop.reads)
    return chooses or keeps_values(loop) or keeps_values(run[-1])


def keeps_values(loop: Compute) -> bool:
    """True if values outside the region are old ones. Such a loop runs alone, so that rows outside cost nothing."""
    return any(out.otherwise is not None and out.otherwise.op == "load" for out in loop.outs)


def _fuse(first: Compute, second: Compute, reads: Counter[str], graph: Graph) -> Compute | None:
    """Choices and a few operations on their results as one loop, if nothing else reads these results.

    `loop choices: a = m ? x : y`, `loop cells: b = 0.9 * a` → `loop choices: b = 0.9 * (m ? x : y)`.
    """
    results = {out.var.name: out.value for out in first.outs}
    if first.over != "choices" or first.region is None or second.region is None:
        return None
    if any(out.var.type != REAL or not out.otherwise or not is_zero(out.otherwise) for out in second.outs):
        return None
    nodes = ordered(second.results)
    simple = all(node.type == REAL and node.op in CONTINUING for node in nodes)
    known = {choices(value)[1].attr for value in results.values()} | results.keys()
    inside = Counter(loaded(second.values))
    few = sum(bool(node.args) for node in nodes) <= FEW
    if not (simple and few and known >= second.reads) or any(reads[name] != inside[name] for name in results):
        return None
    new = rewritten(nodes, graph, lambda node: results.get(node.attr))
    return replace(first, outs=tuple([replace(out, value=new(out.value)) for out in second.outs]))


CONTINUING = ("load", "const", "param", "add", "sub", "mul", "neg", "abs")
"""Operations that are applied to the results of choices in registers."""


def _components(run: Sequence[Compute]) -> list[list[Compute]]:
    """The loops of a run in groups that do not read each other's results."""
    names = made_in(run).keys()
    return connected(run, lambda loop: names & (loop.reads | loop.vars.keys()))


def _sweeps(run: Sequence[Compute], reads: Counter[str]) -> Sweeps:
    """The loops with their parts and lags, and the fields that only loops of the same part read.

    A row that is read at other columns was stored a row earlier: a processor waits for what it has just stored if a load
    does not begin where the store did.
    """
    loops: list[Compute] = []
    makers: dict[str, Compute] = {}
    inside = Counter[tuple[int, str]]()
    part = 0
    for loop in run:
        before = [(read, makers[read.name]) for read in field_reads(loop) if read.name in makers]
        part = max([part, *[maker.part + 1 for read, maker in before if read.wraps and read.dy]])
        behind = [maker.lag + read.dy + (read.dx != 0) for read, maker in before if maker.part == part]
        loops.append(replace(loop, part=part, lag=max([0, *behind])))
        makers |= {name: loops[-1] for name, var in loop.vars.items() if var.type == REAL}
        inside.update((part, name) for name in loaded(loop.values))
    passing = [name for name, loop in makers.items() if reads[name] == inside[loop.part, name]]
    return Sweeps(frees=tuple(passing), body=tuple(loops))
