"""NVRTC and the CUDA driver through ctypes: compile kernels, cache them, launch them on a stream.

NVRTC comes with torch, so no toolkit has to be installed; the context is that of torch.
"""

from __future__ import annotations

import ctypes
import glob
import hashlib
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import torch

from powderdsl.system import cache as native_cache
from powderdsl.targets.cuda.source import KernelSource

OPTIONS = ("--std=c++17", "--fmad=false", "--prec-div=true", "--prec-sqrt=true", "--ftz=false", "-w")
"""No contraction and no flushing: every operation is rounded separately, so that all backends agree bit for bit."""

ENTRY = b"powderdsl_steps"
_DYNAMIC_SHARED = 8
"""The number of an attribute of functions in the driver's interface."""


class NoCuda(Exception):
    """No CUDA device, driver or NVRTC that works was found; the message names it."""


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
                ctypes.CDLL(beside)  # NVRTC opens it by name, without looking in its own folder
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

    Safe with other processes doing the same: files are added atomically.

    Raises:
        NoCuda: NVRTC is missing or failed, or there is no folder for the cache.
    """
    compiler = nvrtc(version)
    major, minor = ctypes.c_int(), ctypes.c_int()
    compiler.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    options = (f"--gpu-architecture={architecture}", *OPTIONS)
    key = "\0".join([source.text, f"{major.value}.{minor.value}", *options])
    try:
        folder = native_cache.compiled_folder()
    except OSError as error:
        raise NoCuda(f"no cache folder: {error}") from None
    name = hashlib.sha256(key.encode()).hexdigest()[:32]
    if (path := native_cache.find(folder, name)) is not None:
        return path.read_bytes()
    code = compile_text(compiler, source.text, options)
    with suppress(OSError):
        native_cache.add(folder, name, code, f"{source.name}.cuda")
    return code


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
            code = cuda.cuLaunchKernel(
                function, blocks, 1, 1, source.threads, 1, 1, shared, stream, arguments, None
            )  # fmt: skip
        check(code, "a kernel could not be started")

    return launch
