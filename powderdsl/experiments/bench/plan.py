"""What is measured: the cells of a cross product, as values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from powderdsl.analysis.reactions import moved_ids
from powderdsl.compiler import BACKENDS, current_backend
from powderdsl.diagnostics import suggest
from powderdsl.model.types import Ruleset
from powderdsl.model.world_sides import check_sides
from powderdsl.worlds.raster import Size
from powderdsl.worlds.strewn import check_cells

WORKLOADS: dict[str, str] = {
    "gusts": "shapes, and rectangles of ±20 in every vector field that stays in its place: busy worlds",
    "shapes": "shapes of all elements at random places, everything else at rest",
    "noise": "every cell a random element, every field of floats random: more than worlds ever do",
    "few": "shapes of two elements: by default the first two that move",
}
"""Worlds to start from, for any ruleset."""

MAX_SECONDS = 3600.0


@dataclass(frozen=True)
class Cell:
    """One combination of the cross product. `size` is (rows, columns) of a world, `elements` are in the worlds."""

    backend: str
    batch: int
    size: Size
    elements: tuple[str, ...]
    threads: int

    @property
    def world_cells(self) -> int:
        """Cells of one world."""
        return self.size[0] * self.size[1]

    @property
    def cells(self) -> int:
        """Cells of all worlds of the batch."""
        return self.batch * self.world_cells


@dataclass(frozen=True)
class Plan:
    """All that a measurement depends on.

    A sample is as many calls of `Simulator.step` as fit into ``seconds / rounds``, each of up to `steps` steps
    from the same worlds.
    """

    ruleset: Ruleset
    cells: tuple[Cell, ...]
    workload: str
    device: str
    seed: int
    steps: int
    seconds: float
    rounds: int
    profile: bool


def make_plan(
    ruleset: Ruleset,
    *,
    backends: Sequence[str] = ("arrays",),
    batches: Sequence[int] = (1, 32),
    sizes: Sequence[Size] = ((64, 64),),
    elements: Sequence[int] = (),
    only: Sequence[str] = (),
    threads: Sequence[int] = (1,),
    workload: str = "gusts",
    device: str = "cpu",
    seed: int = 0,
    steps: int = 16,
    seconds: float = 2.0,
    rounds: int = 5,
    profile: bool = False,
) -> Plan:
    """The plan of a cross product of backends, batches, sizes (rows, columns), elements and threads.

    Args:
        elements: the worlds have the first so many elements of the ruleset, the ground among them.
        only: the worlds have these elements on the ground, by plain or qualified name.
        workload: one of `WORKLOADS`.
        steps: of a call, at most.
        seconds: measured time of each cell, all rounds together.
        profile: time each pass too.

    Raises:
        KeyError: an unknown backend, workload or element. ValueError: numbers out of range.
        CompileError: PD607 for worlds of more cells than fit.
    """
    if workload not in WORKLOADS:
        raise KeyError(f"no workload `{workload}`; {'; '.join(suggest(workload, WORKLOADS, 'workloads'))}")
    backends = [current_backend(backend) for backend in backends]
    for backend in backends:
        if backend not in BACKENDS:
            raise KeyError(f"no backend `{backend}`; {'; '.join(suggest(backend, BACKENDS, 'backends'))}")
    counts = {"batches": batches, "threads": threads, "steps": (steps,), "rounds": (rounds,)}
    for name, numbers in {**counts, "sizes": [side for size in sizes for side in size]}.items():
        if not numbers or min(numbers) < 1:
            raise ValueError(f"{name}: integers of 1 or more are needed")
    if not 0 < seconds <= MAX_SECONDS:  # false for NaN
        raise ValueError(f"seconds: a number above 0, up to {MAX_SECONDS:g}, is needed")
    for size in sizes:
        check_sides(ruleset, size)
    for batch, size in product(batches, sizes):
        check_cells(batch, size)
    chosen = _elements(ruleset, workload, elements, only)
    points = product(
        dict.fromkeys(backends),
        dict.fromkeys(sizes),
        dict.fromkeys(chosen),
        dict.fromkeys(threads),
        dict.fromkeys(batches),
    )
    cells = tuple(Cell(backend, batch, size, names, count) for backend, size, names, count, batch in points)
    return Plan(ruleset, cells, workload, device, seed, steps, seconds, rounds, profile)


def _elements(
    ruleset: Ruleset, workload: str, counts: Sequence[int], only: Sequence[str]
) -> list[tuple[str, ...]]:
    """The names of the elements that worlds have, one tuple for each point of the axis."""
    known = ruleset.elements
    if counts and only:
        raise ValueError("elements are chosen by number or by name, not by both")
    if only:
        for name in only:
            if ruleset.element(name) is None:
                names = [element.name for element in known]
                raise KeyError(f"no element `{name}`; {'; '.join(suggest(name, names, 'elements'))}")
        return [tuple(dict.fromkeys(only))]
    if counts:
        if not 1 <= min(counts) <= max(counts) <= len(known):
            raise ValueError(f"elements: {ruleset.name} has 1 to {len(known)} of them")
        return [tuple(element.name for element in known[:count]) for count in counts]
    if workload == "few":
        moved = moved_ids(ruleset)
        ground, *others = known
        movers_first = sorted(others, key=lambda element: (element.id not in moved, element.id))
        return [tuple(element.name for element in movers_first[:2]) or (ground.name,)]
    return [tuple(element.name for element in known)]
