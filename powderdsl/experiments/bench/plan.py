"""What is measured: the cells of a cross product, the worlds that they start from, and programs of the user.

Worlds are made from a ruleset's tables alone: no element has a name here.
"""

from __future__ import annotations

import runpy
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from powderdsl.analysis.changes import moved_ids
from powderdsl.compiler import BACKENDS
from powderdsl.diagnostics import suggest
from powderdsl.model.state import check_sides
from powderdsl.model.types import Element, Field, Ruleset
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
"""Makes so many steps; the next call continues from there."""


@dataclass(frozen=True)
class Program:
    """A program that is measured beside the backends. `load` is not timed; what it returns is."""

    name: str
    load: Callable[[State], Run]


class Cell(NamedTuple):
    """One combination of the cross product. `size` is (rows, columns) of a world.

    `backend` may be the name of a program that is measured beside the backends.
    """

    backend: str
    size: Size
    threads: int
    batch: int

    @property
    def world_cells(self) -> int:
        """Cells of one world."""
        return self.size[0] * self.size[1]

    def __str__(self) -> str:
        threads = f", {self.threads} threads" if self.threads > 1 else ""
        return f"{self.backend}, {self.batch} of {self.size[0]}×{self.size[1]}{threads}"


@dataclass(frozen=True)
class Plan:
    """All that a measurement depends on: the cross product of backends and programs, sizes, threads and batches.

    A sample is as many calls of `Simulator.step` as fit into ``seconds / rounds``, each of up to `steps` steps
    from the same worlds. `workload` is one of `WORKLOADS`, `only` names the elements on the ground, and `profile`
    times each pass too.

    Raises:
        ValueError: an unknown element, a size that the rules do not take, or a program's name that is taken.
        CompileError: PD607 for worlds of more cells than fit.
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
                raise ValueError("; ".join([f"no element `{name}`", *suggest(name, known, "elements")]))

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """Each combination once."""
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

    def program(self, cell: Cell) -> Program | None:
        """The program that a cell measures; None for a backend."""
        return next((program for program in self.programs if program.name == cell.backend), None)


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
    """The worlds of a cell: world i depends on the plan, its size and i alone."""
    streams = [np.random.default_rng([plan.seed, index]) for index in range(cell.batch)]
    ids = np.stack([_ids(plan, cell, random) for random in streams])
    fields = {
        field.name: np.stack([_field(field, cell, plan.workload, random) for random in streams])
        for field in sim.ruleset.fields
        if _starts_moving(field, plan.workload)
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


def _starts_moving(field: Field, workload: str) -> bool:
    """The field does not start at its default."""
    if field.resets or field.of is not None:
        return False
    if workload == "noise":
        return field.kind.name in ("real", "vec2")
    return workload == "gusts" and field.kind.name == "vec2" and field.at == "place"


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
    """A number for `PER_CELLS` cells, for the worlds of a cell of the plan."""
    return max(1, round(count * cell.world_cells / PER_CELLS))


# Programs


def read_program(path: Path) -> Program:
    """Run a Python file that defines `load(state)`, which returns `run(steps)`. Its name is the file's.

    The file is run as `python` would run it, so it has to be trusted.

    Raises:
        ValueError: the file cannot be run, or does not define `load`.
    """
    load = _located(path, runpy.run_path)(str(path), run_name=f"beside_{path.stem}").get("load")
    if not callable(load):
        raise ValueError(f"{path}: does not define `load(state)`, which returns `run(steps)`")

    def start(state: State) -> Run:
        run = _located(path, load)(state)
        if not callable(run):
            raise ValueError(f"{path}: `load(state)` does not return a function `run(steps)`")
        return _located(path, run)

    return Program(path.stem, start)


def _located(path: Path, function: Callable[..., Any]) -> Callable[..., Any]:
    """A function whose exceptions name the line of the file that led to them."""

    def call(*values: Any, **named: Any) -> Any:
        try:
            return function(*values, **named)
        except Exception as error:
            frames = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(error.__traceback__)]
            words = str(error)
            if isinstance(error, SyntaxError):
                frames, words = (
                    [(error.filename or "", error.lineno)],
                    error.msg,
                )  # str() repeats file and line
            lines = [line for file, line in frames if Path(file).resolve() == path.resolve()]
            place = f"{path}:{lines[-1]}" if lines else str(path)
            raise ValueError(f"{place}: {type(error).__name__}: {words}") from error

    return call
