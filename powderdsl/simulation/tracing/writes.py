"""Every write to one cell in a step, in the order of the reference: what it was, what it became, where it came from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from powderdsl.model.state import Slot
from powderdsl.model.types import Assign, Move, Offset, Rule, Swap, Transform
from powderdsl.simulation.provenance import NumberedRule
from powderdsl.simulation.tracing.scenes import Cell, RecordedStep, RecordedSubstep, pick, value_at

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
class Write:
    """One write to one slot of the cell. Values are NumPy numbers, or two of a vector.

    `cell` is where the rule's condition held; `source` is where content came from that moved here. `scene` is the
    substep; None before the first one.
    """

    slot: Slot
    before: Any
    after: Any
    how: str
    scene: RecordedSubstep | None
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
    scene: RecordedSubstep | None = None
    for scene_now in step.scenes:
        first_of_pass = scene is None or scene.pass_ is not scene_now.pass_
        if first_of_pass:
            how = "reset" if scene is None else "settle"
            found += _differences(scene, scene_now.table, held, scene_now.at.state, cell, how)
            held = {name: pick(array, cell) for name, array in scene_now.at.state.items()}
        scene = scene_now
        found += _moment(scene, cell, held)
    if scene is not None:
        found += _differences(scene, scene.table, held, step.end, cell, "settle")
    return found


def _differences(
    scene: RecordedSubstep | None,
    table: dict[str, Slot],
    held: dict[str, Any],
    now: Any,
    cell: Cell,
    how: str,
) -> Iterator[Write]:
    """What changed without a rule between two substeps."""
    for name, array in now.items():
        if name in held and not np.array_equal(held[name], pick(array, cell)):
            yield Write(table[name], held[name], pick(array, cell), how, scene)


def _moment(scene: RecordedSubstep, cell: Cell, held: dict[str, Any]) -> Iterator[Write]:
    """The writes of a substep; `held` becomes what it leaves. The order is that of `model.reference.run_moment`."""
    claims = [rule for rule in scene.rules if not isinstance(rule.rule, Assign)]

    def put(name: str, value: Any, how: str, rule: NumberedRule | None, *places: Cell | None) -> Write:
        write = Write(scene.table[name], held[name], value, how, scene, rule, *places)
        held[name] = value
        return write

    for rule in scene.rules:
        if isinstance(rule.rule, Assign):
            yield from _assigned(scene, rule, rule.rule, rule.rule, cell, held, put)
    for rule in claims:
        model = rule.rule
        if isinstance(model, (Transform, Move)) and scene.happened(model, cell):
            target = model.target if isinstance(model, Transform) else model.leaving
            identity = int(value_at(target, scene.at, cell))
            for name in _travelling(scene):
                how = "become" if isinstance(model, Transform) else "leave"
                yield put(name, _fresh(scene, scene.table[name], identity), how, rule, cell)
    for rule in claims:
        for anchor, source in _arrivals(scene, rule.rule, cell):
            content = _after_assignments(scene, source)
            for name in _travelling(scene):
                yield put(name, content[name], "arrive", rule, anchor, source)
    for rule in claims:
        assert not isinstance(rule.rule, Assign)
        for effect in rule.rule.effects:
            yield from _assigned(scene, rule, rule.rule, effect, cell, held, put)
    for name, slot in scene.table.items():
        if slot.of is not None and int(held["element"]) not in slot.of:
            default = np.asarray(slot.default, np.asarray(held[name]).dtype)
            if not np.array_equal(held[name], default):
                yield put(name, default, "limit", None)


def _travelling(scene: RecordedSubstep) -> list[str]:
    return [name for name, slot in scene.table.items() if slot.travels]


def anchors(rule: Rule, cell: Cell, scene: RecordedSubstep, slot: str) -> tuple[Cell, ...]:
    """Where the rule's condition would have to hold for it to write a slot of the cell."""
    found: list[Offset] = []
    if isinstance(rule, Assign):
        found += [rule.offset] if rule.field == slot else []
    else:
        if scene.table[slot].travels:
            found += [(0, 0)] + ([rule.offset] if isinstance(rule, (Swap, Move)) else [])
        found += [effect.offset for effect in rule.effects if effect.field == slot]
    return tuple(dict.fromkeys(scene.near(cell, (-dy, -dx)) for dy, dx in found))


def _arrivals(scene: RecordedSubstep, rule: Rule, cell: Cell) -> Iterator[tuple[Cell, Cell]]:
    """Where a rule's condition held that moves something here, and where that stood."""
    if not isinstance(rule, (Swap, Move)):
        return
    behind = scene.near(cell, (-rule.offset[0], -rule.offset[1]))
    if scene.happened(rule, behind):
        yield behind, behind
    if isinstance(rule, Swap) and scene.happened(rule, cell):
        yield cell, scene.near(cell, rule.offset)


def _assigned(
    scene: RecordedSubstep,
    rule: NumberedRule,
    where: Rule,
    write: Assign,
    cell: Cell,
    held: dict[str, Any],
    put: Any,
) -> Iterator[Write]:
    anchor = scene.near(cell, (-write.offset[0], -write.offset[1]))
    if scene.happened(where, anchor):
        value = _assigned_value(scene, write, anchor, held[write.field])
        yield put(write.field, value, "assign" if where is write else "effect", rule, anchor)


def _assigned_value(scene: RecordedSubstep, write: Assign, anchor: Cell, old: Any) -> Any:
    value = value_at(write.value, scene.at, anchor)
    with np.errstate(all="ignore"):
        new = old + value if write.op == "+=" else old - value if write.op == "-=" else value
    kind = scene.table[write.field].kind
    return np.clip(new, int(kind.lo), int(kind.hi)) if kind.name == "int" else new


def _after_assignments(scene: RecordedSubstep, cell: Cell) -> dict[str, Any]:
    """What a cell holds once the substep's assignments are done: that is what moves."""
    held = {name: pick(array, cell) for name, array in scene.at.state.items()}
    for rule in scene.moment.rules:
        if isinstance(rule, Assign):
            anchor = scene.near(cell, (-rule.offset[0], -rule.offset[1]))
            if scene.happened(rule, anchor):
                held[rule.field] = _assigned_value(scene, rule, anchor, held[rule.field])
    return held


def _fresh(scene: RecordedSubstep, slot: Slot, identity: int) -> Any:
    """What a new cell of an element holds in a slot."""
    dtype = scene.at.state[slot.name].dtype
    if slot.name == "element":
        return np.asarray(identity, dtype)[()]
    prop = scene.ruleset.property(slot.name)
    if prop is None:
        return np.asarray(slot.fresh(identity), dtype)[()]
    value = prop.values[identity]
    return np.asarray(scene.at.params[value][0] if isinstance(value, str) else value, dtype)[()]
