"""The layout of batches of worlds in the memory of a module, for the host that fills and reads them."""

from __future__ import annotations

from powderdsl.targets.layout import Layout, Piece

HEADER = 16
"""Bytes of numbers before the contents of planes, fields and batches."""

WORLDS, GROUPS = 0, 4
"""Where the header of a batch has its numbers of worlds and of groups, i32."""


def aligned(count: int, by: int = 16) -> int:
    """The next multiple of `by`."""
    return -(-count // by) * by


def numbers_of(piece: Piece, layout: Layout, size: int) -> tuple[int, int, int, int]:
    """The arguments of `load` and `store` for a piece of the state whose cells have `size` bytes."""
    slot, planes, signed = layout.home(piece)
    return slot if planes else len(layout.planes) + slot, planes, int(signed), size
