"""Provenance: which rule last wrote the element of each cell in a step, on any backend and device.

The rules get one more field, and every rule that writes an element sets the field to its number in that cell. Backends
need no support for it, and ordinary simulators do not change.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from powderdsl.diagnostics import Span
from powderdsl.model.text import place_of
from powderdsl.model.types import (
    Assign,
    Expr,
    Field,
    Move,
    Offset,
    Pass,
    Rule,
    Ruleset,
    Swap,
    Transform,
    integer,
)
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.targets.array_kind import Array

SLOT = "last writer"
"""The field of the numbers. Names in rule files have no blanks, so none is the same."""


@dataclass(frozen=True)
class NumberedRule:
    """A rule of the checked model. One line of a file makes several under loops and symmetries.

    `number` counts from 1 in the order in which they run; `moment` counts the pass's substeps from 0; `label` has the
    loop variables, such as ``side = left``.
    """

    number: int
    pack: str
    pass_name: str
    moment: int
    label: str
    rule: Rule

    @property
    def span(self) -> Span:
        return self.rule.span

    @property
    def place(self) -> str:
        """`file:line`."""
        return place_of(self.span)


def numbered_rules(ruleset: Ruleset) -> tuple[NumberedRule, ...]:
    """All rules in the order in which they run; rule number n is at index n − 1."""
    found: list[NumberedRule] = []
    for pass_ in ruleset.passes:
        for position, moment in enumerate(pass_.moments):
            for rule in moment.rules:
                found.append(
                    NumberedRule(len(found) + 1, pass_.pack, pass_.name, position, moment.label, rule)
                )
    return tuple(found)


@dataclass(frozen=True)
class Provenance:
    """Worlds after a step, and what wrote their elements in it.

    `numbers` is int16 [B, H, W] on the worlds' device: the number of the rule in `rules` that last wrote the element
    of a cell in the last step, 0 where none did. A rule that writes the element that was there counts too.
    """

    world: World
    numbers: Array
    rules: tuple[NumberedRule, ...]

    def rule_at(self, row: int, column: int, world: int = 0) -> NumberedRule | None:
        """The rule that last wrote a cell's element; None if there is none. Raises IndexError outside the grid."""
        number = int(self.numbers[world, row, column])
        return self.rules[number - 1] if number else None


class Recorder:
    """Steps worlds of a simulator and records which rules wrote their elements. Compiles the rules once more."""

    def __init__(self, sim: Simulator):
        self.sim = sim
        self.rules = numbered_rules(sim.ruleset)
        self._marked = sim.of(marked(sim.ruleset))

    def step(self, world: World, steps: int = 1, **options: Any) -> Provenance:
        """Like `Simulator.step`, which takes the same options, gives the same worlds and raises the same errors.

        After 0 steps no rule has written.
        """
        self.sim.check(world)
        xp = self.sim.kind.xp
        dtype = next(getattr(xp, slot.dtype) for slot in self._marked.slots if slot.name == SLOT)
        nothing = xp.asarray(xp.zeros_like(world.ids), dtype=dtype)
        start = replace(world, sim=self._marked, state={**world.state, SLOT: nothing})
        end = self._marked.step(start, steps, **options)
        state = dict(end.state)
        numbers = xp.asarray(state.pop(SLOT), dtype=xp.int16)
        return Provenance(replace(end, sim=self.sim, state=state), numbers, self.rules)


def marked(ruleset: Ruleset) -> Ruleset:
    """The same rules, with a field that holds the number of the rule that last wrote a cell's element in this step."""
    rules = numbered_rules(ruleset)
    numbers = iter(rules)
    passes = tuple(_marked_pass(pass_, numbers) for pass_ in ruleset.passes)
    kind = integer(0, max(1, len(rules)))
    slot = Field(SLOT, kind, 0, "place", True, None, ruleset.elements[0].pack, ruleset.elements[0].span)
    return replace(ruleset, fields=(*ruleset.fields, slot), passes=passes)


def _marked_pass(pass_: Pass, numbers: Iterator[NumberedRule]) -> Pass:
    moments = []
    for moment in pass_.moments:
        numbered = [(rule, next(numbers).number) for rule in moment.rules]
        if moment.policy in ("prove", "overwrite"):
            rules = (*moment.rules, *_marks_in_order(numbered))
        else:  # of the cells that rules claim each has one writer
            rules = tuple(_marked_rule(rule, number) for rule, number in numbered)
        moments.append(replace(moment, rules=rules))
    return replace(pass_, moments=tuple(moments))


def _marks_in_order(numbered: Sequence[tuple[Rule, int]]) -> Iterator[Assign]:
    """Assignments of the numbers of rules that all happen where their conditions hold, in the order of their writes.

    What becomes of cells, or is left behind, is written before anything arrives.
    """
    for rule, number in numbered:
        if isinstance(rule, (Transform, Move)):
            yield _mark(number, (0, 0), rule.mask, rule)
    for rule, number in numbered:
        if isinstance(rule, (Swap, Move)):
            yield _mark(number, rule.offset, rule.mask, rule)
        if isinstance(rule, Swap):
            yield _mark(number, (0, 0), rule.mask, rule)


def _mark(number: int, place: Offset, mask: Expr | None, rule: Rule) -> Assign:
    value = Expr("const", integer(number, number), value=number)
    return Assign(SLOT, place, ":=", value, mask, rule.span)


def _marked_rule(rule: Rule, number: int) -> Rule:
    """The rule with effects that leave its number in every cell whose element it writes."""
    if isinstance(rule, Assign):
        return rule  # assignments never write elements
    places = [(0, 0)] if not isinstance(rule, (Swap, Move)) else [rule.offset, (0, 0)]
    marks = tuple(_mark(number, place, None, rule) for place in places)
    return replace(rule, effects=(*rule.effects, *marks))
