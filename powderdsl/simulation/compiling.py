"""Simulators by the name of a backend: on torch where it is installed and needed, else on arrays without it."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from powderdsl.compiler import checked_request
from powderdsl.diagnostics import CompileError
from powderdsl.model.types import Ruleset
from powderdsl.simulation.any_arrays import AnySimulator
from powderdsl.system.writing import failure

if TYPE_CHECKING:
    from powderdsl.simulation.array_worlds import ArraySimulator

WITHOUT_TORCH = ("wasm", "reference")
"""Backends that need no torch; where it is missing, `auto` is the first one that runs."""


@cache
def has_torch() -> bool:
    """Whether torch can be imported. It is not imported."""
    from importlib.util import find_spec

    try:
        return find_spec("torch") is not None
    except ImportError:
        return False


def compile(
    ruleset: Ruleset | str, backend: str = "auto", device: str = "cpu", threads: int = 1
) -> AnySimulator[Any]:
    """A simulator that runs a ruleset: a `Simulator`, or where torch is missing an `ArraySimulator`.

    Args:
        ruleset: from `load` (or a name to load).
        backend: one of `BACKENDS`; all give the same worlds, bit for bit.
        device: a torch device: ``"cpu"``, ``"cuda"``, ``"cuda:1"``.
        threads: for native code, which shares a batch out among them. Torch has its own setting.

    Raises:
        CompileError: PD701 if the backend or the device is not available.
    """
    if not has_torch():
        return compile_arrays(ruleset, backend, device)
    from powderdsl.simulation import simulator

    return simulator.compile(ruleset, backend, device, threads)


def compile_any(
    ruleset: Ruleset | str, backend: str = "auto", device: str = "cpu", threads: int = 1
) -> AnySimulator[Any]:
    """Like `compile`, for callers that take worlds of any library: torch is imported only for what needs it."""
    if backend in WITHOUT_TORCH and device == "cpu":
        return compile_arrays(ruleset, backend)
    return compile(ruleset, backend, device, threads)


def compile_arrays(ruleset: Ruleset | str, backend: str = "auto", device: str = "cpu") -> ArraySimulator:
    """A simulator without torch. Raises CompileError (PD701) for a backend or device that needs torch."""
    from powderdsl.simulation.array_worlds import ArraySimulator, wasm_problem

    model = checked_request(ruleset, backend)
    problem = wasm_problem()
    if backend == "auto":
        backend = "reference" if problem else "wasm"
    if backend not in WITHOUT_TORCH:
        raise _refusal(f"the {backend} backend is not available", "torch is not installed")
    if device != "cpu":
        raise _refusal(f"no device `{device}`", "torch is not installed")
    if backend == "wasm" and problem:
        raise _refusal("the wasm backend is not available", problem)
    return ArraySimulator(model, backend)


def _refusal(message: str, problem: str) -> CompileError:
    help = "install torch, or run on the device `cpu` and the backend `wasm` or `reference`"
    return failure("PD701", message, notes=(problem,), helps=(help,))
