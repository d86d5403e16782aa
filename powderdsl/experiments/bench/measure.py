"""Measuring a plan: every cell made ready, then all of them in turn, round after round.

Rounds are interleaved, so that a machine that is slow for a while is slow for all cells alike.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING

from powderdsl.experiments.bench.machine import peak_growth
from powderdsl.experiments.bench.plan import Cell, Plan, start_worlds
from powderdsl.experiments.bench.programs import Program, Run
from powderdsl.experiments.bench.report import CellFigures

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World


def measuring(plan: Plan, cells: list[CellFigures]) -> Iterator[tuple[str, Cell]]:
    """Measure a plan part by part; yields the kind of part and its cell.

    Parts are ``compile`` and ``profile``, which begin now, and ``measure``, a sample that is done. Figures of each
    cell are added to `cells`, so a caller who stops early has what was measured so far. Torch's number of threads is that of
    each cell while this runs.

    Raises:
        CompileError: PD701 for a backend or device that is not available.
    """
    import torch

    from powderdsl.simulation.simulator import compile

    @cache
    def compiled(backend: str, device: str, threads: int) -> tuple[Simulator, float]:
        began = time.perf_counter()
        return compile(plan.ruleset, backend, device, threads), time.perf_counter() - began

    threads = torch.get_num_threads()
    subjects: list[_Subject] = []
    try:
        for cell in plan.cells:
            yield "compile", cell
            torch.set_num_threads(cell.threads)
            program = plan.program(cell)
            if program is None:
                sim, compiling = compiled(cell.backend, plan.device, cell.threads)
            else:
                sim, compiling = compiled("reference", "cpu", 1)[0], 0.0
            world = start_worlds(sim, plan, cell)
            subject = _Subject(sim, world, program)
            memory = peak_growth(partial(subject.begin, plan), sim.device.type)
            subjects.append(subject)
            first, steps, calls = subject.first, subject.steps, subject.calls
            cells.append(CellFigures(cell, compiling, first, memory, steps, calls))
        for _ in range(plan.rounds):
            for subject, figures in zip(subjects, cells, strict=True):
                torch.set_num_threads(figures.cell.threads)
                seconds, processor_seconds = subject.timed(subject.steps, subject.calls)
                figures.round_seconds.append(seconds)
                figures.round_processor_seconds.append(processor_seconds)
                yield "measure", figures.cell
        for subject, figures in zip(subjects, cells, strict=True) if plan.profile else ():
            yield "profile", figures.cell
            torch.set_num_threads(figures.cell.threads)
            figures.passes.update(subject.pass_times())
    finally:
        torch.set_num_threads(threads)


@dataclass
class _Subject:
    """What a cell measures: a simulator, or a program that loads the simulator's worlds.

    A round makes `calls` calls of `steps` steps, each from the same worlds. `first` is the time of the first step.
    """

    sim: Simulator
    world: World
    program: Program | None
    steps: int = 1
    calls: int = 1
    first: float = 0.0

    def begin(self, plan: Plan) -> None:
        """Make the first step, and find out how many calls fit into a round, loading included."""
        budget = plan.seconds / plan.rounds
        self.first = self.timed(1, 1)[0]
        if self.program is None:
            self.world = self.sim.step(self.world)  # from now on in the backend's own form
        self.steps = max(1, min(plan.steps, int(budget / max(self.timed(1, 1)[0], 1e-9))))
        began = time.perf_counter()
        self.timed(self.steps, 1)
        self.calls = max(1, int(budget / max(time.perf_counter() - began, 1e-9)))

    def timed(self, steps: int, calls: int) -> tuple[float, float]:
        """Seconds, and processor seconds, of some calls. A program loads its worlds before each call, untimed."""
        loads = 1 if self.program is None else calls
        seconds = processor_seconds = 0.0
        for _ in range(loads):
            run = self._load()
            began, busy = time.perf_counter(), time.process_time()
            for _ in range(calls // loads):
                run(steps)
            self._wait()
            seconds += time.perf_counter() - began
            processor_seconds += time.process_time() - busy
        return seconds, processor_seconds

    def _load(self) -> Run:
        self._wait()
        if self.program is None:
            return lambda steps: self.sim.step(self.world, steps)
        return self.program.load({name: values.numpy().copy() for name, values in self.world.state.items()})

    def _wait(self) -> None:
        """Wait for what a GPU still has to do."""
        if self.sim.device.type == "cuda":
            import torch

            torch.cuda.synchronize(self.sim.device)

    def pass_times(self) -> dict[str, float]:
        """Microseconds a world and step of each pass; empty if the backend cannot report them."""
        if self.program is not None or not self.sim.profile(self.world, 1):  # compiles what profiling needs
            return {}
        seconds = dict.fromkeys(self.sim.passes, 0.0)
        for _ in range(self.calls):
            for name, spent in self.sim.profile(self.world, self.steps).items():
                seconds[name] += spent
        world_steps = len(self.world) * self.steps * self.calls
        return (
            {name: 1e6 * spent / world_steps for name, spent in seconds.items()}
            if any(seconds.values())
            else {}
        )
