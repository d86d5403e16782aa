"""One step of one world on the reference interpreter, substep by substep, and every write to one of its cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

from powderdsl.arrays import np
from powderdsl.model import reference
from powderdsl.model.reference import Array
from powderdsl.model.state import Slot, scratch_slots, slots
from powderdsl.model.types import (
    Assign,
    Expr,
    Let,
    Moment,
    Move,
    Offset,
    Pass,
    Rule,
    Ruleset,
    Swap,
    Transform,
)
from powderdsl.simulation.any_arrays import AnyWorld
from powderdsl.simulation.provenance import NumberedRule, numbered_rules

Cell = tuple[int, int]
"""(row, column)."""

HOW = {
    "assign": "a field was assigned",
    "effect": "a field was assigned by `then`",
    "become": "the cell became another element",
    "leave": "the element moved away; this is what it left",
    "arrive": "what stood in another cell came here",
    "limit": "no rule: cells of this element keep the field's default",
    "settle": "no rule: at the end of a pass floats are cut off at their bounds, and tiny ones are zero",
    "reset": "no rule: the field starts each step at its default",
}
"""The kinds of writes. The last three have no rule."""


@dataclass(frozen=True)
class RecordedSubstep:
    """A substep of the step: what it found, and its rules. Arrays have a batch of one."""

    ruleset: Ruleset
    pass_: Pass
    moment: Moment
    rules: tuple[NumberedRule, ...]
    at: reference.Context
    table: dict[str, Slot]
    """Slots of the state, and scratch fields of the pass."""
    lets: dict[str, tuple[Let, reference.Context]]
    """For each `let` of the pass so far, its expression and what that read."""
    masks: dict[int, Array]
    """Where each rule happened, by `id` of the rule."""

    def near(self, cell: Cell, offset: Offset) -> Cell:
        """The neighbor of a cell; the grid wraps around."""
        _, height, width = self.at.shape
        return (cell[0] + offset[0]) % height, (cell[1] + offset[1]) % width

    def behind(self, cell: Cell, offset: Offset) -> Cell:
        """The cell whose neighbor this one is."""
        return self.near(cell, (-offset[0], -offset[1]))

    def happened(self, rule: Rule, cell: Cell) -> bool:
        return bool(self.masks[id(rule)][(0, *cell)])


@dataclass
class RecordedStep:
    """The substeps of a step in order, and the states before and after it.

    States are the reference's: integers int64, floats float32, [1, H, W] or [1, 2, H, W].
    """

    begin: reference.State
    end: reference.State = field(default_factory=dict)
    substeps: list[RecordedSubstep] = field(default_factory=list)


def record_step(world: AnyWorld, number: int = 0) -> RecordedStep:
    """The next step of one world of a batch, with default parameters, recorded."""
    one = world.select([number])
    ruleset = world.sim.ruleset
    table = {slot.name: slot for slot in slots(ruleset)}
    to_numpy = world.sim.kind.to_numpy
    state = {name: to_numpy(value) for name, value in one.state.items()}
    clock = reference.Clock(*(to_numpy(part) for part in (one.seed, one.index, one.step)))
    step = RecordedStep(reference.widened(ruleset, state))
    rules = iter(numbered_rules(ruleset))
    lets: dict[str, tuple[Let, reference.Context]] = {}

    def seen(pass_: Pass, moment: Moment, at: reference.Context, after: reference.State) -> None:
        found = replace(at, lets=dict(at.lets))
        own = tuple(islice(rules, len(moment.rules)))
        if moment is pass_.moments[0]:
            lets.clear()
        lets.update((let.name, (let, found)) for let in moment.lets)
        everything = {**table, **scratch_slots(pass_)}
        masks = reference.masks_of(moment, found)
        step.substeps.append(
            RecordedSubstep(ruleset, pass_, moment, own, found, everything, dict(lets), masks)
        )

    params = reference.parameters(ruleset, 1, {})
    step.end = reference.widened(ruleset, reference.step(ruleset, state, clock, params, seen=seen))
    return step


def value_at(expr: Expr, at: reference.Context, cell: Cell) -> Any:
    """The value of an expression in one cell: a NumPy number, or two of a vector."""
    return pick(reference.evaluate(expr, at), cell)


def pick(array: Array, cell: Cell) -> Any:
    """One cell's value of a reference array."""
    return array[0, ..., cell[0], cell[1]]


# Writes


@dataclass(frozen=True)
class Write:
    """One write to one slot of the cell. Values are NumPy numbers, or two of a vector.

    `cell` is where the rule's condition held; `source` is where content came from that moved here. `substep` is None
    before the first one.
    """

    slot: Slot
    before: Any
    after: Any
    how: str
    substep: RecordedSubstep | None
    rule: NumberedRule | None = None
    cell: Cell | None = None
    source: Cell | None = None

    @property
    def changed(self) -> bool:
        return not np.array_equal(self.before, self.after)


def writes_of(step: RecordedStep, cell: Cell) -> list[Write]:
    """All writes to all slots of a cell in a step, scratch fields among them, in order.

    Each write finds what the one before it left; what the last one leaves is what the step leaves.
    """
    found: list[Write] = []
    held = {name: pick(array, cell) for name, array in step.begin.items()}
    before: RecordedSubstep | None = None
    for substep in step.substeps:
        if before is None or before.pass_ is not substep.pass_:
            how = "reset" if before is None else "settle"
            found += _differences(before, substep.table, held, substep.at.state, cell, how)
            held = {name: pick(array, cell) for name, array in substep.at.state.items()}
        found += _Replay(substep, cell, held).writes()
        before = substep
    if before is not None:
        found += _differences(before, before.table, held, step.end, cell, "settle")
    return found


def _differences(
    substep: RecordedSubstep | None,
    table: dict[str, Slot],
    held: dict[str, Any],
    now: reference.State,
    cell: Cell,
    how: str,
) -> Iterator[Write]:
    """The changes between two substeps that no rule made."""
    for name, array in now.items():
        if name in held and not np.array_equal(held[name], pick(array, cell)):
            yield Write(table[name], held[name], pick(array, cell), how, substep)


class _Replay:
    """The writes of a substep to one cell, in the order of `model.reference.run_moment`.

    `held` is what the cell holds in each slot, and becomes what the substep leaves.
    """

    def __init__(self, substep: RecordedSubstep, cell: Cell, held: dict[str, Any]):
        self.substep, self.cell, self.held = substep, cell, held
        self.travelling = [name for name, slot in substep.table.items() if slot.travels]

    def writes(self) -> Iterator[Write]:
        substep, cell = self.substep, self.cell
        claims = [(rule, rule.rule) for rule in substep.rules if not isinstance(rule.rule, Assign)]
        for rule in substep.rules:
            if isinstance(rule.rule, Assign):
                yield from self.assigned(rule, rule.rule, "assign")
        for rule, model in claims:
            if isinstance(model, (Transform, Move)) and substep.happened(model, cell):
                how, target = (
                    ("become", model.target) if isinstance(model, Transform) else ("leave", model.leaving)
                )
                if target is None and isinstance(model, Move):
                    source = substep.near(cell, model.offset)
                    content = _after_assignments(substep, source)
                    for name in self.travelling:
                        yield self.put(name, content[name], "arrive", rule, cell, source)
                    continue
                assert target is not None
                identity = int(value_at(target, substep.at, cell))
                for name in self.travelling:
                    yield self.put(name, _fresh(substep, name, identity), how, rule, cell)
        for rule, model in claims:
            for anchor, source in _arrivals(substep, model, cell):
                content = _after_assignments(substep, source)
                for name in self.travelling:
                    yield self.put(name, content[name], "arrive", rule, anchor, source)
        for rule, model in claims:
            for effect in model.effects:
                yield from self.assigned(rule, effect, "effect")
        for name, slot in substep.table.items():
            if slot.of is not None and int(self.held["element"]) not in slot.of:
                default = np.asarray(slot.default, np.asarray(self.held[name]).dtype)
                if not np.array_equal(self.held[name], default):
                    yield self.put(name, default, "limit", None)

    def put(self, name: str, value: Any, how: str, rule: NumberedRule | None, *places: Cell) -> Write:
        write = Write(self.substep.table[name], self.held[name], value, how, self.substep, rule, *places)
        self.held[name] = value
        return write

    def assigned(self, rule: NumberedRule, write: Assign, how: str) -> Iterator[Write]:
        anchor = self.substep.behind(self.cell, write.offset)
        if self.substep.happened(rule.rule, anchor):
            value = _assigned_value(self.substep, write, anchor, self.held[write.field])
            yield self.put(write.field, value, how, rule, anchor)


def anchors(rule: Rule, cell: Cell, substep: RecordedSubstep, slot: str) -> tuple[Cell, ...]:
    """The cells in which a rule's condition must hold for it to write a slot of this cell."""
    found: list[Offset] = []
    if isinstance(rule, Assign):
        found += [rule.offset] if rule.field == slot else []
    else:
        if substep.table[slot].travels:
            found += [(0, 0)] + ([rule.offset] if isinstance(rule, (Swap, Move)) else [])
        found += [effect.offset for effect in rule.effects if effect.field == slot]
    return tuple(dict.fromkeys(substep.behind(cell, offset) for offset in found))


def _arrivals(substep: RecordedSubstep, rule: Rule, cell: Cell) -> Iterator[tuple[Cell, Cell]]:
    """If a rule moved something here: where its condition held, and where the content came from."""
    if not isinstance(rule, (Swap, Move)):
        return
    behind = substep.behind(cell, rule.offset)
    if substep.happened(rule, behind):
        yield behind, behind
    if isinstance(rule, Swap) and substep.happened(rule, cell):
        yield cell, substep.near(cell, rule.offset)


def _assigned_value(substep: RecordedSubstep, write: Assign, anchor: Cell, old: Any) -> Any:
    value = value_at(write.value, substep.at, anchor)
    with np.errstate(all="ignore"):
        new = old + value if write.op == "+=" else old - value if write.op == "-=" else value
    kind = substep.table[write.field].kind
    return np.clip(new, int(kind.lo), int(kind.hi)) if kind.name == "int" else new


def _after_assignments(substep: RecordedSubstep, cell: Cell) -> dict[str, Any]:
    """The values of a cell after the substep's assignments, which are the values that move."""
    held = {name: pick(array, cell) for name, array in substep.at.state.items()}
    for rule in substep.moment.rules:
        if isinstance(rule, Assign):
            anchor = substep.behind(cell, rule.offset)
            if substep.happened(rule, anchor):
                held[rule.field] = _assigned_value(substep, rule, anchor, held[rule.field])
    return held


def _fresh(substep: RecordedSubstep, name: str, identity: int) -> Any:
    """The value of a slot in a new cell of an element."""
    prop = substep.ruleset.property(name)
    if name == "element":
        value: Any = identity
    elif prop is None:
        value = substep.table[name].fresh(identity)
    else:
        value = prop.values[identity]
        value = substep.at.params[value][0] if isinstance(value, str) else value
    return np.asarray(value, substep.at.state[name].dtype)[()]
