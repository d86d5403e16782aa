"""The native backend: worlds stay packed between calls; tensors are made when they are read."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from powderdsl.targets.codec import parameters
from powderdsl.targets.cpp.build import load_library
from powderdsl.targets.cpp.code import NativeCode
from powderdsl.targets.job import Job

Like = Mapping[str, tuple[torch.dtype, tuple[int, ...]]]
"""The dtype and shape of each tensor of a state."""

BATCH_SIZES = 16
"""How many batch sizes a program keeps the inputs of parameters for."""


class Inputs(NamedTuple):
    """The parameters of a batch as generated code reads them: flags uint8 [n, B], floats float32 [m, B], and where."""

    params: Mapping[str, Tensor]
    planes: Tensor
    reals: Tensor
    planes_at: int
    reals_at: int


class PackedState(Mapping[str, Tensor]):
    """A batch's state in native memory. Slots are unpacked into tensors one by one, on first access."""

    __slots__ = ("_handle", "_tensors", "like", "program")

    def __init__(self, program: NativeProgram, handle: int, like: Like):
        self._tensors: dict[str, Tensor] = {}
        self.program, self.like = program, like
        self._handle: int | None = handle

    def __del__(self) -> None:
        # Not a weakref.finalize, which takes as long as a quiet step. A signal may have ended `__init__` before its end.
        if getattr(self, "_handle", None) is not None:
            self.program.library.pd_free(self._handle)

    def __copy__(self) -> PackedState:
        return PackedState(self.program, self.program.library.pd_copy(self.handle), self.like)

    def __deepcopy__(self, memo: Any) -> PackedState:
        return self.__copy__()

    @property
    def handle(self) -> int:
        """The batch in native memory. Raises RuntimeError after `take`."""
        if self._handle is None:
            raise RuntimeError(
                "these worlds were stepped with `reuse`: only those that came of it can be used"
            )
        return self._handle

    def take(self) -> int:
        """The batch, for a new owner. This state must not be used afterwards."""
        handle, self._handle = self.handle, None
        self._tensors.clear()
        return handle

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._tensors:
            dtype, shape = self.like[name]
            self._tensors[name] = self.write(name, torch.empty(shape, dtype=dtype))
        return self._tensors[name]

    def has(self, name: str) -> bool:
        """Whether a slot's tensor has been made."""
        return name in self._tensors

    def write(self, name: str, out: Tensor) -> Tensor:
        """One slot, written into a tensor of its storage dtype whose worlds are contiguous; returns it."""
        program = self.program
        for piece in program.pieces[name]:
            place = address(piece.of(out))
            if piece.is_real:
                number = program.layout.reals[piece.slot]
                program.library.pd_store_real(self.handle, number, place, out.stride(0))
            else:
                slot, bits, signed = program.planes_of(name)
                program.library.pd_store(
                    self.handle, slot, bits, signed, out.element_size(), place, out.stride(0)
                )
        return out

    def fill(self, boxes: Tensor, values: Mapping[str, Tensor], *, reuse: bool) -> PackedState:
        """The state with one box of cells in each world filled, without unpacking the rest.

        Args:
            boxes: int64 [B, 4]: first row, the one after the last, first column, the one after the last, all within
                the grid; empty where nothing changes.
            values: by slot: int64 [B], float32 [B] for reals, float32 [B, 2] for vectors.
            reuse: write to this state itself, and return it.
        """
        program = self.program
        changed = self if reuse else self.__copy__()
        boxes = boxes.contiguous()
        for name, value in values.items():
            changed._tensors.pop(name, None)
            for piece in program.pieces[name]:
                numbers = piece.of(value).contiguous()
                if piece.is_real:
                    slot = program.layout.reals[piece.slot]
                    program.library.pd_fill_real(changed.handle, slot, address(boxes), address(numbers))
                else:
                    slot, bits, _ = program.planes_of(name)
                    program.library.pd_fill(changed.handle, slot, bits, address(boxes), address(numbers))
        return changed

    def put(self, places: Tensor, state: Mapping[str, Tensor], *, reuse: bool) -> PackedState:
        """The state with the worlds `places`, int64 [n], replaced by those of another state of n worlds.

        `reuse`: write to this state itself, and return it.
        """
        program = self.program
        changed = self if reuse else self.__copy__()
        changed._tensors.clear()
        places, count = places.contiguous(), len(places)
        for name, value in state.items():
            for piece in program.pieces[name]:
                plane = piece.of(value).contiguous()
                if piece.is_real:
                    number = program.layout.reals[piece.slot]
                    program.library.pd_put_real(
                        changed.handle, number, count, address(places), address(plane)
                    )
                else:
                    slot, bits, _ = program.planes_of(name)
                    item = plane.element_size()
                    program.library.pd_put(
                        changed.handle, slot, bits, item, count, address(places), address(plane)
                    )
        return changed

    def __iter__(self) -> Iterator[str]:
        return iter(self.like)

    def __len__(self) -> int:
        return len(self.like)


class NativeProgram:
    """A program as compiled C++. Passes are timed on one thread, in processor time."""

    def __init__(self, code: NativeCode, threads: int):
        self.library = load_library(code.library)
        self.layout, self.threads = code.layout, threads
        self.pieces, self._passes = code.pieces, code.passes
        self._inputs: dict[int, Inputs] = {}
        self._planes = {
            name: (self.layout.planes[parts[0].planes[0]], len(parts[0].planes), parts[0].signed)
            for name, parts in self.pieces.items()
            if not parts[0].is_real
        }

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later. Jobs with given draws or chosen passes are for other backends."""
        assert not job.draws
        assert job.passes is None
        state, (seed, index, start, since) = job.state, job.clock
        if not (seed.is_contiguous() and index.is_contiguous() and start.is_contiguous()):
            seed, index, start = seed.contiguous(), index.contiguous(), start.contiguous()
        inputs = self._inputs.get(start.shape[0])
        if inputs is None or inputs.params is not job.params:
            inputs = self._made_inputs(job.params, start.shape[0])
        if isinstance(state, PackedState) and state.program is self:
            like, copy = state.like, not job.reuse
            handle = state.handle if copy else state.take()
        else:
            copy = False
            handle, like = self._pack(state)
        seconds = None if job.timing is None else (ctypes.c_double * len(self._passes))()
        handle = self.library.pd_run(
            handle, copy, job.steps, self.threads,
            seed.data_ptr(), index.data_ptr(), start.data_ptr(), since, inputs.planes_at, inputs.reals_at, seconds,
        )  # fmt: skip
        if job.timing is not None and seconds is not None:
            for name, spent in zip(self._passes, seconds, strict=True):
                job.timing.add(name, spent)
        return PackedState(self, handle, like)

    def _made_inputs(self, params: Mapping[str, Tensor], batch: int) -> Inputs:
        """The inputs of some parameters, kept for the next call with the same mapping."""
        layout = self.layout
        planes, reals = parameters(torch, params, layout.param_planes, layout.param_reals, batch)
        found = Inputs(params, planes, reals, planes.data_ptr(), reals.data_ptr())
        if len(self._inputs) >= BATCH_SIZES:
            self._inputs = {}  # not cleared: another thread may be reading it
        self._inputs[batch] = found
        return found

    def _pack(self, state: Mapping[str, Tensor]) -> tuple[int, Like]:
        batch, height, width = state["element"].shape
        handle = self.library.pd_new(batch, height, width)
        like: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {}
        for name, value in state.items():
            value = value.contiguous()
            like[name] = (value.dtype, tuple(value.shape))
            for piece in self.pieces[name]:
                place = address(piece.of(value))
                if piece.is_real:
                    self.library.pd_load_real(handle, self.layout.reals[piece.slot], place, value.stride(0))
                else:
                    slot, bits, _ = self.planes_of(name)
                    self.library.pd_load(handle, slot, bits, value.element_size(), place)
        return handle, like

    def planes_of(self, name: str) -> tuple[int, int, bool]:
        """The first plane of a state tensor, the number of planes, and whether the last one is a sign."""
        return self._planes[name]


def address(tensor: Tensor) -> ctypes.c_void_p:
    """The address of a tensor's data, for C."""
    return ctypes.c_void_p(tensor.data_ptr())
