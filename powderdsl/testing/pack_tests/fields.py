"""Fields of pack tests: drawn ones in start worlds, and those that a last world must have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from powderdsl.model.fields.grids import ANYTHING, DEFAULT
from powderdsl.model.fields.words import direction_word
from powderdsl.model.state import Slot
from powderdsl.model.text import show_number, show_value
from powderdsl.model.types import Cell, Example, FieldGrid, Kind, Ruleset
from powderdsl.simulation.draw import to_numpy

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import World

Place = tuple[int, int, int]
"""World, row, column."""


def with_fields(world: World, examples: Sequence[Example]) -> World:
    """Fresh worlds with the fields that their tests draw; `examples` has the test of each world."""
    names = dict.fromkeys(grid.name for example in examples for grid in example.fields)
    slots = {slot.name: slot for slot in world.sim.slots}
    changed = {}
    for name in names:
        values = to_numpy(world.state[name]).copy()
        may_hold = _holders(world, slots[name])
        for index, example in enumerate(examples):
            for grid in example.fields:
                if grid.name == name:
                    _draw(grid, values[index], may_hold[index])
        changed[name] = values
    return world.sim.replace(world, **changed) if changed else world


def _draw(grid: FieldGrid, values: NDArray[Any], may_hold: NDArray[np.bool_]) -> None:
    """Put the drawn values into those of one world, [H, W] or [2, H, W]."""
    for row, cells in enumerate(grid.cells):
        for column, cell in enumerate(cells):
            if cell and (may_hold[row, column] or not grid.everywhere):
                values[..., row, column] = [low for low, _ in cell] if values.ndim == 3 else cell[0][0]


def _holders(world: World, slot: Slot) -> NDArray[np.bool_]:
    """The cells [B, H, W] whose element can have the slot's field."""
    prop = world.sim.ruleset.property(slot.name)
    limited = slot.of if prop is None else prop.stored
    ids = to_numpy(world.ids)
    return np.ones(ids.shape, np.bool_) if limited is None else np.isin(ids, sorted(limited))


def unlike(grid: FieldGrid, world: World) -> Place | None:
    """The first cell of the first world that is not as the grid says."""
    slot = next(slot for slot in world.sim.slots if slot.name == grid.name)
    found = to_numpy(world.state[grid.name])
    found = found if slot.planes == 2 else found[:, None]
    low, high = np.empty_like(found), np.empty_like(found)
    fresh = to_numpy(world.sim.world(world.ids).state[grid.name])
    fresh = fresh if slot.planes == 2 else fresh[:, None]
    counts = np.ones(found[:, 0].shape, np.bool_)
    for row, cells in enumerate(grid.cells):
        for column, cell in enumerate(cells):
            if cell is None:
                counts[:, row, column] = False
            elif cell == ():
                low[..., row, column] = high[..., row, column] = fresh[..., row, column]
            else:
                low[..., row, column] = [bounds[0] for bounds in cell]
                high[..., row, column] = [bounds[1] for bounds in cell]
    if grid.everywhere:
        counts &= _holders(world, slot)
    wrong = ((found < low) | (found > high)).any(axis=1) & counts
    if not wrong.any():
        return None
    index, row, column = (int(part[0]) for part in np.nonzero(wrong))
    return index, row, column


def described(grid: FieldGrid, world: World, place: Place) -> str:
    """What a cell holds, and what it should: `row 1, column 2 is 3, not 4`."""
    index, row, column = place
    kind = next(slot.kind for slot in world.sim.slots if slot.name == grid.name)
    rules = world.sim.ruleset
    cell = grid.cells[row][column]
    if cell == ():
        fresh = to_numpy(world.sim.world(world.ids).state[grid.name])
        wanted = f"{_word(rules, kind, fresh[index][..., row, column])}, its default"
    else:
        wanted = _wanted(rules, kind, cell)
    found = _word(rules, kind, to_numpy(world.state[grid.name])[index][..., row, column])
    return f"row {row}, column {column} is {found}, not {wanted}"


def field_rows(name: str, world: World, index: int) -> tuple[str, ...]:
    """A field of one world as tests draw it: rows of words, in columns. Floats with all their digits."""
    kind = next(slot.kind for slot in world.sim.slots if slot.name == name)
    values = to_numpy(world.state[name])[index]
    height, width = values.shape[-2:]
    words = [
        [_word(world.sim.ruleset, kind, values[..., row, column]) for column in range(width)]
        for row in range(height)
    ]
    wide = [max(len(row[column]) for row in words) for column in range(width)]
    return tuple(" ".join(word.rjust(size) for word, size in zip(row, wide, strict=True)) for row in words)


def _word(rules: Ruleset, kind: Kind, value: NDArray[Any]) -> str:
    """A value of a cell, as a drawing has it."""
    if kind.name in ("real", "vec2"):
        return ",".join(str(part) for part in np.atleast_1d(value))
    return _name(rules, kind, int(value))


def _name(rules: Ruleset, kind: Kind, value: int) -> str:
    return direction_word(value) if kind.name == "direction" else show_value(rules, kind, value)


def _wanted(rules: Ruleset, kind: Kind, cell: Cell) -> str:
    if cell is None:
        return ANYTHING
    if not cell:
        return DEFAULT
    if kind.name not in ("int", "real", "vec2"):
        return _name(rules, kind, int(cell[0][0]))
    return ",".join(
        show_number(low) if low == high else f"{show_number(low)}..{show_number(high)}" for low, high in cell
    )
