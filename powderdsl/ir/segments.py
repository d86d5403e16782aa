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
    """Consecutive passes. `planes` is `program` on bit planes, or None for passes on cells."""

    program: Program
    planes: Program | None


@dataclass(frozen=True)
class PassForm:
    """A pass and its form on bit planes, or the reason and the rule why bit planes cannot carry it."""

    cells: PassGraph
    planes: PassGraph | None
    why: str = ""
    place: str = ""


def choose_form(program: Program, pass_: PassGraph) -> PassForm:
    """The form in which a pass of a program runs."""
    try:
        return PassForm(pass_, lower_pass(program, pass_))
    except NotBits as error:
        return PassForm(pass_, None, str(error), error.place)


def segments(
    program: Program, choose_form: Callable[[Program, PassGraph], PassForm] = choose_form
) -> tuple[Segment, ...]:
    """The longest segments of a program. Slots that reset do so in the first one only."""
    parts = []
    slots = program.slots
    forms = [choose_form(program, pass_) for pass_ in program.passes]
    if not forms:
        return (Segment(program, lower_bits(program)),)
    for packed, group in groupby(forms, lambda form: form.planes is not None):
        run = tuple(group)
        part = replace(program, slots=slots, passes=tuple(form.cells for form in run))
        passes = tuple(form.planes for form in run if form.planes is not None)
        planes = replace(part, slots=plane_slots(slots), passes=passes)
        parts.append(Segment(part, planes if packed else None))
        slots = tuple(replace(slot, resets=False) for slot in program.slots)
    return tuple(parts)
