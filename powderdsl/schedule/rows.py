"""Plans of loops over cells: in which rows each one runs, and where the rows that it reads and writes are. Targets print them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from powderdsl.ir.ops import REAL, Node, ordered
from powderdsl.schedule.join import keeps
from powderdsl.schedule.types import Compute, Out, Schedule, Sweeps, alternatives, choices, field_reads, flat

ANY_PASS = 1 << 30
"""A field is read as far as any pass reads its slot."""

TURNED = 16
"""The masks of a loop begin at a multiple of this many words: the most that a vector has."""


@dataclass(frozen=True)
class Ring:
    """The rows of a passing field: `depth` of them wait, a power of two, from row `first` of all that wait.

    `bare`: the columns beyond the edges that hold zeros, since no loop reads this field around them; None if one does.
    """

    first: int
    depth: int
    bare: int | None


@dataclass(frozen=True)
class RowLoop:
    """A loop over cells in a run of loops.

    `marked` are the planes whose rows are marked before the run, to find those in which the loop has work. `chains` and
    `masks` are those of a loop over choices; its masks begin at `first_mask` of all that are turned.
    """

    loop: Compute
    marked: tuple[str, ...]
    chains: tuple[tuple[Node, ...], ...]
    first_mask: int

    @property
    def masks(self) -> tuple[str, ...]:
        """The planes of the masks, in the order in which choices are applied."""
        return tuple(choice.args[0].attr for choice in self.chains[0]) if self.chains else ()


@dataclass(frozen=True)
class Rows:
    """A run of loops over cells."""

    loops: tuple[RowLoop, ...]
    rings: Mapping[str, Ring]
    """The fields whose rows wait only until later loops have read them."""
    saved: Mapping[str, tuple[int, int]]
    """Fields that are written over while later rows still read their first rows, around the edge: the number of rows that are
    saved, and the first of them among all that wait."""
    waiting: int
    turned: int
    places: Mapping[str, str]
    """The variables that hold the old values of others, in a loop that changes fields in place."""
    reaches: Mapping[str, int]
    """The columns of each field that are read beyond the edges, see `reaches_of`."""

    @property
    def outs(self) -> list[Out]:
        """The variables that all loops compute."""
        return [out for part in self.loops for out in part.loop.outs]


def rows_of(sweeps: Sweeps, reaches: Mapping[str, int]) -> Rows:
    """The plan of loops that run together."""
    rings, saved, waiting = _waiting(sweeps)
    made = sweeps.vars
    loops = []
    turned = 0
    for loop in sweeps.body:
        chains = chains_of(loop) if loop.over == "choices" else []
        _, planes = region_of(loop)
        # Choices test their masks themselves.
        marked = [] if chains else [name for name in planes if name not in made]
        loops.append(RowLoop(loop, tuple(marked), tuple(map(tuple, chains)), turned))
        turned += -(-len(loops[-1].masks) // TURNED) * TURNED
    first = sweeps.body[0]
    places = {out.into: out.var.name for out in first.outs if out.into is not None} if keeps(first) else {}
    return Rows(tuple(loops), rings, saved, waiting, turned, places, reaches)


def _waiting(sweeps: Sweeps) -> tuple[dict[str, Ring], dict[str, tuple[int, int]], int]:
    """The rings of passing fields, the rows that are saved of others, and the number of rows that wait in all."""
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
    """Tell whether a loop only copies fields."""
    return all(out.value.op == "load" and out.var.type == REAL for out in loop.outs)


def reaches_of(schedule: Schedule) -> dict[str, int]:
    """The columns of each field that are read beyond the edges; ANY_PASS for fields that slots may get."""
    reaches = {node.attr: ANY_PASS for node in schedule.results if node.op == "load"}
    copies: list[tuple[str, Node]] = []  # a field whose rows may be those of another one
    for statement in flat(schedule.body):
        for node in ordered(statement.values):
            if node.op == "shift" and node.type == REAL and node.attr[2]:
                name = node.args[0].attr
                reaches[name] = max(reaches.get(name, 0), abs(node.attr[1]))
        copies += statement.olds.items()
    for _ in copies:
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
