"""What worlds show: fields, pictures, the paper's matrix, packed planes, each written into a given buffer or a new one.

Worlds that are packed in native memory are read from there; all others are tensors. Nothing waits for a GPU.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from powderdsl.ir.lower import ir_type, part_names
from powderdsl.ir.ops import component_of
from powderdsl.model.state import Slot, property_dtype, property_values, slots
from powderdsl.model.types import MatrixChannel, Ruleset
from powderdsl.simulation.draw import CellTint, Ramp, palette, ramps, tint_cells, tints
from powderdsl.targets.cpp.program import PackedState
from powderdsl.targets.job import shape_of
from powderdsl.targets.words import pack, word_count

State = Mapping[str, Tensor]

SHIFT = 20
"""Low bits of a float32 that a code of `compact` drops: three bits of the mantissa remain."""


@dataclass(frozen=True)
class Channel:
    """Where one channel of cells in float32 comes from.

    `kind` is ``zero``; ``one_hot``, 1 where the slot has the number `value`; ``table``, entry `value` of the tables at
    the slot's number; or ``slot``, the slot's value. Components of vectors have slots of their own: ``name.row``.
    """

    kind: str
    slot: str = ""
    value: int = 0


class Observer:
    """Reads the worlds of one ruleset on one device. What follows from the ruleset alone is made once.

    Methods take a state and, as `out`, None or the buffer to write to: of the result's shape, dtype and device, each
    of its worlds contiguous, so that a slice of a larger batch serves. They return the buffer.
    """

    def __init__(self, ruleset: Ruleset, device: torch.device):
        self.ruleset = ruleset
        self.device = torch.empty(0, device=device).device  # with its number
        self.slots: dict[str, Slot] = {slot.name: slot for slot in slots(ruleset)}
        self._tints = tints(ruleset.fields)

    @torch.no_grad()
    def read(self, state: State, name: str, out: Any = None) -> Tensor:
        """A slot. Raises ValueError, TypeError: the buffer does not fit."""
        slot, (batch, height, width) = self.slots[name], shape_of(state)
        shape = (batch, 2, height, width) if slot.planes == 2 else (batch, height, width)
        return _write_slot(state, name, self.buffer(out, shape, getattr(torch, slot.dtype)))

    @torch.no_grad()
    def rgb(self, state: State, out: Any = None) -> Tensor:
        """Pictures uint8 [B, H, W, 3], a pixel a cell, in the elements' colors, which may follow fields; then tints."""
        out, colors = self.buffer(out, (*shape_of(state), 3), torch.uint8), self._palette
        if isinstance(state, PackedState):
            library, (slot, bits, _) = state.program.library, state.program.planes_of("element")
            library.pd_rgb(state.handle, slot, bits, colors.data_ptr(), out.data_ptr(), out.stride(0))
        else:
            ids = state["element"].flatten().int()
            out.copy_(colors[:, :3].index_select(0, ids).view(out.shape))  # faster than an index
        for ramp in self._ramps:
            _write_ramp(state, ramp, out)
        for tint in self._tints:
            _write_tint(state, tint, out)
        return out

    @torch.no_grad()
    def matrix(self, state: State, out: Any = None) -> Tensor:
        """Channels float32 [B, C, H, W], as the ruleset's `matrix:` names them."""
        batch, height, width = shape_of(state)
        channels, tables = self._channels
        out = self.buffer(out, (batch, len(channels), height, width), torch.float32)
        if isinstance(state, PackedState):
            wanted = torch.tensor([_native_channel(one, state) for one in channels], dtype=torch.int32)
            state.program.library.pd_channels(
                state.handle,
                len(channels),
                wanted.data_ptr(),
                tables.data_ptr(),
                out.data_ptr(),
                out.stride(0),
            )
            return out
        at = 0
        while at < len(channels):
            channel, end = channels[at], at + 1
            if channel.kind == "one_hot":  # consecutive numbers together
                while end < len(channels) and channels[end] == replace(
                    channel, value=channel.value + end - at
                ):
                    end += 1
                last = channel.value + end - at
                numbers = torch.arange(channel.value, last, device=out.device, dtype=torch.uint8)
                out[:, at:end] = state[channel.slot][:, None] == numbers[:, None, None]
            elif channel.kind == "table":
                out[:, at] = tables[channel.value][state[channel.slot].int()]
            elif channel.kind == "slot":
                out[:, at] = _component(state, channel.slot)
            else:
                out[:, at] = 0
            at = end
        return out

    @torch.no_grad()
    def compact(self, state: State, out: Any = None) -> Tensor:
        """Everything that lasts from step to step, as bytes: uint8 [B, C, H, W], C those of `compact_names`."""
        batch, height, width = shape_of(state)
        out = self.buffer(out, (batch, len(self._coded), height, width), torch.uint8)
        for at, (name, slot) in enumerate(self._coded):
            _write_codes(state, slot, name, out[:, at])
        return out

    @torch.no_grad()
    def planes(self, state: State, out: Any = None) -> Tensor:
        """Packed planes int64 [B, P, H, ⌈W/64⌉], in the order of `plane_names`."""
        batch, height, width = shape_of(state)
        out = self.buffer(out, (batch, len(self._bits), height, word_count(width)), torch.int64)
        if isinstance(state, PackedState):
            program = state.program
            slots = [program.planes_of(name)[0] + bit for name, bit in self._bits]
            numbers = torch.tensor(slots, dtype=torch.int32)
            program.library.pd_planes(
                state.handle, len(slots), numbers.data_ptr(), out.data_ptr(), out.stride(0)
            )
            return out
        for place, (name, bit) in enumerate(self._bits):
            out[:, place] = pack((state[name] >> bit) & 1 != 0)
        return out

    @cached_property
    def compact_names(self) -> tuple[str, ...]:
        """What the channels of `compact` are: ``element``, fields by name, ``name.row`` and ``name.column``."""
        return tuple(name for name, _ in self._coded)

    @cached_property
    def compact_values(self) -> Tensor:
        """What the numbers of `compact` stand for: float32 [C, 256]."""
        return torch.stack([_code_values(slot) for _, slot in self._coded]).to(self.device)

    @cached_property
    def matrix_names(self) -> tuple[str, ...]:
        """What the channels of `matrix` are: elements, properties and fields by name; ``name.row`` of vectors."""
        return tuple(channel.name for channel in self.ruleset.matrix)

    @cached_property
    def matrix_tables(self) -> tuple[tuple[int, ...], Tensor]:
        """How the channels of `matrix` follow from those of `compact`.

        For each channel, the number of the channel that it is read from; and float32 [n, 256], its value for each
        byte there. Fields that do not last read as 0.
        """
        channels, tables = self._channels
        sources, rows = [], []
        for channel in channels:
            name = channel.slot if channel.slot in self.compact_names else "element"
            sources.append(self.compact_names.index(name))
            row = torch.zeros(256, device=self.device)
            if channel.kind == "one_hot":
                row[channel.value] = 1
            elif channel.kind == "table":
                row = tables[channel.value]
            elif channel.kind == "slot" and channel.slot == name:
                row = self.compact_values[sources[-1]]
            rows.append(row)
        return tuple(sources), torch.stack(rows)

    @property
    def plane_names(self) -> tuple[str, ...]:
        """What each plane is: a flag's name, or ``name:bit`` for integers."""
        return tuple(
            name if self.slots[name].kind.name == "flag" else f"{name}:{bit}" for name, bit in self._bits
        )

    @cached_property
    def _coded(self) -> tuple[tuple[str, Slot], ...]:
        """The channels of `compact`: names, and the slots that they are codes of, which a step does not restart."""
        lasting = [slot for slot in self.slots.values() if not slot.resets]
        return tuple((name, slot) for slot in lasting for name in part_names(slot.name, slot.kind))

    @cached_property
    def _bits(self) -> tuple[tuple[str, int], ...]:
        """The slot and bit of each plane: flags and integers, slot by slot, lowest bit first. Floats have none."""
        found = []
        for slot in self.slots.values():
            if not slot.is_real:
                type = ir_type(slot.kind, self.ruleset.slots)
                count = 1 if type.name == "flag" else type.bits
                found += [(slot.name, bit) for bit in range(count)]
        return tuple(found)

    @cached_property
    def _palette(self) -> Tensor:
        """uint8 [256, 4]: red, green, blue, nothing."""
        return self._colors(palette(self.ruleset.elements), 256)

    @cached_property
    def _ramps(self) -> tuple[Ramp, ...]:
        """As tensors, with four bytes a color."""
        found = []
        for ramp in ramps(self.ruleset.elements):
            starts = torch.from_numpy(ramp.starts).to(self.device)
            found.append(replace(ramp, starts=starts, colors=self._colors(ramp.colors, len(ramp.colors))))
        return tuple(found)

    def _colors(self, colors: Any, count: int) -> Tensor:
        """Colors uint8 [n, 3] with a fourth byte, and black up to `count` of them."""
        table = torch.zeros(count, 4, dtype=torch.uint8)
        table[: len(colors), :3] = torch.from_numpy(colors)
        return table.to(self.device)

    @cached_property
    def _channels(self) -> tuple[tuple[Channel, ...], Tensor]:
        """The channels of `matrix:`, and the tables float32 [n, 256] of properties among them."""
        properties: list[Tensor] = []
        channels = tuple(self._channel_of(channel, properties) for channel in self.ruleset.matrix)
        return channels, torch.stack(properties) if properties else torch.zeros(1, 256, device=self.device)

    def _channel_of(self, channel: MatrixChannel, tables: list[Tensor]) -> Channel:
        name = channel.source
        if channel.id is not None:
            return Channel("one_hot", "element", channel.id)
        if name in self.slots:
            return Channel("slot", f"{name}.{channel.part}" if channel.part else name)
        prop = self.ruleset.property(name)
        if prop is None:
            return Channel("zero")
        values = torch.tensor(property_values(self.ruleset, name), dtype=torch.float64)
        tables.append(values.to(getattr(torch, property_dtype(prop))).float().to(self.device))
        return Channel("table", "element", len(tables) - 1)

    def buffer(self, out: Any, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """The given buffer, if it fits, or a new one."""
        if out is None:
            return torch.empty(shape, dtype=dtype, device=self.device)
        if not isinstance(out, Tensor):
            raise TypeError(f"out must be a torch tensor, found {type(out).__name__}")
        if (tuple(out.shape), out.dtype, out.device) != (shape, dtype, self.device):
            wanted = f"{dtype} {list(shape)} on {self.device}"
            found = f"{out.dtype} {list(out.shape)} on {out.device}"
            raise ValueError(f"out must be {wanted}, found {found}")
        if shape[0] and not (out[0].is_contiguous() and (shape[0] == 1 or out.stride(0) >= out[0].numel())):
            raise ValueError(
                f"each world of out must be contiguous, and worlds apart; found the strides {list(out.stride())}"
            )
        return out


def _write_slot(state: State, name: str, out: Tensor) -> Tensor:
    """Write a slot in its storage dtype; returns `out`."""
    if isinstance(state, PackedState) and not state.has(name):
        return state.write(name, out)
    return out.copy_(state[name])


def _write_ramp(state: State, ramp: Ramp, out: Tensor) -> None:
    """Color the cells of a ramp's element in pictures uint8 [B, H, W, 3]; others stay."""
    if isinstance(state, PackedState):
        program = state.program
        slot, bits, _ = program.planes_of("element")
        real = ramp.starts.dtype == torch.float32
        field = (program.layout.reals[ramp.field], 0, False) if real else program.planes_of(ramp.field)
        program.library.pd_ramp(
            state.handle, slot, bits, ramp.id, int(real), field[0], field[1], int(field[2]), len(ramp.starts),
            ramp.starts.data_ptr(), ramp.colors.data_ptr(), out.data_ptr(), out.stride(0),
        )  # fmt: skip
        return
    reached = torch.bucketize(state[ramp.field].to(ramp.starts.dtype), ramp.starts, right=True)
    cells = (state["element"] == ramp.id)[..., None]
    torch.where(cells, ramp.colors[:, :3][reached], out, out=out)


def _write_tint(state: State, tint: CellTint, out: Tensor) -> None:
    """Tint pictures uint8 [B, H, W, 3]."""
    if isinstance(state, PackedState):
        program = state.program
        row, column = (program.layout.reals[piece.slot] for piece in program.pieces[tint.field])
        numbers = torch.tensor([*tint.color, tint.full, tint.most])
        program.library.pd_tint(state.handle, row, column, numbers.data_ptr(), out.data_ptr(), out.stride(0))
    else:
        tint_cells(out, state[tint.field], tint)


def _component(state: State, name: str) -> Tensor:
    """A slot [B, H, W], or one component of a vector."""
    vector, component = component_of(name)
    return state[name] if component is None else state[vector][:, component]


def _native_channel(channel: Channel, state: PackedState) -> tuple[int, int, int, int]:
    """A channel as native code has it: kind, first plane or float slot, planes, value."""
    program = state.program
    if channel.kind == "zero":
        return 0, 0, 0, 0
    if channel.slot in program.layout.reals:
        return 4, program.layout.reals[channel.slot], 0, 0
    slot, bits, signed = program.planes_of(channel.slot)
    if channel.kind == "slot":
        return 3, slot, bits, int(signed)
    return (1 if channel.kind == "one_hot" else 2), slot, bits, channel.value


def _write_codes(state: State, slot: Slot, name: str, out: Tensor) -> None:
    """Write the codes uint8 [B, H, W] of a slot, or of its component `name`: see `_code_values`."""
    if _is_small(slot):
        _write_slot(state, slot.name, out.view(getattr(torch, slot.dtype)))
        if slot.kind.lo:
            out -= int(slot.kind.lo) & 255  # in eight bits, that is +
        return
    floor = _floor(slot)
    if isinstance(state, PackedState) and slot.dtype == "float32" and not state.has(slot.name):
        program = state.program
        program.library.pd_codes(
            state.handle, program.layout.reals[name], floor, out.data_ptr(), out.stride(0)
        )
    else:
        value = (_component(state, name) if slot.planes == 2 else state[name]).to(torch.float32)
        one = torch.tensor(floor, device=out.device).view(torch.int32)
        size = ((value.abs() + floor).view(torch.int32) - one + (1 << (SHIFT - 1))) >> SHIFT
        out.copy_(128 + torch.where(value < 0, -size, size))


def _code_values(slot: Slot) -> Tensor:
    """What each of the 256 codes of a slot stands for: float32 [256].

    Integers in a range of at most 256 are counted from the lowest. Others have a sign and a size: code 128 is 0,
    and 128 ± n is ±(x − `_floor`), where x grows by an eighth of a power of two with each n: steps of an eighth of the
    floor near 0, and of an eighth of the value, at most, far from it.
    """
    if _is_small(slot):
        return torch.arange(256, dtype=torch.float32) + float(slot.kind.lo)
    floor = _floor(slot)
    one = torch.tensor(floor).view(torch.int32)
    signed = torch.arange(256, dtype=torch.int32) - 128
    size = (one + (signed.abs() << SHIFT)).to(torch.int32).view(torch.float32) - floor
    return torch.where(signed < 0, -size, size)


def _floor(slot: Slot) -> float:
    """Eight times the smallest step of a slot's codes: a power of two near 2⁻¹⁵ of its largest value."""
    return 2.0 ** (math.ceil(math.log2(max(abs(slot.kind.lo), abs(slot.kind.hi), 1e-3))) - 15)


def _is_small(slot: Slot) -> bool:
    """Whether eight bits hold every value."""
    return slot.dtype in ("uint8", "int8")
