"""The codec of the state: tensors to slots of a program and back, and parameters to the numbers that kernels read.

A state tensor is one slot of the IR, or two if it is a vector. On bit planes, an integer slot has one plane per bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from powderdsl.ir.gates import width
from powderdsl.ir.ops import Program, Threshold, Type, plane_name


@dataclass(frozen=True)
class Piece:
    """A tensor of the state, or one component of a vector, and the slot of the program that holds it."""

    state: str
    component: int | None
    slot: str
    type: Type

    def of(self, tensor: Tensor) -> Tensor:
        """The piece of a tensor [B, H, W], or [B, 2, H, W] for a vector."""
        return tensor if self.component is None else tensor[:, self.component]

    @property
    def planes(self) -> tuple[str, ...]:
        """The slots of its bit planes, lowest first; the slot itself for flags and floats."""
        if self.type.name != "int":
            return (self.slot,)
        return tuple(plane_name(self.slot, i) for i in range(width(self.type.lo, self.type.hi)[0]))

    @property
    def signed(self) -> bool:
        """Whether the highest plane is a sign bit."""
        return self.type.name == "int" and width(self.type.lo, self.type.hi)[1]

    @property
    def is_real(self) -> bool:
        return self.type.name == "real"


def pieces(program: Program) -> dict[str, tuple[Piece, ...]]:
    """The pieces of each state tensor of a program on numbers, by the tensor's name."""
    found: dict[str, tuple[Piece, ...]] = {}
    for slot in program.slots:
        piece = Piece(slot.state or slot.name, slot.component, slot.name, slot.type)
        found[piece.state] = (*found.get(piece.state, ()), piece)
    return found


def limits(values: Tensor, threshold: Threshold) -> Tensor:
    """For chances, float64 [B]: how many of the possible draws lie below each, or not above it if strict: int64 [B]."""
    count = 1 << threshold.bits
    scaled = values * count - 0.5
    limit = scaled.ceil() if threshold.strict else scaled.floor() + 1
    return limit.clamp(0, count).to(torch.int64)


def parameters(
    params: Mapping[str, Tensor],
    planes: Mapping[tuple[str, Threshold | None, int], int],
    reals: Mapping[str, int],
    batch: int,
    device: torch.device,
) -> tuple[Tensor, Tensor]:
    """Parameters as the bits and floats that compiled code reads: uint8 [n, B], float32 [m, B].

    `planes` and `reals` give the numbers of what it reads: bits of a value or of a threshold, and values.
    """
    bits = torch.zeros(max(1, len(planes)), batch, dtype=torch.uint8, device=device)
    views: dict[tuple[str, Threshold | None], Tensor] = {}
    for (name, threshold, bit), number in planes.items():
        if (name, threshold) not in views:
            value = params[name]
            views[name, threshold] = value.to(torch.int64) if threshold is None else limits(value, threshold)
        bits[number] = (views[name, threshold] >> bit) & 1
    floats = torch.zeros(max(1, len(reals)), batch, dtype=torch.float32, device=device)
    for name, number in reals.items():
        floats[number] = params[name].to(torch.float32)
    return bits, floats
