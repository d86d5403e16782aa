"""The cuda backend: packed worlds on the device, one launch for all steps of a call."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from powderdsl.ir.ops import Program
from powderdsl.targets.codec import parameters, pieces
from powderdsl.targets.cuda import build
from powderdsl.targets.cuda.source import KernelSource, cuda_source
from powderdsl.targets.job import Job, Like, PackedArrays, Runnable, like_of, shape_of, unavailable
from powderdsl.targets.tensor_kind import pack
from powderdsl.targets.torch.program import packed_program

_HELP = "run on the device `cuda`, or on the backend `torch`, or on `native` on the CPU"

Compile = Callable[[KernelSource], build.Launch]
"""Makes a kernel from its source, for one device."""


def cuda_program(program: Program, device: torch.device) -> Runnable:
    """A program for a CUDA device; passes that bit planes cannot represent run on cells.

    Raises:
        CompileError: PD701 if the device, the driver or NVRTC is missing, here or when a kernel is made.
    """
    version = torch.version.cuda or ""

    def compile(source: KernelSource) -> build.Launch:
        try:
            code = build.machine_code(source, f"sm_{limits.major}{limits.minor}", version)
            return build.load_kernel(code, source, device)
        except build.NoCuda as error:
            raise unavailable("cuda", str(error), _HELP) from None

    try:
        if device.type != "cuda":
            raise build.NoCuda("its kernels run on a CUDA device")
        limits: Any = torch.cuda.get_device_properties(device)
        build.driver()
        build.nvrtc(version)
    except build.NoCuda as error:
        raise unavailable("cuda", str(error), _HELP) from None
    shared = limits.shared_memory_per_block_optin
    return packed_program(program, device, lambda cells, planes: CudaProgram(cells, planes, compile, shared))


class DeviceState(PackedArrays):
    """A batch's state in packed tensors: planes int32 [B, slots, H, ⌈W/32⌉], floats float32 [B, reals, H, W]."""

    def __init__(self, program: CudaProgram, planes: Tensor, reals: Tensor, like: Like):
        self.program, self.planes, self.reals = program, planes, reals
        super().__init__(like)

    def unpack(self, name: str) -> Tensor:
        return self.program.unpack(self, name)


class CudaProgram:
    """A program as kernels, one per size of grid.

    Args:
        program: the numeric program, whose slots are the state's.
        planes: the same program from `ir.bits.lower_bits`.
        compile: makes kernels for the device.
        shared_limit: bytes of shared memory that a block may have there.
    """

    def __init__(self, program: Program, planes: Program, compile: Compile, shared_limit: int):
        self._planes, self._compile, self._limit = planes, compile, shared_limit
        self._pieces = pieces(program)
        self._kernels: dict[tuple[int, int], tuple[KernelSource, build.Launch]] = {}

    def kernel(self, height: int, width: int) -> tuple[KernelSource, build.Launch]:
        """The kernel for a size of grid, compiled on first use."""
        if (height, width) not in self._kernels:
            source = cuda_source(self._planes, height, width, self._limit)
            self._kernels[height, width] = source, self._compile(source)
        return self._kernels[height, width]

    @torch.no_grad()
    def run(self, job: Job) -> DeviceState:
        """The state `job.steps` later. Jobs with given draws or chosen passes are for other backends."""
        state = job.state
        if isinstance(state, DeviceState) and state.program is self:
            after = DeviceState(self, state.planes.clone(), state.reals.clone(), state.like)
        else:
            after = self._pack(state)
        device, (batch, height, width) = after.planes.device, after.like["element"][1]
        source, launch = self.kernel(height, width)
        layout = source.layout
        flags, numbers = parameters(
            torch, job.params, layout.param_planes, layout.param_reals, batch, device=device
        )
        blocks = -(-batch // source.group)
        scratch = torch.empty(max(1, blocks * source.scratch // 4), dtype=torch.int32, device=device)
        clock = [part.contiguous() for part in (job.clock.seed, job.clock.world, job.clock.step)]
        tensors = (after.planes, after.reals, scratch, *clock, flags, numbers)
        launch(build.Worlds(*[tensor.data_ptr() for tensor in tensors], batch, job.steps), blocks)
        return after

    def _pack(self, state: Mapping[str, Tensor]) -> DeviceState:
        """State slots as packed planes and reals."""
        (batch, height, width), device = shape_of(state), state["element"].device
        layout = self.kernel(height, width)[0].layout
        row_words = -(-width // 32)
        planes = torch.zeros(
            batch, max(1, len(layout.planes)), height, row_words, dtype=torch.int32, device=device
        )
        reals = torch.zeros(
            batch, max(1, len(layout.reals)), height, width, dtype=torch.float32, device=device
        )
        for name, value in state.items():
            for piece in self._pieces[name]:
                if piece.is_real:
                    reals[:, layout.reals[piece.slot]] = piece.of(value)
                    continue
                for i, plane in enumerate(piece.planes):
                    words = pack((value >> i) & 1 != 0)
                    planes[:, layout.planes[plane]] = words.view(torch.int32)[..., :row_words]
        return DeviceState(self, planes, reals, like_of(state))

    def unpack(self, state: DeviceState, name: str) -> Tensor:
        """One slot of a state in its storage dtype."""
        dtype, (*_, height, width) = state.like[name]
        parts, layout = self._pieces[name], self.kernel(height, width)[0].layout
        if parts[0].is_real:
            fields = [state.reals[:, layout.reals[piece.slot]] for piece in parts]
            return torch.stack(fields, 1) if len(fields) > 1 else fields[0].clone()
        (piece,) = parts
        words = state.planes[:, [layout.planes[plane] for plane in piece.planes]]
        octets = words.contiguous().view(torch.uint8)
        flags = (octets[..., None] >> torch.arange(8, dtype=torch.uint8, device=words.device)) & 1
        cells = flags.flatten(-2)[..., :width].to(torch.int32)
        weights = [1 << i for i in range(len(piece.planes))]
        if piece.signed:
            weights[-1] *= -1
        return reduce(torch.add, [cells[:, i] * weight for i, weight in enumerate(weights)]).to(dtype)
