"""One step of one world on the reference interpreter, substep by substep, with everything a substep read and left."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from powderdsl.model import reference
from powderdsl.model.state import Slot, slots
from powderdsl.model.types import Expr, Let, Moment, Offset, Pass, Rule, Ruleset
from powderdsl.simulation.provenance import NumberedRule, numbered_rules
from powderdsl.simulation.simulator import World

Array = np.ndarray[Any, Any]
Cell = tuple[int, int]
"""(row, column)."""

_WIDE = {"flag": np.bool_, "real": np.float32, "vec2": np.float32}
_PARAMS = {"int": np.int64, "flag": np.bool_, "real": np.float32, "chance": np.float64}


@dataclass(frozen=True)
class RecordedSubstep:
    """A substep of the step: what it found and left, and its rules. Arrays have a batch of one."""

    ruleset: Ruleset
    pass_: Pass
    moment: Moment
    rules: tuple[NumberedRule, ...]
    at: reference.Context
    after: reference.State
    table: dict[str, Slot]
    """Slots of the state, and scratch fields of the pass."""
    lets: dict[str, tuple[Let, reference.Context]]
    """Where each value of the pass was fixed so far, and what was read there."""
    masks: dict[int, Array]
    """Where each rule happened, by `id` of the rule."""

    @property
    def shape(self) -> Cell:
        return self.at.shape[1:]

    def near(self, cell: Cell, offset: Offset) -> Cell:
        """The neighbor of a cell; the grid wraps around."""
        height, width = self.shape
        return (cell[0] + offset[0]) % height, (cell[1] + offset[1]) % width

    def happened(self, rule: Rule, cell: Cell) -> bool:
        return bool(self.masks[id(rule)][(0, *cell)])


@dataclass
class RecordedStep:
    """The substeps of a step in order, the state that it began with, and the one that it left.

    States are the reference's: integers int64, floats float32, [1, H, W] or [1, 2, H, W].
    """

    ruleset: Ruleset
    begin: reference.State
    end: reference.State = field(default_factory=dict)
    scenes: list[RecordedSubstep] = field(default_factory=list)


def record_step(world: World, number: int = 0) -> RecordedStep:
    """The next step of one world of a batch, with default parameters, watched."""
    one = world.select([number])
    ruleset = world.sim.ruleset
    table = {slot.name: slot for slot in slots(ruleset)}
    state = {name: value.cpu().numpy() for name, value in one.state.items()}
    clock = reference.Clock(*(part.cpu().numpy() for part in (one.seed, one.index, one.step)))
    params: dict[str, Array] = {
        p.name: np.full(1, float(p.default), _PARAMS[p.kind.name]) for p in ruleset.params
    }
    step = RecordedStep(ruleset, _widened(state, table))
    rules = _rules_by_moment(ruleset)
    lets: dict[str, tuple[Let, reference.Context]] = {}

    def seen(pass_: Pass, moment: Moment, at: reference.Context, after: reference.State) -> None:
        found = replace(at, lets=dict(at.lets))
        own = next(rules)
        if moment is pass_.moments[0]:
            lets.clear()
        lets.update((let.name, (let, found)) for let in moment.lets)
        scratch = {f.name: scratch_slot(f.name, pass_) for f in pass_.scratch}
        masks = reference.masks_of(moment, found)
        step.scenes.append(
            RecordedSubstep(
                ruleset, pass_, moment, own, found, after, {**table, **scratch}, dict(lets), masks
            )
        )

    step.end = _widened(reference.step(ruleset, state, clock, params, seen=seen), table)
    return step


def scratch_slot(name: str, pass_: Pass) -> Slot:
    """A scratch field of a pass as a slot."""
    item = next(f for f in pass_.scratch if f.name == name)
    return Slot(name, item.kind, item.default, False, True, None, "", 2 if item.kind.name == "vec2" else 1)


def value_at(expr: Expr, at: reference.Context, cell: Cell) -> Any:
    """The value of an expression in one cell: a NumPy number, or two of a vector."""
    return pick(reference.evaluate(expr, at), cell)


def pick(array: Array, cell: Cell) -> Any:
    """One cell's value of a reference array."""
    return array[0, ..., cell[0], cell[1]]


def _widened(state: reference.State, table: dict[str, Slot]) -> reference.State:
    """In the reference's working dtypes."""
    return {name: value.astype(_WIDE.get(table[name].kind.name, np.int64)) for name, value in state.items()}


def _rules_by_moment(ruleset: Ruleset) -> Iterator[tuple[NumberedRule, ...]]:
    """The numbered rules of each substep, in the order in which substeps run."""
    rules = iter(numbered_rules(ruleset))
    for pass_ in ruleset.passes:
        for moment in pass_.moments:
            yield tuple(next(rules) for _ in moment.rules)
