"""A program in consecutive segments, each in one form: bit planes, or one value a cell where planes cannot carry a pass.

Random numbers depend on streams, cells and steps, never on the pass: segments draw the same numbers as the program.
What each pass costs is counted in its form: nothing runs, and nothing counts as skipped.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby

from powderdsl.ir.bits import NotBits, lower_bits, lower_pass, plane_slots
from powderdsl.ir.ops import OPS, REAL, Offset, PassGraph, Program, nodes_of


@dataclass(frozen=True)
class Segment:
    """Passes in a row. `planes` is `program` on bit planes, None if they run on cells."""

    program: Program
    planes: Program | None


@dataclass(frozen=True)
class Carried:
    """A pass and the same on bit planes, or why these cannot carry it and the rule that this is due to."""

    cells: PassGraph
    planes: PassGraph | None
    why: str = ""
    place: str = ""


def carry(program: Program, pass_: PassGraph) -> Carried:
    """The form in which a pass of a program runs."""
    try:
        return Carried(pass_, lower_pass(program, pass_))
    except NotBits as error:
        return Carried(pass_, None, str(error), error.place)


def segments(program: Program, carry: Callable[[Program, PassGraph], Carried] = carry) -> tuple[Segment, ...]:
    """The longest segments of a program. Slots that reset do so in the first one only."""
    parts = []
    slots = program.slots
    carried = [carry(program, pass_) for pass_ in program.passes]
    if not carried:
        return (Segment(program, lower_bits(program)),)
    for packed, group in groupby(carried, lambda form: form.planes is not None):
        forms = tuple(group)
        part = replace(program, slots=slots, passes=tuple(form.cells for form in forms))
        planes = replace(
            part,
            slots=plane_slots(slots),
            passes=tuple(form.planes for form in forms if form.planes is not None),
        )
        parts.append(Segment(part, planes if packed else None))
        slots = tuple(replace(slot, resets=False) for slot in program.slots)
    return tuple(parts)


WEIGHTS = {"gates": 1.0, "shifts": 4.0, "moves": 8.0, "random_bits": 8.0, "reals": 32.0, "dense": 200.0}
"""About what one of each takes, in vector operations on 512 cells: sixteen floats fill the vector that holds 512 flags,
a random bit is a hash, what runs on cells goes through memory. Chosen so that the shares of the shipped rulesets come
out as native code needs them on worlds full of everything: most do to a factor of two."""


@dataclass(frozen=True)
class PassCost:
    """One pass. Counts are for every cell and step.

    `gates` are those of flags and integers on bit planes, `shifts` the planes read at a neighbor, `moves` those
    exchanged with one, `random_bits` what its draws take at most, `reals` operations on float32. A pass on cells has
    `dense` operations instead, with the reason and the rule (``file:line``) that is why. `share` is an estimate.
    """

    name: str
    pack: str
    moments: int
    """Substeps, by the name that the output of `check --json` has for them."""
    gates: int
    shifts: int
    moves: int
    random_bits: int
    reals: int
    dense: int
    neighbors: int
    form: str
    why: str
    place: str
    share: float


def costs(program: Program) -> tuple[PassCost, ...]:
    """The costs of the passes of an optimized program, in their order. Shares add up to 1."""
    forms = [carry(program, pass_) for pass_ in program.passes]
    counts = [_work(form) for form in forms]
    weights = [sum(WEIGHTS[kind] * count[kind] for kind in WEIGHTS) for count in counts]
    total = sum(weights) or 1.0
    return tuple(
        PassCost(
            name=form.cells.name,
            pack=form.cells.pack,
            moments=len(form.cells.substeps),
            **{kind: count[kind] for kind in WEIGHTS},
            neighbors=_neighbors(form.cells),
            form="planes" if form.planes else "cells",
            why=form.why,
            place=form.place,
            share=weight / total,
        )
        for form, count, weight in zip(forms, counts, weights, strict=True)
    )


def _work(form: Carried) -> Counter[str]:
    """The amount of each kind of work."""
    count: Counter[str] = Counter()
    bits: Counter[str] = Counter()
    """Random bits a cell: for each stream those that its finest comparison needs. A pass shares them."""
    for node in nodes_of(form.planes or form.cells, substeps=False):
        if node.op in ("chance", "below", "below_planes", "draw"):
            stream, most, *limit = node.attr
            own = most - ((limit[0] & -limit[0]).bit_length() - 1) if limit else most
            bits[stream] = max(bits[stream], own)
        if form.planes is None:
            count["dense"] += bool(node.args)
        elif node.type == REAL or any(arg.type == REAL for arg in node.args):
            count["reals"] += bool(node.args)
        else:
            count["gates"] += OPS[node.op].gates
            count["shifts"] += node.op == "shift"
            count["moves"] += node.op in ("swap", "arrive")
    return count + Counter(random_bits=bits.total())


def _neighbors(pass_: PassGraph) -> int:
    """The number of offsets at which a pass reads or writes other cells."""
    offsets: set[Offset] = {(0, 0)}
    for node in nodes_of(pass_, substeps=False):
        if node.op in ("shift", "swap", "arrive"):
            offsets.add(node.attr[:2])
        elif node.op == "count":
            offsets |= {(dy, dx) for dy, dx, _ in node.attr[0]}
    return len(offsets) - 1
