"""Lifetimes on targets that count references: variables are released after the last statement that reads them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from powderdsl.ir.ops import FLAG, REAL, Graph, Node
from powderdsl.schedule.join import field_reads, keeps
from powderdsl.schedule.rewrite import with_values
from powderdsl.schedule.types import (
    ANSWER,
    Carried,
    Compute,
    Guard,
    Move,
    Namer,
    Out,
    Release,
    Schedule,
    Statement,
    Sweeps,
    combined,
    flat,
    in_order,
    load,
    loaded,
    read_elsewhere,
)


def release(schedule: Schedule) -> Schedule:
    """Every variable is released exactly once, even if nothing reads it; planes overwrite old ones that end.

    `swap by m: b = a`, where `a` is not read again → `b = a into a`; the same where a loop over words changes some words.
    """
    live = set(loaded(node for _, node in schedule.leaves))
    body = _block(schedule.body, live, Namer(schedule), schedule.graph)
    return replace(schedule, body=body)


def _block(
    body: Sequence[Statement], live_end: set[str], namer: Namer, graph: Graph
) -> tuple[Statement, ...]:
    lives: list[set[str]] = []
    live = set(live_end)
    for statement in reversed(body):
        lives.append(live)
        live = live_before(statement, live)
    result: list[Statement] = []
    for given, after in zip(body, reversed(lives), strict=True):
        statement = given
        written = {var.name for var in statement.defined() if var.type != ANSWER}
        gone = (reads(statement) | written) - after
        if isinstance(statement, Guard):
            outside = reads(statement) - made_in(statement.body)
            kept = {var.name for var, _ in statement.keeps}
            # Outer variables are released after the guard, whether its body runs or not.
            inner = _block(statement.body, after | kept | outside, namer, graph)
            statement = replace(statement, body=inner)
            gone = (outside | kept) - after
        elif isinstance(statement, Move):
            statement = _in_place(statement, after)
            gone -= {plane.into for plane in statement.planes if plane.into is not None}
        elif isinstance(statement, Sweeps) and keeps(statement.loops[0]):
            loop = _overwriting(statement.loops[0], after)
            statement = replace(statement, loops=(loop,))
            gone -= {out.into for out in loop.outs if out.into is not None}
        elif isinstance(statement, Sweeps):
            statement = _overtaken(_put_off(statement, after, namer, graph), after)
            gone -= {out.into for loop in statement.loops for out in loop.outs if out.into is not None}
        elif isinstance(statement, Compute) and statement.region is not None:
            statement = _updated(statement, after | read_elsewhere(statement.values()))
            gone -= {out.into for out in statement.outs if out.into is not None}
        result.append(statement)
        if gone:
            result.append(Release(tuple(in_order(gone))))
    return tuple(result)


def _in_place(move: Move, after: set[str]) -> Move:
    """A movement that overwrites what ends with it: the old plane, or the one whose flags stay where none arrives."""
    reads = Counter(loaded([move.movers]))
    for plane in move.planes:
        reads.update(set(loaded([plane.old, plane.leaves])))

    def overwritten(plane: Carried) -> str | None:
        stays = plane.leaves if plane.leaves.op in ("load", "const") else plane.old
        free = stays.op == "load" and stays.attr not in after and reads[str(stays.attr)] == 1
        return str(stays.attr) if free else None

    return replace(move, planes=tuple(replace(plane, into=overwritten(plane)) for plane in move.planes))


def _overwriting(loop: Compute, after: set[str]) -> Compute:
    """A loop that changes some rows of fields, in place where nothing reads the old one elsewhere."""
    far = {read.name for read in field_reads(loop) if (read.dy or read.dx) and not read.live}
    return _updated(loop, after | far)


def _put_off(sweeps: Sweeps, after: set[str], namer: Namer, graph: Graph) -> Sweeps:
    """Choices whose result waits for a loop that stores it over their old fields, when no row is missing any more.

    `loop choices: b = m ? f(a[-1,0]) : a` → `b'` in its place, and `loop cells, 2 behind: b = b' into a`.
    """
    loop = sweeps.loops[0]
    lasting = [out for out in loop.outs if out.var.name not in sweeps.passing]
    first, readers = _last_reads(sweeps, after)
    free = [name for name in first if first[name] < NEVER and readers[name] == 0]
    if (
        loop.over != "choices"
        or loop.region is None
        or any(sweeps.parts)
        or not lasting
        or len(free) < len(lasting)
    ):
        return sweeps
    waiting = {out.var.name: namer.var(REAL) for out in lasting}

    def rule(node: Node) -> Node | None:
        return load(graph, waiting[str(node.attr)]) if node.op == "load" and node.attr in waiting else None

    loops = [with_values(one, graph, rule) for one in sweeps.loops]
    outs = tuple(replace(out, var=waiting.get(out.var.name, out.var)) for out in loop.outs)
    zero = graph.node("const", REAL, (), 0.0)
    olds = [load(graph, waiting[out.var.name]) for out in lasting]
    region = combined("or", [graph.node("live", FLAG, (old,), (0, 0)) for old in olds], graph)
    stored = tuple(Out(out.var, old, None, zero) for out, old in zip(lasting, olds, strict=True))
    return Sweeps(
        (replace(loop, outs=outs), *(one for one in loops[1:] if isinstance(one, Compute)), Compute(stored, loop.place, "cells", region)),
        (*sweeps.parts, 0),
        (*sweeps.lags, max(first[name] for name in free)),
        (*sweeps.passing, *(var.name for var in waiting.values())),
    )  # fmt: skip


def _last_reads(sweeps: Sweeps, after: set[str]) -> tuple[dict[str, int], dict[str, int]]:
    """By field that loops read: the least lag with which a row of it may be written over, and the last loop that reads it."""
    made = {out.var.name for loop in sweeps.loops for out in loop.outs}
    first: dict[str, int] = {}
    readers: dict[str, int] = {}
    for number, (loop, part, lag) in enumerate(zip(sweeps.loops, sweeps.parts, sweeps.lags, strict=True)):
        for read in field_reads(loop):
            far = part > 0 or (read.live and read.dy != 0)
            least = NEVER if far or read.name in after or read.name in made else lag - read.dy + 1
            first[read.name] = max(first.get(read.name, 0), least)
            readers[read.name] = number
    return first, readers


def _overtaken(sweeps: Sweeps, after: set[str]) -> Sweeps:
    """Loops with fields that overwrite a field which earlier loops of the part have read in all rows so far."""
    first, readers = _last_reads(sweeps, after)
    loops = []
    for number, (loop, part, lag) in enumerate(zip(sweeps.loops, sweeps.parts, sweeps.lags, strict=True)):
        free = [name for name in first if first[name] <= lag and readers[name] < number and part == 0]
        outs = []
        for out in loop.outs:
            lasts = out.var.type == REAL and out.var.name not in sweeps.passing
            into = free.pop(0) if lasts and free else None
            if into is not None:
                first[into] = NEVER
            outs.append(replace(out, into=into))
        loops.append(replace(loop, outs=tuple(outs)))
    return replace(sweeps, loops=tuple(loops))


NEVER = 1 << 30


def _updated(loop: Compute, after: set[str]) -> Compute:
    olds = Counter(str(out.otherwise.attr) for out in loop.outs if out.otherwise is not None)
    outs = []
    for out in loop.outs:
        old = str(out.otherwise.attr) if out.otherwise is not None else ""
        ends = old and old not in after and olds[old] == 1
        outs.append(replace(out, into=old) if ends else out)
    return replace(loop, outs=tuple(outs))


def live_before(statement: Statement, after: set[str]) -> set[str]:
    """The variables that are live before a statement, given those that are live after it."""
    live = after - {var.name for var in statement.defined()}
    return live | (reads(statement) - made_in([statement]))


def reads(statement: Statement) -> set[str]:
    """The variables that a statement reads, including nested statements."""
    names: set[str] = set()
    for inner in flat([statement]):
        passing = inner.passing if isinstance(inner, Sweeps) else ()
        names |= set(loaded(inner.values())) - set(passing)
    return names


def made_in(body: Sequence[Statement]) -> set[str]:
    """The variables that statements define, including nested ones."""
    return {var.name for statement in flat(body) for var in statement.defined()}
