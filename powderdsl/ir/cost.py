"""The cost of each pass of a program, counted in its IR: nothing runs, and nothing counts as skipped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from powderdsl.ir.ops import REAL, Node, Offset, PassGraph, Program, nodes_of
from powderdsl.ir.segments import Carried, carry

GATES = {"not": 1, "and": 1, "or": 1, "xor": 1, "select": 3}
"""Gates that an operation on bit planes takes: a choice is (a and c) or (b and not c)."""

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
    carried = [carry(program, pass_) for pass_ in program.passes]
    counts = [_work(one) for one in carried]
    weights = [sum(WEIGHTS[kind] * number for kind, number in count.items()) for count in counts]
    total = sum(weights) or 1.0
    return tuple(
        PassCost(
            name=one.cells.name,
            pack=one.cells.pack,
            moments=len(one.cells.substeps),
            **{kind: count[kind] for kind in WEIGHTS},
            neighbors=len(_neighbors(one.cells)),
            form="planes" if one.planes else "cells",
            why=one.why,
            place=one.place,
            share=weight / total,
        )
        for one, count, weight in zip(carried, counts, weights, strict=True)
    )


def _work(carried: Carried) -> Counter[str]:
    """The amount of each kind of work."""
    nodes = nodes_of(carried.planes or carried.cells, substeps=False)
    count = Counter({"random_bits": _random_bits(nodes)})
    if carried.planes is None:
        count["dense"] = sum(1 for node in nodes if node.args)
        return count
    for node in nodes:
        if node.type == REAL or any(arg.type == REAL for arg in node.args):
            count["reals"] += bool(node.args)
        elif node.op in GATES:
            count["gates"] += GATES[node.op]
        elif node.op == "shift":
            count["shifts"] += 1
        elif node.op in ("swap", "arrive"):
            count["moves"] += 1
    return count


def _random_bits(nodes: Iterable[Node]) -> int:
    """Bits drawn a cell: for each stream the bits that its finest comparison needs. A pass shares them."""
    needed: Counter[str] = Counter()
    for node in nodes:
        if node.op in ("chance", "below", "below_planes", "draw"):
            stream, bits = node.attr[:2]
            limit = node.attr[2] if node.op == "chance" else 1
            needed[stream] = max(needed[stream], bits - ((limit & -limit).bit_length() - 1))
    return needed.total()


def _neighbors(pass_: PassGraph) -> set[Offset]:
    """The offsets at which a pass reads or writes other cells."""
    found: set[Offset] = set()
    for node in nodes_of(pass_, substeps=False):
        if node.op == "shift":
            found.add(node.attr[:2])
        elif node.op == "count":
            found |= {(dy, dx) for dy, dx, _ in node.attr[0]}
        elif node.op in ("swap", "arrive"):
            found.add(node.attr)
    return found - {(0, 0)}
