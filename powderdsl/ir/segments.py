"""A program in consecutive segments, each in one form: bit planes, or one value a cell where planes cannot carry a pass.

Random numbers depend on streams, cells and steps, never on the pass: segments draw the same numbers as the program.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby

from powderdsl.ir.bits import NotBits, lower_bits, lower_pass, plane_slots
from powderdsl.ir.ops import PassGraph, Program


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
