"""What worlds show, written into a tensor that is there: pictures, channels, packed planes. No host sync.

Worlds that lie packed in native memory are read where they lie; all others are tensors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from powderdsl.ir.ops import component_of
from powderdsl.targets import words
from powderdsl.targets.cpp.program import PackedState, address

State = Mapping[str, Tensor]


@dataclass(frozen=True)
class Channel:
    """One channel of cells in float32: where it comes from.

    `kind` is ``zero``; ``one_hot``, 1 where the slot has the number `value`; ``table``, entry `value` of the tables at
    the slot's number; or ``slot``, what the slot holds. Parts of vectors are slots of their own: ``name.row``.
    """

    kind: str
    slot: str = ""
    value: int = 0


@dataclass(frozen=True)
class PlaneName:
    """One packed plane: bit `bit` of a slot in two's complement."""

    slot: str
    bit: int


def shape_of(state: State) -> tuple[int, int, int]:
    """(worlds, rows, columns), without unpacking anything."""
    shape = state.like["element"][1] if isinstance(state, PackedState) else state["element"].shape
    batch, height, width = shape
    return batch, height, width


def write_slot(state: State, name: str, out: Tensor) -> None:
    """A slot in its storage dtype."""
    if isinstance(state, PackedState) and not state.has(name):
        state.write(name, out)
    else:
        out.copy_(state[name])


def write_rgb(state: State, palette: Tensor, out: Tensor) -> None:
    """Colors uint8 [B, H, W, 3] of the elements. `palette` is uint8 [256, 4]: red, green, blue, nothing."""
    if isinstance(state, PackedState):
        slot, bits, _ = state.program.planes_of("element")
        state.program.library.pd_rgb(state.handle, slot, bits, address(palette), address(out), out.stride(0))
    else:
        ids = state["element"].flatten().int()
        out.copy_(palette[:, :3].index_select(0, ids).view(out.shape))  # faster than an index


@dataclass(frozen=True)
class RampTable:
    """The colors of the element `id` by a slot: `colors` uint8 [n + 1, 4], of which row k is that of values that reach
    k of `starts`, int32 [n] or float32 [n]."""

    id: int
    slot: str
    starts: Tensor
    colors: Tensor


def write_ramp(state: State, ramp: RampTable, out: Tensor) -> None:
    """The cells of a ramp's element in pictures uint8 [B, H, W, 3]; others stay."""
    if isinstance(state, PackedState):
        program = state.program
        slot, bits, _ = program.planes_of("element")
        real = ramp.starts.dtype == torch.float32
        field = (program.layout.reals[ramp.slot], 0, False) if real else program.planes_of(ramp.slot)
        program.library.pd_ramp(
            state.handle, slot, bits, ramp.id, int(real), field[0], field[1], int(field[2]), len(ramp.starts),
            address(ramp.starts), address(ramp.colors), address(out), out.stride(0),
        )  # fmt: skip
        return
    reached = torch.bucketize(state[ramp.slot].to(ramp.starts.dtype), ramp.starts, right=True)
    cells = (state["element"] == ramp.id)[..., None]
    torch.where(cells, ramp.colors[:, :3][reached], out, out=out)


def write_channels(state: State, channels: Sequence[Channel], tables: Tensor, out: Tensor) -> None:
    """Channels float32 [B, C, H, W]. `tables` is float32 [n, 256]."""
    if isinstance(state, PackedState):
        wanted = torch.tensor([_native_channel(c, state) for c in channels], dtype=torch.int32)
        state.program.library.pd_channels(
            state.handle, len(channels), address(wanted), address(tables), address(out), out.stride(0)
        )
        return
    at = 0
    while at < len(channels):
        channel, end = channels[at], at + 1
        if channel.kind == "one_hot":  # consecutive numbers together
            while end < len(channels) and channels[end] == replace(
                channels[end - 1], value=channels[end - 1].value + 1
            ):
                end += 1
            first, last = channel.value, channels[end - 1].value
            numbers = torch.arange(first, last + 1, device=out.device, dtype=torch.uint8)
            out[:, at:end] = state[channel.slot][:, None] == numbers[:, None, None]
        elif channel.kind == "table":
            out[:, at] = tables[channel.value][state[channel.slot].int()]
        elif channel.kind == "slot":
            out[:, at] = _part(state, channel.slot)
        else:
            out[:, at] = 0
        at = end


def _part(state: State, name: str) -> Tensor:
    vector, component = component_of(name)
    return state[name] if component is None else state[vector][:, component]


def _native_channel(channel: Channel, state: PackedState) -> tuple[int, int, int, int]:
    """A channel as native code has it: kind, first plane or real, planes, value."""
    program = state.program
    if channel.kind == "zero":
        return 0, 0, 0, 0
    if channel.slot in program.layout.reals:
        return 4, program.layout.reals[channel.slot], 0, 0
    slot, bits, signed = program.planes_of(channel.slot)
    if channel.kind == "slot":
        return 3, slot, bits, int(signed)
    return (1 if channel.kind == "one_hot" else 2), slot, bits, channel.value


class CodedSlot(Protocol):
    """What codes are made from: a slot's name, its dtype, and the kind with its range."""

    @property
    def name(self) -> str: ...
    @property
    def dtype(self) -> str: ...
    @property
    def kind(self) -> Any: ...


def write_codes(state: State, slot: CodedSlot, part: str, floor: float, out: Tensor) -> None:
    """Codes uint8 [B, H, W] of one slot, or one part of a vector; `code_values` says what they stand for."""
    if _is_small(slot):
        write_slot(state, slot.name, out.view(getattr(torch, slot.dtype)))
        if slot.kind.lo:
            out -= int(slot.kind.lo) & 255  # in eight bits, that is +
    elif isinstance(state, PackedState) and slot.dtype == "float32" and not state.has(slot.name):
        program = state.program
        real = program.layout.reals[f"{slot.name}.{part}" if part else slot.name]
        program.library.pd_codes(state.handle, real, floor, address(out), out.stride(0))
    else:
        value = _part(state, f"{slot.name}.{part}") if part else state[slot.name]
        value = value.to(torch.float32)
        one = torch.tensor(floor, device=out.device).view(torch.int32)
        size = ((value.abs() + floor).view(torch.int32) - one + ROUND) >> SHIFT
        out.copy_(128 + torch.where(value < 0, -size, size))


SHIFT = 20
"""Bits of a float32 below those that a code keeps: three of the mantissa are left."""
ROUND = 1 << (SHIFT - 1)


def code_values(slot: CodedSlot, floor: float) -> Tensor:
    """What each of the 256 codes of a slot stands for: float32 [256].

    Integers in a range of at most 256 are counted from the lowest. Others have a sign and a size: code 128 is 0,
    and 128 ± n is ±(x − `floor`), where x grows by an eighth of a power of two with each n: steps of ``floor / 8`` near
    0, and of an eighth of the value, at most, far from it.
    """
    if _is_small(slot):
        return torch.arange(256, dtype=torch.float32) + float(slot.kind.lo)
    one = torch.tensor(floor).view(torch.int32)
    signed = torch.arange(256, dtype=torch.int32) - 128
    size = (one + (signed.abs() << SHIFT)).to(torch.int32).view(torch.float32) - floor
    return torch.where(signed < 0, -size, size)


def _is_small(slot: CodedSlot) -> bool:
    """Whether eight bits hold every value."""
    return slot.dtype in ("uint8", "int8")


def write_planes(state: State, names: Sequence[PlaneName], out: Tensor) -> None:
    """Packed planes int64 [B, P, H, ⌈W/64⌉]; bits beyond the width are zero."""
    if isinstance(state, PackedState):
        program = state.program
        slots = torch.tensor([program.planes_of(n.slot)[0] + n.bit for n in names], dtype=torch.int32)
        program.library.pd_planes(state.handle, len(names), address(slots), address(out), out.stride(0))
        return
    for i, name in enumerate(names):
        out[:, i] = words.pack((state[name.slot] >> name.bit) & 1 != 0)
