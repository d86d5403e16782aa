"""Measuring a plan: every cell made ready, then all of them in turn, round after round.

Rounds are interleaved, so that a machine that is slow for a while is slow for all cells alike.
"""

from __future__ import annotations

import ctypes
import gc
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from powderdsl.experiments.bench.plan import Cell, Plan, Program, Run, start_worlds
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
                sim, seconds = compiled(cell.backend, plan.device, cell.threads)
            else:
                sim, seconds = compiled("reference", "cpu", 1)[0], 0.0
            subject = _Subject(sim, start_worlds(sim, plan, cell), program, CellFigures(cell, seconds))
            subject.figures.peak_memory_bytes = peak_growth(partial(subject.begin, plan), sim.device.type)
            subjects.append(subject)
            cells.append(subject.figures)
        for _ in range(plan.rounds):
            for subject in subjects:
                subject.measure()
                yield "measure", subject.figures.cell
        for subject in subjects if plan.profile else ():
            yield "profile", subject.figures.cell
            subject.profile()
    finally:
        torch.set_num_threads(threads)


@dataclass
class _Subject:
    """What a cell measures: a simulator, or a program that loads the simulator's worlds.

    A round makes some calls of some steps, each from the same worlds.
    """

    sim: Simulator
    world: World
    program: Program | None
    figures: CellFigures

    def begin(self, plan: Plan) -> None:
        """Make the first step, and find out how many calls fit into a round, loading included."""
        figures, budget = self.figures, plan.seconds / plan.rounds
        figures.first_step_seconds = self.timed(1, 1)[0]
        if self.program is None:
            self.world = self.sim.step(self.world)  # from now on in the backend's own form
        figures.steps_per_call = max(1, min(plan.steps, int(budget / max(self.timed(1, 1)[0], 1e-9))))
        began = time.perf_counter()
        self.timed(figures.steps_per_call, 1)
        figures.calls_per_round = max(1, int(budget / max(time.perf_counter() - began, 1e-9)))

    def measure(self) -> None:
        """Measure a round."""
        import torch

        torch.set_num_threads(self.figures.cell.threads)
        seconds, processor_seconds = self.timed(self.figures.steps_per_call, self.figures.calls_per_round)
        self.figures.round_seconds.append(seconds)
        self.figures.round_processor_seconds.append(processor_seconds)

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

    def profile(self) -> None:
        """Measure the microseconds a world and step of each pass, if the backend can report them."""
        import torch

        figures = self.figures
        torch.set_num_threads(figures.cell.threads)
        if self.program is not None or not self.sim.profile(self.world, 1):  # compiles what profiling needs
            return
        samples = [
            self.sim.profile(self.world, figures.steps_per_call) for _ in range(figures.calls_per_round)
        ]
        totals = {name: sum(sample.get(name, 0.0) for sample in samples) for name in self.sim.passes}
        if any(totals.values()):
            figures.passes = {name: 1e6 * spent / figures.world_steps for name, spent in totals.items()}


# The machine


def this_machine(device: str) -> dict[str, Any]:
    """This machine, the name of a torch device, and the versions of what runs on it: what results depend on.

    Raises CompileError (PD701) without such a device.
    """
    import torch

    from powderdsl.simulation.programs import find_device
    from powderdsl.targets.cpp.compilers import NoCompiler, find_compiler

    kind = find_device(device)
    try:
        compiler = find_compiler().version
    except NoCompiler:
        compiler = "none"
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cpus": os.cpu_count(),
        "device": torch.cuda.get_device_name(kind) if kind.type == "cuda" else device,
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "compiler": compiler,
        "powderdsl": sys.modules["powderdsl"].__version__,
    }


def _processor() -> str:
    with suppress(OSError):
        name = re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        if name:
            return name[1]
    return platform.processor() or platform.machine()


def peak_growth(work: Callable[[], None], device: str) -> int | None:
    """Do some work; returns by how many bytes the peak of memory exceeded the memory in use before.

    None where the system does not report it. On Linux the process' own peak is reset first. What freed memory still
    belongs to the process is handed back before, so that the work cannot hide in it.
    """
    import torch

    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        work()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before
    gc.collect()
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)  # glibc only
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the peak
    except OSError:
        work()
        return None
    resident = _status("VmRSS")
    work()
    return max(0, _status("VmHWM") - resident)


def _status(name: str) -> int:
    """A line of /proc/self/status in bytes."""
    line = re.search(rf"^{name}:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(line[1]) * 1024 if line else 0
