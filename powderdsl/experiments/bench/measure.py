"""Measuring a plan: every cell made ready, then all of them in turn, round after round.

Rounds are interleaved, so that a machine that is slow for a while is slow for all cells alike.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from powderdsl.experiments.bench.machine import load_average, peak_growth, this_machine
from powderdsl.experiments.bench.plan import Cell, Plan, start_worlds
from powderdsl.experiments.bench.programs import Program, State
from powderdsl.experiments.bench.report import CellFigures, Report, make_report

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World

Clock = Callable[[], float]
"""Gives seconds."""


def measure(plan: Plan, on_progress: Callable[[str, Cell], None] | None = None) -> Report:
    """Measure a plan to its end; `on_progress` is called with what `measuring` yields.

    Raises:
        CompileError: PD701 for a backend or device that is not there.
    """
    machine = this_machine(plan.device)
    cells: list[CellFigures] = []
    for what, cell in measuring(plan, cells):
        if on_progress is not None:
            on_progress(what, cell)
    return make_report(plan, machine, cells, load_average())


def measuring(plan: Plan, cells: list[CellFigures]) -> Iterator[tuple[str, Cell]]:
    """Measure a plan part by part; yields the kind of part and its cell.

    Parts are ``compile`` and ``profile``, which begin now, and ``measure``, a sample that is done. Figures are added to `cells`, so whoever stops early has what came so far. Torch's number of threads is that of each
    cell while this runs.
    """
    import torch

    threads = torch.get_num_threads()
    try:
        simulators: dict[tuple[str, int], tuple[Simulator, float]] = {}
        runs: list[_Run | _ProgramRun] = []
        for cell in plan.cells:
            yield "compile", cell
            run, figures = _make_ready(plan, cell, simulators)
            runs.append(run)
            cells.append(figures)
        for _, index, seconds, busy in interleaved([run.sample for run in runs], plan.rounds):
            cells[index].seconds.append(seconds)
            cells[index].processor_seconds.append(busy)
            yield "measure", plan.cells[index]
        for figures, run in zip(cells, runs, strict=True) if plan.profile else ():
            yield "profile", figures.cell
            figures.passes = run.costs()
    finally:
        torch.set_num_threads(threads)


@dataclass
class Stopwatch:
    """Adds up the seconds, and the processor's, that are spent within `with` blocks of it."""

    clock: Clock = time.perf_counter
    processor: Clock = time.process_time
    seconds: float = 0.0
    processor_seconds: float = 0.0

    def __enter__(self) -> None:
        self.seconds -= self.clock()
        self.processor_seconds -= self.processor()

    def __exit__(self, *_: object) -> None:
        self.seconds += self.clock()
        self.processor_seconds += self.processor()


def interleaved(
    works: Sequence[Callable[[Stopwatch], None]],
    rounds: int,
    clock: Clock = time.perf_counter,
    processor: Clock = time.process_time,
) -> Iterator[tuple[int, int, float, float]]:
    """Do each work once, then each once more, and so on; yields (round, index of the work, seconds, processor seconds).

    A work gets a stopwatch for what is to be timed.
    """
    for number in range(rounds):
        for index, work in enumerate(works):
            watch = Stopwatch(clock, processor)
            work(watch)
            yield number, index, watch.seconds, watch.processor_seconds


@dataclass
class _Run:
    """A cell that is ready: `calls` calls of `steps` steps, each from the same worlds. `first`: seconds of the first step."""

    sim: Simulator
    world: World
    threads: int
    steps: int = 1
    calls: int = 1
    first: float = 0.0

    def begin(self, most_steps: int, budget: float) -> None:
        """Make the first step, and find out how many calls fit into `budget` seconds.

        Samples start from the worlds after that step: they are in the backend's own form by then.
        """
        self.world, self.first = self._timed(1)
        self.steps = max(1, min(most_steps, int(budget / self._timed(1)[1])))
        self.calls = max(1, int(budget / self._timed(self.steps)[1]))

    def _timed(self, steps: int) -> tuple[World, float]:
        began = time.perf_counter()
        after = self.sim.step(self.world, steps)
        synchronize(self.sim)
        return after, max(time.perf_counter() - began, 1e-9)

    def sample(self, watch: Stopwatch) -> None:
        import torch

        torch.set_num_threads(self.threads)
        with watch:
            for _ in range(self.calls):
                self.sim.step(self.world, self.steps)
            synchronize(self.sim)

    def costs(self) -> tuple[tuple[str, float], ...]:
        """Seconds a world and step of each pass; empty if the backend cannot say."""
        import torch

        torch.set_num_threads(self.threads)
        if not self.sim.profile(self.world, 1):  # what has to be compiled for it is compiled now
            return ()
        seconds = dict.fromkeys(self.sim.passes, 0.0)
        for _ in range(self.calls):
            for name, spent in self.sim.profile(self.world, self.steps).items():
                seconds[name] += spent
        if not any(seconds.values()):
            return ()
        world_steps = len(self.world) * self.steps * self.calls
        return tuple((name, spent / world_steps) for name, spent in seconds.items())


@dataclass
class _ProgramRun:
    """A cell of another program: `calls` times, its worlds are loaded, untimed, and make `steps` steps."""

    program: Program
    state: State
    threads: int
    steps: int = 1
    calls: int = 1
    first: float = 0.0

    def begin(self, most_steps: int, budget: float) -> None:
        """Make the first step, and find out how many calls fit into `budget` seconds, loading included."""
        self.first = self._timed(1)[1]
        self.steps = max(1, min(most_steps, int(budget / max(self._timed(1)[1], 1e-9))))
        self.calls = max(1, int(budget / max(self._timed(self.steps)[0], 1e-9)))

    def _timed(self, steps: int) -> tuple[float, float]:
        """Seconds of a call with and without loading."""
        began = time.perf_counter()
        run = self.program.load(self._copy())
        loaded = time.perf_counter()
        run(steps)
        return time.perf_counter() - began, time.perf_counter() - loaded

    def _copy(self) -> State:
        return {name: values.copy() for name, values in self.state.items()}

    def sample(self, watch: Stopwatch) -> None:
        import torch

        torch.set_num_threads(self.threads)
        for _ in range(self.calls):
            run = self.program.load(self._copy())
            with watch:
                run(self.steps)

    def costs(self) -> tuple[tuple[str, float], ...]:
        """Empty: the passes of another program are unknown."""
        return ()


def synchronize(sim: Simulator) -> None:
    """Wait for what a GPU still has to do."""
    import torch

    if sim.device.type == "cuda":
        torch.cuda.synchronize(sim.device)


def _make_ready(
    plan: Plan, cell: Cell, simulators: dict[tuple[str, int], tuple[Simulator, float]]
) -> tuple[_Run | _ProgramRun, CellFigures]:
    """Compile a cell's backend unless another cell has, and run the first calls."""
    import torch

    from powderdsl.simulation.simulator import compile

    torch.set_num_threads(cell.threads)
    program = plan.program(cell)
    if program is not None:
        return _program_ready(plan, cell, program)
    key = (cell.backend, cell.threads)
    if key not in simulators:
        began = time.perf_counter()
        sim = compile(plan.ruleset, cell.backend, plan.device, cell.threads)
        simulators[key] = (sim, time.perf_counter() - began)
    sim, compiling = simulators[key]
    start = start_worlds(sim, cell, plan.workload, plan.seed)
    state_bytes = sum(value.numel() * value.element_size() for value in start.state.values())
    synchronize(sim)
    run = _Run(sim, start, cell.threads)
    memory = peak_growth(lambda: run.begin(plan.steps, plan.seconds / plan.rounds), plan.device)
    return run, CellFigures(cell, compiling, run.first, memory, state_bytes, run.steps, run.calls)


def _program_ready(plan: Plan, cell: Cell, program: Program) -> tuple[_ProgramRun, CellFigures]:
    """Load the worlds that the backends start from into another program, and run the first calls."""
    from powderdsl.simulation.simulator import compile

    start = start_worlds(compile(plan.ruleset, "reference"), cell, plan.workload, plan.seed)
    state = {name: values.numpy() for name, values in start.state.items()}
    run = _ProgramRun(program, state, cell.threads)
    memory = peak_growth(lambda: run.begin(plan.steps, plan.seconds / plan.rounds), "cpu")
    state_bytes = sum(values.nbytes for values in state.values())
    return run, CellFigures(cell, 0.0, run.first, memory, state_bytes, run.steps, run.calls)
