"""The cuda backend: packed worlds on the device, one launch for all steps of a call.

Kernels are compiled and launched by NVRTC and the CUDA driver through ctypes. NVRTC comes with torch, so no toolkit has to
be installed; the context is that of torch.
"""

from __future__ import annotations

import ctypes
import glob
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache, reduce
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from powderdsl.ir.bits import Segment
from powderdsl.ir.ops import REAL, Program
from powderdsl.system.cache import persistent
from powderdsl.targets.cuda.source import KernelSource, cuda_source
from powderdsl.targets.job import Job, Like, PackedArrays, Runnable, like_of, shape_of, unavailable
from powderdsl.targets.layout import pieces
from powderdsl.targets.tensor_kind import pack
from powderdsl.targets.torch.program import packed_program

OPTIONS = ("--std=c++17", "--fmad=false", "--prec-div=true", "--prec-sqrt=true", "--ftz=false", "-w")
"""No contraction and no flushing: every operation is rounded separately, so that all backends agree bit for bit."""

ENTRY = b"powderdsl_steps"
_DYNAMIC_SHARED = 8
"""The number of an attribute of functions in the driver's interface."""


class NoCuda(Exception):
    """Raised if no working CUDA device, driver or NVRTC was found; the message names it."""


class Worlds(ctypes.Structure):
    """The kernel's argument, as declared in `driver.cuh`."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("planes", "reals", "scratch", "seed", "index", "step", "flags", "numbers")),
        ("worlds", ctypes.c_int),
        ("steps", ctypes.c_int),
    )  # fmt: skip


@cache
def driver() -> ctypes.CDLL:
    """The CUDA driver. Raises NoCuda."""
    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        return ctypes.CDLL(name)
    except OSError as error:
        raise NoCuda(f"no CUDA driver: {error}") from None


@cache
def nvrtc(version: str) -> ctypes.CDLL:
    """NVRTC of a CUDA version such as ``13.0``: loaded, on the library path, or in a package. Raises NoCuda."""
    major = version.split(".")[0]
    if sys.platform == "win32":
        names, pattern = [f"nvrtc64_{major}0_0.dll"], f"nvrtc64_{major}*.dll"
    else:
        names, pattern = [f"libnvrtc.so.{major}"], f"libnvrtc.so.{major}*"
    for folder in sys.path:
        for place in ("nvidia/*/lib", "nvidia/*/bin", "nvidia/*/bin/*", "torch/lib"):
            names += sorted(glob.glob(str(Path(folder or ".") / place / pattern)))
    for name in names:
        try:
            for beside in glob.glob(str(Path(name).parent / "libnvrtc-builtins.so.*")) if "/" in name else ():
                ctypes.CDLL(beside)  # NVRTC opens it by name, without searching its own folder
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise NoCuda(f"no NVRTC of CUDA {version}: `pip install nvidia-cuda-nvrtc`, or reinstall torch")


def check(code: int, what: str) -> None:
    """Raise NoCuda unless a call of the driver succeeded."""
    if code:
        text = ctypes.c_char_p()
        driver().cuGetErrorString(code, ctypes.byref(text))
        raise NoCuda(f"{what}: {(text.value or b'unknown error').decode()} ({code})")


def machine_code(source: KernelSource, architecture: str, version: str) -> bytes:
    """A kernel's machine code, from the cache or newly compiled.

    Raises NoCuda if NVRTC is missing or failed.
    """
    compiler = nvrtc(version)
    major, minor = ctypes.c_int(), ctypes.c_int()
    compiler.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    options = (f"--gpu-architecture={architecture}", *OPTIONS)
    key = "\0".join([source.text, f"{major.value}.{minor.value}", *options])
    return persistent(f"{source.name}.cuda", key, lambda: compile_text(compiler, source.text, options))


def compile_text(compiler: ctypes.CDLL, text: str, options: Sequence[str]) -> bytes:
    """Machine code of a source by NVRTC. Raises NoCuda with the first lines of its messages."""
    program, size = ctypes.c_void_p(), ctypes.c_size_t()
    compiler.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"powderdsl.cu", 0, None, None)
    try:
        encoded = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
        if compiler.nvrtcCompileProgram(program, len(options), encoded):
            compiler.nvrtcGetProgramLogSize(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(size.value)
            compiler.nvrtcGetProgramLog(program, log)
            raise NoCuda("NVRTC failed:\n" + "\n".join(log.value.decode(errors="replace").splitlines()[:8]))
        compiler.nvrtcGetCUBINSize(program, ctypes.byref(size))
        code = ctypes.create_string_buffer(size.value)
        compiler.nvrtcGetCUBIN(program, code)
        return code.raw
    finally:
        compiler.nvrtcDestroyProgram(ctypes.byref(program))


Launch = Callable[[Worlds, int], None]
"""Runs a kernel on the current stream: its argument, and the number of blocks."""


def load_kernel(code: bytes, source: KernelSource, device: torch.device) -> Launch:
    """A kernel from machine code, loaded permanently into a device's context. Raises NoCuda."""
    cuda, shared = driver(), source.shared
    module, function = ctypes.c_void_p(), ctypes.c_void_p()
    with torch.cuda.device(device):
        torch.empty(1, device=device)  # makes the context current in this thread
        check(cuda.cuModuleLoadData(ctypes.byref(module), code), "a kernel could not be loaded")
        check(cuda.cuModuleGetFunction(ctypes.byref(function), module, ENTRY), "a kernel has no entry")
        check(cuda.cuFuncSetAttribute(function, _DYNAMIC_SHARED, shared), f"{shared} bytes of shared memory")

    def launch(worlds: Worlds, blocks: int) -> None:
        arguments = (ctypes.c_void_p * 1)(ctypes.cast(ctypes.byref(worlds), ctypes.c_void_p))
        with torch.cuda.device(device):
            stream = ctypes.c_void_p(torch.cuda.current_stream(device).cuda_stream)
            shape = (blocks, 1, 1, source.threads, 1, 1)
            code = cuda.cuLaunchKernel(function, *shape, shared, stream, arguments, None)
        check(code, "a kernel could not be started")

    return launch


_HELP = "run on the device `cuda`, or on the backend `torch`, or on `native` on the CPU"

Compile = Callable[[KernelSource], Launch]
"""Makes a kernel from its source, for one device."""


def cuda_program(segments: Sequence[Segment], device: torch.device) -> Runnable:
    """A program for a CUDA device; passes that bit planes cannot represent run on cells.

    Raises CompileError (PD701) if the device, the driver or NVRTC is missing, here or when a kernel is made.
    """
    version = torch.version.cuda or ""

    def compile(source: KernelSource) -> Launch:
        try:
            code = machine_code(source, f"sm_{limits.major}{limits.minor}", version)
            return load_kernel(code, source, device)
        except NoCuda as error:
            raise unavailable("cuda", str(error), _HELP) from None

    try:
        if device.type != "cuda":
            raise NoCuda("its kernels run on a CUDA device")
        limits: Any = torch.cuda.get_device_properties(device)
        driver()
        nvrtc(version)
    except NoCuda as error:
        raise unavailable("cuda", str(error), _HELP) from None
    shared = limits.shared_memory_per_block_optin
    return packed_program(segments, device, lambda cells, planes: CudaProgram(cells, planes, compile, shared))


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
        self._kernels: dict[tuple[int, int], tuple[KernelSource, Launch]] = {}

    def kernel(self, height: int, width: int) -> tuple[KernelSource, Launch]:
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
        flags, numbers = source.layout.parameters(torch, job.params, batch, device=device)
        blocks = -(-batch // source.group)
        scratch = torch.empty(max(1, blocks * source.scratch // 4), dtype=torch.int32, device=device)
        clock = [part.contiguous() for part in (job.clock.seed, job.clock.world, job.clock.step)]
        tensors = (after.planes, after.reals, scratch, *clock, flags, numbers)
        launch(Worlds(*[tensor.data_ptr() for tensor in tensors], batch, job.steps), blocks)
        return after

    def _pack(self, state: Mapping[str, Tensor]) -> DeviceState:
        (batch, height, width), device = shape_of(state), state["element"].device
        layout = self.kernel(height, width)[0].layout
        row_words = -(-width // 32)
        shape = batch, max(1, len(layout.planes)), height, row_words
        planes = torch.zeros(shape, dtype=torch.int32, device=device)
        shape = batch, max(1, len(layout.reals)), height, width
        reals = torch.zeros(shape, dtype=torch.float32, device=device)
        for name, value in state.items():
            for piece in self._pieces[name]:
                if piece.type == REAL:
                    reals[:, layout.reals[piece.name]] = piece.of(value)
                    continue
                for i, plane in enumerate(piece.planes):
                    words = pack((value >> i) & 1 != 0)
                    planes[:, layout.planes[plane]] = words.view(torch.int32)[..., :row_words]
        return DeviceState(self, planes, reals, like_of(state))

    def unpack(self, state: DeviceState, name: str) -> Tensor:
        dtype, (*_, height, width) = state.like[name]
        parts, layout = self._pieces[name], self.kernel(height, width)[0].layout
        if parts[0].type == REAL:
            fields = [state.reals[:, layout.reals[piece.name]] for piece in parts]
            return torch.stack(fields, 1) if len(fields) > 1 else fields[0].clone()
        (piece,) = parts
        words = state.planes[:, [layout.planes[plane] for plane in piece.planes]]
        octets = words.contiguous().view(torch.uint8)
        flags = (octets[..., None] >> torch.arange(8, dtype=torch.uint8, device=words.device)) & 1
        cells = flags.flatten(-2)[..., :width].to(torch.int32)
        weights = [1 << i for i in range(len(piece.planes))]
        if piece.type.signed:
            weights[-1] *= -1
        return reduce(torch.add, [cells[:, i] * weight for i, weight in enumerate(weights)]).to(dtype)
