"""Why cells hold what they hold.

`trace` explains one cell in one step: its writes on the reference interpreter, and the rules that nearly wrote it.

`Recorder` names the rule that last wrote the element of each cell of a batch, on any backend and device. The rules get one
more field, and every rule that writes an element sets the field to its number in that cell. Backends need no support for
it, and ordinary simulators do not change.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count, groupby, islice
from math import isfinite
from typing import Any

from powderdsl.arrays import np
from powderdsl.diagnostics import Label, Span, suggest
from powderdsl.diagnostics.printable import printable
from powderdsl.diagnostics.render import source_lines
from powderdsl.model import reference
from powderdsl.model.expressions.operators import TRUE, look
from powderdsl.model.state import Slot, scratch_slots, slot_name
from powderdsl.model.text import element_name, one_line, place_of, show_expr, show_offset, show_value
from powderdsl.model.types import (
    ELEMENT,
    FLAG,
    Assign,
    Expr,
    Field,
    Kind,
    Let,
    Moment,
    Move,
    Offset,
    Rule,
    Ruleset,
    Swap,
    Transform,
    integer,
)
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.targets.array_kind import Array

Cell = tuple[int, int]
"""(row, column)."""

HERE: Offset = (0, 0)
_LEAVES = ("element", "property", "field", "let", "draw", "coordinate", "param", "inside", "count", "sum")

_WITHOUT_RULE = {
    "limit": "no rule: cells of this element keep the field's default",
    "settle": "no rule: at the end of a pass floats are cut off at their bounds, and tiny ones are zero",
    "reset": "no rule: the field starts each step at its default",
}
"""The kinds of writes that have no rule. The others are ``assign``, ``effect``, ``become``, ``leave``, ``arrive``."""


@dataclass(frozen=True)
class NumberedRule:
    """A rule of the checked model. One line of a file makes several under loops and symmetries.

    `number` counts from 1 in the order in which they run; `moment` counts the pass's substeps from 1; `label` has the
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
    numbers = count(1)
    return tuple(
        NumberedRule(next(numbers), pass_.pack, pass_.name, position, moment.label, rule)
        for pass_ in ruleset.passes
        for position, moment in enumerate(pass_.moments, 1)
        for rule in moment.rules
    )


# What happens in a step


@dataclass(frozen=True)
class Substep:
    """A substep as it happened: what it found, and its rules. Arrays have a batch of one.

    `lets` has the expression of each `let` so far and what that read, `masks` where each rule happened, by `id`.
    """

    policy: str
    rules: tuple[NumberedRule, ...]
    at: reference.Context
    lets: Mapping[str, tuple[Let, reference.Context]]
    masks: Mapping[int, Array]

    def near(self, cell: Cell, offset: Offset, way: int = 1) -> Cell:
        """The neighbor of a cell, or, with -1, the cell whose neighbor it is; the grid wraps around."""
        _, height, width = self.at.shape
        return (cell[0] + way * offset[0]) % height, (cell[1] + way * offset[1]) % width

    def happened(self, rule: Rule, cell: Cell) -> bool:
        return bool(self.masks[id(rule)][(0, *cell)])

    def parts(self, rule: Rule, cell: Cell) -> tuple[Part, ...]:
        """A rule's condition in one cell, split at its `and`s. Flags fixed by `let` are split too, as they were fixed."""
        return tuple(self._split(rule.mask, self.at, None, cell))

    def _split(self, expr: Expr, at: reference.Context, let: str | None, cell: Cell) -> Iterator[Part]:
        if expr.op == "and":
            for arg in expr.args:
                yield from self._split(arg, at, let, cell)
        elif expr.op == "let" and expr.kind == FLAG:
            fixed, then = self.lets[expr.value]
            yield from self._split(fixed.value, then, _written(expr.value), cell)
        elif not (expr.op == "const" and expr.value):
            yield Part(expr, at, let, self, cell)


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
    substep: Substep | None
    rule: NumberedRule | None = None
    cell: Cell | None = None
    source: Cell | None = None

    @property
    def changed(self) -> bool:
        return not np.array_equal(self.before, self.after)

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """The parts of the condition that let its rule happen; none without a rule."""
        if self.rule is None or self.substep is None or self.cell is None:
            return ()
        return self.substep.parts(self.rule.rule, self.cell)


@dataclass
class RecordedStep:
    """A step as it happens: its substeps, and all writes to all slots of one cell, scratch fields among them, in order.

    Each write finds what the one before it left; what the last one leaves is what the step leaves. States are the
    reference's: integers int64, floats float32, [1, H, W] or [1, 2, H, W].
    """

    rules: Iterator[NumberedRule]
    cell: Cell
    begin: reference.State
    end: reference.State = field(default_factory=dict)
    substeps: list[Substep] = field(default_factory=list)
    writes: list[Write] = field(default_factory=list)

    def begins(self, moment: Moment, at: reference.Context, masks: Mapping[int, Array]) -> None:
        """Record a substep: see `reference.Watch`."""
        now = replace(at, lets=dict(at.lets))
        earlier = self.substeps[-1].lets if self.substeps else {}
        lets = {**earlier, **{let.name: (let, now) for let in moment.lets}}
        rules = tuple(islice(self.rules, len(moment.rules)))
        self.substeps.append(Substep(moment.policy, rules, now, lets, masks))

    def wrote(self, change: reference.Change, before: Array, after: Array, mask: Array | None = None) -> None:
        """Record a write to the cell. One without a rule counts if it changes something."""
        substep = self.substeps[-1] if self.substeps else None
        write = Write(change.slot, pick(before, self.cell), pick(after, self.cell), change.how, substep)
        if change.rule is None:
            self.writes += [write] if write.changed else []
        elif substep is not None and mask is not None and mask[(0, *self.cell)]:
            rule = next(numbered for numbered in substep.rules if numbered.rule is change.rule)
            source = None if change.source is None else substep.near(self.cell, change.source)
            asked = substep.near(self.cell, change.asked)
            self.writes.append(replace(write, rule=rule, cell=asked, source=source))


def record_step(world: World, cell: Cell) -> RecordedStep:
    """The next step of a batch of one world, with default parameters, recorded."""
    ruleset, to_numpy = world.sim.ruleset, world.sim.kind.to_numpy
    state = {name: to_numpy(value) for name, value in world.state.items()}
    clock = reference.Clock(*(to_numpy(part) for part in (world.seed, world.index, world.step)))
    step = RecordedStep(iter(numbered_rules(ruleset)), cell, reference.widened(ruleset, state))
    params = reference.parameters(ruleset, 1, {})
    step.end = reference.widened(ruleset, reference.step(ruleset, state, clock, params, watch=step))
    return step


def pick(array: Array, cell: Cell) -> Any:
    """One cell's value of a reference array: a NumPy number, or two of a vector."""
    return array[0, ..., cell[0], cell[1]]


# Conditions


@dataclass(frozen=True)
class Read:
    """One value that a condition read. `cell` is where it stands, None for parameters.

    `value` is plain data, `shown` how a rule file would write it. `element` is what the cell is, where it matters.
    `counted` are the cells that a count found.
    """

    text: str
    value: Any
    shown: str
    cell: Cell | None
    element: str | None
    counted: tuple[Cell, ...] = ()


@dataclass(frozen=True, eq=False)
class Part:
    """One of the conditions that must all hold for a rule to happen, in one cell.

    `at` is the state that it reads; `let` names the one that it comes from.
    """

    expr: Expr
    at: reference.Context
    let: str | None
    substep: Substep
    cell: Cell

    @property
    def text(self) -> str:
        return show_expr(self.at.ruleset, self.expr)

    @cached_property
    def holds(self) -> bool:
        return bool(pick(reference.evaluate(self.expr, self.at), self.cell))

    @cached_property
    def reads(self) -> tuple[Read, ...]:
        """Everything that the condition read, each value once."""
        reads: dict[str, Read] = {}
        for read in self._reads(self.expr, self.at, HERE):
            reads.setdefault(read.text, read)
        return tuple(reads.values())

    def _reads(self, expr: Expr, at: reference.Context, offset: Offset) -> Iterator[Read]:
        if expr.op == "look":
            dy, dx = expr.value
            yield from self._reads(expr.args[0], at, (offset[0] + dy, offset[1] + dx))
        elif expr.op not in _LEAVES:
            for arg in expr.args:
                yield from self._reads(arg, at, offset)
        else:
            yield self._leaf(expr, at, offset)
            if expr.op == "let" and expr.value in self.substep.lets:
                let, then = self.substep.lets[expr.value]
                yield from self._reads(let.value, then, offset)

    def _leaf(self, expr: Expr, at: reference.Context, offset: Offset) -> Read:
        ruleset, place = at.ruleset, self.substep.near(self.cell, offset)
        value = pick(reference.evaluate(expr, at), place)
        if expr.op == "element" and offset != HERE:
            text = show_offset(offset)
        else:
            text = _written(show_expr(ruleset, look(expr, offset)))
        element, counted = None, []
        if expr.op == "property" or (expr.op in ("field", "let") and offset != HERE):
            element = element_name(
                ruleset, int(pick(reference.evaluate(Expr("element", ELEMENT), at), place))
            )
        if expr.op == "count":  # the neighbors with a weight where the argument holds
            holds, kernel = reference.evaluate(expr.args[0], at), expr.value
            for dy, dx, weight in kernel.weights:
                there = self.substep.near(place, (dy, dx))
                inside = there == (place[0] + dy, place[1] + dx)
                if weight and (inside or kernel.wrap) and holds[(0, *there)]:
                    counted.append(there)
        return Read(
            text,
            plain(ruleset, expr.kind, value),
            show_at_cell(ruleset, expr.kind, value),
            None if expr.op in ("param", "coordinate") else place,
            element,
            tuple(counted),
        )


def _written(name: str) -> str:
    """The name of a `let` in the file: copies under loops are numbered."""
    return name.partition("#")[0]


def plain(ruleset: Ruleset, kind: Kind, value: Any) -> Any:
    """A cell's value as plain data: elements by name, directions as rules name them, the rest as numbers.

    JSON has no infinities, which values within a pass may be: these are text.
    """
    if kind.name in ("element", "direction"):
        return show_at_cell(ruleset, kind, value)
    numbers = [number if isfinite(number) else str(number) for number in value.reshape(-1).tolist()]
    return numbers if kind.name == "vec2" else numbers[0]


def show_at_cell(ruleset: Ruleset, kind: Kind, value: Any) -> str:
    """A cell's value as a rule file would write it; draws in per cent, as chances are."""
    number = value.tolist()
    match kind.name:
        case "draw":
            return f"{number * 100:.6g}%"
        case "vec2":
            return "({:.7g}, {:.7g})".format(*number)
        case "real" | "number":
            return f"{number:.7g}"
    return show_value(ruleset, kind, number)


# Traces


@dataclass(frozen=True)
class Miss:
    """A rule that would have written the cell, and did not. `cell` is where its condition was asked.

    `failed` are the parts that do not hold, `held` the others. If none failed, the rule gave way to another one under
    the policy of `conflicts:`.
    """

    rule: NumberedRule
    cell: Cell
    failed: tuple[Part, ...]
    held: tuple[Part, ...]
    policy: str


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
    writes: tuple[Write, ...]
    misses: tuple[Miss, ...]

    def writer(self, slot: str = "element") -> NumberedRule | None:
        """The rule that last wrote a slot; None if no rule did."""
        rules = [write.rule for write in self.writes if write.slot.name == slot and write.rule]
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
        step: which step, from 1: the world after it is explained.
        number: which world of the batch.
        of: names of slots: the element, fields, scratch fields such as ``pass.name``. All but scratch by default.
        every_rule: also the rules that missed by more than one part of their condition, or are about other elements.

    Raises:
        IndexError: the world has no such cell, or the batch no such world. ValueError: step 0. KeyError: an unknown name.
    """
    batch, height, width = world.shape
    if not 0 <= number < batch:
        raise IndexError(f"there is no world {number}: the batch has {batch}, counted from 0")
    if not (0 <= row < height and 0 <= column < width):
        raise IndexError(f"there is no cell {row},{column}: the world has {height} rows and {width} columns, counted from 0")  # fmt: skip
    if step < 1:
        raise ValueError("the first step is step 1")
    slots = _slots(world, of)
    alone, cell = world.select([number]), (row, column)
    recorded = record_step(world.sim.step(alone, step - 1), cell)
    writes = [write for write in recorded.writes if write.slot.name in slots]
    misses = _misses(recorded, slots.values(), every_rule)
    if not every_rule:
        lines = {_line(write.rule) for write in writes if write.rule}
        misses = [miss for miss in misses if _line(miss.rule) not in lines]
    return Trace(
        world.sim.ruleset,
        number,
        cell,
        int(alone.step[0]) + step,
        tuple(slots.values()),
        {name: pick(array, cell) for name, array in recorded.begin.items() if name in slots},
        {name: pick(array, cell) for name, array in recorded.end.items() if name in slots},
        tuple(writes),
        tuple(misses),
    )


def _slots(world: World, names: Iterable[str] | None) -> dict[str, Slot]:
    """The slots of some names, or all of the state. Raises KeyError."""
    known, ruleset = dict(world.sim.slot_by_name), world.sim.ruleset
    if names is None:
        return known
    for pass_ in ruleset.passes:
        known |= scratch_slots(pass_)
    wanted = list(dict.fromkeys(slot_name(ruleset, name) for name in names))
    for name in wanted:
        if name not in known and ruleset.property(name) is not None:
            raise KeyError(f"`{name}` follows from the element: ask for `element`")
        if name not in known:
            raise KeyError("; ".join([f"no field `{name}`", *suggest(name, known, "fields")]))
    return {name: known[name] for name in wanted}


def _line(rule: NumberedRule) -> tuple[Span, str]:
    """A key that is equal for all rules of one line in one pass."""
    return rule.span, rule.pass_name


def _misses(step: RecordedStep, slots: Iterable[Slot], every_rule: bool) -> list[Miss]:
    """Rules that did not happen where they would have written the cell. Unless all are asked for, a line counts once a cell."""
    misses: dict[Any, Miss] = {}
    for substep in step.substeps:
        for numbered in substep.rules:
            rule = numbered.rule
            offsets = [offset for slot in slots for offset in _writes_at(rule, slot)]
            for place in dict.fromkeys(substep.near(step.cell, offset, -1) for offset in offsets):
                key = (numbered.number if every_rule else _line(numbered), place)
                if key in misses or substep.happened(rule, place):
                    continue
                parts = substep.parts(rule, place)
                failed = tuple(islice((part for part in parts if not part.holds), None if every_rule else 2))
                if not every_rule and failed:
                    # Of a rule that nearly happened one part fails, which is not what element the cell is.
                    asks = failed[0].expr
                    about_itself = asks.op == "member" and asks.args[0].op == "element"
                    if len(failed) > 1 or len(parts) == 1 or about_itself:
                        continue
                held = tuple(part for part in parts if part not in failed)
                misses[key] = Miss(numbered, place, failed, held, substep.policy)
    return list(misses.values())


def _writes_at(rule: Rule, slot: Slot) -> Iterator[Offset]:
    """Where a rule writes a slot, from the cell in which its condition holds."""
    assigns = [rule] if isinstance(rule, Assign) else rule.effects
    yield from (assign.offset for assign in assigns if assign.field == slot.name)
    if slot.travels:
        yield from (offset for _, offset in _element_writes(rule))


def _element_writes(rule: Rule) -> list[tuple[bool, Offset]]:
    """Where a rule writes elements and what travels with them, and whether they arrive there: that comes after all else."""
    match rule:
        case Transform():
            return [(False, HERE)]
        case Move():
            return [(False, HERE), (True, rule.offset)]
        case Swap():
            return [(True, rule.offset), (True, HERE)]
    return []


# Text

MAX_CELLS = 9
"""The most cells that a count names in a text."""


def trace_text(trace: Trace, *, color: bool = False) -> str:
    """The whole trace, without a line break at its end."""
    blocks = [_head(trace)]
    blocks += [_writes_text(trace, list(writes), color) for _, writes in groupby(trace.writes, _event)]
    blocks += [_miss_text(trace, miss, color) for miss in trace.misses]
    return "\n\n".join(blocks)


def _event(write: Write) -> tuple[object, ...]:
    """A key that is equal for all writes of one rule in one substep."""
    return id(write.substep), id(write.rule), write.cell, _WITHOUT_RULE.get(write.how)


def _change(trace: Trace, slot: Slot, before: Any, after: Any) -> str:
    old, new = (show_at_cell(trace.ruleset, slot.kind, value) for value in (before, after))
    return f"{slot.name}: {new}, as before" if old == new else f"{slot.name}: {old} -> {new}"


def _head(trace: Trace) -> str:
    lines = [f"cell {_at(trace.cell)} in step {trace.step} of {trace.ruleset.name}"]
    for slot in trace.slots:
        if slot.name in trace.after:  # a scratch field lives in its pass
            change = _change(trace, slot, trace.before[slot.name], trace.after[slot.name])
            rule = trace.writer(slot.name)
            lines.append(f"  {change}, by {rule.place}" if rule and " -> " in change else f"  {change}")
    if not any(write.rule for write in trace.writes):
        lines.append("  no rule wrote it")
    return "\n".join(map(printable, lines))


def _writes_text(trace: Trace, writes: list[Write], color: bool) -> str:
    lines, first = [], writes[0]
    for write in writes:
        if write.changed:
            moved = f", moved here from {_at(write.source)}" if write.source else ""
            change = _change(trace, write.slot, write.before, write.after)
            lines.append(_painted(change, "32;1", color) + moved)
    if not lines:
        names = dict.fromkeys(write.slot.name for write in writes)
        lines = [f"{printable(', '.join(names))}: written again, as before"]
    if first.rule is None or first.cell is None:
        return "\n".join([*lines, f"  = {_WITHOUT_RULE[first.how]}"])
    return "\n".join(lines + _source(trace, first.rule, first.cell, first.parts, [Label(first.rule.span)]))


def _miss_text(trace: Trace, miss: Miss, color: bool) -> str:
    span = miss.rule.span
    labels = [Label(part.expr.span or span, _reads_text(part)) for part in miss.failed]
    if not labels:
        labels = [Label(span, "all of its condition holds: it gave way to a rule that claims a cell too")]
    elif all(label.span and label.span.line != span.line for label in labels):
        labels.append(Label(span, ""))
    head = _painted("almost" if len(miss.failed) <= 1 else "not", "33;1", color)
    but = " and ".join(f"`{part.text}`" for part in miss.failed) or f"`conflicts: {miss.policy}`"
    source = _source(trace, miss.rule, miss.cell, miss.held, labels)
    return "\n".join([f"{head}, but for {printable(but)}", *source])


def _source(
    trace: Trace, rule: NumberedRule, asked: Cell, held: Iterable[Part], labels: list[Label]
) -> list[str]:
    """The source lines of labels, and below them the rule and the parts of its condition that hold."""
    label = f" ({rule.label})" if rule.label else ""
    where = f", asked at {_at(asked)}" if asked != trace.cell else ""
    notes = [f"pass {rule.pass_name} of {rule.pack}, substep {rule.moment}{label}{where}"]
    for part in held:
        values, span = _reads_text(part), part.expr.span
        come = f" (`{part.let}`, {place_of(span)})" if part.let and span else ""
        notes.append(f"holds: {part.text}{come}{'; ' if values else ''}{values}")
    lines, gutter = source_lines(labels)
    return [*lines, *(f"{' ' * gutter} = {printable(note)}" for note in notes)]


def _reads_text(part: Part) -> str:
    texts = []
    for read in part.reads:
        there = _at(read.cell) if read.cell and read.cell != part.cell else ""
        where = " at ".join(filter(None, [read.element, there]))
        if read.counted:
            more = " …" if len(read.counted) > MAX_CELLS else ""
            where = " ".join(map(_at, read.counted[:MAX_CELLS])) + more
        texts.append(f"{read.text} is {read.shown}" + (f" ({where})" if where else ""))
    return ", ".join(texts)


def _at(cell: Cell) -> str:
    """`row,column`."""
    return f"{cell[0]},{cell[1]}"


def _painted(text: str, style: str, color: bool) -> str:
    return f"\x1b[{style}m{printable(text)}\x1b[0m" if color else printable(text)


# Plain data

SCHEMA = 1
"""The version of the plain data. It increases when a key changes its meaning or is removed."""


def trace_data(trace: Trace) -> dict[str, Any]:
    """Rows and columns count from 0, steps, lines, columns of text, rules and substeps from 1."""

    def change(slot: Slot, before: Any, after: Any) -> dict[str, Any]:
        values = {"before": before, "after": after}
        return {key: plain(trace.ruleset, slot.kind, value) for key, value in values.items()}

    return {
        "schema": SCHEMA,
        "ruleset": trace.ruleset.name,
        "world": trace.world,
        "cell": trace.cell,
        "step": trace.step,
        "slots": {
            slot.name: change(slot, trace.before[slot.name], trace.after[slot.name])
            | {"writer": _data(trace.writer(slot.name))}
            for slot in trace.slots
            if slot.name in trace.after
        },
        "writes": [
            {"slot": write.slot.name, **change(write.slot, write.before, write.after)}
            | {name: _data(getattr(write, name)) for name in ("how", "rule", "cell", "source", "parts")}
            for write in trace.writes
        ],
        "almost": [
            {name: _data(getattr(miss, name)) for name in ("rule", "cell", "failed", "held")}
            | {"gave_way": None if miss.failed else miss.policy}
            for miss in trace.misses
        ],
    }


def _data(value: Any) -> Any:
    """Rules, parts of conditions and what they read, as plain data."""
    match value:
        case tuple():
            return [_data(item) for item in value]
        case NumberedRule():
            numbered = {"number": value.number, "pack": value.pack, "pass": value.pass_name}
            numbered |= {"moment": value.moment, "label": value.label, "text": one_line(value.span)}
            return numbered | _place(value.span)
        case Part():
            part = {"text": value.text, "holds": value.holds, "let": value.let}
            return part | _place(value.expr.span) | {"reads": _data(value.reads)}
        case Read():
            return {name: item for name, item in vars(value).items() if name != "shown"}
    return value


def _place(span: Span | None) -> dict[str, Any]:
    if span is None:
        return {"file": None, "line": None, "column": None}
    return {"file": span.source.name, "line": span.line, "column": span.column}


# All cells at once

SLOT = "last writer"
"""The field of the numbers. Names in rule files have no blanks, so none is the same."""


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
        self._marked = sim.of(_marked(sim.ruleset))

    def step(self, world: World, steps: int = 1, **options: Any) -> Provenance:
        """Like `Simulator.step`, which takes the same options, gives the same worlds and raises the same errors.

        After 0 steps no rule has written.
        """
        self.sim.check(world)
        xp = self.sim.kind.xp
        dtype = getattr(xp, self._marked.slot_by_name[SLOT].dtype)
        nothing = xp.asarray(xp.zeros_like(world.ids), dtype=dtype)
        start = replace(world, sim=self._marked, state={**world.state, SLOT: nothing})
        end = self._marked.step(start, steps, **options)
        state = dict(end.state)
        numbers = xp.asarray(state.pop(SLOT), dtype=xp.int16)
        return Provenance(replace(end, sim=self.sim, state=state), numbers, self.rules)


def _marked(ruleset: Ruleset) -> Ruleset:
    """The same rules, with a field that holds the number of the rule that last wrote a cell's element in this step."""
    numbers, passes = count(1), []
    for pass_ in ruleset.passes:
        moments = []
        for moment in pass_.moments:
            numbered = list(zip(moment.rules, numbers, strict=False))
            if moment.policy in ("prove", "overwrite"):  # all rules happen where their conditions hold
                marks = [
                    (arrives, _mark(number, offset, rule, rule.mask))
                    for rule, number in numbered
                    for arrives, offset in _element_writes(rule)
                ]
                marks.sort(key=lambda mark: mark[0])
                rules = (*moment.rules, *(mark for _, mark in marks))
            else:  # of the cells that rules claim each has one writer
                rules = tuple(_marked_rule(rule, number) for rule, number in numbered)
            moments.append(replace(moment, rules=rules))
        passes.append(replace(pass_, moments=tuple(moments)))
    kind = integer(0, max(1, next(numbers) - 1))
    slot = Field(SLOT, kind, 0, "place", True, None, ruleset.elements[0].pack, ruleset.elements[0].span)
    return replace(ruleset, fields=(*ruleset.fields, slot), passes=tuple(passes))


def _marked_rule(rule: Rule, number: int) -> Rule:
    """The rule with effects that leave its number in every cell whose element it writes."""
    if isinstance(rule, Assign):
        return rule
    marks = [_mark(number, offset, rule) for _, offset in _element_writes(rule)]
    return replace(rule, effects=(*rule.effects, *marks))


def _mark(number: int, place: Offset, rule: Rule, mask: Expr = TRUE) -> Assign:
    """The assignment of a rule's number to a cell that it writes."""
    value = Expr("const", integer(number, number), value=number)
    return Assign(SLOT, place, ":=", value, mask, rule.span)
