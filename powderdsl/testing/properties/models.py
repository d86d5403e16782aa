"""Start worlds from models of the prover: cells that must hold something, amid others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import lcm

from powderdsl.arrays import np
from powderdsl.ir.lower import slot_parts
from powderdsl.model.state import Slot, fitting, slots
from powderdsl.model.types import Ruleset
from powderdsl.prover.questions import Model
from powderdsl.testing.generators.cases import Array, Choices, Start, clamped_to_holders, fresh, random_start

COPIES = 64
"""Worlds of a batch: each has other cells around, and another seed."""

BATCHES = ((0, 1), (2, 1), (2, 3), (5, 2))
"""By batch: the rows and columns around the cells of the model, and the steps that it runs."""

MAX_SIDE = 64


def starts(model: Model, ruleset: Ruleset) -> Iterator[tuple[Start, dict[str, Array], int]]:
    """Worlds that hold the cells of a model, in batches: with draws for a first step, and the number of steps to run."""
    cells = [*model.cells, *((y, x) for _, y, x in model.draws), (0, 0)]
    top, left = (min(cell[axis] for cell in cells) for axis in (0, 1))
    height, width = (max(cell[axis] for cell in cells) + 1 for axis in (0, 1))
    modulus = lcm(1, *(modulus for axis, modulus in model.numbers if axis != "step"))
    for margin, steps in BATCHES:
        sides = []
        for span in (height - top, width - left):
            side = span + margin
            sides.append(fitting(ruleset, side if modulus > MAX_SIDE else -(-side // modulus) * modulus))
        if max(sides) <= MAX_SIDE:
            yield *_batch(model, ruleset, (top, left), (sides[0], sides[1]), Choices.seeded(margin)), steps


def _batch(
    model: Model, ruleset: Ruleset, corner: tuple[int, int], shape: tuple[int, int], choices: Choices
) -> tuple[Start, dict[str, Array]]:
    """Random worlds, half of them of one element, into which the cells and draws of the model are put."""
    known = [element.id for element in ruleset.elements]
    start = random_start(ruleset, choices, (COPIES, *shape))
    ids, places = start.ids.copy(), []
    for world in range(COPIES):
        if world % 2:
            ids[world] = known[world // 2 % len(known)]
        place = [-corner[0], -corner[1]]
        for axis, name in enumerate(("row", "column")):  # the cell asked about has the number of the model
            numbers = [(number, modulus) for (word, modulus), number in model.numbers.items() if word == name]
            if numbers or model.has_edges:
                allowed = [at for at in range(shape[axis]) if all(at % m == number for number, m in numbers)]
                place[axis] = choices.pick(allowed or [place[axis]])
        places.append(place)

    def put(values: Array, cell: tuple[int, int], value: float) -> None:
        for world, (row, column) in enumerate(places):
            values[world, (row + cell[0]) % shape[0], (column + cell[1]) % shape[1]] = value

    table, fields = slots(ruleset), {}
    for cell, bits in model.cells.items():
        number = _number(table[0], ruleset, bits)
        if number in known:
            put(ids, cell, number)
    for slot in table[1:]:
        values = start.fields[slot.name].copy() if slot.name in start.fields else fresh(ruleset, slot, ids)
        for cell, bits in model.cells.items():
            number = None if slot.is_real else _number(slot, ruleset, bits)
            if number is not None:
                put(values, cell, number)
        if (
            slot.is_real and model.floats
        ):  # in every third world, what lies between constants, or is one of them
            near = np.array([choices.pick(model.floats) for _ in range(values.size)]).reshape(values.shape)
            values[::3] = np.clip(near, slot.kind.lo, slot.kind.hi)[::3]
        fields[slot.name] = clamped_to_holders(ruleset, slot, values, ids)
    draws = {}
    for stream in ruleset.streams:
        whole = [choices.below(1 << stream.bits) for _ in range(ids.size)]
        draws[stream.name] = (np.array(whole).reshape(ids.shape) + 0.5) / 2.0**stream.bits
        for (name, y, x), number in model.draws.items():
            if name == stream.name:
                put(draws[stream.name], (y, x), (number + 0.5) / 2.0**stream.bits)
    steps = [number for (axis, _), number in model.numbers.items() if axis == "step"]
    clock = np.full(COPIES, max(steps, default=0), np.int64)
    start = Start.fresh(ids, fields=fields, params=_params(model, ruleset)).seeded()
    return replace(start, step=clock), draws


def _number(slot: Slot, ruleset: Ruleset, bits: Mapping[str, bool]) -> int | None:
    """The value of a slot in a cell of the model; None if it says nothing about it."""
    part, *_ = slot_parts(slot, ruleset)
    names = part.planes
    if not any(name in bits for name in names):
        return None
    number = sum(bits.get(name, False) << i for i, name in enumerate(names))
    return number - (1 << len(names)) if part.type.signed and number >> (len(names) - 1) else number


def _params(model: Model, ruleset: Ruleset) -> dict[str, Array]:
    """The values of parameters, if the model says anything about them."""
    given = {
        name: number / (1 << threshold.bits) if threshold else number
        for (name, threshold), number in model.params.items()
    }
    if not given:
        return {}
    return {p.name: np.full(COPIES, float(given.get(p.name, p.default))) for p in ruleset.params}
