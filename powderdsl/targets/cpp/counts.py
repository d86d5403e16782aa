"""Counts of cells where masks hold, for packed worlds: lists of gates that the library evaluates."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from powderdsl.ir.ops import Node, ordered

_OPS = {"not": 2, "and": 3, "or": 4, "xor": 5}
_PLANE, _MASK, _NOTHING = 0, 1, 6

MOST_GATES = 512
"""Maximum number of gates, since the library evaluates each gate for each word."""


@dataclass(frozen=True)
class Counted:
    """Cells where a flag and the mask `region`, if given, hold: each adds `weight` to the measure `number`.

    With `highest` the measure is the height of the highest such cell.
    """

    flag: Node
    number: int
    region: str | None = None
    highest: bool = False
    weight: float = 1.0


class CountsPlan(ctypes.Structure):
    """`Counts` of views.hpp."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("gates", "counts", "numbers", "top", "bottom")),
        ("gate", ctypes.c_void_p),
        ("count", ctypes.c_void_p),
    )


_COUNT = np.dtype([("gate", "i4"), ("number", "i4"), ("highest", "i4"), ("weight", "f8")], align=True)


class CellCounts:
    """Counts in worlds of one program.

    Args:
        counted: the counts; flags are nodes on bit planes of slots and masks.
        numbers: how many measures there are.
        planes: the numbers of the program's planes by slot.
        masks: the numbers of masks by name.
        rows: the first row to count, and the row after the last.

    Raises:
        KeyError: a flag needs more than these planes, masks and gates. ValueError: more than MOST_GATES gates.
    """

    def __init__(
        self,
        counted: Sequence[Counted],
        numbers: int,
        planes: Mapping[str, int],
        masks: Mapping[str, int],
        rows: tuple[int, int],
    ):
        self.numbers = frozenset(count.number for count in counted)
        """The counted measures."""
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
                places[node] = gate(_MASK, masks[node.attr])
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
                end = gate(_OPS["and"], end, gate(_MASK, masks[count.region]))
            ends.append((end, count.number, count.highest, count.weight))
        if len(gates) > MOST_GATES:
            raise ValueError(f"{len(gates)} gates")
        self.gates, self.ends = np.array(gates, np.int32), np.array(ends, _COUNT)
        self.plan = CountsPlan(
            len(gates), len(ends), numbers, *rows, self.gates.ctypes.data, self.ends.ctypes.data
        )

    def take(self, library: Any, handle: int, masks: Tensor, sizes: Tensor, values: Tensor) -> None:
        """Write the measures of a batch in native memory into `values`, float64 [B, n].

        `masks` are int64 [B or 1, m, H, ⌈W/64⌉]; `sizes`, which sums are divided by, float64 [B or 1, n].
        """
        apart = (masks.data_ptr(), row_stride(masks), sizes.data_ptr(), row_stride(sizes))
        library.pd_count(handle, ctypes.byref(self.plan), *apart, values.data_ptr())


def row_stride(rows: Tensor) -> int:
    """Return the items from one world's row to the next, 0 if there is one row for all."""
    return rows.stride(0) if len(rows) > 1 else 0
