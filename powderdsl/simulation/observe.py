"""Ways out of a world: fields, pictures, the paper's matrix, packed planes, each written into a given buffer or a new one."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from powderdsl.diagnostics import suggest
from powderdsl.ir.gates import width as width_of
from powderdsl.ir.lower.rules import plane_type
from powderdsl.ir.ops import Type
from powderdsl.model.state import Slot, slot_name, slots, storage
from powderdsl.model.types import MatrixChannel, Property, Ruleset
from powderdsl.simulation.draw import palette, ramps
from powderdsl.simulation.views import (
    Channel,
    PlaneName,
    RampTable,
    State,
    code_values,
    shape_of,
    write_channels,
    write_codes,
    write_planes,
    write_ramp,
    write_rgb,
    write_slot,
)
from powderdsl.targets.words import word_count


class Observer:
    """Reads the worlds of one ruleset on one device. What follows from the ruleset alone is made once.

    Methods take a state and, as `out`, None or the buffer to write to: of the result's shape, dtype and device, each
    of its worlds contiguous, so that a slice of a larger batch serves. They return the buffer.
    """

    def __init__(self, ruleset: Ruleset, device: torch.device):
        self.ruleset = ruleset
        self.device = torch.empty(0, device=device).device  # with its number
        self.slots: dict[str, Slot] = {slot.name: slot for slot in slots(ruleset)}
        self._tables: dict[str, Tensor] = {}

    def read(self, state: State, name: str, out: Any = None) -> Tensor:
        """A field or property: what `World.__getitem__` returns, or a copy of it in `out`.

        Raises:
            KeyError: for a name that the ruleset does not have. ValueError, TypeError: a buffer that does not fit.
        """
        name = slot_name(self.ruleset, name)
        if name in self.slots:
            if out is None:
                return state[name]
            slot = self.slots[name]
            batch, height, width = shape_of(state)
            shape = (batch, 2, height, width) if slot.planes == 2 else (batch, height, width)
            self._check(out, shape, getattr(torch, slot.dtype))
            with torch.no_grad():
                write_slot(state, name, out)
            return out
        prop = self.ruleset.property(name)
        if prop is None:
            known = [*self.slots, *(p.name for p in self.ruleset.properties)]
            raise KeyError(
                f"{self.ruleset.name} has no field or property `{name}`; {'; '.join(suggest(name, known, 'it has'))}"
            )
        out = self._buffer(out, shape_of(state), _dtype(prop))
        with torch.no_grad():
            out.copy_(self.table(name)[state["element"].int()])
        return out

    def rgb(self, state: State, out: Any = None) -> Tensor:
        """Pictures uint8 [B, H, W, 3], a pixel a cell, in the elements' colors, which may follow fields."""
        out = self._buffer(out, (*shape_of(state), 3), torch.uint8)
        with torch.no_grad():
            write_rgb(state, self._palette, out)
            for ramp in self._ramps:
                write_ramp(state, ramp, out)
        return out

    def matrix(self, state: State, out: Any = None) -> Tensor:
        """Channels float32 [B, C, H, W], as the ruleset's `matrix:` names them."""
        batch, height, width = shape_of(state)
        channels, tables = self._channels
        out = self._buffer(out, (batch, len(channels), height, width), torch.float32)
        with torch.no_grad():
            write_channels(state, channels, tables, out)
        return out

    def compact(self, state: State, out: Any = None) -> Tensor:
        """Everything that lasts from step to step, in small numbers: uint8 [B, C, H, W], C those of `compact_names`."""
        batch, height, width = shape_of(state)
        out = self._buffer(out, (batch, len(self.compact_names), height, width), torch.uint8)
        with torch.no_grad():
            at = 0
            for slot in self._lasting:
                for part in _parts(slot):
                    write_codes(state, slot, part, self._floor(slot), out[:, at])
                    at += 1
        return out

    @cached_property
    def compact_names(self) -> tuple[str, ...]:
        """What the channels of `compact` are: ``element``, fields by name, ``name.row`` and ``name.column``."""
        return tuple(
            f"{slot.name}.{part}" if part else slot.name for slot in self._lasting for part in _parts(slot)
        )

    @cached_property
    def compact_values(self) -> Tensor:
        """What the numbers of `compact` stand for: float32 [C, 256]."""
        rows = [code_values(slot, self._floor(slot)) for slot in self._lasting for _ in _parts(slot)]
        return torch.stack(rows).to(self.device)

    @cached_property
    def matrix_names(self) -> tuple[str, ...]:
        """What the channels of `matrix` are: elements, properties and fields by name; ``name.row`` of vectors."""
        return tuple(channel.name for channel in self.ruleset.matrix)

    @cached_property
    def matrix_tables(self) -> tuple[tuple[int, ...], Tensor]:
        """The channels of `matrix` from those of `compact`: the channel that each is read from, and float32 [n, 256],
        what it is where that channel has a number. Fields that do not last read as 0."""
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

    @cached_property
    def _lasting(self) -> tuple[Slot, ...]:
        """The slots that a step does not restart."""
        return tuple(slot for slot in self.slots.values() if not slot.resets)

    def _floor(self, slot: Slot) -> float:
        """Eight times the smallest step of a slot's codes: a power of two near 2⁻¹⁵ of its largest value."""
        return 2.0 ** (math.ceil(math.log2(max(abs(slot.kind.lo), abs(slot.kind.hi), 1e-3))) - 15)

    def planes(self, state: State, out: Any = None) -> Tensor:
        """Packed planes int64 [B, P, H, ⌈W/64⌉], in the order of `plane_names`."""
        batch, height, width = shape_of(state)
        shape = (batch, len(self.planes_there), height, word_count(width))
        out = self._buffer(out, shape, torch.int64)
        with torch.no_grad():
            write_planes(state, self.planes_there, out)
        return out

    def table(self, name: str) -> Tensor:
        """A property's values by id, parameters at their defaults: float64 [256]."""
        if name not in self._tables:
            prop = self.ruleset.property(name)
            assert prop is not None
            defaults = {param.name: param.default for param in self.ruleset.params}
            values = [float(defaults[v]) if isinstance(v, str) else float(v) for v in prop.values]  # type: ignore[arg-type]
            values += [0.0] * (256 - len(values))
            self._tables[name] = torch.tensor(values, dtype=torch.float64, device=self.device)
        return self._tables[name]

    @cached_property
    def planes_there(self) -> tuple[PlaneName, ...]:
        """The planes of flags and integers, slot by slot, lowest bit first. Floats have none."""
        return tuple(
            PlaneName(slot.name, bit)
            for slot in self.slots.values()
            if not slot.is_real
            for bit in range(_bits(plane_type(slot.kind, self.ruleset.slots)))
        )

    @property
    def plane_names(self) -> tuple[str, ...]:
        """What each plane is: a flag's name, or ``name:bit`` for integers."""
        flags = {slot.name for slot in self.slots.values() if slot.kind.name == "flag"}
        return tuple(p.slot if p.slot in flags else f"{p.slot}:{p.bit}" for p in self.planes_there)

    @cached_property
    def _palette(self) -> Tensor:
        """uint8 [256, 4]: red, green, blue, nothing."""
        colors = torch.from_numpy(palette(self.ruleset.elements))
        table = torch.zeros(256, 4, dtype=torch.uint8)
        table[: len(colors), :3] = colors
        return table.to(self.device)

    @cached_property
    def _ramps(self) -> tuple[RampTable, ...]:
        found = []
        for ramp in ramps(self.ruleset.elements):
            colors = torch.zeros(len(ramp.colors), 4, dtype=torch.uint8)
            colors[:, :3] = torch.from_numpy(ramp.colors)
            starts = torch.from_numpy(ramp.starts).to(self.device)
            found.append(RampTable(ramp.id, ramp.field, starts, colors.to(self.device)))
        return tuple(found)

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
        tables.append(self.table(name).to(_dtype(prop)).float())
        return Channel("table", "element", len(tables) - 1)

    def _buffer(self, out: Any, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """The buffer that was given, or a new one."""
        if out is None:
            return torch.empty(shape, dtype=dtype, device=self.device)
        self._check(out, shape, dtype)
        tensor: Tensor = out
        return tensor

    def _check(self, out: Any, shape: tuple[int, ...], dtype: torch.dtype) -> None:
        if not isinstance(out, Tensor):
            raise TypeError(f"out must be a torch tensor, found {type(out).__name__}")
        if tuple(out.shape) != shape:
            raise ValueError(f"out must have the shape {list(shape)}, found {list(out.shape)}")
        if out.dtype != dtype:
            raise ValueError(f"out must be {dtype}, found {out.dtype}")
        if out.device != self.device:
            raise ValueError(f"out must be on {self.device}, found {out.device}")
        if shape[0] and not (out[0].is_contiguous() and (shape[0] == 1 or out.stride(0) >= out[0].numel())):
            raise ValueError(
                f"each world of out must be contiguous, and worlds apart; found the strides {list(out.stride())}"
            )


def _parts(slot: Slot) -> tuple[str, ...]:
    return ("row", "column") if slot.planes == 2 else ("",)


def _bits(type: Type) -> int:
    return 1 if type.name == "flag" else width_of(type.lo, type.hi)[0]


def _dtype(prop: Property) -> torch.dtype:
    """In which a property is read."""
    if prop.kind.name == "chance":
        return torch.float32
    if prop.kind.name == "int":
        return torch.int32 if storage(prop.kind) == "int32" else torch.int16
    return torch.uint8
