"""Worlds and the simulator on torch tensors."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from powderdsl.compiler import checked_request, starting_backend
from powderdsl.model.types import Ruleset
from powderdsl.simulation.any_arrays import MAX_CELLS, AnySimulator, AnyWorld, clock_of, whole_count
from powderdsl.simulation.observe import Observer
from powderdsl.simulation.programs import find_device, make_program
from powderdsl.targets.job import Job, profile_of
from powderdsl.targets.tensor_kind import Tensors

__all__ = ["MAX_CELLS", "Simulator", "World", "compile"]


class World(AnyWorld):
    """A batch of worlds of one ruleset, as torch tensors on the simulator's device.

    `state` has one tensor a slot; `seed`, `index` and `step` (int64 [B]) decide the random numbers: the same three
    give the same future, alone or in any batch.
    """

    sim: Simulator
    state: Mapping[str, Tensor]
    seed: Tensor
    index: Tensor
    step: Tensor

    def read(self, name: str, out: Tensor | None = None) -> Tensor:
        """`world[name]`, written into `out`.

        Args:
            out: written to and returned, instead of a new tensor or the world's own: of the same shape, dtype and
                device, each of its worlds contiguous. The methods below take one too.

        Raises:
            KeyError: an unknown name. TypeError, ValueError: `out` is not a tensor, or does not fit.
        """
        return self.sim.observer.read(self.state, name, out)

    def matrix(self, out: Tensor | None = None) -> Tensor:
        """All channels of the ruleset's `matrix:` as float32 [B, C, H, W]: elements one-hot, then fields."""
        return self.sim.observer.matrix(self.state, out)

    def rgb(self, out: Tensor | None = None) -> Tensor:
        """Pictures in the elements' colors, a pixel a cell: uint8 [B, H, W, 3]."""
        return self.sim.observer.rgb(self.state, out)

    def compact(self, out: Tensor | None = None) -> Tensor:
        """Everything that lasts from step to step, as bytes: uint8 [B, C, H, W]. `sim.observer.compact_names` has their names."""
        return self.sim.observer.compact(self.state, out)

    def planes(self, out: Tensor | None = None) -> Tensor:
        """Flags and integers in bits: int64 [B, P, H, ⌈W/64⌉].

        Bit x % 64 of word x // 64 is column x; bits beyond the width are zero. The planes are those of
        `Simulator.plane_names`. Fields of floats have none: `read` them.
        """
        return self.sim.observer.planes(self.state, out)


class Simulator(AnySimulator[World]):
    """Runs one ruleset on one backend and device. Made by `powderdsl.compile`."""

    world_type = World

    def __init__(self, ruleset: Ruleset, backend: str, device: str | torch.device, threads: int = 1):
        self.backend = backend
        self.device = find_device(device)
        super().__init__(ruleset, Tensors(self.device))
        self.observer = Observer(ruleset, self.device)
        self._program = make_program(ruleset, backend, self.device, threads)
        self._threads = threads

    def of(self, ruleset: Ruleset) -> Simulator:
        return Simulator(ruleset, self.backend, self.device, self._threads)

    @property
    def running(self) -> str:
        """The backend that the next step runs on: for ``auto`` on the CPU, ``wasm`` (or ``torch``) or ``native``."""
        at_once = starting_backend(self.device.type) if self.backend == "auto" else self.backend
        return str(getattr(self._program, "running", at_once))

    @property
    def notes(self) -> tuple[str, ...]:
        """For ``auto``: sentences about which backend ran, and why."""
        return tuple(getattr(self._program, "notes", ()))

    @property
    def plane_names(self) -> tuple[str, ...]:
        """What the planes are: a flag's name, or ``name:bit`` from bit 0; the last bit of a signed number is its sign."""
        return self.observer.plane_names

    def profile(self, world: World, steps: int = 1) -> dict[str, float]:
        """Seconds that each pass takes over some steps, in the order they run; empty if the backend cannot report them.

        Native code counts processor time on one thread.
        """
        params = self._params.defaults(len(world))
        job = Job(world.state, clock_of(world), whole_count(steps), params, {}, None)
        seconds = profile_of(self._program, job)
        return {name: seconds.get(name, 0.0) for name in self.passes} if seconds else {}


def compile(
    ruleset: Ruleset | str, backend: str = "auto", device: str = "cpu", threads: int = 1
) -> Simulator:
    """`simulation.compiling.compile`, on torch. Raises CompileError (PD701)."""
    model = checked_request(ruleset, backend)
    return Simulator(model, backend, device, threads)
