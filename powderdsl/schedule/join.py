"""Merges consecutive loops over cells, so that values of a row are read while they are in the cache."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from powderdsl.ir.ops import FLAG, REAL, Graph, Node, ordered
from powderdsl.schedule.types import (
    Compute,
    Out,
    Schedule,
    Statement,
    Sweeps,
    flat,
    is_zero,
    loaded,
    map_blocks,
    over_variables,
)

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
