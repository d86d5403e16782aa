"""Do two backends agree? Bit by bit; where they do not, the first cell, slot and step is named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.testing.generators.cases import Start, load_text
from tests.fuzz import STARTS_AT_ONCE

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator

BACKENDS = ("reference", *STARTS_AT_ONCE)
"""What random rulesets are compared on: native code and emulated kernels take seconds to compile."""


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


def assert_same(
    ruleset: Ruleset | str,
    start: Start,
    backends: Sequence[str] = BACKENDS,
    steps: int = 1,
    *,
    simulators: Sequence[Simulator] | None = None,
    random: Mapping[str, Any] | None = None,
) -> None:
    """Run the same worlds on several backends and compare every slot after every step.

    Args:
        ruleset: a checked model, or a pack's text.
        start: the worlds at the start.
        simulators: of this ruleset, if there are some already: one a backend.
        random: draws for all streams, as `Simulator.step` takes them.

    Raises:
        AssertionError: they differ. The message says where first, and has the text of the rules.
    """
    rules = load_text(ruleset) if isinstance(ruleset, str) else ruleset
    sims = list(simulators or (compile_ruleset(rules, backend=backend) for backend in backends))
    worlds = [start.world(sim) for sim in sims]
    options: dict[str, Any] = {"params": start.params or None, "random": random}
    for step in range(steps + 1):
        for world in worlds[1:]:
            difference = find_difference(worlds[0].state, world.state)
            if difference is not None:
                names = " and ".join(sim.backend for sim in sims)
                problem = f"{names} differ after step {step}: {difference}"
                raise AssertionError("\n".join([problem, str(start), source_text(rules)]))
        if step < steps:
            worlds = [sim.step(world, **options) for sim, world in zip(sims, worlds, strict=True)]


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
