"""Why a cell holds what it holds: its writes in one step on the reference interpreter, and the rules that nearly wrote it."""

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
from powderdsl.model.reference import Array
from powderdsl.model.state import Slot, scratch_slots, slot_name, slots
from powderdsl.model.text import element_name, one_line, place_of, show_expr, show_offset, show_value
from powderdsl.model.types import (
    ELEMENT,
    FLAG,
    Assign,
    Expr,
    Kind,
    Let,
    Moment,
    Move,
    Offset,
    Pass,
    Rule,
    Ruleset,
    Swap,
)
from powderdsl.simulation.provenance import NumberedRule, numbered_rules
from powderdsl.simulation.simulator import World

Cell = tuple[int, int]
"""(row, column)."""

HERE: Offset = (0, 0)
_LEAVES = ("element", "property", "field", "let", "draw", "coordinate", "param", "inside", "count", "sum")

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

    pass_: Pass
    moment: Moment
    rules: tuple[NumberedRule, ...]
    at: reference.Context
    table: dict[str, Slot]
    """Slots of the state, and scratch fields of the pass."""
    lets: dict[str, tuple[Let, reference.Context]]
    """For each `let` of the pass so far, its expression and what that read."""
    masks: Mapping[int, Array]
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
        return _parts(self.rule.rule, self.substep, self.cell)


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
        self._slots = {slot.name: slot for slot in slots(self.ruleset)}
        self._moments = self.ruleset.substeps()
        self._rules = iter(numbered_rules(self.ruleset))
        self._lets: dict[str, tuple[Let, reference.Context]] = {}

    def begins(self, at: reference.Context, masks: Mapping[int, Array]) -> None:
        """Record a substep: see `reference.Watch`."""
        pass_, moment = next(self._moments)
        found = replace(at, lets=dict(at.lets))
        if moment is pass_.moments[0]:
            self._lets.clear()
        self._lets.update((let.name, (let, found)) for let in moment.lets)
        rules = tuple(islice(self._rules, len(moment.rules)))
        table = {**self._slots, **scratch_slots(pass_)}
        self.substeps.append(RecordedSubstep(pass_, moment, rules, found, table, dict(self._lets), masks))

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


def value_at(expr: Expr, at: reference.Context, cell: Cell) -> Any:
    """The value of an expression in one cell: a NumPy number, or two of a vector."""
    return pick(reference.evaluate(expr, at), cell)


def pick(array: Array, cell: Cell) -> Any:
    """One cell's value of a reference array."""
    return array[0, ..., cell[0], cell[1]]


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
        return bool(value_at(self.expr, self.at, self.cell))

    @cached_property
    def reads(self) -> tuple[Read, ...]:
        """Everything that the condition read, each value once."""
        found: dict[str, Read] = {}
        for read in _reads(self.expr, self.at, self.cell, HERE, self.substep):
            found.setdefault(read.text, read)
        return tuple(found.values())

    @property
    def about_itself(self) -> bool:
        """Whether it only asks which element the cell is. If that fails, the rule is about other cells."""
        return self.expr.op == "member" and self.expr.args[0].op == "element"


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
    alone = world.select([number])
    cell = (row, column)
    recorded = record_step(world.sim.step(alone, step - 1), cell)
    names = {slot.name for slot in wanted}
    writes = [write for write in recorded.writes if write.slot.name in names]
    lines = {(write.rule.span, write.substep.pass_.name) for write in writes if write.rule and write.substep}
    misses = _misses(recorded, sorted(names), every_rule)
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
        tuple(writes),
        tuple(misses),
    )


def _slots(world: World, names: Iterable[str] | None) -> list[Slot]:
    """The slots of some names, or all of the state. Raises KeyError."""
    known, ruleset = {slot.name: slot for slot in world.sim.slots}, world.sim.ruleset
    if names is None:
        return list(known.values())
    for pass_ in ruleset.passes:
        known |= scratch_slots(pass_)
    wanted = list(dict.fromkeys(slot_name(ruleset, name) for name in names))
    for name in wanted:
        if name not in known and ruleset.property(name) is not None:
            raise KeyError(f"`{name}` follows from the element: ask for `element`")
        if name not in known:
            raise KeyError("; ".join([f"no field `{name}`", *suggest(name, known, "fields")]))
    return [known[name] for name in wanted]


def _misses(step: RecordedStep, names: Sequence[str], every_rule: bool) -> list[Miss]:
    """Rules that did not happen where they would have written the cell. Unless all are asked for, a line counts once a cell."""
    found: dict[Any, Miss] = {}
    for substep in step.substeps:
        for rule in substep.rules:
            places = dict.fromkeys(
                place
                for name in names
                if name in substep.table
                for place in anchors(rule.rule, step.cell, substep, name)
            )
            for place in places:
                key = (rule.number if every_rule else (rule.span, rule.pass_name), place)
                if key in found or substep.happened(rule.rule, place):
                    continue
                parts = _parts(rule.rule, substep, place)
                failed = list(islice((part for part in parts if not part.holds), 2))
                # Of a rule that nearly happened one part fails, which is not what element the cell is, or none.
                nearly = len(failed) == 1 and len(parts) > 1 and not failed[0].about_itself
                if every_rule or nearly or not failed:
                    found[key] = Miss(rule, place, parts, substep.moment.policy)
    return list(found.values())


# Conditions


def _parts(rule: Rule, substep: RecordedSubstep, cell: Cell) -> tuple[Part, ...]:
    """A rule's condition in one cell, split at its `and`s. Flags fixed by `let` are split too, as they were fixed."""
    assert rule.mask is not None
    return tuple(_apart(Part(rule.mask, substep.at, "", substep, cell)))


def _apart(part: Part) -> Iterator[Part]:
    expr, substep = part.expr, part.substep
    if expr.op == "and":
        for arg in expr.args:
            yield from _apart(Part(arg, part.at, part.of, substep, part.cell))
    elif expr.op == "let" and expr.kind == FLAG:
        let, found = substep.lets[expr.value]
        yield from _apart(Part(let.value, found, _written(expr.value), substep, part.cell))
    elif not (expr.op == "const" and expr.value):
        yield part


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
            let, found = substep.lets[expr.value]
            yield from _reads(let.value, found, cell, offset, substep)


def _leaf(expr: Expr, at: reference.Context, place: Cell, offset: Offset, substep: RecordedSubstep) -> Read:
    ruleset = at.ruleset
    value = value_at(expr, at, place)
    if expr.op == "element" and offset != HERE:
        text = show_offset(offset)
    else:
        text = _written(show_expr(ruleset, look(expr, offset)))
    element = None
    if expr.op == "property" or (expr.op in ("field", "let") and offset != HERE):
        element = element_name(ruleset, int(value_at(Expr("element", ELEMENT), at, place)))
    return Read(
        text,
        plain(ruleset, expr.kind, value),
        show_at_cell(ruleset, expr.kind, value),
        None if expr.op in ("param", "coordinate") else place,
        element,
        tuple(_counted(expr, at, place, substep)) if expr.op == "count" else (),
    )


def _counted(expr: Expr, at: reference.Context, place: Cell, substep: RecordedSubstep) -> Iterator[Cell]:
    """The neighbors that a count found: those with a weight where its argument holds."""
    holds = reference.evaluate(expr.args[0], at)
    kernel = expr.value
    for dy, dx, weight in kernel.weights[: 1 << 10]:
        there = substep.near(place, (dy, dx))
        inside = there == (place[0] + dy, place[1] + dx)
        if weight and (inside or kernel.wrap) and holds[(0, *there)]:
            yield there


def plain(ruleset: Ruleset, kind: Kind, value: Any) -> Any:
    """A cell's value as plain data: elements by name, directions as rules name them, the rest as numbers."""
    if kind.name == "element":
        return element_name(ruleset, int(value))
    if kind.name == "direction":
        return show_at_cell(ruleset, kind, value)
    if kind.name == "flag":
        return bool(value)
    numbers = np.asarray(value).tolist()
    return [_finite(one) for one in numbers] if isinstance(numbers, list) else _finite(numbers)


def _finite(number: float) -> float | str:
    """JSON has no infinities; values within a pass may be infinite."""
    return number if isfinite(number) else str(number)


def show_at_cell(ruleset: Ruleset, kind: Kind, value: Any) -> str:
    """A cell's value as a rule file would write it; draws in per cent, as chances are."""
    if kind.name in ("element", "flag", "direction"):
        return show_value(ruleset, kind, int(value))
    if kind.name == "chance":
        return show_value(ruleset, kind, float(value))
    if kind.name == "draw":
        return f"{float(value) * 100:.6g}%"
    if kind.name == "vec2":
        return "({:.7g}, {:.7g})".format(*(float(part) for part in value))
    return str(int(value)) if kind.name == "int" else f"{float(value):.7g}"


SCHEMA = 1
"""The version of the plain data. It increases when a key changes its meaning or is removed."""

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
    blocks += [_miss_text(trace, one, color) for one in shown]
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
        before, after = _values(trace, slot, trace.before[slot.name], trace.after[slot.name])
        rule = trace.writer(slot.name)
        by = f", by {rule.place}" if rule else ""
        lines.append(
            f"  {slot.name}: {before} -> {after}{by}"
            if before != after
            else f"  {slot.name}: {after}, as before"
        )
    if not any(write.rule for write in trace.writes):
        lines.append("  no rule wrote it")
    return "\n".join(map(printable, lines))


def _writes_text(trace: Trace, writes: list[Write], color: bool) -> str:
    lines = []
    for write in writes:
        if write.changed:
            before, after = _values(trace, write.slot, write.before, write.after)
            moved = f", moved here from {_at(write.source)}" if write.source else ""
            lines.append(_painted(f"{write.slot.name}: {before} -> {after}", "32;1", color) + moved)
    first = writes[0]
    rule, cell = first.rule, first.cell
    if rule is None or cell is None:
        return "\n".join([*lines, f"  = {HOW[first.how]}"])
    notes = [_rule_note(rule, cell, trace.cell), *(_part_text(part, cell) for part in first.parts)]
    return "\n".join([*lines, *_source(notes, Label(rule.span))])


def _miss_text(trace: Trace, miss: Miss, color: bool) -> str:
    span = miss.rule.span
    labels = [Label(part.span or span, _reads_text(part, miss.cell)) for part in miss.failed]
    if not labels:
        labels = [Label(span, "all of its condition holds: it gave way to a rule that claims a cell too")]
    elif all(label.span and label.span.line != span.line for label in labels):
        labels.append(Label(span, ""))
    notes = [_rule_note(miss.rule, miss.cell, trace.cell)]
    notes += [_part_text(part, miss.cell) for part in miss.parts if part.holds]
    head = _painted("almost" if len(miss.failed) <= 1 else "not", "33;1", color)
    but = " and ".join(f"`{part.text}`" for part in miss.failed) or f"`conflicts: {miss.policy}`"
    return "\n".join([f"{head}, but for {printable(but)}", *_source(notes, *labels)])


def _source(notes: list[str], *labels: Label) -> list[str]:
    """The source lines of labels, and notes below them."""
    lines, gutter = source_lines(labels)
    return [*lines, *(f"{' ' * gutter} = {printable(note)}" for note in notes)]


def _rule_note(rule: NumberedRule, asked: Cell, cell: Cell) -> str:
    label = f" ({rule.label})" if rule.label else ""
    where = f", asked at {_at(asked)}" if asked != cell else ""
    return f"pass {rule.pass_name} of {rule.pack}, substep {rule.moment + 1}{label}{where}"


def _part_text(part: Part, asked: Cell) -> str:
    """`holds: text; values`."""
    values = _reads_text(part, asked)
    come = f" (`{part.of}`, {place_of(part.span)})" if part.of and part.span else ""
    return f"{'holds' if part.holds else 'fails'}: {part.text}{come}{'; ' if values else ''}{values}"


def _reads_text(part: Part, asked: Cell) -> str:
    return ", ".join(_read_text(read, asked) for read in part.reads)


def _read_text(read: Read, asked: Cell) -> str:
    text = f"{read.text} is {read.shown}"
    there = _at(read.cell) if read.cell and read.cell != asked else ""
    where = " at ".join(filter(None, [read.element, there]))
    if read.counted:
        cells = " ".join(_at(cell) for cell in read.counted[:MAX_CELLS])
        where = cells + (" …" if len(read.counted) > MAX_CELLS else "")
    return f"{text} ({where})" if where else text


def _at(cell: Cell) -> str:
    """`row,column`."""
    return f"{cell[0]},{cell[1]}"


def _values(trace: Trace, slot: Slot, *values: object) -> list[str]:
    return [show_at_cell(trace.ruleset, slot.kind, value) for value in values]


def _painted(text: str, style: str, color: bool) -> str:
    return f"\x1b[{style}m{printable(text)}\x1b[0m" if color else printable(text)


# Plain data


def trace_data(trace: Trace) -> dict[str, Any]:
    """Rows and columns count from 0, steps, lines, columns of text, rules and substeps from 1."""
    return {
        "schema": SCHEMA,
        "ruleset": trace.ruleset.name,
        "world": trace.world,
        "cell": trace.cell,
        "step": trace.step,
        "slots": {
            slot.name: {
                "before": plain(trace.ruleset, slot.kind, trace.before[slot.name]),
                "after": plain(trace.ruleset, slot.kind, trace.after[slot.name]),
                "writer": _rule_data(trace.writer(slot.name)),
            }
            for slot in trace.slots
            if slot.name in trace.after
        },
        "writes": [
            {
                "slot": write.slot.name,
                "before": plain(trace.ruleset, write.slot.kind, write.before),
                "after": plain(trace.ruleset, write.slot.kind, write.after),
                "how": write.how,
                "rule": _rule_data(write.rule),
                "cell": write.cell,
                "source": write.source,
                "parts": list(map(_part_data, write.parts)),
            }
            for write in trace.writes
        ],
        "almost": [
            {
                "rule": _rule_data(miss.rule),
                "cell": miss.cell,
                "failed": list(map(_part_data, miss.failed)),
                "held": [_part_data(part) for part in miss.parts if part.holds],
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


def _part_data(part: Part) -> dict[str, Any]:
    return {
        "text": part.text,
        "holds": part.holds,
        "let": part.of or None,
        **_place(part.span),
        "reads": [
            {name: value for name, value in vars(read).items() if name != "shown"} for read in part.reads
        ],
    }


def _place(span: Span | None) -> dict[str, Any]:
    if span is None:
        return {"file": None, "line": None, "column": None}
    return {"file": span.source.name, "line": span.line, "column": span.column}
