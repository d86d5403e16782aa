"""Numbers of cells where masks on bit planes hold, for packed worlds: lists of gates that the library evaluates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes import Structure, c_double, c_int
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from powderdsl.ir.ops import Node, ordered

_OPS = {"not": 2, "and": 3, "or": 4, "xor": 5}
_PLANE, _MASK, _NOTHING = 0, 1, 6

MOST_GATES = 512
"""More are not worth it: the library looks at each gate for each word."""


@dataclass(frozen=True)
class Counted:
    """The number of cells where a flag holds and the mask `region`, if it has one; or the height of the highest of them.

    `divisor` is what the number is divided by.
    """

    flag: Node
    region: str | None = None
    highest: bool = False
    divisor: float = 1.0


class _Gate(Structure):
    _fields_ = [("op", c_int), ("a", c_int), ("b", c_int)]


class _Count(Structure):
    _fields_ = [("gate", c_int), ("highest", c_int), ("divisor", c_double)]


class CellCounts:
    """Counts in worlds of one program.

    Args:
        counted: what is counted; flags are nodes on bit planes of slots and masks.
        planes: the numbers of the program's planes by slot.
        masks: words of masks that all worlds share, by name: int64 [H, ⌈W/64⌉].
        rows: the rows that are looked at: the first, and the one after the last.

    Raises:
        KeyError: a flag needs more than these planes, these masks, and gates. ValueError: it has too many of them.
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

        for node in ordered([one.flag for one in counted]):
            if node.op == "input" and node.attr in planes:
                places[node] = gate(_PLANE, planes[node.attr])
            elif node.op == "input" and node.attr in masks:
                places[node] = gate(_MASK, names.index(node.attr))
            elif node.op == "const":
                nothing = gate(_NOTHING)
                places[node] = gate(_OPS["not"], nothing) if node.attr else nothing
            elif node.op == "select":
                condition, yes, no = (places[arg] for arg in node.args)
                kept = gate(_OPS["and"], condition, yes), gate(_OPS["and"], gate(_OPS["not"], condition), no)
                places[node] = gate(_OPS["or"], *kept)
            else:
                places[node] = gate(_OPS[node.op], *(places[arg] for arg in node.args))
        ends = []
        for one in counted:
            end = places[one.flag]
            if one.region is not None:
                end = gate(_OPS["and"], end, gate(_MASK, names.index(one.region)))
            ends.append((end, int(one.highest), one.divisor))
        if len(gates) > MOST_GATES:
            raise ValueError(f"{len(gates)} gates")
        self.count = len(counted)
        self._gates: Any = (_Gate * len(gates))(*(_Gate(*one) for one in gates))
        self._counts: Any = (_Count * len(ends))(*(_Count(*one) for one in ends))
        self._rows = rows

    def of(self, library: Any, handle: int, worlds: int) -> Tensor:
        """The numbers in each world of a batch in native memory: float64 [B, n]."""
        found = torch.empty(worlds, self.count, dtype=torch.float64)
        library.pd_count(
            handle, len(self._gates), self._gates, self.count, self._counts, *self._rows,
            self.masks.data_ptr(), found.data_ptr(),
        )  # fmt: skip
        return found
