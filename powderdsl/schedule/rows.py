"""Plans of loops over cells, which targets print: the rows in which each loop runs, and the rows that it reads and writes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from powderdsl.ir.ops import REAL, Node, ordered
from powderdsl.schedule.join import keeps_values
from powderdsl.schedule.types import Compute, Out, Schedule, Sweeps, alternatives, choices, field_reads, flat

ANY_PASS = 1 << 30
"""The reach of a field that ends up in a slot: any pass may read it."""


@dataclass(frozen=True)
class Ring:
    """The buffer of a passing field: `depth` rows, a power of two, from row `first` of all buffered rows.

    `bare`: the columns beyond the edges that hold zeros, since no loop reads the field around the edge; None if one does.
    """

    first: int
    depth: int
    bare: int | None


@dataclass(frozen=True)
class Rows:
    """A run of loops over cells."""

    loops: tuple[Compute, ...]
    rings: Mapping[str, Ring]
    """The passing fields: their rows are buffered until later loops have read them."""
    saved: Mapping[str, tuple[int, int]]
    """Fields that are overwritten while later rows still read their first rows, around the edge: the number of saved rows,
    and the position of the first among all buffered rows."""
    waiting: int
    """The number of buffered rows."""
    places: Mapping[str, str]
    """In a loop that changes fields in place: the variable that holds the old values of another."""
    reaches: Mapping[str, int]
    """The columns of each field that are read beyond the edges (`reaches_of`)."""

    @property
    def outs(self) -> list[Out]:
        return [out for loop in self.loops for out in loop.outs]


def rows_of(sweeps: Sweeps, reaches: Mapping[str, int]) -> Rows:
    """The plan of loops that run together."""
    kept = sweeps.body[0].outs if keeps_values(sweeps.body[0]) else ()
    places = {out.into: out.var.name for out in kept if out.into is not None}
    return Rows(sweeps.body, *_buffer_rows(sweeps), places, reaches)


def _buffer_rows(sweeps: Sweeps) -> tuple[dict[str, Ring], dict[str, tuple[int, int]], int]:
    """The rings of passing fields, the saved rows of other fields, and the number of all buffered rows."""
    # A reader `d` rows behind its writer, which reads `dy` rows down, needs the last `d - dy + 1` rows.
    lags = {name: loop.lag for loop in sweeps.body for name in loop.vars}
    depths = dict.fromkeys(sweeps.frees, 1)
    bare: dict[str, int | None] = dict.fromkeys(sweeps.frees, 0)
    below = {out.into: 0 for loop in sweeps.body for out in loop.outs if out.into is not None}
    for loop in sweeps.body:
        for read in field_reads(loop):
            if (name := read.name) in depths:
                depths[name] = max(depths[name], loop.lag - lags[name] - read.dy + 1)
                around, reach = read.wraps and read.dx, bare[name]
                bare[name] = None if around or reach is None else max(reach, abs(read.dx))
            elif name in below and read.wraps:
                below[name] = max(below[name], read.dy)
    rings, saved = {}, {}
    count = 0
    for name, depth in depths.items():
        rings[name] = Ring(count, 1 << (depth - 1).bit_length(), bare[name])
        count += rings[name].depth
    for old, rows in below.items():
        if rows:
            saved[old] = rows, count
            count += rows
    return rings, saved, count


def region_of(loop: Compute) -> tuple[list[Node], list[str]]:
    """The parts of a loop's region: fields that must be live in some row (`live`), and planes."""
    parts = alternatives(loop.region)
    return [part for part in parts if part.op == "live"], [p.attr for p in parts if p.op == "load"]


def is_copy(loop: Compute) -> bool:
    """True if a loop only copies fields."""
    return all(out.value.op == "load" and out.var.type == REAL for out in loop.outs)


def reaches_of(schedule: Schedule) -> dict[str, int]:
    """The columns of each field that are read beyond the edges; ANY_PASS for fields that may end up in slots."""
    reaches = {node.attr: ANY_PASS for node in schedule.results if node.op == "load"}
    copies: list[tuple[str, Node]] = []  # a field may hold rows of another field, which needs the same reach
    for statement in flat(schedule.body):
        for node in ordered(statement.values):
            if node.op == "shift" and node.type == REAL and node.attr[2]:
                name = node.args[0].attr
                reaches[name] = max(reaches.get(name, 0), abs(node.attr[1]))
        copies += statement.olds.items()
    for _ in copies:  # until nothing changes: copies may form chains
        before = dict(reaches)
        for name, old in copies:
            if old.op == "load" and old.type == REAL:
                reaches[old.attr] = max(reaches.get(old.attr, 0), reaches.get(name, 0))
        if reaches == before:
            break
    return reaches


def chains_of(loop: Compute) -> list[list[Node]]:
    """The chains of choices of a loop, all on the same masks, in the order in which choices are applied."""
    chains: list[list[Node]] = []
    below: set[Node] = set()
    for node in reversed(ordered(loop.results)):
        if node.op == "select" and node not in below:
            chain, _ = choices(node)
            below.update(chain)
            chains.append(chain[::-1])
    return chains[::-1]
