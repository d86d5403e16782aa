"""Backends by name: makes the program of a checked model, a `Runnable`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from functools import cache

import torch
from torch import Tensor

from powderdsl.compiler import has_webassembly, lower, starting_backend
from powderdsl.diagnostics import CompileError
from powderdsl.ir.ops import Program
from powderdsl.model.types import Ruleset
from powderdsl.simulation.reference_program import ReferenceProgram
from powderdsl.system.writing import failure
from powderdsl.targets.cpp.compilers import INSTALL, NoCompiler
from powderdsl.targets.job import Job, Runnable
from powderdsl.targets.tensor_kind import Tensors


def find_device(name: str | torch.device) -> torch.device:
    """The torch device of a name. Raises CompileError (PD701) if it is not available."""
    try:
        device = torch.device(name)
        if device.type == "meta":
            raise RuntimeError("a meta device has shapes and no values")
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError, TypeError, ValueError, ImportError) as error:
        problem = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise failure("PD701", f"no device `{name}`", notes=(problem,), helps=("run on `cpu`",)) from None
    return device


class CompiledProgram:
    """Compiled code for whole steps; torch tensors where draws are given or passes chosen."""

    def __init__(self, native: Runnable, rest: Callable[[], Runnable], running: str = "native"):
        self._native, self._rest, self.running = native, rest, running

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later."""
        runnable = self._rest() if job.draws or job.passes is not None else self._native
        return runnable.run(job)


def make_program(ruleset: Ruleset, backend: str, device: torch.device, threads: int = 1) -> Runnable:
    """The program of a ruleset on a backend, for an available device.

    Raises:
        CompileError: PD701 if the backend is not available.
    """
    if backend == "reference":
        return ReferenceProgram(ruleset, Tensors(device))
    # Both are made when first needed: code that was compiled before needs neither.
    lowered = cache(lambda: lower(ruleset))
    cells = cache(lambda: _torch_program(lowered(), device))
    if backend == "torch":
        return cells()
    if backend == "wasm":
        return CompiledProgram(_wasm_program(lowered(), device), cells, "wasm")
    if backend == "native":
        return CompiledProgram(_native(ruleset, lowered, device, threads), cells)
    if backend == "cuda" or (backend == "auto" and device.type == "cuda"):
        from powderdsl.targets.cuda.program import cuda_program

        with suppress(CompileError) if backend == "auto" else nullcontext():
            return CompiledProgram(cuda_program(lowered(), device), cells, "cuda")
    if backend == "auto" and device.type == "cpu":
        from powderdsl.simulation.native import auto_by_width

        first = starting_backend(device.type)
        begin = cache(lambda: _wasm_program(lowered(), device)) if first == "wasm" else cells
        return auto_by_width(ruleset, lowered, threads, (first, begin), cells)
    return cells()


def _torch_program(program: Program, device: torch.device) -> Runnable:
    from powderdsl.targets.torch.program import TorchProgram

    return TorchProgram(program, device)


def _wasm_program(program: Program, device: torch.device) -> Runnable:
    """On the CPU only; passes that do not fit bit planes run on torch tensors."""
    if device.type != "cpu":
        raise _refusal("wasm", "wasmtime runs on the CPU", _ELSEWHERE.format(device))
    if not has_webassembly():
        problem = "the package `wasmtime` is missing, or does not run on this machine"
        raise _refusal("wasm", problem, "`pip install wasmtime`, or run on the backend `torch` or `native`")
    from powderdsl.targets.torch.mixed import packed_program
    from powderdsl.targets.wasm.program import WasmProgram

    kind = Tensors(device)
    return packed_program(program, device, lambda numbers, planes: WasmProgram(numbers, planes, kind))


def _native(ruleset: Ruleset, lowered: Callable[[], Program], device: torch.device, threads: int) -> Runnable:
    """Native code for the width of each grid. Without a compiler, there is an error at once."""
    from powderdsl.simulation.native import ByWidth, latest_width, native_program

    if device.type != "cpu":
        raise _refusal("native", "native code runs on the CPU", _ELSEWHERE.format(device))
    with _compiler_needed():
        if latest_width(ruleset) is None:
            lowered()  # what cannot be lowered is reported before the first step

    def make(width: int) -> Runnable:
        with _compiler_needed():
            return native_program(ruleset, lowered, threads, width)

    return ByWidth(make)


@contextmanager
def _compiler_needed() -> Iterator[None]:
    try:
        yield
    except NoCompiler as error:
        help = f"run on the backend `wasm`, or {INSTALL}"
        raise _refusal("native", str(error), help) from None


_ELSEWHERE = "run on the device `cpu`, or on the backend `torch` or `auto` on `{}`"


def _refusal(backend: str, problem: str, help: str) -> CompileError:
    message = f"the {backend} backend is not available"
    return failure("PD701", message, notes=tuple(problem.splitlines()), helps=(help,))
