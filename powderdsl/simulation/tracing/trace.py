"""The answer to "why does this cell hold what it holds?": its writes in a step, and the rules that nearly wrote it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from powderdsl.diagnostics import suggest
from powderdsl.model.state import Slot, slot_name
from powderdsl.model.types import Expr, Rule, Ruleset
from powderdsl.simulation.provenance import NumberedRule
from powderdsl.simulation.simulator import World
from powderdsl.simulation.tracing.parts import Part, answer, questions
from powderdsl.simulation.tracing.scenes import (
    Cell,
    RecordedStep,
    RecordedSubstep,
    pick,
    record_step,
    scratch_slot,
)
from powderdsl.simulation.tracing.writes import Write, anchors, writes_of


@dataclass(frozen=True)
class Cause:
    """A write, and the parts of the condition that let its rule happen; no parts for a write without a rule."""

    write: Write
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Miss:
    """A rule that would have written the cell, and did not. `cell` is where its condition was asked.

    `failed` are the parts that do not hold. If all hold, the rule gave way to another one under `conflicts:`.
    """

    rule: NumberedRule
    cell: Cell
    parts: tuple[Part, ...]
    policy: str

    @property
    def failed(self) -> tuple[Part, ...]:
        return tuple(part for part in self.parts if not part.holds)


@dataclass(frozen=True)
class Trace:
    """One cell in one step. `before` and `after` are NumPy values by slot, for the slots that were asked for."""

    ruleset: Ruleset
    world: int
    cell: Cell
    step: int
    slots: tuple[Slot, ...]
    before: dict[str, Any]
    after: dict[str, Any]
    causes: tuple[Cause, ...]
    misses: tuple[Miss, ...]

    def writer(self, slot: str = "element") -> NumberedRule | None:
        """The rule that last wrote a slot; None if no rule did."""
        rules = [one.write.rule for one in self.causes if one.write.slot.name == slot and one.write.rule]
        return rules[-1] if rules else None


def trace(
    world: World,
    row: int,
    column: int,
    step: int = 1,
    *,
    number: int = 0,
    of: Iterable[str] | None = None,
    every_rule: bool = False,
) -> Trace:
    """Why a cell holds what it holds after a step.

    Args:
        world: the worlds before the first step. All but the last step run on its simulator.
        row, column: the cell, from 0.
        step: which step, from 1: the world after it is what is explained.
        number: which world of the batch.
        of: names of slots: the element, fields, scratch fields such as ``pass.name``. All but scratch by default.
        every_rule: also the rules that missed by more than one part of their condition, or are about other elements.

    Raises:
        IndexError: a cell or world that is not there. ValueError: step 0. KeyError: an unknown name.
    """
    count, height, width = world.shape
    if not 0 <= number < count:
        raise IndexError(f"there is no world {number}: the batch has {count}, counted from 0")
    if not (0 <= row < height and 0 <= column < width):
        raise IndexError(f"there is no cell {row},{column}: the world has {height} rows and {width} columns, counted from 0")  # fmt: skip
    if step < 1:
        raise ValueError("the first step is step 1")
    wanted = _slots(world, of)
    alone = world.select([number])
    recorded = record_step(world.sim.step(alone, step - 1))
    cell = (row, column)
    names = {slot.name for slot in wanted}
    writes = [write for write in writes_of(recorded, cell) if write.slot.name in names]
    lines = {(write.rule.span, write.scene.pass_.name) for write in writes if write.rule and write.scene}
    misses = _misses(recorded, cell, sorted(names), every_rule)
    if not every_rule:
        misses = [one for one in misses if (one.rule.span, one.rule.pass_name) not in lines]
    return Trace(
        world.sim.ruleset,
        number,
        cell,
        int(alone.step[0]) + step,
        tuple(wanted),
        {name: pick(array, cell) for name, array in recorded.begin.items() if name in names},
        {name: pick(array, cell) for name, array in recorded.end.items() if name in names},
        tuple(Cause(write, _parts_of(write)) for write in writes),
        tuple(misses),
    )


def _slots(world: World, names: Iterable[str] | None) -> list[Slot]:
    known = {slot.name: slot for slot in world.sim.slots}
    if names is None:
        return list(known.values())
    for pass_ in world.sim.ruleset.passes:
        known.update((item.name, scratch_slot(item.name, pass_)) for item in pass_.scratch)
    found = []
    for name in dict.fromkeys(slot_name(world.sim.ruleset, name) for name in names):
        if name not in known:
            if world.sim.ruleset.property(name) is not None:
                raise KeyError(f"`{name}` follows from the element: ask for `element`")
            raise KeyError("; ".join([f"no field `{name}`", *suggest(name, known, "fields")]))
        found.append(known[name])
    return found


def _condition(rule: Rule, scene: RecordedSubstep, cell: Cell) -> tuple[Part, ...]:
    assert rule.mask is not None
    return tuple(answer(question, cell, scene) for question in questions(rule.mask, scene))


def _parts_of(write: Write) -> tuple[Part, ...]:
    if write.rule is None or write.scene is None or write.cell is None:
        return ()
    return _condition(write.rule.rule, write.scene, write.cell)


def _misses(step: RecordedStep, cell: Cell, slots: Sequence[str], every_rule: bool) -> list[Miss]:
    """Rules that did not happen where they would have written the cell; those of one line once a place, unless all are asked."""
    found: dict[Any, Miss] = {}
    for scene in step.scenes:
        for rule in scene.rules:
            places = dict.fromkeys(
                place
                for slot in slots
                if slot in scene.table
                for place in anchors(rule.rule, cell, scene, slot)
            )
            for place in places:
                if scene.happened(rule.rule, place) or not (every_rule or _nearly(rule.rule, scene, place)):
                    continue
                key = (rule.number if every_rule else (rule.span, rule.pass_name), place)
                if key not in found:
                    policy = scene.moment.policy
                    found[key] = Miss(rule, place, _condition(rule.rule, scene, place), policy)
    return list(found.values())


def _nearly(rule: Rule, scene: RecordedSubstep, cell: Cell) -> bool:
    """Whether all parts of a condition but one hold, and the one is not which element the cell is; or all of them."""
    mask: Expr | None = rule.mask
    assert mask is not None
    asked = list(questions(mask, scene))
    failed = list(_first_two(question for question in asked if not question.holds(cell)))
    if len(failed) == 1:
        return len(asked) > 1 and not failed[0].about_itself
    return not failed


def _first_two(items: Iterable[Any]) -> Iterator[Any]:
    for item, _ in zip(items, range(2), strict=False):
        yield item
