"""Why cells hold what they hold.

`trace` explains one cell in one step: its writes on the reference interpreter, and the rules that nearly wrote it.

`Recorder` names the rule that last wrote the element of each cell of a batch, on any backend and device. The rules get one
more field, and every rule that writes an element sets the field to its number in that cell. Backends need no support for
it, and ordinary simulators do not change.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby, islice
from math import isfinite
from typing import Any

from powderdsl.arrays import np
from powderdsl.diagnostics import Label, Span, suggest
from powderdsl.diagnostics.printable import printable
from powderdsl.diagnostics.render import source_lines
from powderdsl.model import reference
from powderdsl.model.expressions.operators import look
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
    rules: list[NumberedRule] = []
    for pass_ in ruleset.passes:
        for position, moment in enumerate(pass_.moments):
            for rule in moment.rules:
                number = len(rules) + 1
                rules.append(NumberedRule(number, pass_.pack, pass_.name, position, moment.label, rule))
    return tuple(rules)


# What happens in a step


@dataclass(frozen=True)
class RecordedSubstep:
    """A substep of the step: what it found, and its rules. Arrays have a batch of one.

    `table` has the slots of the state and of its pass, `lets` the expression of each `let` of the pass so far and what
    that read, `masks` where each rule happened, by `id` of the rule.
    """

    policy: str
    rules: tuple[NumberedRule, ...]
    at: reference.Context
    table: Mapping[str, Slot]
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
        assert rule.mask is not None
        return tuple(self._split(rule.mask, self.at, "", cell))

    def _split(self, expr: Expr, at: reference.Context, of: str, cell: Cell) -> Iterator[Part]:
        if expr.op == "and":
            for arg in expr.args:
                yield from self._split(arg, at, of, cell)
        elif expr.op == "let" and expr.kind == FLAG:
            let, then = self.lets[expr.value]
            yield from self._split(let.value, then, _written(expr.value), cell)
        elif not (expr.op == "const" and expr.value):
            yield Part(expr, at, of, self, cell)


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

    ruleset: Ruleset
    cell: Cell
    begin: reference.State
    end: reference.State = field(default_factory=dict)
    substeps: list[RecordedSubstep] = field(default_factory=list)
    writes: list[Write] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._rules = iter(numbered_rules(self.ruleset))

    def begins(
        self, moment: Moment, at: reference.Context, masks: Mapping[int, Array], table: Mapping[str, Slot]
    ) -> None:
        """Record a substep: see `reference.Watch`."""
        now = replace(at, lets=dict(at.lets))
        fixed = {let.name: (let, now) for let in moment.lets}
        lets = {name: fixed[name] if name in fixed else self.substeps[-1].lets[name] for name in at.lets}
        rules = tuple(islice(self._rules, len(moment.rules)))
        self.substeps.append(RecordedSubstep(moment.policy, rules, now, table, lets, masks))

    def wrote(self, change: reference.Change, before: Array, after: Array, mask: Array | None = None) -> None:
        """Record a write to the cell. One without a rule counts if it changes something."""
        substep = self.substeps[-1] if self.substeps else None
        values = pick(before, self.cell), pick(after, self.cell)
        if change.rule is None:
            write = Write(change.slot, *values, change.how, substep)
            self.writes += [write] if write.changed else []
        elif substep is not None and mask is not None and mask[(0, *self.cell)]:
            rule = next(numbered for numbered in substep.rules if numbered.rule is change.rule)
            source = None if change.source is None else substep.near(self.cell, change.source)
            asked = substep.near(self.cell, change.asked)
            self.writes.append(Write(change.slot, *values, change.how, substep, rule, asked, source))


def record_step(world: World, cell: Cell) -> RecordedStep:
    """The next step of a batch of one world, with default parameters, recorded."""
    ruleset, to_numpy = world.sim.ruleset, world.sim.kind.to_numpy
    state = {name: to_numpy(value) for name, value in world.state.items()}
    clock = reference.Clock(*(to_numpy(part) for part in (world.seed, world.index, world.step)))
    step = RecordedStep(ruleset, cell, reference.widened(ruleset, state))
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

    `at` is the state that it reads; `of` names the `let` that it comes from.
    """

    expr: Expr
    at: reference.Context
    of: str
    substep: RecordedSubstep
    cell: Cell

    @property
    def text(self) -> str:
        return show_expr(self.at.ruleset, self.expr)

    @property
    def span(self) -> Span | None:
        return self.expr.span

    @cached_property
    def holds(self) -> bool:
        return bool(pick(reference.evaluate(self.expr, self.at), self.cell))

    @cached_property
    def reads(self) -> tuple[Read, ...]:
        """Everything that the condition read, each value once."""
        reads: dict[str, Read] = {}
        for read in _reads(self.expr, self.at, self.cell, HERE, self.substep):
            reads.setdefault(read.text, read)
        return tuple(reads.values())

    @property
    def about_itself(self) -> bool:
        """Whether it only asks which element the cell is. If that fails, the rule is about other cells."""
        return self.expr.op == "member" and self.expr.args[0].op == "element"


def _written(name: str) -> str:
    """The name of a `let` in the file: copies under loops are numbered."""
    return name.partition("#")[0]


def _reads(
    expr: Expr, at: reference.Context, cell: Cell, offset: Offset, substep: RecordedSubstep
) -> Iterator[Read]:
    if expr.op == "look":
        dy, dx = expr.value
        yield from _reads(expr.args[0], at, cell, (offset[0] + dy, offset[1] + dx), substep)
    elif expr.op not in _LEAVES:
        for arg in expr.args:
            yield from _reads(arg, at, cell, offset, substep)
    else:
        yield _leaf(expr, at, substep.near(cell, offset), offset, substep)
        if expr.op == "let" and expr.value in substep.lets:
            let, then = substep.lets[expr.value]
            yield from _reads(let.value, then, cell, offset, substep)


def _leaf(expr: Expr, at: reference.Context, place: Cell, offset: Offset, substep: RecordedSubstep) -> Read:
    ruleset, value = at.ruleset, pick(reference.evaluate(expr, at), place)
    if expr.op == "element" and offset != HERE:
        text = show_offset(offset)
    else:
        text = _written(show_expr(ruleset, look(expr, offset)))
    element, counted = None, []
    if expr.op == "property" or (expr.op in ("field", "let") and offset != HERE):
        element = element_name(ruleset, int(pick(reference.evaluate(Expr("element", ELEMENT), at), place)))
    if expr.op == "count":  # the neighbors with a weight where the argument holds
        holds, kernel = reference.evaluate(expr.args[0], at), expr.value
        for dy, dx, weight in kernel.weights[: 1 << 10]:
            there = substep.near(place, (dy, dx))
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


def plain(ruleset: Ruleset, kind: Kind, value: Any) -> Any:
    """A cell's value as plain data: elements by name, directions as rules name them, the rest as numbers.

    JSON has no infinities, which values within a pass may be: these are text.
    """
    if kind.name in ("element", "direction"):
        return show_at_cell(ruleset, kind, value)
    numbers = np.asarray(value).tolist()
    if isinstance(numbers, list):
        return [number if isfinite(number) else str(number) for number in numbers]
    return bool(numbers) if kind.name == "flag" else numbers if isfinite(numbers) else str(numbers)


def show_at_cell(ruleset: Ruleset, kind: Kind, value: Any) -> str:
    """A cell's value as a rule file would write it; draws in per cent, as chances are."""
    number = np.asarray(value).tolist()
    match kind.name:
        case "element" | "flag" | "direction" | "chance":
            return show_value(ruleset, kind, number)
        case "draw":
            return f"{number * 100:.6g}%"
        case "vec2":
            return "({:.7g}, {:.7g})".format(*number)
    return str(number) if kind.name == "int" else f"{number:.7g}"


# Traces


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
    count, height, width = world.shape
    if not 0 <= number < count:
        raise IndexError(f"there is no world {number}: the batch has {count}, counted from 0")
    if not (0 <= row < height and 0 <= column < width):
        raise IndexError(f"there is no cell {row},{column}: the world has {height} rows and {width} columns, counted from 0")  # fmt: skip
    if step < 1:
        raise ValueError("the first step is step 1")
    wanted = _slots(world, of)
    alone, cell = world.select([number]), (row, column)
    recorded = record_step(world.sim.step(alone, step - 1), cell)
    writes = [write for write in recorded.writes if write.slot.name in wanted]
    misses = _misses(recorded, sorted(wanted), every_rule)
    if not every_rule:
        lines = {(write.rule.span, write.rule.pass_name) for write in writes if write.rule}
        misses = [miss for miss in misses if (miss.rule.span, miss.rule.pass_name) not in lines]
    return Trace(
        world.sim.ruleset,
        number,
        cell,
        int(alone.step[0]) + step,
        tuple(wanted.values()),
        {name: pick(array, cell) for name, array in recorded.begin.items() if name in wanted},
        {name: pick(array, cell) for name, array in recorded.end.items() if name in wanted},
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


def _misses(step: RecordedStep, names: Sequence[str], every_rule: bool) -> list[Miss]:
    """Rules that did not happen where they would have written the cell. Unless all are asked for, a line counts once a cell."""
    misses: dict[Any, Miss] = {}
    for substep in step.substeps:
        for rule in substep.rules:
            offsets = [offset for name in names for offset in _writes_at(rule.rule, substep.table.get(name))]
            for place in dict.fromkeys(substep.near(step.cell, offset, -1) for offset in offsets):
                key = (rule.number if every_rule else (rule.span, rule.pass_name), place)
                if key in misses or substep.happened(rule.rule, place):
                    continue
                parts = substep.parts(rule.rule, place)
                failed = list(islice((part for part in parts if not part.holds), 2))
                # Of a rule that nearly happened one part fails, which is not what element the cell is, or none.
                nearly = len(failed) == 1 and len(parts) > 1 and not failed[0].about_itself
                if every_rule or nearly or not failed:
                    misses[key] = Miss(rule, place, parts, substep.policy)
    return list(misses.values())


def _writes_at(rule: Rule, slot: Slot | None) -> Iterator[Offset]:
    """Where a rule writes a slot, from the cell in which its condition holds."""
    if slot is None:
        return
    if isinstance(rule, Assign):
        if rule.field == slot.name:
            yield rule.offset
        return
    if slot.travels:
        yield HERE
        if isinstance(rule, (Swap, Move)):
            yield rule.offset
    for effect in rule.effects:
        if effect.field == slot.name:
            yield effect.offset


# Text

MAX_MISSES = 12
"""The most rules that nearly happened in a text, unless all are asked for."""

MAX_CELLS = 9
"""The most cells that a count names in a text."""


def trace_text(trace: Trace, *, color: bool = False, every_rule: bool = False) -> str:
    """The whole trace, without a line break at its end."""
    blocks, again = [_head(trace)], []
    for _, group in groupby(trace.writes, key=_event):
        writes = list(group)
        rule = writes[0].rule
        if any(write.changed for write in writes):
            blocks.append(_writes_text(trace, writes, color))
        elif rule is not None:
            names = ", ".join(dict.fromkeys(write.slot.name for write in writes))
            again.append(printable(f"  {names}: {rule.place}, pass {rule.pass_name}"))
    if again:
        blocks.append("\n".join(["written again, as it was:", *again]))
    shown = trace.misses if every_rule else trace.misses[:MAX_MISSES]
    blocks += [_miss_text(trace, miss, color) for miss in shown]
    if len(shown) < len(trace.misses):
        blocks.append(f"{len(trace.misses) - len(shown)} more rules nearly happened: --all")
    return "\n\n".join(blocks)


def _event(write: Write) -> tuple[int, int, object]:
    """A key that is equal for all writes of one rule in one substep."""
    if write.rule is None:
        return id(write.substep), 0, write.how
    return id(write.substep), write.rule.number, write.cell


def _head(trace: Trace) -> str:
    lines = [f"cell {_at(trace.cell)} in step {trace.step} of {trace.ruleset.name}"]
    for slot in trace.slots:
        if slot.name not in trace.after:
            continue  # a scratch field lives in its pass
        before, after = (
            show_at_cell(trace.ruleset, slot.kind, values[slot.name])
            for values in (trace.before, trace.after)
        )
        rule = trace.writer(slot.name)
        by = f", by {rule.place}" if rule else ""
        change = f"{after}, as before" if before == after else f"{before} -> {after}{by}"
        lines.append(f"  {slot.name}: {change}")
    if not any(write.rule for write in trace.writes):
        lines.append("  no rule wrote it")
    return "\n".join(map(printable, lines))


def _writes_text(trace: Trace, writes: list[Write], color: bool) -> str:
    lines = []
    for write in writes:
        if write.changed:
            before, after = (
                show_at_cell(trace.ruleset, write.slot.kind, value) for value in (write.before, write.after)
            )
            moved = f", moved here from {_at(write.source)}" if write.source else ""
            lines.append(_painted(f"{write.slot.name}: {before} -> {after}", "32;1", color) + moved)
    first = writes[0]
    if first.rule is None or first.cell is None:
        return "\n".join([*lines, f"  = {_WITHOUT_RULE[first.how]}"])
    return "\n".join(lines + _source(trace, first.rule, first.cell, first.parts, [Label(first.rule.span)]))


def _miss_text(trace: Trace, miss: Miss, color: bool) -> str:
    span = miss.rule.span
    labels = [Label(part.span or span, _reads_text(part)) for part in miss.failed]
    if not labels:
        labels = [Label(span, "all of its condition holds: it gave way to a rule that claims a cell too")]
    elif all(label.span and label.span.line != span.line for label in labels):
        labels.append(Label(span, ""))
    head = _painted("almost" if len(miss.failed) <= 1 else "not", "33;1", color)
    but = " and ".join(f"`{part.text}`" for part in miss.failed) or f"`conflicts: {miss.policy}`"
    held = [part for part in miss.parts if part.holds]
    return "\n".join(
        [f"{head}, but for {printable(but)}", *_source(trace, miss.rule, miss.cell, held, labels)]
    )


def _source(
    trace: Trace, rule: NumberedRule, asked: Cell, held: Iterable[Part], labels: list[Label]
) -> list[str]:
    """The source lines of labels, and below them the rule and the parts of its condition that hold."""
    label = f" ({rule.label})" if rule.label else ""
    where = f", asked at {_at(asked)}" if asked != trace.cell else ""
    notes = [f"pass {rule.pass_name} of {rule.pack}, substep {rule.moment + 1}{label}{where}"]
    for part in held:
        values = _reads_text(part)
        come = f" (`{part.of}`, {place_of(part.span)})" if part.of and part.span else ""
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
            | {"writer": _rule_data(trace.writer(slot.name))}
            for slot in trace.slots
            if slot.name in trace.after
        },
        "writes": [
            {
                "slot": write.slot.name,
                **change(write.slot, write.before, write.after),
                "how": write.how,
                "rule": _rule_data(write.rule),
                "cell": write.cell,
                "source": write.source,
                "parts": _parts_data(write.parts),
            }
            for write in trace.writes
        ],
        "almost": [
            {
                "rule": _rule_data(miss.rule),
                "cell": miss.cell,
                "failed": _parts_data(miss.failed),
                "held": _parts_data(part for part in miss.parts if part.holds),
                "gave_way": miss.policy if not miss.failed else None,
            }
            for miss in trace.misses
        ],
    }


def _rule_data(rule: NumberedRule | None) -> dict[str, Any] | None:
    if rule is None:
        return None
    return {
        "number": rule.number,
        "pack": rule.pack,
        "pass": rule.pass_name,
        "moment": rule.moment + 1,
        "label": rule.label,
        "text": one_line(rule.span),
        **_place(rule.span),
    }


def _parts_data(parts: Iterable[Part]) -> list[dict[str, Any]]:
    return [
        {
            "text": part.text,
            "holds": part.holds,
            "let": part.of or None,
            **_place(part.span),
            "reads": [
                {name: value for name, value in vars(read).items() if name != "shown"} for read in part.reads
            ],
        }
        for part in parts
    ]


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
    numbers = iter(range(1, 1 << 31))
    passes = []
    for pass_ in ruleset.passes:
        moments = []
        for moment in pass_.moments:
            numbered = list(zip(moment.rules, numbers, strict=False))
            if moment.policy in ("prove", "overwrite"):
                rules = (*moment.rules, *_marks_in_order(numbered))
            else:  # of the cells that rules claim each has one writer
                rules = tuple(_marked_rule(rule, number) for rule, number in numbered)
            moments.append(replace(moment, rules=rules))
        passes.append(replace(pass_, moments=tuple(moments)))
    kind = integer(0, max(1, next(numbers) - 1))
    slot = Field(SLOT, kind, 0, "place", True, None, ruleset.elements[0].pack, ruleset.elements[0].span)
    return replace(ruleset, fields=(*ruleset.fields, slot), passes=tuple(passes))


def _marks_in_order(numbered: Sequence[tuple[Rule, int]]) -> Iterator[Assign]:
    """Assignments of the numbers of rules that all happen where their conditions hold, in the order of their writes.

    What becomes of cells, or is left behind, is written before anything arrives.
    """
    for rule, number in numbered:
        if isinstance(rule, (Transform, Move)):
            yield _mark(number, HERE, rule.mask, rule)
    for rule, number in numbered:
        if isinstance(rule, (Swap, Move)):
            yield _mark(number, rule.offset, rule.mask, rule)
        if isinstance(rule, Swap):
            yield _mark(number, HERE, rule.mask, rule)


def _mark(number: int, place: Offset, mask: Expr | None, rule: Rule) -> Assign:
    value = Expr("const", integer(number, number), value=number)
    return Assign(SLOT, place, ":=", value, mask, rule.span)


def _marked_rule(rule: Rule, number: int) -> Rule:
    """The rule with effects that leave its number in every cell whose element it writes."""
    if isinstance(rule, Assign):
        return rule  # assignments never write elements
    places = [rule.offset, HERE] if isinstance(rule, (Swap, Move)) else [HERE]
    marks = tuple(_mark(number, place, None, rule) for place in places)
    return replace(rule, effects=(*rule.effects, *marks))
