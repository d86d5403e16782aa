"""The torch backend on bit planes: batches as words, steps as generated functions of tensors, eager or compiled."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from threading import get_ident
from typing import Any, NamedTuple

import torch
from torch import Tensor

from powderdsl.ir.ops import REAL, Program, nodes_of
from powderdsl.system.cache import collection_paused
from powderdsl.system.random import base_keys
from powderdsl.targets.job import Job, Like, PackedArrays, like_of, shape_of
from powderdsl.targets.layout import limits, pieces
from powderdsl.targets.torch.library import Eager, Portable
from powderdsl.targets.torch.planes import Key, pass_source
from powderdsl.targets.torch.program import step_keys
from powderdsl.targets.torch.source import load_source

CHUNK = 1 << 18
"""Cells of the worlds that an eager program steps together: about as many as fit into the cache."""

MOST_SIZES = 8

FIXED = ("row", "column", "inside", "inside_mask", "left")
"""Inputs of passes that depend on the grid only: methods of the library."""

Batch = tuple[Tensor, tuple[Tensor, ...]]
"""Words of all planes, int64 [planes, H, B, K], and floats of each field, see `library`."""


class PlanesState(PackedArrays):
    """A batch as chunks of worlds on bit planes."""

    __slots__ = ("chunks", "program")

    def __init__(self, program: PlanesProgram, chunks: Sequence[Batch], like: Like):
        super().__init__(like)
        self.program, self.chunks = program, chunks

    def unpack(self, name: str) -> Tensor:
        return torch.cat([self.program.unpack(chunk, name, self.like) for chunk in self.chunks])


class _Kernels(NamedTuple):
    """The operations for one size, and the functions of the passes."""

    k: Portable
    draw: Callable[..., tuple[Tensor, ...]]
    functions: list[Callable[..., Batch]]


class PlanesProgram:
    """A program on bit planes, whose passes are generated torch functions.

    `program` is the same on numbers. With `fuse`, inductor compiles the functions.
    """

    def __init__(self, program: Program, planes: Program, device: torch.device, *, fuse: bool = False):
        self.device, self.planes, self._fuse = device, planes, fuse
        # glibc maps large blocks anew for each tensor until it frees a larger one; clearing pages takes half the time.
        torch.empty(31 << 20, dtype=torch.uint8)
        self.eager = device.type == "cpu" and sys.byteorder == "little" and not fuse
        self._pieces = pieces(program)
        names = [slot.name for slot in planes.slots if slot.type != REAL]
        self._number = {name: i for i, name in enumerate(names)}
        self._fields = [slot.name for slot in planes.slots if slot.type == REAL]
        self._bits = _significant_bits(planes)
        idents = [ident for name, ident, _ in planes.streams if name in self._bits]
        self._idents = torch.tensor(idents, dtype=torch.int64, device=device)
        self._sources = [pass_source(planes, pass_, i) for i, pass_ in enumerate(planes.passes)]
        known = {"inf": float("inf"), "nan": float("nan")}
        self._functions = [load_source(source.text, source.name, known) for source in self._sources]
        self._kernels: dict[tuple[int, int, int, int], _Kernels] = {}
        self._settings: tuple[Any, list[dict[Key, Any]]] | None = None
        """The parameters of the last job, and the inputs of passes that depend on them, by chunk."""

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later; no host sync, except on the CPU."""
        like = like_of(job.state)
        batch, height, width = shape_of(job.state)
        count = -(-batch * height * width // CHUNK) if self.eager else 1
        size = -(-batch // count)
        parts = [slice(start, min(start + size, batch)) for start in range(0, batch, size)]
        settings = self._settings
        if settings is None or settings[0] is not job.params:
            settings = (job.params, [self._parameters(job.params, part) for part in parts])
            self._settings = settings
        chunks = []
        for number, part in enumerate(parts):
            with torch.inference_mode():
                kernels = self._sized(part.stop - part.start, height, width)
                if isinstance(job.state, PlanesState) and job.state.program is self:
                    chunk = job.state.chunks[number]
                else:
                    chunk = self.pack(kernels.k, {name: array[part] for name, array in job.state.items()})
                base, step = base_keys(job.clock.seed[part], job.clock.world[part]), job.clock.step[part]
                chunks.append(self._steps(kernels, chunk, job, base, step, settings[1][number]))
        return PlanesState(self, chunks, like)

    def _sized(self, batch: int, height: int, width: int) -> _Kernels:
        # The eager library has memory that threads must not share.
        key = (batch, height, width, get_ident() if self.eager else 0)
        if key not in self._kernels:
            if len(self._kernels) >= MOST_SIZES:
                self._kernels.clear()
            k = (Eager if self.eager else Portable)(batch, height, width, self.device)
            draw: Callable[..., Any] = partial(_draw, tuple(self._bits.values()))
            functions = [draw, *self._functions]
            if self._fuse:
                with collection_paused():
                    from powderdsl.targets.torch.fuse import fused  # takes seconds to import

                functions = list(map(fused, functions))
            self._kernels[key] = _Kernels(k, functions[0], functions[1:])
        return self._kernels[key]

    def _steps(
        self, kernels: _Kernels, chunk: Batch, job: Job, base: Tensor, start: Tensor, settings: dict[Key, Any]
    ) -> Batch:
        k, (words, fields) = kernels.k, chunk
        for key in self._keys(*FIXED):
            if key not in k.fixed:
                k.fixed[key] = getattr(k, key[0])(*key[1:])
        for i in range(job.steps):
            step = start + i
            values = k.fixed | settings
            drawn = kernels.draw(k, base, step, self._idents) if self._bits else ()
            for stream, planes in zip(self._bits, drawn, strict=True):
                values["draws", stream] = planes.unbind() if self.eager else planes
            for key in self._keys("step"):
                values[key] = -(step % key[1] >> key[2] & 1)[:, None]
            words, fields = self._reset(k, words, fields)
            job.tick("")
            passes = zip(self.planes.passes, self._sources, kernels.functions, strict=True)
            for pass_, source, function in passes:
                words, fields = function(k, words, fields, tuple([values[key] for key in source.inputs]))
                job.tick(pass_.name)
        return words, fields

    def _keys(self, *kinds: str) -> list[Key]:
        return [key for source in self._sources for key in source.inputs if key[0] in kinds]

    # Inputs of passes

    def _parameters(self, params: Mapping[str, Tensor], part: slice) -> dict[Key, Any]:
        """Inputs that depend on parameters. Limits that all worlds share are numbers if that needs no sync."""
        values: dict[Key, Any] = {}
        for key in self._keys("limit", "bit", "real"):
            kind, name, *rest = key
            value = params[name][part]
            if kind == "real":
                values[key] = value.to(torch.float32)[:, None] if self.eager else value.to(torch.float32)
                continue
            threshold, *bit = rest
            number = value.to(torch.int64) if threshold is None else limits(torch, value, threshold)
            if kind == "bit":
                values[key] = -(number >> bit[0] & 1)[:, None]
            elif self.eager and bool((number == number[0]).all()):
                values[key] = int(number[0])
            else:
                values[key] = tuple([-(number >> i & 1)[:, None] for i in range(threshold.bits, -1, -1)])
        return values

    def _reset(self, k: Portable, words: Tensor, fields: tuple[Tensor, ...]) -> Batch:
        resets = [slot for slot in self.planes.slots if slot.resets]
        planes = {self._number[slot.name]: slot for slot in resets if slot.type != REAL}
        if planes:
            words = words.clone()
            for number, slot in planes.items():
                words[number] = -int(slot.default)
        floats = {slot.name: float(slot.default) for slot in resets if slot.type == REAL}
        parts = zip(self._fields, fields, strict=True)
        return words, tuple([k.all_cells(floats[name]) if name in floats else value for name, value in parts])

    # States

    def pack(self, k: Portable, state: Mapping[str, Tensor]) -> Batch:
        """Arrays of a state as words and fields."""
        planes: dict[int, Tensor] = {}
        fields: dict[str, Tensor] = {}
        for name, array in state.items():
            for piece in self._pieces[name]:
                cells = k.to_cells(piece.of(array))
                if piece.type == REAL:
                    fields[piece.name] = cells.contiguous()
                    continue
                for i, plane in enumerate(piece.planes):
                    flags = (cells >> i & 1) != 0 if piece.type.name == "int" else cells != 0
                    planes[self._number[plane]] = k.pack(flags)
        stacked = k.stack([planes[i] for i in range(len(planes))])
        return stacked, tuple([fields[name] for name in self._fields])

    def unpack(self, chunk: Batch, name: str, like: Like) -> Tensor:
        """One array of a state, in its storage dtype."""
        words, fields = chunk
        k = self._sized(words.shape[2], words.shape[1], like["element"][1][2]).k
        dtype = like[name][0]
        parts = []
        for piece in self._pieces[name]:
            if piece.type == REAL:
                parts.append(k.from_cells(fields[self._fields.index(piece.name)]))
                continue
            bits = k.bits(torch.stack([words[self._number[plane]] for plane in piece.planes])).to(torch.int32)
            weights = [1 << i for i in range(len(bits))]
            if piece.type.signed:
                weights[-1] = -weights[-1]
            factors = torch.tensor(weights, dtype=torch.int32, device=bits.device).view(-1, 1, 1, 1)
            parts.append(k.from_cells((bits * factors).sum(0)))
        whole = parts[0] if self._pieces[name][0].component is None else torch.stack(parts, 1)
        return whole.to(dtype).contiguous()


def _draw(bits: Sequence[int], k: Portable, base: Tensor, step: Tensor, idents: Tensor) -> tuple[Tensor, ...]:
    """The draws of each stream in a step, from its number and the bits it needs."""
    keys = step_keys(base, step, idents).to(torch.int32)
    return tuple([k.draws(keys[i], count) for i, count in enumerate(bits)])


def _significant_bits(planes: Program) -> dict[str, int]:
    """The number of bits of each stream that a program needs: those above the lowest bits of constant limits, which are 0."""
    bits: dict[str, int] = {}
    for pass_ in planes.passes:
        for node in nodes_of(pass_, substeps=False):
            if node.op in ("chance", "below_planes", "draw"):
                stream, own, *limit = node.attr
                if limit and limit[0]:
                    own -= (limit[0] & -limit[0]).bit_length() - 1
                bits[stream] = max(bits.get(stream, 1), own)
    return {name: bits[name] for name, _, _ in planes.streams if name in bits}
