"""The readable torch backend: one tensor element per cell, with masks, rolls and shifted sums. It has every IR operation.

Each pass becomes a generated straight-line Python function. Its names come from node numbers, never from rule files. Flags
are bool, integers int32, floats float32, all [B, H, W] or broadcastable to it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from powderdsl.ir.bits import Segment
from powderdsl.ir.ops import SNAP, Program, Threshold, kernel_rows
from powderdsl.system.cache import collection_paused
from powderdsl.system.random import MASK, base_keys, mix
from powderdsl.targets.job import Job, Runnable, mixed_program
from powderdsl.targets.layout import limits, pieces
from powderdsl.targets.torch.source import load_source, pass_source

PassFunction = Callable[[Any, dict[str, Tensor]], dict[str, Tensor]]

DTYPES = {"flag": torch.bool, "int": torch.int32, "real": torch.float32}
"""Of working planes, by type."""


# Random numbers: the bit planes of each draw are hashes of (seed, world, step, stream, word). The same numbers as
# `model.reference.draw`, in int64 arithmetic kept below 2³²: no generator, no state, no host sync.


def step_keys(base: Tensor, step: Tensor, idents: Tensor) -> Tensor:
    """Keys of one step for each stream: int64 [S, 2, B]. `step` is [B], `idents` [S]."""
    keys = mix((base + (step & MASK)) & MASK)
    return mix((keys[None] + idents[:, None, None]) & MASK)


def words(keys: Tensor, bits: int, height: int, width: int) -> Tensor:
    """Hashes of the first `bits` bit planes: int64 [bits, B, H, ⌈W/32⌉]; bit x % 32 of word x // 32 is column x.

    `keys` is [2, B]: one stream's part of `step_keys`.
    """
    across = -(-width // 32)
    number = torch.arange(height * across, dtype=torch.int64, device=keys.device).view(height, across) * 32
    plane = torch.arange(bits, dtype=torch.int64, device=keys.device)
    n = ((number + plane[:, None, None]) * 0x9E3779B1) & MASK
    h = (n[:, None] + keys[0][:, None, None]) & MASK
    h = h ^ (h >> 16)
    h = (h * 0x7FEB352D) & MASK
    h = h ^ (h >> 15)
    h = (((h + keys[1][:, None, None]) & MASK) * 0x846CA68B) & MASK
    return h ^ (h >> 16)


def draws(keys: Tensor, bits: int, height: int, width: int) -> Tensor:
    """The first `bits` bits of each cell's draw as an integer: int64 [B, H, W]."""
    planes = words(keys, bits, height, width)
    column = torch.arange(32, dtype=torch.int64, device=keys.device)
    result = torch.zeros((), dtype=torch.int64, device=keys.device)
    for plane in planes:
        result = (result << 1) | ((plane[..., None] >> column) & 1)
    batch, rows, across, _ = result.shape
    return result.view(batch, rows, across * 32)[..., :width]


@dataclass
class Kernels:
    """The functions that generated code calls, for one grid size and batch: neighbors, draws, coordinates, parameters."""

    shape: tuple[int, int, int]
    device: torch.device
    params: Mapping[str, Tensor]
    streams: Mapping[str, tuple[int, int]]
    """Position in `keys`, and bits."""
    replacements: Mapping[str, Tensor]
    """Draws that replace random numbers, by stream."""
    base: Tensor
    idents: Tensor
    step: Tensor
    snap: float = SNAP
    """Smaller magnitudes of float slots become zero at the end of a pass."""
    keys: Tensor = field(init=False)
    _draws: dict[str, Tensor] = field(default_factory=dict)

    def begin(self, step: Tensor) -> None:
        """Start a step: new keys, no draws yet."""
        self.step = step
        self.keys = step_keys(self.base, step, self.idents)
        self._draws.clear()

    def full(self, x: Tensor) -> Tensor:
        return x.expand(self.shape)

    def roll(self, x: Tensor, dy: int, dx: int) -> Tensor:
        """The value at the neighbor (dy, dx); the grid wraps."""
        return torch.roll(self.full(x), (-dy, -dx), (-2, -1))

    def reach(self, x: Tensor, dy: int, dx: int) -> Tensor:
        """The value at the neighbor (dy, dx), zero outside the grid."""
        margin = max(abs(dy), abs(dx))
        _, height, width = self.shape
        return pad(self.full(x), (margin,) * 4).narrow(1, margin + dy, height).narrow(2, margin + dx, width)

    def inside(self, dy: int, dx: int) -> Tensor:
        """True where the neighbor lies inside the grid."""
        return self.reach(torch.ones((), dtype=torch.bool, device=self.device), dy, dx)

    def count(self, x: Tensor, weights: tuple[tuple[int, int, int], ...], wraps: bool) -> Tensor:
        """The weighted number of neighbors where a flag holds: sums of rows first, each pattern of weights once.

        Sums of slices in the narrowest integers are faster than convolutions, see docs/performance.md.
        """
        largest = sum(abs(weight) for *_, weight in weights)
        dtype = next(t for t in (torch.int8, torch.int16, torch.int32) if largest <= torch.iinfo(t).max)
        margin = max((abs(n) for *offset, _ in weights for n in offset), default=0)
        _, height, width = self.shape
        cells = self.full(x).to(dtype)
        if wraps:  # padding wraps once: copies side by side where the kernel is larger than the world
            cells = cells.repeat(1, *(max(1, -(-margin // n)) for n in (height, width)))
        cells = pad(cells, (margin,) * 4, "circular" if wraps else "constant")
        sums: dict[tuple[tuple[int, int], ...], Tensor] = {}
        total = torch.zeros(self.shape, dtype=dtype, device=self.device)
        for dy, pattern in kernel_rows(weights).items():
            if pattern not in sums:
                sums[pattern] = torch.zeros_like(cells[..., :width])
                for dx, weight in pattern:
                    sums[pattern].add_(cells.narrow(2, margin + dx, width), alpha=weight)
            total += sums[pattern].narrow(1, margin + dy, height)
        return total.to(torch.int32)

    def draw(self, stream: str) -> Tensor:
        """A stream's draws as integers, int64 [B, H, W]."""
        if stream not in self._draws:
            position, bits = self.streams[stream]
            if (drawn := self.replacements.get(stream)) is None:
                drawn = draws(self.keys[position], bits, *self.shape[1:])
            self._draws[stream] = drawn
        return self._draws[stream]

    def draw_real(self, stream: str) -> Tensor:
        """A stream's draws in (0, 1), float32."""
        return ((self.draw(stream).double() + 0.5) / float(1 << self.streams[stream][1])).float()

    def coordinate(self, axis: str, modulus: int) -> Tensor:
        _, height, width = self.shape
        if axis == "step":
            value = self.step[:, None, None]
        else:
            value = torch.arange(height if axis == "row" else width, device=self.device)
            value = value[:, None] if axis == "row" else value[None]
        return (value % modulus).to(torch.int32)

    def param(self, name: str, kind: str) -> Tensor:
        """A parameter's value [B, 1, 1]."""
        return self.params[name][:, None, None].to(DTYPES[kind])

    def limit(self, name: str, bits: int, strict: bool) -> Tensor:
        """A parameter as a chance [B, 1, 1]: the number of possible draws below it, or not above it."""
        return limits(torch, self.params[name], Threshold(bits, strict))[:, None, None]

    def clamp(self, x: Tensor, low: float, high: float) -> Tensor:
        """No NaN, within bounds, nothing smaller than `snap`."""
        x = x.masked_fill(x.isnan(), 0).clamp(low, high)
        return x.masked_fill(x.abs() < self.snap, 0)


class TorchProgram:
    """A program whose passes are generated torch functions.

    `snap` replaces the threshold SNAP below which floats become zero, to follow engines that keep every magnitude.
    """

    def __init__(self, program: Program, device: torch.device, snap: float = SNAP):
        self.program = program
        self._snap = snap
        self.device = device
        self._pieces = pieces(program)
        self._streams = {name: (i, bits) for i, (name, _, bits) in enumerate(program.streams)}
        idents = [ident for _, ident, _ in program.streams]
        self._idents = torch.tensor(idents, dtype=torch.int64, device=device)
        self._functions = [compiled(*pass_source(p, i), device) for i, p in enumerate(program.passes)]

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later in storage dtypes; no host sync."""
        seed, index, start = *job.clock[:2], job.clock.step
        batch, height, width = job.state["element"].shape
        kernels = Kernels(
            (batch, height, width), self.device, job.params, self._streams, job.draws,
            base_keys(seed, index), self._idents, start, snap=self._snap,
        )  # fmt: skip
        planes = {  # in working dtypes: vectors split, integers widened
            piece.name: piece.of(job.state[name]).to(DTYPES[piece.type.name])
            for name, parts in self._pieces.items()
            for piece in parts
        }
        with torch.no_grad():
            for i in range(job.steps):
                kernels.begin(start + i)
                for slot in self.program.slots:
                    if slot.resets:
                        dtype = DTYPES[slot.type.name]
                        planes[slot.name] = torch.full(
                            kernels.shape, slot.default, dtype=dtype, device=self.device
                        )
                job.tick("")
                for pass_, function in zip(self.program.passes, self._functions, strict=True):
                    if job.passes is None or pass_.name in job.passes:
                        planes.update(function(kernels, planes))
                        job.tick(pass_.name)
        packed = {}
        for name, old in job.state.items():
            parts = [kernels.full(planes[piece.name]) for piece in self._pieces[name]]
            if self._pieces[name][0].component is not None:
                packed[name] = torch.stack(parts, 1)
            else:  # a copy, also where no pass wrote the plane
                packed[name] = parts[0].to(old.dtype, memory_format=torch.contiguous_format, copy=True)
        return packed


@collection_paused()
def packed_program(
    segments: Sequence[Segment], device: torch.device, make: Callable[[Program, Program], Runnable]
) -> Runnable:
    """A program on bit planes, see `mixed_program`; passes that bit planes cannot represent run on torch tensors."""
    return mixed_program(segments, make, lambda cells: TorchProgram(cells, device))


def compiled(source: str, name: str, constants: Mapping[str, object], device: torch.device) -> PassFunction:
    """The function of a pass's source on this device."""
    namespace: dict[str, object] = {"torch": torch}
    dtypes: dict[type, torch.dtype] = {bool: torch.bool, float: torch.float32}
    for key, value in constants.items():
        dtype = dtypes.get(type(value))
        if dtype is None:  # integers: thresholds of draws of 32 bits need more than 32
            wide = max(value if isinstance(value, tuple) else (value,)) >= 1 << 31
            dtype = torch.int64 if wide else torch.int32
        namespace[key] = torch.tensor(value, dtype=dtype, device=device)
    return load_source(source, name, namespace)
