"""Merges consecutive loops over cells, so that values of a world are read while they are in the cache."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from powderdsl.ir.ops import REAL, Node
from powderdsl.schedule.types import (
    Compute,
    Schedule,
    Statement,
    Sweeps,
    flat,
    in_order,
    loaded,
    map_blocks,
    ordered,
    values_of,
)

Read = tuple[str, int, int]
"""A field and the rows and columns by which a read is offset."""


def join(schedule: Schedule) -> Schedule:
    """Every run of consecutive loops over cells, also a single one, becomes a `Sweeps`.

    `loop cells: a = …`, `loop cells: b = a[0,1] + …` → one loop over worlds, row by row.
    """
    everything = [node for _, node in schedule.leaves]
    everything += [node for statement in flat(schedule.body) for node in values_of(statement)]
    reads: dict[str, int] = {}
    for name in loaded(everything):
        reads[name] = reads.get(name, 0) + 1

    def change(block: tuple[Statement, ...]) -> tuple[Statement, ...]:
        result: list[Statement] = []
        run: list[Compute] = []
        for statement in (*block, None):
            if isinstance(statement, Compute) and statement.over in ("cells", "choices"):
                run.append(statement)
                continue
            if run:
                result.append(_joined(run, reads))
                run = []
            if statement is not None:
                result.append(statement)
        return tuple(result)

    return replace(schedule, body=map_blocks(schedule.body, change))


def _joined(run: Sequence[Compute], reads: dict[str, int]) -> Sweeps:
    written = [out.var.name for loop in run for out in loop.outs if out.var.type == REAL]
    inside = dict.fromkeys(written, 0)
    for name in loaded(node for loop in run for node in values_of(loop)):
        if name in inside:
            inside[name] += 1
    passing = {name for name in written if reads.get(name, 0) == inside[name]}
    over = _written_over(run, passing)
    loops = tuple(
        replace(loop, outs=tuple(replace(out, into=over.get(out.var.name)) for out in loop.outs))
        for loop in run
    )
    return Sweeps(loops, tuple(_parts(run)), tuple(name for name in written if name in passing))


def field_reads(loop: Compute) -> list[Read]:
    """The fields that a loop or its region reads, with offsets."""
    found: dict[Read, None] = {}
    nodes: list[Node] = ordered(values_of(loop))
    for node in nodes:
        if node.op == "load" and node.type == REAL:
            found[str(node.attr), 0, 0] = None
        elif node.op in ("shift", "live") and node.args[0].op == "load":
            dy, dx = node.attr[:2]
            if node.args[0].type == REAL:
                found[str(node.args[0].attr), dy, dx if node.op == "shift" else 0] = None
    return list(found)


def _parts(run: Sequence[Compute]) -> list[int]:
    """The part of each loop: a loop that reads other rows of an earlier one is in a later part."""
    parts: list[int] = []
    made: dict[str, int] = {}
    for loop in run:
        far = [made[name] + 1 for name, dy, _ in field_reads(loop) if dy and name in made]
        parts.append(max([*far, *parts[-1:]], default=0))
        made |= {out.var.name: parts[-1] for out in loop.outs if out.var.type == REAL}
    return parts


def _written_over(run: Sequence[Compute], passing: set[str]) -> dict[str, str]:
    """Fields that overwrite, cell by cell, a field of the run that their loop is the last to read."""
    over: dict[str, str] = {}
    earlier: set[str] = set()
    reads = [field_reads(loop) for loop in run]
    for number, loop in enumerate(run):
        others = [read for i, one in enumerate(reads) if i != number for read in one]
        later = {name for one in reads[number + 1 :] for name, _, _ in one}
        far = {name for name, dy, _ in others if dy} | {name for name, dy, dx in reads[number] if dy or dx}
        free = in_order({name for name, _, _ in reads[number]} & earlier & passing - later - far)
        fields = [out.var.name for out in loop.outs if out.var.type == REAL]
        if loop.over == "cells":
            over |= dict(zip(fields, free, strict=False))
        earlier |= set(fields)
    return over
