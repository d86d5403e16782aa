"""Bit planes on the CPU: generated passes on NumPy's arrays, as many worlds at a time as fit into the cache."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from powderdsl.ir.ops import PassGraph, Program
from powderdsl.targets.arrays.draws import Draws, base_keys
from powderdsl.targets.arrays.kernels import ArrayKernels
from powderdsl.targets.arrays.source import pass_source
from powderdsl.targets.arrays.words import Array, pack, unpack
from powderdsl.targets.codec import pieces
from powderdsl.targets.job import Job
from powderdsl.targets.torch.source import load_source

State = dict[str, Array]

CHUNK = 1 << 17
"""Cells processed at a time: a float32 for each fits into the second-level cache at least twice."""


PassFunction = Callable[[ArrayKernels, State], State]


def _function(pass_: PassGraph, number: int) -> PassFunction:
    source, name, constants = pass_source(pass_, number)
    function: PassFunction = load_source(source, name, {k: np.float32(v) for k, v in constants.items()})
    return function


class ArrayProgram:
    """A program on planes for the CPU.

    Args:
        program: the numeric program, whose slots are the state's.
        planes: the same program from `ir.bits.lower_bits`.
    """

    def __init__(self, program: Program, planes: Program):
        self._pieces = pieces(program)
        self._kinds = dict(program.params)
        self._streams = {name: (i, bits) for i, (name, _, bits) in enumerate(program.streams)}
        self._idents = np.array([ident for _, ident, _ in program.streams], np.uint32)
        self._resets = [slot for slot in planes.slots if slot.resets]
        self._kept: tuple[tuple[int, int, int], dict[object, Array]] = ((0, 0, 0), {})
        """The last shape of worlds and the kernels for it."""
        self._functions = [(pass_.name, _function(pass_, i)) for i, pass_ in enumerate(planes.passes)]

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later in storage dtypes."""
        batch, height, width = job.state["element"].shape
        result = {name: torch.empty_like(old) for name, old in job.state.items()}
        chunk = max(CHUNK // (height * width), 1)
        functions = [(name, f) for name, f in self._functions if job.passes is None or name in job.passes]
        with np.errstate(all="ignore"):
            for start in range(0, batch, chunk):
                some = slice(start, min(start + chunk, batch))
                kernels = self._kernels(job, some, (height, some.stop - some.start, width))
                state = self._unpack(job.state, some)
                first = job.clock.step[some].numpy()
                for i in range(job.steps):
                    kernels.begin(first + i)
                    self._reset(state, kernels)
                    job.tick("")
                    for name, function in functions:
                        state.update(function(kernels, state))
                        job.tick(name)
                self._pack(state, result, some, kernels)
        return result

    def _kernels(self, job: Job, some: slice, shape: tuple[int, int, int]) -> ArrayKernels:
        if self._kept[0] != shape:
            self._kept = (shape, {"valid": pack(np.ones(shape, bool))})
        lasting = self._kept[1]
        valid = lasting["valid"]
        seed, index = (part[some].numpy() for part in job.clock[:2])
        given = {name: _rows_first(value[some]) for name, value in job.draws.items()}
        draws = Draws(shape, valid, self._streams, given, base_keys(seed, index), self._idents, lasting)
        return ArrayKernels(
            shape, lambda name: job.params[name][some].numpy(), self._kinds, draws, lasting, valid
        )

    def _reset(self, state: State, kernels: ArrayKernels) -> None:
        for slot in self._resets:
            if slot.type.name == "flag":
                state[slot.name] = kernels.valid if slot.default else kernels.zero
            else:
                state[slot.name] = np.full(kernels.shape, slot.default, np.float32)

    def _unpack(self, stored: Mapping[str, Tensor], some: slice) -> State:
        """Some worlds' state slots as planes."""
        planes = {}
        for piece in (piece for parts in self._pieces.values() for piece in parts):
            value = _rows_first(piece.of(stored[piece.state][some]))
            if piece.is_real:
                planes[piece.slot] = value
            elif piece.type.name == "flag":
                planes[piece.slot] = pack(value)
            else:
                for i, name in enumerate(piece.planes):
                    planes[name] = pack(value & value.dtype.type(1 << i) if i < 7 else value >> i & 1)
        return planes

    def _pack(self, state: State, result: Mapping[str, Tensor], some: slice, kernels: ArrayKernels) -> None:
        """Planes as some worlds' state slots in storage dtypes."""
        for piece in (piece for parts in self._pieces.values() for piece in parts):
            out = piece.of(result[piece.state][some]).numpy()
            if piece.is_real:
                out[...] = state[piece.slot].transpose(1, 0, 2)
            elif piece.type.name == "flag":
                out[...] = unpack(state[piece.slot], kernels.width).transpose(1, 0, 2)
            else:
                value = np.zeros(kernels.shape, f"u{out.itemsize}")
                for i, name in enumerate(piece.planes):
                    bit = unpack(state[name], kernels.width).astype(value.dtype, copy=False)
                    weight = -1 << i if piece.signed and i == len(piece.planes) - 1 else 1 << i
                    value += bit * value.dtype.type(weight % (1 << 8 * out.itemsize))
                out[...] = value.view(out.dtype).transpose(1, 0, 2)


def _rows_first(worlds: Tensor) -> Array:
    """[B, H, W] as [H, B, W], copied."""
    return np.array(worlds.numpy().transpose(1, 0, 2), order="C")
