"""Fields of pack tests: drawn in start worlds, and expected in last worlds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from powderdsl.arrays import NDArray, np
from powderdsl.model.fields.words import direction_word
from powderdsl.model.text import show_number, show_value
from powderdsl.model.types import Cell, Example, FieldGrid, Kind, Ruleset
from powderdsl.testing.generators.cases import holding

if TYPE_CHECKING:
    from powderdsl.simulation.any_arrays import AnyWorld, W


def with_fields(world: W, examples: Sequence[Example]) -> W:
    """Fresh worlds with the fields that their tests draw; `examples` has the test of each world."""
    names = dict.fromkeys(grid.name for example in examples for grid in example.fields)
    slots = {slot.name: slot for slot in world.sim.slots}
    changed = {}
    to_numpy = world.sim.kind.to_numpy
    for name in names:
        values = to_numpy(world.state[name]).copy()
        may_hold = holding(world.sim.ruleset, slots[name], to_numpy(world.ids))
        for index, example in enumerate(examples):
            for grid in example.fields:
                if grid.name == name:
                    _draw(grid, values, index, may_hold[index])
        changed[name] = values
    found: W = world.sim.replace(world, **changed) if changed else world
    return found


def _draw(grid: FieldGrid, values: NDArray[Any], world: int, may_hold: NDArray[np.bool_]) -> None:
    """Put the drawn values into those of one of some worlds, [B, H, W] or [B, 2, H, W]."""
    for row, cells in enumerate(grid.cells):
        for column, cell in enumerate(cells):
            if cell and (may_hold[row, column] or not grid.everywhere):
                drawn = [low for low, _ in cell] if values.ndim == 4 else cell[0][0]
                values[(world, ..., row, column)] = drawn


def field_problem(grid: FieldGrid, world: AnyWorld) -> tuple[int, str] | None:
    """The first of some worlds that is not as the grid says: its number, and `row 1, column 2 is 3, not 4`."""
    slot = next(slot for slot in world.sim.slots if slot.name == grid.name)
    to_numpy = world.sim.kind.to_numpy
    found, fresh = (to_numpy(one.state[grid.name]) for one in (world, world.sim.world(world.ids)))
    low, high = fresh.copy(), fresh.copy()
    counts = holding(world.sim.ruleset, slot, to_numpy(world.ids))
    if not grid.everywhere:
        counts = np.ones_like(counts)
    for row, cells in enumerate(grid.cells):
        for column, cell in enumerate(cells):
            if cell is None:
                counts[:, row, column] = False
            elif cell:
                low[..., row, column], high[..., row, column] = _ends(cell, found.ndim == 4)
    wrong = (found < low) | (found > high)
    wrong = (wrong.any(axis=1) if wrong.ndim == 4 else wrong) & counts
    if not wrong.any():
        return None
    index, row, column = (int(part[0]) for part in np.nonzero(wrong))
    here = np.s_[index, ..., row, column]
    wanted = _wanted(world.sim.ruleset, slot.kind, grid.cells[row][column], fresh[here])
    return (
        index,
        f"row {row}, column {column} is {_word(world.sim.ruleset, slot.kind, found[here])}, not {wanted}",
    )


def _ends(cell: Cell, vector: bool) -> NDArray[Any]:
    """The lowest and the highest value that a cell allows, [2], or [2, components] of a vector."""
    ends = np.array(cell, float).T
    return ends if vector else ends[:, 0]


def field_rows(name: str, world: AnyWorld, index: int) -> tuple[str, ...]:
    """A field of one world as tests draw it: rows of words, in columns. Floats with all their digits."""
    kind = next(slot.kind for slot in world.sim.slots if slot.name == name)
    values = world.sim.kind.to_numpy(world.state[name])[index]
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
    return direction_word(int(value)) if kind.name == "direction" else show_value(rules, kind, int(value))


def _wanted(rules: Ruleset, kind: Kind, cell: Cell, fresh: NDArray[Any]) -> str:
    """The value that a cell should hold, a range, or its default."""
    if not cell:
        return f"{_word(rules, kind, fresh)}, its default"
    if kind.name not in ("int", "real", "vec2"):
        return _word(rules, kind, np.asarray(cell[0][0]))
    return ",".join(
        show_number(low) if low == high else f"{show_number(low)}..{show_number(high)}" for low, high in cell
    )
