"""Backends by name: what each makes of a checked model. All of them run the same signature (`Runnable`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch
from torch import Tensor

from powderdsl import reference
from powderdsl.diagnostics import CompileError, Reporter
from powderdsl.model.types import Ruleset

Clock = tuple[Tensor, Tensor, Tensor]
"""Seed, world index and step of each world: int64 [B]."""


class Runnable(Protocol):
    """A ruleset made executable."""

    def run(
        self,
        state: Mapping[str, Tensor],
        clock: Clock,
        steps: int,
        params: Mapping[str, Tensor],
        draws: Mapping[str, Tensor],
        passes: frozenset[str] | None,
    ) -> Mapping[str, Tensor]:
        """The state `steps` later; the argument is not changed.

        `params` are float64 [B]; `draws` int64 [B, H, W] below 2^bits replace a stream's numbers.
        """
        ...


class ReferenceProgram:
    """The oracle behind the common signature."""

    def __init__(self, ruleset: Ruleset):
        self.ruleset = ruleset
        self._bits = {stream.name: stream.bits for stream in ruleset.streams}

    def run(
        self,
        state: Mapping[str, Tensor],
        clock: Clock,
        steps: int,
        params: Mapping[str, Tensor],
        draws: Mapping[str, Tensor],
        passes: frozenset[str] | None,
    ) -> dict[str, Tensor]:
        device = state["element"].device
        seed, index, start = (part.cpu().numpy() for part in clock)
        arrays = {name: value.cpu().numpy() for name, value in state.items()}
        numbers = {name: value.cpu().numpy() for name, value in params.items()}
        kinds = {param.name: param.kind.name for param in self.ruleset.params}
        dtypes = {"int": "int64", "flag": "bool", "real": "float32", "chance": "float64"}
        numbers = {name: value.astype(dtypes[kinds[name]]) for name, value in numbers.items()}
        given = {name: (value.cpu().numpy() + 0.5) / 2.0 ** self._bits[name] for name, value in draws.items()}
        for i in range(steps):
            at = reference.Clock(seed, index, start + i)
            arrays = reference.step(self.ruleset, arrays, at, numbers, passes=passes, draws=given)
        return {name: torch.from_numpy(value.copy()).to(device) for name, value in arrays.items()}


def find_device(name: str | torch.device) -> torch.device:
    """The torch device of a name. Raises CompileError (PD701) if it is not there."""
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reporter = Reporter()
        problem = str(error).splitlines()[0]
        reporter.error("PD701", f"no device `{name}`", None, notes=[problem], helps=["run on `cpu`"])
        raise CompileError(reporter.diagnostics) from None
    return device


def make_program(ruleset: Ruleset, backend: str, device: torch.device) -> Runnable:
    """The program of a ruleset on a backend, for a device that is there."""
    if backend == "reference":
        return ReferenceProgram(ruleset)
    from powderdsl.backends.torch_dense import DenseProgram
    from powderdsl.backends.torch_planes import PlanesProgram
    from powderdsl.compiler import lower
    from powderdsl.ir.bits import NotBits, lower_bits

    program = lower(ruleset)
    if backend == "dense":
        return DenseProgram(program, device)
    try:
        planes = lower_bits(program)
    except NotBits:  # cells carry everything
        return DenseProgram(program, device)
    if backend == "native":
        from powderdsl.backends.torch_native import NativeProgram

        return NativeProgram(program, planes)
    return PlanesProgram(program, planes, device)
