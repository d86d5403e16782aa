"""Observations of worlds (fields, pictures, the paper's matrix, packed planes), each written into a buffer.

Worlds that are packed in native memory are read from there; all others are tensors. No observation waits for a GPU.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from math import prod
from typing import Any, NamedTuple

import torch
from torch import Tensor

from powderdsl.ir.lower import slot_parts
from powderdsl.ir.ops import REAL, SlotType
from powderdsl.model.state import Slot, property_dtype, property_values, slots
from powderdsl.model.types import Ruleset
from powderdsl.simulation.draw import looks, rgb
from powderdsl.targets.cpp.program import NativeProgram, PackedState, Places, Views
from powderdsl.targets.job import shape_of
from powderdsl.targets.tensor_kind import Tensors, pack, word_count

State = Mapping[str, Tensor]

SHIFT = 20
"""Low bits of a float32 that `compact` drops: three bits of the mantissa remain."""


class Channel(NamedTuple):
    """A channel of `matrix`: 1 where the element has the id `one_hot`; if `read`, the values of a slot or its component
    ``name.row``; otherwise table entries for the slot's numbers."""

    slot: str
    one_hot: int | None = None
    read: bool = False


class Observer:
    """Reads the worlds of one ruleset on one device. Tables that depend only on the ruleset are made once.

    Methods take a state and, as `out`, None or the buffer to write to: of the result's shape, dtype and device, each
    world contiguous, such as a slice of a larger batch. They return the buffer. Raises TypeError or ValueError for other
    buffers.
    """

    def __init__(self, ruleset: Ruleset, device: torch.device):
        self.ruleset = ruleset
        self.device = torch.empty(0, device=device).device  # with its number
        self.slots: dict[str, Slot] = {slot.name: slot for slot in slots(ruleset)}
        parts = ((slot, slot_parts(slot, ruleset)) for slot in self.slots.values())
        self._parts = {part.name: (part, slot) for slot, own in parts for part in own}
        """The slots of the IR, and the arrays of the state that hold them."""
        self._views: dict[tuple[str, int, int], tuple[NativeProgram, Views]] = {}
        """By kind, number of cells and bytes per pixel, for the program that ran last."""

    @torch.no_grad()
    def read(self, state: State, name: str, out: Any = None) -> Tensor:
        """A slot in its storage dtype: [B, H, W], or [B, 2, H, W] for vectors."""
        slot, (batch, height, width) = self.slots[name], shape_of(state)
        shape = (batch, 2, height, width) if slot.planes == 2 else (batch, height, width)
        return _write_slot(state, name, self.buffer(out, shape, getattr(torch, slot.dtype)))

    @torch.no_grad()
    def rgb(self, state: State, out: Any = None, *, size: int = 3) -> Tensor:
        """Pictures uint8 [B, H, W, 3 to 8], colored by elements and fields, then tinted. The other bytes are 0."""
        out, shown = self.buffer(out, (*shape_of(state), size), torch.uint8), self._looks
        if isinstance(state, PackedState):
            return self._show("rgb", state, out, size)
        out[..., :3] = rgb(state["element"], fields=state, kind=Tensors(self.device), **shown)
        out[..., 3:] = 0
        return out

    @torch.no_grad()
    def matrix(self, state: State, out: Any = None) -> Tensor:
        """The channels listed in the ruleset's `matrix:`, float32 [B, C, H, W]."""
        batch, height, width = shape_of(state)
        channels, tables = self._channels
        out = self.buffer(out, (batch, len(channels), height, width), torch.float32)
        if isinstance(state, PackedState):
            return self._show("matrix", state, out)
        ids = state["element"].flatten().int()
        for at, channel in enumerate(channels):
            if channel.read:
                part, _ = self._parts[channel.slot]
                out[:, at] = part.of(state[part.state])
            else:
                out[:, at] = tables[at].index_select(0, ids).view(batch, height, width)
        return out

    @torch.no_grad()
    def compact(self, state: State, out: Any = None) -> Tensor:
        """All fields that persist between steps, as bytes: uint8 [B, C, H, W], in the order of `compact_names`."""
        batch, height, width = shape_of(state)
        out = self.buffer(out, (batch, len(self._coded), height, width), torch.uint8)
        if isinstance(state, PackedState):
            return self._show("compact", state, out)
        for at, (part, slot) in enumerate(self._coded):
            _write_codes(state, slot, part, out[:, at])
        return out

    @torch.no_grad()
    def planes(self, state: State, out: Any = None) -> Tensor:
        """Packed planes int64 [B, P, H, ⌈W/64⌉], in the order of `plane_names`."""
        batch, height, width = shape_of(state)
        out = self.buffer(out, (batch, len(self._bits), height, word_count(width)), torch.int64)
        if isinstance(state, PackedState):
            return self._show("planes", state, out)
        for place, (name, bit) in enumerate(self._bits):
            out[:, place] = pack((state[name] >> bit) & 1 != 0)
        return out

    def views(self, kind: str, program: Places, cells: int, size: int = 3) -> Views:
        """Return what native code writes for ``ids`` or a method's observations, by cells and bytes per pixel."""
        views, homes = Views(), program.homes
        ids = homes["element"][:2]
        match kind:
            case "ids":
                views.add("values", *ids, 0, 1)
            case "rgb":
                shown = self._looks
                views.add("colors", *ids, number=size, tables=[shown["colors"]])
                for ramp in shown["ramps"]:
                    field = homes[ramp.field]
                    numbers = *ids, ramp.id, int(not field[1]), *map(int, field), len(ramp.starts)
                    views.add("ramp", *numbers, tables=[ramp.colors, ramp.starts])
                for tint in shown["tints"]:
                    parts = (homes[piece.name][0] for piece in program.pieces[tint.field])
                    views.add("tint", *parts, tables=[torch.tensor([*tint.color, tint.full, tint.most])])
            case "matrix":
                channels, tables = self._channels
                rows = [_native_channel(channel, at, homes) for at, channel in enumerate(channels)]
                views.add("channels", len(rows), tables=[torch.tensor(rows, dtype=torch.int32), tables])
            case "compact":
                for at, (part, slot) in enumerate(self._coded):
                    numbers = homes[part.name]
                    if _is_small(slot):
                        views.add("values", *numbers, 1, int(slot.kind.lo) & 255, offset=at * cells)
                    else:
                        views.add("codes", *numbers, number=_floor(slot), offset=at * cells)
            case "planes":
                places = [homes[name][0] + bit for name, bit in self._bits]
                views.add("planes", len(places), tables=[torch.tensor(places, dtype=torch.int32)])
        return views

    def _show(self, kind: str, state: PackedState, out: Tensor, size: int = 3) -> Tensor:
        """Write an observation of packed worlds into `out`; returns it."""
        cells = prod(shape_of(state)[1:])
        key = kind, cells, size
        if key not in self._views or self._views[key][0] is not state.program:
            self._views[key] = state.program, self.views(kind, state.program, cells, size)
        return state.show(self._views[key][1], out)

    @cached_property
    def compact_names(self) -> tuple[str, ...]:
        """The names of the channels of `compact`: ``element``, fields, ``name.row`` and ``name.column``."""
        return tuple(part.name for part, _ in self._coded)

    @cached_property
    def compact_values(self) -> Tensor:
        """The values of the codes of `compact`: float32 [C, 256]."""
        return torch.stack([_code_values(slot) for _, slot in self._coded]).to(self.device)

    @cached_property
    def matrix_names(self) -> tuple[str, ...]:
        """The names of the channels of `matrix`: elements, properties and fields; ``name.row`` of vectors."""
        return tuple(channel.name for channel in self.ruleset.matrix)

    @cached_property
    def matrix_tables(self) -> tuple[tuple[int, ...], Tensor]:
        """The channels of `matrix` in terms of `compact`.

        For each channel, the number of a channel of `compact`, and float32 [n, 256], the value of each byte of that
        channel. Fields that do not persist read as 0.
        """
        channels, tables = self._channels
        names, tables = self.compact_names, tables.clone()
        sources = [names.index(channel.slot if channel.slot in names else "element") for channel in channels]
        for at, channel in enumerate(channels):
            if channel.read and channel.slot in names:
                tables[at] = self.compact_values[sources[at]]
        return tuple(sources), tables

    @property
    def plane_names(self) -> tuple[str, ...]:
        """The names of the planes: a flag's name, or ``name:bit`` for integers."""
        return tuple(name for part, _ in self._parts.values() if part.type != REAL for name in part.planes)

    @cached_property
    def _coded(self) -> tuple[tuple[SlotType, Slot], ...]:
        """The channels of `compact`: those of `_parts` that a step does not restart."""
        return tuple((part, slot) for part, slot in self._parts.values() if not slot.resets)

    @cached_property
    def _bits(self) -> tuple[tuple[str, int], ...]:
        """The slot and bit of each plane: flags and integers, slot by slot, lowest bit first. Floats have none."""
        stored = [part for part, _ in self._parts.values() if part.type != REAL]
        return tuple((part.name, bit) for part in stored for bit in range(len(part.planes)))

    @cached_property
    def _looks(self) -> dict[str, Any]:
        shown, put = looks(self.ruleset.elements, self.ruleset.fields), Tensors(self.device).from_numpy
        ramps = [replace(ramp, starts=put(ramp.starts), colors=put(ramp.colors)) for ramp in shown["ramps"]]
        return {**shown, "colors": put(shown["colors"]), "ramps": ramps}

    @cached_property
    def _channels(self) -> tuple[tuple[Channel, ...], Tensor]:
        """The channels of `matrix:`, and a table for each, float32 [C, 256]: the values of elements.

        Tables of channels that are read, and of names that no loaded pack defines, are zero.
        """
        channels = []
        tables = torch.zeros(len(self.ruleset.matrix), 256)
        for table, channel in zip(tables, self.ruleset.matrix, strict=True):
            name, read = channel.source, channel.source in self.slots
            slot = f"{name}.{channel.part}" if channel.part else name
            channels.append(Channel(slot if read else "element", channel.id, read))
            prop = self.ruleset.property(name)
            if channel.id is not None:
                table[channel.id] = 1
            elif prop is not None and not read:
                dtype = getattr(torch, property_dtype(prop))
                table[:] = torch.tensor(property_values(self.ruleset, name), dtype=dtype)
        return tuple(channels), tables.to(self.device)

    def buffer(self, out: Any, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """`out` if it is suitable, or a new buffer if it is None. Raises TypeError and ValueError."""
        if out is None:
            return torch.empty(shape, dtype=dtype, device=self.device)
        if not isinstance(out, Tensor):
            raise TypeError(f"out must be a torch tensor, found {type(out).__name__}")
        if (tuple(out.shape), out.dtype, out.device) != (shape, dtype, self.device):
            kind = f"{out.dtype} {list(out.shape)} on {out.device}"
            raise ValueError(f"out must be {dtype} {list(shape)} on {self.device}, found {kind}")
        if shape[0] and not (out[0].is_contiguous() and (shape[0] == 1 or out.stride(0) >= out[0].numel())):
            rule = "each world of out must be contiguous, and worlds must not overlap"
            raise ValueError(f"{rule}; found the strides {list(out.stride())}")
        return out


def _write_slot(state: State, name: str, out: Tensor) -> Tensor:
    """Write a slot in its storage dtype; returns `out`."""
    if isinstance(state, PackedState) and not state.has(name):
        return state.write(name, out)
    return out.copy_(state[name])


def _native_channel(
    channel: Channel, number: int, homes: Mapping[str, tuple[int, int, bool]]
) -> tuple[int, int, int, int]:
    """A channel for native code: kind, first plane or float slot, planes, value."""
    slot, bits, signed = homes[channel.slot]
    if not bits:
        return 4, slot, 0, 0
    if channel.read:
        return 3, slot, bits, int(signed)
    return (2, slot, bits, number) if channel.one_hot is None else (1, slot, bits, channel.one_hot)


def _write_codes(state: State, slot: Slot, part: SlotType, out: Tensor) -> None:
    """Write the codes uint8 [B, H, W] of a slot, or of a part of a vector: see `_code_values`."""
    if _is_small(slot):
        _write_slot(state, slot.name, out.view(getattr(torch, slot.dtype)))
        if slot.kind.lo:
            out -= int(slot.kind.lo) & 255  # in eight bits, that is +
        return
    floor = _floor(slot)
    value = part.of(state[slot.name]).to(torch.float32)
    zero = torch.tensor(floor, device=out.device).view(torch.int32)
    size = ((value.abs() + floor).view(torch.int32) - zero + (1 << (SHIFT - 1))) >> SHIFT
    out.copy_(128 + torch.where(value < 0, -size, size))


def _code_values(slot: Slot) -> Tensor:
    """The values of the 256 codes of a slot: float32 [256].

    Integers with at most 256 values are counted from the lowest. Other values have a sign and a magnitude: code 128 is
    0, and 128 ± n is ±(x − `_floor`), where x grows by an eighth of a power of two with each n. Steps are an eighth of
    the floor near 0, and at most an eighth of the value far from 0.
    """
    if _is_small(slot):
        return torch.arange(256, dtype=torch.float32) + float(slot.kind.lo)
    floor = _floor(slot)
    zero = torch.tensor(floor).view(torch.int32)
    signed = torch.arange(256, dtype=torch.int32) - 128
    size = (zero + (signed.abs() << SHIFT)).to(torch.int32).view(torch.float32) - floor
    return torch.where(signed < 0, -size, size)


def _floor(slot: Slot) -> float:
    """Eight times the smallest step of a slot's codes: a power of two near 2⁻¹⁵ of its largest value."""
    return 2.0 ** (math.ceil(math.log2(max(abs(slot.kind.lo), abs(slot.kind.hi), 1e-3))) - 15)


def _is_small(slot: Slot) -> bool:
    """True if eight bits hold every value."""
    return slot.dtype in ("uint8", "int8")
