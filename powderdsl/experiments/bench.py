"""Benchmarks of rules: the plan of a measurement, its worlds, rounds of measuring, and reports as text and JSON.

Worlds are created only from a ruleset's tables, without naming elements. Rounds are interleaved, so that slowdowns of
the machine affect all combinations alike.
"""

from __future__ import annotations

import math
import os
import platform
import re
import runpy
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import product
from pathlib import Path
from random import Random
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

from powderdsl.analysis.changes import moved_ids
from powderdsl.arrays import NDArray, np
from powderdsl.compiler import BACKENDS
from powderdsl.diagnostics import with_suggestion
from powderdsl.model.state import check_sides
from powderdsl.model.types import Element, Field, Ruleset
from powderdsl.system.reports import table
from powderdsl.targets.job import now
from powderdsl.worlds.raster import Size, mask
from powderdsl.worlds.strewn import check_cells, random_shape

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World

WORKLOADS: dict[str, str] = {
    "gusts": "shapes, and rectangles of ±20 in every vector field that stays in its place: busy worlds",
    "shapes": "shapes of all elements at random places, everything else at rest",
    "noise": "every cell a random element, every field of floats random: more than worlds ever do",
    "few": "shapes of two elements: by default the first two that move",
}
"""Worlds to start from, for any ruleset."""

State = dict[str, NDArray[Any]]
"""The state of a batch: `element` as uint8 [N, H, W], fields as [N, H, W] or, vectors, [N, 2, H, W], by name."""
Run = Callable[[int], object]
"""Makes a number of steps; the next call continues from there."""


@dataclass(frozen=True)
class Program:
    """A program to measure along with the backends. `load` is not timed, but the function that it returns is."""

    name: str
    load: Callable[[State], Run]


class Cell(NamedTuple):
    """One combination of the cross product. `size` is (rows, columns) of a world.

    `backend` may be the name of a program.
    """

    backend: str
    size: Size
    threads: int
    batch: int

    def __str__(self) -> str:
        threads = f", {self.threads} threads" if self.threads > 1 else ""
        return f"{self.backend}, {self.batch} of {self.size[0]}×{self.size[1]}{threads}"


@dataclass(frozen=True)
class Plan:
    """The settings of a measurement: the cross product of backends and programs, sizes, threads and batches.

    A sample is as many calls of `Simulator.step` as fit into ``seconds / rounds``, each of up to `steps` steps
    from the same worlds. `workload` is one of `WORKLOADS`, `only` names the elements on the ground, `profile` times
    each pass too, and `check` compares each backend with another one on the CPU and counts its kernels.

    Raises:
        ValueError: an unknown element, a size that the rules do not allow, or the name of a program that is taken.
        CompileError: PD607 for worlds with too many cells.
    """

    ruleset: Ruleset
    backends: Sequence[str] = ("wasm",)
    sizes: Sequence[Size] = ((64, 64),)
    threads: Sequence[int] = (1,)
    batches: Sequence[int] = (1, 32)
    only: Sequence[str] = ()
    workload: str = "gusts"
    device: str = "cpu"
    seed: int = 0
    steps: int = 16
    seconds: float = 2.0
    rounds: int = 5
    profile: bool = False
    check: bool = False
    programs: Sequence[Program] = ()

    def __post_init__(self) -> None:
        names = [program.name for program in self.programs]
        for name in names:
            if name in BACKENDS or names.count(name) > 1:
                raise ValueError(f"programs: `{name}` is the name of another program or of a backend")
        for size in self.sizes:
            check_sides(self.ruleset, size)
            check_cells(max(self.batches), size)
        known = [element.name for element in self.ruleset.elements]
        for name in self.only:
            if self.ruleset.element(name) is None:
                raise ValueError(with_suggestion(f"no element `{name}`", name, known, "elements"))

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """The combinations to measure, each once."""
        names = [*self.backends, *(program.name for program in self.programs)]
        return tuple(dict.fromkeys(map(Cell._make, product(names, self.sizes, self.threads, self.batches))))

    @property
    def elements(self) -> list[Element]:
        """The elements that worlds have."""
        if self.only:
            return [element for element in map(self.ruleset.element, self.only) if element is not None]
        if self.workload == "few":
            moved = moved_ids(self.ruleset)
            return sorted(self.ruleset.elements[1:], key=lambda element: element.id not in moved)[:2]
        return list(self.ruleset.elements)


# Worlds

SHAPES, GUSTS = 26, 4
"""Numbers of shapes and gusts in 64×64 cells; larger worlds have proportionally more."""
PER_CELLS = 64 * 64
REACH = 7
"""Size of the shapes in cells. They cover about a quarter of the world."""
GUST_SIDE, GUST_SPEED = 10, 20.0
NOISE = 3.0
"""Standard deviation of noisy floats."""


def start_worlds(sim: Simulator, plan: Plan, cell: Cell) -> World:
    """The worlds of a cell. World i depends only on the plan, the size and i."""
    streams = [np.random.default_rng([plan.seed, index]) for index in range(cell.batch)]
    ids = np.stack([_ids(plan, cell, random) for random in streams])
    moving = {"noise": ("real", "vec2"), "gusts": ("vec2",)}.get(plan.workload, ())
    fields = {
        field.name: np.stack([_field(field, cell, plan.workload, random) for random in streams])
        for field in sim.ruleset.fields
        if field.kind.name in moving and not field.resets and field.of is None
        if plan.workload == "noise" or field.at == "place"
    }
    return sim.replace(sim.world(ids, seed=plan.seed), **fields)


def _ids(plan: Plan, cell: Cell, random: np.random.Generator) -> NDArray[np.uint8]:
    """One world: uint8 [H, W]."""
    ids = [element.id for element in plan.elements]
    if plan.workload == "noise":
        return random.choice(np.array(ids, dtype=np.uint8), cell.size)
    ground = plan.ruleset.elements[0].id
    world = np.full(cell.size, ground, dtype=np.uint8)
    others = [number for number in ids if number != ground]
    shapes = Random(int(random.integers(1 << 32)))
    for i in range(_scaled(SHAPES, cell) if others else 0):
        world[mask(random_shape(shapes, cell.size, REACH), cell.size)] = others[i % len(others)]
    return world


def _field(field: Field, cell: Cell, workload: str, random: np.random.Generator) -> NDArray[np.float32]:
    """A field of one world: float32 [H, W], or [2, H, W] of a vector."""
    shape = (2, *cell.size) if field.kind.name == "vec2" else cell.size
    if workload == "noise":
        values = NOISE * random.standard_normal(shape, dtype=np.float32)
    else:
        values = np.zeros(shape, dtype=np.float32)
        for _ in range(_scaled(GUSTS, cell)):
            top, left = (int(random.integers(max(side - GUST_SIDE, 1))) for side in cell.size)
            speed = GUST_SPEED * random.integers(-1, 2, 2)
            values[:, top : top + GUST_SIDE, left : left + GUST_SIDE] = speed[:, None, None]
    bounded = field.kind.hi > field.kind.lo
    return np.clip(values, field.kind.lo, field.kind.hi) if bounded else values


def _scaled(count: int, cell: Cell) -> int:
    """Scale a number per `PER_CELLS` cells to the worlds of a cell of the plan."""
    return max(1, round(count * math.prod(cell.size) / PER_CELLS))


# Programs


def read_program(path: Path) -> Program:
    """Run a Python file that defines `load(state)`, which returns `run(steps)`. Its name is the file's.

    The file is executed, so it must be trusted. Raises ValueError if that fails.
    """
    with _located(path):
        load = runpy.run_path(str(path), run_name=f"beside_{path.stem}").get("load")
    if not callable(load):
        raise ValueError(f"{path}: does not define `load(state)`, which returns `run(steps)`")

    def start(state: State) -> Run:
        with _located(path):
            run = load(state)
        if not callable(run):
            raise ValueError(f"{path}: `load(state)` does not return a function `run(steps)`")
        return _located(path)(run)

    return Program(path.stem, start)


@contextmanager
def _located(path: Path) -> Iterator[None]:
    """Report the line of a file that led to an exception; also a decorator."""
    try:
        yield
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if Path(frame.filename).resolve() == path.resolve()]
        place = f"{path}:{lines[-1]}" if lines else str(path)
        raise ValueError(f"{place}: {type(error).__name__}: {error}") from error


# Measuring

EQUAL = "equal"


def disagreement(world: World, other: World, most: int = 8) -> str:
    """The first difference of two simulators in calls of up to `most` steps; empty if they are equal."""
    ahead, wanted = world, other
    for steps in range(1, most + 1):
        ahead, wanted = (side.sim.step(side) for side in (ahead, wanted))
        for end, name in product((ahead, world.sim.step(world, steps)), wanted.state):
            values = [side.state[name].cpu().numpy() for side in (end, wanted)]
            for place in np.argwhere(values[0] != values[1])[:1]:
                index, *_, row, column = place.tolist()
                contents = " instead of ".join(str(array[tuple(place)]) for array in values)
                return f"{name} of world {index}, cell ({row}, {column}), step {steps}: {contents}"
    return ""


@dataclass
class CellFigures:
    """The measurements of a cell. `round_seconds` and `round_processor_seconds` get one value a round.

    `compile_seconds` are its backend's, shared by all cells that have it. `passes` has the microseconds a world and step
    of each pass, in the order they run; it is empty if passes were not profiled. Processor times count all threads
    together; other processes hardly affect them. `check` is ``equal``, the first difference, or the error that ended the
    measurement, without rounds; it is empty if nothing was compared. `kernels_per_step` are events of torch's profiler.
    """

    cell: Cell
    compile_seconds: float = 0.0
    first_step_seconds: float = 0.0
    steps_per_call: int = 1
    calls_per_round: int = 1
    round_seconds: list[float] = field(default_factory=list)
    round_processor_seconds: list[float] = field(default_factory=list)
    passes: dict[str, float] = field(default_factory=dict)
    check: str = ""
    kernels_per_step: float | None = None

    @property
    def world_steps(self) -> int:
        """Steps of single worlds in a round."""
        return self.cell.batch * self.steps_per_call * self.calls_per_round

    @property
    def rates(self) -> list[float]:
        """World-steps per second of each round, the slowest first."""
        return sorted(self.world_steps / seconds for seconds in self.round_seconds)

    @property
    def world_step_microseconds(self) -> float:
        return 1e6 * median(self.round_seconds) / self.world_steps

    @property
    def processor_microseconds(self) -> float:
        """Processor time per world and step."""
        return 1e6 * median(self.round_processor_seconds) / self.world_steps


@dataclass(frozen=True)
class Report:
    """A plan and the results of its cells."""

    plan: Plan
    machine: Mapping[str, Any]
    cells: tuple[CellFigures, ...]

    def ratio(self, figures: CellFigures, program: str) -> float | None:
        """The processor time of a cell divided by that of a program for the same worlds; None if unknown."""
        same = figures.cell._replace(backend=program)
        times = [other.processor_microseconds for other in self.cells if other.cell == same]
        return figures.processor_microseconds / times[0] if figures.rates and times and times[0] else None


def measuring(plan: Plan, cells: list[CellFigures]) -> Iterator[tuple[str, Cell]]:
    """Measure a plan part by part; yields the kind of part and its cell.

    Parts are ``compile``, which includes checks, and ``profile``, which begin now, and ``measure``, a sample that is done.
    Figures of each cell are added to `cells`. Torch's number of threads is that of each cell while this runs. Raises
    CompileError (PD701) for a backend or device that is not available; with `check`, figures have the errors instead.
    """
    import torch

    from powderdsl.simulation.programs import starting_backend
    from powderdsl.simulation.simulator import compile

    @cache
    def compiled(backend: str, device: str, threads: int) -> tuple[Simulator, float]:
        began = time.perf_counter()
        return compile(plan.ruleset, backend, device, threads), time.perf_counter() - began

    @contextmanager
    def running(figures: CellFigures) -> Iterator[None]:
        """Use the threads of a cell. If backends are checked, an error of one is recorded, and the others still run."""
        torch.set_num_threads(figures.cell.threads)
        try:
            yield
        except Exception as error:
            if not plan.check or figures.cell.backend in programs:
                raise
            errors = getattr(error, "diagnostics", ())
            lines = [line for problem in errors for line in (problem.message, *problem.notes)]
            figures.check = ": ".join(filter(None, lines)) or f"{type(error).__name__}: {error}"

    threads, programs = torch.get_num_threads(), {program.name: program for program in plan.programs}
    subjects: list[_Subject] = []
    try:
        for cell in plan.cells:
            yield "compile", cell
            program, figures = programs.get(cell.backend), CellFigures(cell)
            cells.append(figures)
            with running(figures):
                if program is None:
                    sim, figures.compile_seconds = compiled(cell.backend, plan.device, cell.threads)
                else:
                    sim = compiled("reference", "cpu", 1)[0]
                subject = _Subject(sim, start_worlds(sim, plan, cell), program, figures)
                subject.begin(plan)
                subjects.append(subject)
                if plan.check and program is None:
                    plain = cell.backend != "wasm" and starting_backend("cpu") == "wasm"
                    other = compile(plan.ruleset, "wasm" if plain else "torch-cells")
                    worlds = start_worlds(sim, plan, cell), start_worlds(other, plan, cell)
                    figures.check = disagreement(*worlds) or EQUAL
                    if sim.backend in ("torch", "torch-cells", "torch-fused", "cuda"):
                        figures.kernels_per_step = subject.kernels(figures.steps_per_call)
        for _ in range(plan.rounds):
            for subject in subjects:
                figures = subject.figures
                with running(figures):
                    spent = subject.timed(figures.steps_per_call, figures.calls_per_round)
                    figures.round_seconds.append(spent[0])
                    figures.round_processor_seconds.append(spent[1])
                yield "measure", figures.cell
        for subject in subjects if plan.profile else ():
            yield "profile", subject.figures.cell
            with running(subject.figures):
                subject.profile()
    finally:
        torch.set_num_threads(threads)


@dataclass
class _Subject:
    """The subject of a measurement: a simulator, or a program that loads the simulator's worlds.

    A round makes several calls of several steps, each from the same worlds.
    """

    sim: Simulator
    world: World
    program: Program | None
    figures: CellFigures

    def begin(self, plan: Plan) -> None:
        """Make the first step, and determine the number of calls per round, loading included."""
        figures, budget = self.figures, plan.seconds / plan.rounds
        figures.first_step_seconds = self.timed(1, 1)[0]
        if self.program is None:
            self.world = self.sim.step(self.world)  # from now on in the backend's own form
        figures.steps_per_call = max(1, min(plan.steps, int(budget / max(self.timed(1, 1)[0], 1e-9))))
        began = time.perf_counter()
        self.timed(figures.steps_per_call, 1)
        figures.calls_per_round = max(1, int(budget / max(time.perf_counter() - began, 1e-9)))

    def timed(self, steps: int, calls: int) -> tuple[float, float]:
        """Seconds, and processor seconds, of some calls. A program loads its worlds, untimed, before each call."""
        loads = 1 if self.program is None else calls
        seconds = processor_seconds = 0.0
        for _ in range(loads):
            run = self._load()
            began, busy = now(self.sim.device), time.process_time()
            for _ in range(calls // loads):
                run(steps)
            seconds += now(self.sim.device) - began
            processor_seconds += time.process_time() - busy
        return seconds, processor_seconds

    def _load(self) -> Run:
        if self.program is None:
            return lambda steps: self.sim.step(self.world, steps)
        return self.program.load({name: values.numpy().copy() for name, values in self.world.state.items()})

    def kernels(self, steps: int) -> float | None:
        """A step as torch's profiler sees it: a GPU's kernels and copies, or operators that call no others on the CPU."""
        os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # otherwise it writes on stderr
        from torch.profiler import ProfilerActivity, profile

        kinds = {"cpu": ProfilerActivity.CPU, "cuda": ProfilerActivity.CUDA, "xpu": ProfilerActivity.XPU}
        if (kind := kinds.get(self.sim.device.type)) is None:
            return None
        with profile(activities=[kind]) as trace:
            self.sim.step(self.world, steps)
            now(self.sim.device)
        on_cpu = kind == ProfilerActivity.CPU
        events = [event for event in trace.events() if (event.device_type.name == "CPU") == on_cpu]
        return sum(not (event.cpu_children or event.is_user_annotation) for event in events) / steps

    def profile(self) -> None:
        """Measure the microseconds per world and step of each pass, if the backend can report them."""
        figures = self.figures
        if self.program is not None or not self.sim.profile(self.world, 1):
            return
        steps, calls = figures.steps_per_call, figures.calls_per_round
        samples = [self.sim.profile(self.world, steps) for _ in range(calls)]
        totals = {name: sum(sample.get(name, 0.0) for sample in samples) for name in self.sim.passes}
        if any(totals.values()):
            figures.passes = {name: 1e6 * spent / figures.world_steps for name, spent in totals.items()}


# The machine


def this_machine(device: str) -> dict[str, Any]:
    """This machine and its software versions. Raises CompileError (PD701) without such a torch device."""
    import torch

    from powderdsl.simulation.programs import find_device
    from powderdsl.targets.cpp.build import NoCompiler, find_compiler

    kind, compiler = find_device(device), "none"
    with suppress(NoCompiler):
        compiler = find_compiler().version
    processor = platform.processor() or platform.machine()
    with suppress(OSError):
        if model := re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            processor = model[1]
    return {
        "processor": processor,
        "cpus": os.cpu_count(),
        "device": torch.cuda.get_device_name(kind) if kind.type == "cuda" else device,
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "compiler": compiler,
        "powderdsl": sys.modules["powderdsl"].__version__,
    }


# Reports


def report_data(report: Report) -> dict[str, Any]:
    """A report for JSON: every figure, and the seconds of every round."""
    plan = report.plan
    cells = []
    for figures in report.cells:
        values = figures.cell._asdict() | vars(figures)
        del values["cell"]
        values["world_steps_per_second"] = median(figures.rates) if figures.rates else None
        values["beside"] = {program.name: report.ratio(figures, program.name) for program in plan.programs}
        cells.append(values)
    return {
        "machine": report.machine,
        "rules": plan.ruleset.name,
        "elements": [element.name for element in plan.elements],
        **{name: getattr(plan, name) for name in ("workload", "device", "seed", "rounds")},
        "cells": cells,
    }


def report_text(report: Report) -> str:
    """The whole report, without a final newline."""
    plan, machine = report.plan, report.machine
    header = [
        f"{plan.ruleset.name}, worlds of {plan.workload}: {WORKLOADS[plan.workload]}",
        "powderdsl {powderdsl}, torch {torch}, Python {python}, C++: {compiler}".format_map(machine),
        "{processor}, {cpus} CPUs, device {device}".format_map(machine),
    ]
    parts = ["\n".join(header)]
    steps = sorted({figures.steps_per_call for figures in report.cells if figures.rates}) or [1]
    shown = str(steps[0]) if len(steps) == 1 else f"{steps[0]} to {steps[-1]}"
    notes = [
        f"medians of {plan.rounds} interleaved rounds; a call makes {shown} steps, always from the same worlds",
        "CPUs: processor time by time; less than the threads if other processes were running",
        "to first step: compiling, which all lines of a backend share, and the first step",
    ]
    if plan.check:
        notes.append("kernels/step: with copies, on a GPU; on the CPU, operators that call no others")
    if plan.programs:
        notes.append("÷: processor time divided by that of another program on the same worlds")
    parts += [_cell_table(report), "\n".join(notes)]
    if profiled := [figures for figures in report.cells if figures.passes]:
        parts.append(_pass_table(profiled))
    return "\n\n".join(parts)


def _cell_table(report: Report) -> str:
    """One line per cell, and a column for each program."""
    titles = ["backend", "batch", "size", "threads", "world-steps/s", "slowest..fastest", "µs/world-step"]
    programs = [program.name for program in report.plan.programs]
    checks = ["kernels/step", "check"] if report.plan.check else []
    rows = [[*titles, "CPUs", "to first step", *(f"÷ {name}" for name in programs), *checks]]
    for figures in report.cells:
        cell, rates = figures.cell, figures.rates
        row = [cell.backend, f"{cell.batch:,}", f"{cell.size[0]}×{cell.size[1]}", str(cell.threads)]
        if rates:
            spent = figures.world_step_microseconds
            row += [number(median(rates)), f"{number(rates[0])}..{number(rates[-1])}", number(spent)]
            row.append(f"{figures.processor_microseconds / spent:.2f}")
            row.append(f"{figures.compile_seconds + figures.first_step_seconds:.2f} s")
        row += ["–"] * (len(titles) + 2 - len(row))
        ratios = [report.ratio(figures, name) for name in programs]
        row += ["?" if ratio is None else number(ratio) for ratio in ratios]
        kernels = "" if figures.kernels_per_step is None else number(figures.kernels_per_step)
        rows.append([*row, kernels, " ".join(figures.check.split())[:200]][: len(rows[0])])
    return "\n".join(table(rows, indent=""))


def _pass_table(profiled: Sequence[CellFigures]) -> str:
    """µs per world and step of each pass, and its share, for each profiled cell."""
    totals = [sum(figures.passes.values()) for figures in profiled]
    rows = [["µs/world-step", *(str(figures.cell) for figures in profiled)]]
    for name in profiled[0].passes:
        shares = zip((figures.passes[name] for figures in profiled), totals, strict=True)
        rows.append([name, *(f"{number(part)} {part / total:4.0%}" for part, total in shares)])
    wholes = {
        "all passes": totals,
        "whole step": [figures.world_step_microseconds for figures in profiled],
        "of that, processor time": [figures.processor_microseconds for figures in profiled],
    }
    rows += [[name, *(f"{number(value)}     " for value in values)] for name, values in wholes.items()]
    return "\n".join(table(rows, indent=""))


def number(value: float) -> str:
    """Three significant digits: 0.0123, 1.23, 12.3, 1,234, 12.3 million as 12.3M."""
    if value >= 1e6:
        return f"{value / 1e6:.3g}M"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
