"""Do two backends agree? Bit by bit; where they do not, the first cell, slot, step, pass and moment is named."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from powderdsl.model.types import Moment, Ruleset
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.testing.generators.cases import Start, load_text
from tests.fuzz import STARTS_AT_ONCE
from tests.fuzz.cuda_emulation import EmulatedSimulator

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World

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
                raise AssertionError(_report(rules, start, sims, worlds, step, difference, options))
        if step < steps:
            previous = worlds
            worlds = [sim.step(world, **options) for sim, world in zip(sims, worlds, strict=True)]
            found = (find_difference(worlds[0].state, world.state) for world in worlds[1:])
            if difference := next((d for d in found if d is not None), None):
                raise AssertionError(_report(rules, start, sims, previous, step, difference, options))


def source_text(ruleset: Ruleset) -> str:
    """The text of the files that a ruleset was made from."""
    spans = [item.span for table in (ruleset.elements, ruleset.passes, ruleset.fields) for item in table]
    sources = dict.fromkeys(span.source for span in spans)
    return "\n".join(f"# {source.name}\n{source.text}" for source in sources)


def _report(
    rules: Ruleset,
    start: Start,
    sims: Sequence[Simulator],
    before: Sequence[World],
    step: int,
    difference: Difference,
    options: dict[str, Any],
) -> str:
    names = " and ".join(sim.backend for sim in sims)
    lines = [f"{names} differ in step {step + 1}: {difference}"]
    place = next(_places(rules, sims, before, options), None)
    if place is not None:
        lines += place
    return "\n".join([*lines, str(start), source_text(rules)])


def _places(
    rules: Ruleset, sims: Sequence[Simulator], before: Sequence[World], options: dict[str, Any]
) -> Iterator[list[str]]:
    """The first pass, and in it the first moment, after which the backends differ: each time the step up to there."""
    for i, pass_ in enumerate(rules.passes):
        if (difference := _run_until(rules, i, len(pass_.moments), sims, before, options)) is None:
            continue
        lines = [f"first in pass `{pass_.name}`: {difference}"]
        for count in range(1, len(pass_.moments) + 1):
            if (difference := _run_until(rules, i, count, sims, before, options)) is not None:
                moment = pass_.moments[count - 1]
                lines.append(f"first in its moment {count} of {len(pass_.moments)}: {difference}")
                yield lines + _tell(moment)
        yield lines


def _run_until(
    rules: Ruleset,
    last: int,
    moments: int,
    sims: Sequence[Simulator],
    before: Sequence[World],
    options: dict[str, Any],
) -> Difference | None:
    """What differs after some passes, of the last of which only some moments run."""
    passes = [*rules.passes[:last], replace(rules.passes[last], moments=rules.passes[last].moments[:moments])]
    cut = replace(rules, passes=tuple(passes))
    states = []
    for sim, world in zip(sims, before, strict=True):
        part = (
            sim.like(cut)
            if isinstance(sim, EmulatedSimulator)
            else compile_ruleset(cut, backend=sim.backend, device=str(sim.device))
        )
        states.append(part.step(replace(world, sim=part), **options).state)
    return next((d for state in states[1:] if (d := find_difference(states[0], state)) is not None), None)


def _tell(moment: Moment) -> list[str]:
    rules = dict.fromkeys(rule.span.text for rule in moment.rules)
    lets = [f"  let {let.name}: {let.span.text}" for let in moment.lets]
    label = f" ({moment.label})" if moment.label else ""
    return [f"conflicts: {moment.policy}{label}", *lets, *(f"  - {rule}" for rule in rules)]


def _array(value: Any) -> np.ndarray:
    return value.cpu().numpy() if hasattr(value, "cpu") else np.asarray(value)


def _bits(values: np.ndarray) -> np.ndarray:
    """Floats as the whole numbers of their bits, with one zero."""
    return (values + values.dtype.type(0)).view(f"i{values.itemsize}") if values.dtype.kind == "f" else values
