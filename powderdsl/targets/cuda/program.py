"""The cuda backend: packed worlds on the device, one launch for all steps of a call."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from powderdsl.ir.ops import Program
from powderdsl.targets import words as torch_words
from powderdsl.targets.codec import parameters, pieces
from powderdsl.targets.cuda import build
from powderdsl.targets.cuda.source import KernelSource, cuda_source
from powderdsl.targets.job import Job, Like, PackedArrays, Runnable, unavailable
from powderdsl.targets.torch.mixed import packed_program


@dataclass(frozen=True)
class Arguments:
    """The arguments of a kernel; tensors are contiguous and on its device."""

    planes: Tensor
    """int32 [B, slots, H, ⌈W/32⌉], changed in place."""
    reals: Tensor
    """float32 [B, reals, H, W], changed in place."""
    scratch: Tensor
    clock: tuple[Tensor, Tensor, Tensor]
    flags: Tensor
    """uint8 [n, B]: planes of parameters."""
    numbers: Tensor
    """float32 [m, B]: parameters as they are."""
    steps: int
    blocks: int

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All tensors in the kernel's order."""
        return self.planes, self.reals, self.scratch, *self.clock, self.flags, self.numbers


_HELP = "run on the device `cuda`, or on the backend `torch`, or on `native` on the CPU"

Launch = Callable[[Arguments], None]
"""Runs a kernel on the current stream."""

Compile = Callable[[KernelSource], Launch]
"""Makes a kernel from its source, for one device."""


def compiler_for(device: torch.device) -> Compile:
    """A function that makes kernels for a CUDA device. It raises CompileError (PD701) if that fails."""

    def compile(source: KernelSource) -> Launch:
        version = torch.version.cuda or ""
        try:
            with torch.cuda.device(device):
                torch.empty(1, device=device)  # creates the context
                architecture = build.architecture(torch.cuda.current_device())
                code = build.machine_code(source, architecture, version)
                start = build.load_kernel(code, source)
        except build.NoCuda as error:
            raise unavailable("cuda", str(error), _HELP) from None

        def launch(arguments: Arguments) -> None:
            with torch.cuda.device(device):
                stream = torch.cuda.current_stream(device).cuda_stream
                start(worlds_of(arguments), arguments.blocks, stream)

        return launch

    return compile


def worlds_of(arguments: Arguments) -> build.Worlds:
    """The arguments as the kernel takes them."""
    addresses = (tensor.data_ptr() for tensor in arguments.tensors)
    return build.Worlds(*addresses, len(arguments.clock[0]), arguments.steps)


def cuda_program(program: Program, device: torch.device) -> Runnable:
    """A program for a CUDA device; passes that bit planes cannot represent run on cells.

    Raises:
        CompileError: PD701 if the device, the driver or NVRTC is missing.
    """
    problem = "its kernels run on a CUDA device" if device.type != "cuda" else ""
    try:
        if not problem:
            with torch.cuda.device(device):
                torch.empty(1, device=device)
                limit = build.shared_limit(torch.cuda.current_device())
            build.nvrtc(torch.version.cuda or "")
            compile = compiler_for(device)
            return packed_program(
                program, device, lambda cells, planes: CudaProgram(cells, planes, compile, limit)
            )
    except build.NoCuda as error:
        problem = str(error)
    raise unavailable("cuda", problem, _HELP)


class DeviceState(PackedArrays):
    """A batch's state in packed tensors."""

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
        self._kernels: dict[tuple[int, int], tuple[KernelSource, Launch]] = {}

    def kernel(self, height: int, width: int) -> tuple[KernelSource, Launch]:
        """The kernel for a size of grid, compiled on first use."""
        if (height, width) not in self._kernels:
            source = cuda_source(self._planes, height, width, self._limit)
            self._kernels[height, width] = source, self._compile(source)
        return self._kernels[height, width]

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later. Jobs with given draws or chosen passes are for other backends."""
        assert not job.draws
        assert job.passes is None
        with torch.no_grad():
            return self._run(job)

    def _run(self, job: Job) -> DeviceState:
        state = job.state
        shape = state.like["element"][1] if isinstance(state, DeviceState) else state["element"].shape
        batch, height, width = shape
        source, launch = self.kernel(height, width)
        if isinstance(state, DeviceState) and state.program is self:
            after = DeviceState(self, state.planes.clone(), state.reals.clone(), state.like)
        else:
            after = self._pack(state, source)
        device = after.planes.device
        layout = source.layout
        flags, numbers = parameters(
            torch, job.params, layout.param_planes, layout.param_reals, batch, device=device
        )
        blocks = -(-batch // source.group)
        scratch = torch.empty(max(1, blocks * source.scratch // 4), dtype=torch.int32, device=device)
        seed, index, start = (part.contiguous() for part in (job.clock.seed, job.clock.world, job.clock.step))
        launch(
            Arguments(
                after.planes, after.reals, scratch, (seed, index, start), flags, numbers, job.steps, blocks
            )
        )
        return after

    def _pack(self, state: Mapping[str, Tensor], source: KernelSource) -> DeviceState:
        """State slots as packed planes and reals."""
        batch, height, width = state["element"].shape
        device, layout = state["element"].device, source.layout
        row_words = -(-width // 32)
        planes = torch.zeros(
            batch, max(1, len(layout.planes)), height, row_words, dtype=torch.int32, device=device
        )
        reals = torch.zeros(
            batch, max(1, len(layout.reals)), height, width, dtype=torch.float32, device=device
        )
        like = {}
        for name, value in state.items():
            like[name] = (value.dtype, tuple(value.shape))
            for piece in self._pieces[name]:
                if piece.is_real:
                    reals[:, layout.reals[piece.slot]] = piece.of(value)
                    continue
                for i, plane in enumerate(piece.planes):
                    words = torch_words.pack((value >> i) & 1 != 0)
                    planes[:, layout.planes[plane]] = words.view(torch.int32)[..., :row_words]
        return DeviceState(self, planes, reals, like)

    def unpack(self, state: DeviceState, name: str) -> Tensor:
        """One slot of a state in its storage dtype."""
        dtype, shape = state.like[name]
        height, width = shape[-2:]
        source, _ = self.kernel(height, width)
        parts, layout = self._pieces[name], source.layout
        if parts[0].is_real:
            found = [state.reals[:, layout.reals[piece.slot]] for piece in parts]
            return torch.stack(found, 1) if len(found) > 1 else found[0].clone()
        (piece,) = parts
        bits, signed = len(piece.planes), piece.signed
        words = state.planes[:, [layout.planes[plane] for plane in piece.planes]]
        octets = words.contiguous().view(torch.uint8)
        flags = (octets[..., None] >> torch.arange(8, dtype=torch.uint8, device=words.device)) & 1
        cells = flags.flatten(-2)[..., :width].to(torch.int32)
        value = torch.zeros(cells.shape[0], *cells.shape[2:], dtype=torch.int32, device=words.device)
        for i in range(bits):
            value += cells[:, i] * (-(1 << i) if signed and i == bits - 1 else 1 << i)
        return value.to(dtype)
