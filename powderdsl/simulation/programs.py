"""Backends by name: the arrays of a simulator, and the program that runs its rules."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import cache, partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

from powderdsl.compiler import BACKENDS, lower, segments_of
from powderdsl.diagnostics import CompileError
from powderdsl.ir.ops import Program
from powderdsl.model import reference
from powderdsl.model.types import Ruleset
from powderdsl.system.cache import Memo, collection_paused
from powderdsl.system.writing import failure
from powderdsl.targets.array_kind import Array, ArrayKind
from powderdsl.targets.job import Job, Runnable, mixed_program, unavailable
from powderdsl.targets.wasm.host import this_host
from powderdsl.targets.wasm.program import WasmProgram

if TYPE_CHECKING:
    import torch

WITHOUT_TORCH = ("wasm", "reference")
"""Backends that do not need torch; without torch, `auto` is the first one that runs."""


@cache
def has_torch() -> bool:
    """True if torch can be imported, and NumPy, which creating tensors requires. Neither is imported."""
    try:
        return all(find_spec(name) for name in ("torch", "numpy"))
    except ImportError:
        return False


def array_kind(backend: str, device: Any, tensors: bool) -> ArrayKind:
    """The arrays of a simulator: torch tensors, or `powderdsl.arrays` if torch is missing or not requested.

    `tensors`: use torch whenever it is installed, not only if the backend or the device needs it. Otherwise, `auto` is
    WebAssembly on the CPU. Raises CompileError (PD701) if the backend or the device is unknown, or needs torch, which
    is missing.
    """
    if backend not in BACKENDS:
        raise failure("PD701", f"no backend `{backend}`", helps=("backends: " + ", ".join(BACKENDS),))
    plain = backend in WITHOUT_TORCH or (backend == "auto" and not _wasm_problem())
    needed = not plain or str(device) != "cpu"
    if has_torch() and (tensors or needed):
        from powderdsl.targets.tensor_kind import Tensors

        return Tensors(find_device(device))
    if backend not in (*WITHOUT_TORCH, "auto"):
        raise unavailable(backend, "torch or NumPy is not installed", _CPU)
    if str(device) != "cpu":
        notes = ("torch or NumPy is not installed",)
        raise failure("PD701", f"no device `{device}`", notes=notes, helps=(_CPU,))
    return ArrayKind()


def find_device(name: str | torch.device) -> torch.device:
    """The torch device of a name. Raises CompileError (PD701) if it is not available."""
    import torch

    try:
        device = torch.device(name)
        if device.type == "meta":
            raise RuntimeError("a meta device has shapes and no values")
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError, TypeError, ValueError, ImportError) as error:
        problem = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise failure("PD701", f"no device `{name}`", notes=(problem,), helps=("run on `cpu`",)) from None
    return device


_CPU = "`pip install torch numpy`, or run on the device `cpu` and the backend `wasm` or `reference`"
_WASMTIME = "`pip install wasmtime`, or run on the backend `torch` or `native`"


def starting_backend(device: str) -> str:
    """The backend that runs rules on a torch device instantly, without a C++ compiler."""
    on_cpu = device.partition(":")[0] == "cpu"
    return "torch" if not on_cpu or _wasm_problem() else "wasm"


def make_program(
    ruleset: Ruleset, backend: str, kind: ArrayKind, threads: int = 1, memo: Memo | None = None
) -> BackendProgram:
    """The program of a ruleset on a backend.

    | arrays  | backend   | whole steps            | chosen passes | given draws |
    |---------|-----------|------------------------|---------------|-------------|
    | any     | reference | oracle                 | oracle        | oracle      |
    | plain   | wasm      | wasm                   | oracle        | oracle      |
    | tensors | others    | the backend            | torch-cells   | torch-cells |

    `auto` is wasm and later native code on the CPU; on other devices cuda, or torch without it; with plain arrays wasm,
    or the oracle without it. Raises CompileError (PD701) if the backend is not available.
    """
    device, plain = kind.device, kind.xp.__name__ != "torch"
    problem = _wasm_problem() if backend in ("auto", "wasm") else ""
    if backend == "reference" or (plain and backend == "auto" and problem):
        return BackendProgram("reference", ReferenceProgram(ruleset, kind))
    if backend in ("wasm", "native") and not kind.on_cpu:
        runs = {"wasm": "wasmtime", "native": "native code"}[backend]
        fix = f"run on the device `cpu`, or on the backend `torch` or `auto` on `{device}`"
        raise unavailable(backend, f"{runs} runs on the CPU", fix)
    if backend == "wasm" and problem:
        raise unavailable("wasm", problem, _CPU if plain else _WASMTIME)
    if plain:
        oracle = partial(ReferenceProgram, ruleset, kind)
        return BackendProgram("wasm", _plain_program(ruleset, kind, memo), oracle)
    from powderdsl.targets.torch.packed import PlanesProgram
    from powderdsl.targets.torch.program import TorchProgram, packed_program

    # Created on first use: cached native code needs none of them.
    lowered, segments = cache(lambda: lower(ruleset)), cache(lambda: segments_of(ruleset))
    cells, fuse = cache(lambda: TorchProgram(lowered(), device)), backend == "torch-fused"
    make = partial(PlanesProgram, device=device, fuse=fuse)
    torch = cache(lambda: packed_program(segments(), device, make))
    wasm = cache(lambda: packed_program(segments(), device, partial(WasmProgram, kind=kind)))
    if backend == "wasm":
        return BackendProgram("wasm", wasm(), cells)
    if backend == "native" or (backend == "auto" and kind.on_cpu):
        from powderdsl.simulation.native import ByWidth

        first = None if backend == "native" else ("torch", torch) if problem else ("wasm", wasm)
        return BackendProgram(backend, ByWidth(ruleset, segments, threads, first, cells), cells)
    if backend == "cuda" or (backend == "auto" and device.type == "cuda"):
        from powderdsl.targets.cuda.program import cuda_program

        with suppress(CompileError) if backend == "auto" else nullcontext():
            return BackendProgram("cuda", cuda_program(segments(), device), cells)
    if fuse and kind.on_cpu:
        from powderdsl.targets.cpp.build import NoCompiler, find_compiler
        from powderdsl.targets.torch.fuse import not_compiled

        try:
            find_compiler()
        except NoCompiler as error:
            raise not_compiled(str(error)) from None
    if backend == "torch-cells":
        return BackendProgram(backend, cells())
    return BackendProgram(backend if fuse else "torch", torch(), cells)


@collection_paused()
def _plain_program(ruleset: Ruleset, kind: ArrayKind, memo: Memo | None) -> Runnable:
    """WebAssembly without torch: the oracle runs the passes that WebAssembly cannot."""
    return mixed_program(
        segments_of(ruleset, memo),
        lambda program, planes: WasmProgram(program, planes, kind, memo),
        lambda program: ReferenceProgram(ruleset, kind, program),
    )


@cache
def _wasm_problem() -> str:
    """The reason that WebAssembly does not run in this process; empty if it runs."""
    try:
        this_host()
    except (ImportError, OSError, RuntimeError) as error:  # wasmtime may be installed but not run
        return " ".join(str(error).split())[:200] or type(error).__name__
    return ""


class BackendProgram(NamedTuple):
    """The programs of one backend. `name` is the running backend, unless `latest` has `running` and `notes`."""

    name: str
    whole: Runnable
    rest: Callable[[], Runnable] | None = None
    """Returns the program for selected passes and given draws, if `whole` cannot run them."""

    @property
    def latest(self) -> Any:
        """The program that ran last, of those by width."""
        return getattr(self.whole, "latest", None)

    def run(self, job: Job) -> Mapping[str, Array]:
        if self.rest is None or (job.passes is None and not job.draws):
            return self.whole.run(job)
        return self.rest().run(job)


class ReferenceProgram:
    """The oracle, which converts the arrays of its jobs to `powderdsl.arrays`.

    `part`: consecutive passes, to run only these. Only the first passes of a step restart fields.
    """

    def __init__(self, ruleset: Ruleset, kind: ArrayKind, part: Program | None = None):
        self._passes = None if part is None else frozenset(pass_.name for pass_ in part.passes)
        if part is not None and not any(slot.resets for slot in part.slots):
            ruleset = replace(ruleset, fields=tuple(replace(field, resets=False) for field in ruleset.fields))
        self._ruleset, self._kind = ruleset, kind
        self._bits = {stream.name: stream.bits for stream in ruleset.streams}

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state after `job.steps` steps. The time before a step's first pass counts toward that pass."""
        host = self._kind.to_numpy
        seed, index, start = map(host, (*job.clock[:2], job.clock.step))
        arrays = {name: host(value) for name, value in job.state.items()}
        params = {name: host(value) for name, value in job.params.items()}
        numbers = reference.parameters(self._ruleset, len(seed), params)
        draws = {name: (host(value) + 0.5) / 2.0 ** self._bits[name] for name, value in job.draws.items()}
        passes = self._passes if job.passes is None else job.passes
        for i in range(job.steps):
            at, rules = reference.Clock(seed, index, start + i), self._ruleset
            job.tick("")
            arrays = reference.step(rules, arrays, at, numbers, passes=passes, draws=draws, tick=job.tick)
        return {name: self._kind.from_numpy(value.copy()) for name, value in arrays.items()}
