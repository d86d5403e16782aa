"""Worlds seen in a mirror or turned by a quarter: cells change places, directions and vectors turn with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from powderdsl.model.state import Slot, slots
from powderdsl.model.types import Ruleset
from powderdsl.testing.properties.samples import Array, Sample, State, full_state, settled


def turned_cells(values: Array, turn: str) -> Array:
    """An array [..., H, W]: left and right exchanged (``mirrored``), or a quarter turn clockwise (``rotated``)."""
    if turn == "mirrored":
        return values[..., ::-1].copy()
    return np.rot90(values, -1, (-2, -1)).copy()


def turned_values(slot: Slot, values: Array, turn: str) -> Array:
    """A slot's array, turned."""
    cells = turned_cells(values, turn)
    if slot.kind.name == "direction":  # octants count clockwise from the right
        return ((4 - cells.astype(np.int64)) % 8 if turn == "mirrored" else (cells + 2) % 8).astype(
            slot.dtype
        )
    if slot.planes == 2:
        rows, columns = cells[:, 0], cells[:, 1]
        parts = (rows, -columns) if turn == "mirrored" else (columns, -rows)
        return np.stack(parts, 1) + np.float32(0)  # one zero only
    return cells


def turned_state(ruleset: Ruleset, state: State, turn: str) -> State:
    """All slots, turned. Cells that cannot hold a value keep the usual one, which does not turn."""
    found = {slot.name: turned_values(slot, state[slot.name], turn) for slot in slots(ruleset)}
    return settled(ruleset, found)


def turned_sample(ruleset: Ruleset, sample: Sample, turn: str) -> Sample:
    """The start worlds, turned, with the same seeds."""
    state = turned_state(ruleset, full_state(ruleset, sample), turn)
    return replace(sample, ids=state.pop("element"), fields=state)
