"""Counts of cells where masks hold, for packed worlds: lists of gates that the library evaluates."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from powderdsl.ir.ops import Node, ordered

_OPS = {"not": 2, "and": 3, "or": 4, "xor": 5}
_PLANE, _MASK, _NOTHING = 0, 1, 6

MOST_GATES = 512
"""The most gates that are worth it: the library evaluates each gate for each word."""


@dataclass(frozen=True)
class Counted:
    """The number of cells where a flag and the mask `region`, if given, hold, divided by `divisor`.

    With `highest`, the height of the highest such cell instead.
    """

    flag: Node
    region: str | None = None
    highest: bool = False
    divisor: float = 1.0


class CellCounts:
    """Counts in worlds of one program.

    Args:
        counted: the counts; flags are nodes on bit planes of slots and masks.
        planes: the numbers of the program's planes by slot.
        masks: words of masks that all worlds share, by name: int64 [H, ⌈W/64⌉].
        rows: the first row to count, and the row after the last.

    Raises:
        KeyError: a flag needs more than these planes, masks and gates. ValueError: more than MOST_GATES gates.
    """

    def __init__(
        self,
        counted: Sequence[Counted],
        planes: Mapping[str, int],
        masks: Mapping[str, Tensor],
        rows: tuple[int, int],
    ):
        names = list(masks)
        self.masks = torch.stack(list(masks.values())) if masks else torch.zeros(0, dtype=torch.int64)
        gates: list[tuple[int, int, int]] = []
        places: dict[Node, int] = {}

        def gate(op: int, a: int = 0, b: int = 0) -> int:
            gates.append((op, a, b))
            return len(gates) - 1

        for node in ordered([count.flag for count in counted]):
            args = [places[arg] for arg in node.args]
            if node.op == "input" and node.attr in planes:
                places[node] = gate(_PLANE, planes[node.attr])
            elif node.op == "input" and node.attr in masks:
                places[node] = gate(_MASK, names.index(node.attr))
            elif node.op == "const":
                nothing = gate(_NOTHING)
                places[node] = gate(_OPS["not"], nothing) if node.attr else nothing
            elif node.op == "select":
                yes, no = gate(_OPS["and"], *args[:2]), gate(_OPS["and"], gate(_OPS["not"], args[0]), args[2])
                places[node] = gate(_OPS["or"], yes, no)
            else:
                places[node] = gate(_OPS[node.op], *args)
        ends = []
        for count in counted:
            end = places[count.flag]
            if count.region is not None:
                end = gate(_OPS["and"], end, gate(_MASK, names.index(count.region)))
            ends.append(struct.pack("iid", end, count.highest, count.divisor))
        if len(gates) > MOST_GATES:
            raise ValueError(f"{len(gates)} gates")
        self._rows = rows
        self._sizes = len(gates), len(ends)
        # As the structs `Gate` and `Count` of views.hpp.
        self._gates, self._counts = b"".join(struct.pack("iii", *gate) for gate in gates), b"".join(ends)

    def of(self, library: Any, handle: int, worlds: int) -> Tensor:
        """The numbers in each world of a batch in native memory: float64 [B, n]."""
        gates, counts = self._sizes
        numbers = torch.empty(worlds, counts, dtype=torch.float64)
        ends = (*self._rows, self.masks.data_ptr(), numbers.data_ptr())
        library.pd_count(handle, gates, self._gates, counts, self._counts, *ends)
        return numbers
