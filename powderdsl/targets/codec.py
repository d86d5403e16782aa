"""The codec of the state: arrays to slots of a program and back, and parameters to the numbers that kernels read.

A state array is one slot of the IR, or two if it is a vector. On bit planes, an integer slot has one plane per bit.
Arrays are of one library: torch, or `powderdsl.arrays`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from powderdsl.ir.ops import Program, Threshold, Type, plane_name


@dataclass(frozen=True)
class Piece:
    """An array of the state, or one component of a vector, and the slot of the program that holds it."""

    state: str
    component: int | None
    slot: str
    type: Type

    def of(self, array: Any) -> Any:
        """The piece of an array [B, H, W], or [B, 2, H, W] for a vector."""
        return array if self.component is None else array[:, self.component]

    @property
    def planes(self) -> tuple[str, ...]:
        """The slots of its bit planes, lowest first; the slot itself for flags and floats."""
        if self.type.name != "int":
            return (self.slot,)
        return tuple(plane_name(self.slot, i) for i in range(self.type.bits))

    @property
    def signed(self) -> bool:
        """True if the highest plane is a sign bit."""
        return self.type.name == "int" and self.type.signed

    @property
    def is_real(self) -> bool:
        return self.type.name == "real"


def pieces(program: Program) -> dict[str, tuple[Piece, ...]]:
    """The pieces of each state array of a program on numbers, by the array's name."""
    groups: dict[str, tuple[Piece, ...]] = {}
    for slot in program.slots:
        piece = Piece(slot.state or slot.name, slot.component, slot.name, slot.type)
        groups[piece.state] = (*groups.get(piece.state, ()), piece)
    return groups


def limits(xp: Any, values: Any, threshold: Threshold) -> Any:
    """The number of possible draws below each chance (float64 [B]), or not above it if strict: int64 [B]."""
    count = 1 << threshold.bits
    scaled = values * count - 0.5
    limit = -xp.floor(-scaled) if threshold.strict else xp.floor(scaled) + 1
    return xp.asarray(xp.clip(limit, 0, count), dtype=xp.int64)


def parameters(
    xp: Any,
    params: Mapping[str, Any],
    planes: Mapping[tuple[str, Threshold | None, int], int],
    reals: Mapping[str, int],
    batch: int,
    **where: Any,
) -> tuple[Any, Any]:
    """Parameters as the bits and floats that compiled code reads: uint8 [n, B], float32 [m, B].

    `xp` is the library of the arrays; `where` is its device argument, if it has one. `planes` numbers the bits of values
    and thresholds that the code reads, and `reals` the values.
    """
    bits = xp.zeros((max(1, len(planes)), batch), dtype=xp.uint8, **where)
    views: dict[tuple[str, Threshold | None], Any] = {}
    for (name, threshold, bit), number in planes.items():
        if (name, threshold) not in views:
            value = params[name]
            views[name, threshold] = (
                xp.asarray(value, dtype=xp.int64) if threshold is None else limits(xp, value, threshold)
            )
        bits[number] = (views[name, threshold] >> bit) & 1
    floats = xp.zeros((max(1, len(reals)), batch), dtype=xp.float32, **where)
    for name, number in reals.items():
        floats[number] = xp.asarray(params[name], dtype=xp.float32)
    return bits, floats
