"""Do two backends agree? Bit by bit; where they do not, the first cell, slot and step is named."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from powderdsl.model.types import Ruleset
from powderdsl.testing.generators.cases import Choices, Start, random_start

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator


@dataclass(frozen=True)
class Difference:
    """The first cell in which two states differ."""

    slot: str
    cell: tuple[int, ...]
    """(world, row, column), or (world, component, row, column) of a vector."""
    values: tuple[Any, ...]
    count: int
    """How many values of the slot differ."""

    def __str__(self) -> str:
        values = " and ".join(repr(value) for value in self.values)
        return f"`{self.slot}` at {self.cell}: {values} ({self.count} differ)"


def find_difference(first: Mapping[str, Any], second: Mapping[str, Any]) -> Difference | None:
    """The first difference of two states (tensors or arrays by slot). Floats differ if their bits do; -0.0 is 0.0."""
    if first.keys() != second.keys():
        return Difference(", ".join(sorted(first.keys() ^ second.keys())), (), ("has", "has not"), 1)
    for slot in first:
        a, b = (_bits(_array(state[slot])) for state in (first, second))
        if a.dtype != b.dtype or a.shape != b.shape:
            return Difference(
                slot, (), ((a.dtype.name, a.shape), (b.dtype.name, b.shape)), max(a.size, b.size)
            )
        unequal = np.argwhere(a != b)
        if len(unequal):
            cell = tuple(int(i) for i in unequal[0])
            return Difference(
                slot, cell, tuple(_array(state[slot])[cell].item() for state in (first, second)), len(unequal)
            )
    return None


def assert_same_worlds(
    simulators: Sequence[Simulator], shapes: Iterable[tuple[int, int, int]], steps: int
) -> None:
    """Compare the simulators of a ruleset on random worlds of some shapes, as `assert_same` does."""
    for seed, shape in enumerate(shapes):
        assert_same(random_start(simulators[0].ruleset, Choices.seeded(seed), shape), simulators, steps)


def assert_same(
    start: Start, simulators: Sequence[Simulator], steps: int = 1, random: Mapping[str, Any] | None = None
) -> None:
    """Run the same worlds on the simulators of a ruleset and compare every slot after every step.

    Args:
        start: the worlds at the start.
        random: draws for all streams, as `Simulator.step` takes them.

    Raises:
        AssertionError: they differ. The message says where first, and has the text of the rules.
    """
    worlds = [start.world(sim) for sim in simulators]
    options: dict[str, Any] = {"params": start.params or None, "random": random}
    for step in range(steps + 1):
        for world in worlds[1:]:
            difference = find_difference(worlds[0].state, world.state)
            if difference is not None:
                names = " and ".join(sim.backend for sim in simulators)
                problem = f"{names} differ after step {step}: {difference}"
                raise AssertionError("\n".join([problem, text_of(start), source_text(simulators[0].ruleset)]))
        if step < steps:
            worlds = [sim.step(world, **options) for sim, world in zip(simulators, worlds, strict=True)]


def text_of(start: Start) -> str:
    parts = {"ids": start.ids, **start.fields, "seed": start.seed, "index": start.index, "step": start.step}
    shown = (
        f"{name} {values.tolist() if values.size <= 160 else '…'}"
        for name, values in {**parts, **start.params}.items()
    )
    return "\n".join([f"worlds {'×'.join(map(str, start.ids.shape))}", *shown])


def source_text(ruleset: Ruleset) -> str:
    """The text of the files that a ruleset was made from."""
    spans = [item.span for table in (ruleset.elements, ruleset.passes, ruleset.fields) for item in table]
    sources = dict.fromkeys(span.source for span in spans)
    return "\n".join(f"# {source.name}\n{source.text}" for source in sources)


def _array(value: Any) -> np.ndarray:
    return value.cpu().numpy() if hasattr(value, "cpu") else np.asarray(value)


def _bits(values: np.ndarray) -> np.ndarray:
    """Floats as the whole numbers of their bits, with one zero."""
    return (values + values.dtype.type(0)).view(f"i{values.itemsize}") if values.dtype.kind == "f" else values
