"""The cost of each pass, counted in its graph. No world is run; skipping is not considered."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from powderdsl.ir.bits import PassForm, choose_form
from powderdsl.ir.ops import OPS, REAL, Offset, PassGraph, Program, nodes_of

WEIGHTS = {"gates": 1, "shifts": 4, "moves": 8, "random_bits": 8, "float_operations": 32, "dense": 200}
"""The cost of one operation of each kind, in vector operations on 512 cells. A vector holds 512 flags or sixteen floats;
a random bit is a hash; passes on cells go through memory. The shares of the shipped rulesets agree with measurements of
native code on worlds with all elements, mostly within a factor of two."""


@dataclass(frozen=True)
class PassCost:
    """The cost of one pass. Counts are per cell and step.

    `gates` counts gates of flags and integers on bit planes, `shifts` the planes read at a neighbor, `moves` the planes
    exchanged with one, `random_bits` the most bits that draws take, `float_operations` those on float32. A pass on cells
    has `dense` operations instead, with the reason (`why`) and the rule that causes it (`place`, ``file:line``). `share`
    is an estimate.
    """

    name: str
    pack: str
    substeps: int
    gates: int
    shifts: int
    moves: int
    random_bits: int
    float_operations: int
    dense: int
    neighbors: int
    form: str
    why: str
    place: str
    share: float


def costs(program: Program) -> tuple[PassCost, ...]:
    """The costs of the passes of an optimized program, in their order. Shares add up to 1."""
    forms = [choose_form(program, pass_) for pass_ in program.passes]
    counts = [_work(form) for form in forms]
    weights = [sum(WEIGHTS[kind] * count[kind] for kind in WEIGHTS) for count in counts]
    total = sum(weights) or 1.0
    return tuple(
        PassCost(
            name=form.cells.name,
            pack=form.cells.pack,
            substeps=len(form.cells.substeps),
            **{kind: count[kind] for kind in WEIGHTS},
            neighbors=_neighbors(form.cells),
            form="planes" if form.planes else "cells",
            why=form.why,
            place=form.place,
            share=weight / total,
        )
        for form, count, weight in zip(forms, counts, weights, strict=True)
    )


def _work(form: PassForm) -> Counter[str]:
    count: Counter[str] = Counter()
    bits: Counter[str] = Counter()
    """Random bits per cell: for each stream, the bits that its finest comparison needs. A pass shares them."""
    for node in nodes_of(form.planes or form.cells, substeps=False):
        if node.op in ("chance", "below", "below_planes", "draw"):
            stream, most, *limit = node.attr
            own = most - ((limit[0] & -limit[0]).bit_length() - 1) if limit else most
            bits[stream] = max(bits[stream], own)
        if form.planes is None:
            count["dense"] += bool(node.args)
        elif node.type == REAL or any(arg.type == REAL for arg in node.args):
            count["float_operations"] += bool(node.args)
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
