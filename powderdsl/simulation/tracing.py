"""Explanations of cells: the rules that wrote their values, and the rules that nearly did.

`trace` explains one cell in one step, by the writes of the reference interpreter.

`Recorder` finds the rule that last wrote the element of each cell of a batch, on any backend and device. It adds a
field to the rules, which every rule that writes an element sets to its own number. Backends need no support for it, and
ordinary simulators do not change.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count, groupby, islice
from math import isfinite
from typing import Any

from powderdsl.arrays import np
from powderdsl.diagnostics import Label, Span, with_suggestion
from powderdsl.diagnostics.diagnostic import source_lines
from powderdsl.diagnostics.printable import printable
from powderdsl.model import reference
from powderdsl.model.expressions.operators import TRUE, look
from powderdsl.model.state import Slot, scratch_slots, slot_name
from powderdsl.model.text import element_name, one_line, place_of, show_expr, show_offset, show_value
from powderdsl.model.types import (
    FLAG,
    Assign,
    Expr,
    Field,
    Kind,
    Let,
    Move,
    Offset,
    Rule,
    Ruleset,
    Substep,
    Swap,
    Transform,
    integer,
)
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.targets.array_kind import Array

Cell = tuple[int, int]
"""(row, column)."""

HERE: Offset = (0, 0)

_WITHOUT_RULE = {
    "limit": "no rule: cells of this element keep the field's default",
    "clamp": "no rule: at the end of a pass, floats are clamped to their range and tiny ones become zero",
    "reset": "no rule: the field starts each step at its default",
}
"""Writes without a rule, by kind. Other kinds: ``assign``, ``effect``, ``become``, ``leave``, ``arrive``."""


@dataclass(frozen=True)
class NumberedRule:
    """A rule of the checked model. With loops and symmetries, one line of a file makes several rules.

    `number` counts rules from 1 in the order in which they run; `substep` counts the pass's substeps from 1; `label` has
    the loop variables, such as ``side = left``.
    """

    number: int
    pack: str
    pass_name: str
    substep: int
    label: str
    rule: Rule

    @property
    def span(self) -> Span:
        """The rule's location in its file."""
        return self.rule.span

    @property
    def place(self) -> str:
        """The rule's position as text: `file:line`."""
        return place_of(self.span)


def numbered_rules(ruleset: Ruleset) -> tuple[NumberedRule, ...]:
    """All rules in the order in which they run; rule number n is at index n − 1."""
    rules: list[NumberedRule] = []
    for pass_ in ruleset.passes:
        for position, substep in enumerate(pass_.substeps, 1):
            where = pass_.pack, pass_.name, position, substep.label
            rules += [NumberedRule(i, *where, rule) for i, rule in enumerate(substep.rules, len(rules) + 1)]
    return tuple(rules)


# Substeps and writes


@dataclass(frozen=True, eq=False)
class RecordedSubstep:
    """A recorded substep: the state before it, and its rules. Arrays have a batch of one.

    `rules`, and `masks` of the cells where they fired, are keyed by `id`; `lets` maps each `let` so far to the substep
    that fixed it.
    """

    policy: str
    rules: Mapping[int, NumberedRule]
    masks: Mapping[int, Array]
    at: reference.Context
    lets: dict[str, tuple[Let, RecordedSubstep]]

    def neighbor_of(self, cell: Cell, offset: Offset, way: int = 1) -> Cell:
        """The neighbor of a cell or, with -1, the cell whose neighbor it is; the grid wraps around."""
        _, height, width = self.at.shape
        return (cell[0] + way * offset[0]) % height, (cell[1] + way * offset[1]) % width

    def value(self, expr: Expr, cell: Cell) -> Any:
        """An expression's value in a cell: see `pick`."""
        return pick(reference.evaluate(expr, self.at), cell)


@dataclass(frozen=True)
class Attempt:
    """A rule of a substep, and the cell in which its condition was evaluated."""

    rule: NumberedRule
    substep: RecordedSubstep
    cell: Cell

    @property
    def happened(self) -> bool:
        return bool(self.substep.masks[id(self.rule.rule)][(0, *self.cell)])

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """The parts of the condition, split at each `and`. Flags fixed by `let` are split too."""
        return tuple(_split(Part(self.rule.rule.mask, self.substep, self.cell)))

    @property
    def failed(self) -> tuple[Part, ...]:
        """The parts that failed. If none did, the rule fired or lost a conflict with another rule."""
        return tuple(part for part in self.parts if not part.holds)

    @property
    def held(self) -> tuple[Part, ...]:
        return tuple(part for part in self.parts if part.holds)

    @property
    def gave_way(self) -> str | None:
        """The policy of `conflicts:` by which the rule lost, or None."""
        return None if self.happened or self.failed else self.substep.policy


@dataclass(frozen=True)
class Change:
    """A slot of the cell before and after a write. Values are NumPy numbers, or pairs of them for vectors."""

    slot: Slot
    before: Any
    after: Any

    @property
    def changed(self) -> bool:
        return not np.array_equal(self.before, self.after)


@dataclass(frozen=True)
class Write(Change):
    """One write to a slot of the cell, by a rule or by none.

    `source` is the cell from which the contents moved here.
    """

    how: str
    attempt: Attempt | None = None
    source: Cell | None = None


class RecordedStep:
    """The next step of a batch of one world, with default parameters: its substeps, and all writes to one cell, in order.

    All slots are included, even scratch fields. Each write starts from the result of the previous one; the last result
    is that of the step. States are those of the reference: integers int64, floats float32, [1, H, W] or [1, 2, H, W].
    """

    def __init__(self, world: World, cell: Cell):
        ruleset, to_numpy = world.sim.ruleset, world.sim.kind.to_numpy
        state = {name: to_numpy(value) for name, value in world.state.items()}
        clock = reference.Clock(*(to_numpy(part) for part in (world.seed, world.index, world.step)))
        self.cell, self.substeps, self.writes = cell, list[RecordedSubstep](), list[Write]()
        self._rules = iter(numbered_rules(ruleset))
        self.begin = reference.widen(ruleset, state)
        params = reference.parameters(ruleset, 1, {})
        self.end = reference.widen(ruleset, reference.step(ruleset, state, clock, params, watch=self))

    def begins(self, substep: Substep, at: reference.Context, masks: Mapping[int, Array]) -> None:
        """Record a substep: see `reference.Watch`."""
        rules = {id(numbered.rule): numbered for numbered in islice(self._rules, len(substep.rules))}
        lets = dict(self.substeps[-1].lets) if self.substeps else {}
        recorded = RecordedSubstep(substep.policy, rules, masks, replace(at, lets=dict(at.lets)), lets)
        lets.update({let.name: (let, recorded) for let in substep.lets})
        self.substeps.append(recorded)

    def wrote(self, change: reference.Change, before: Array, after: Array, mask: Array | None = None) -> None:
        """Record a write to the cell, if it has a rule or changes something."""
        attempt = source = None
        if change.rule is not None and mask is not None:
            if not mask[(0, *self.cell)]:
                return
            substep = self.substeps[-1]
            asked = substep.neighbor_of(self.cell, change.origin)
            attempt = Attempt(substep.rules[id(change.rule)], substep, asked)
            source = None if change.source is None else substep.neighbor_of(self.cell, change.source)
        old, new = pick(before, self.cell), pick(after, self.cell)
        write = Write(change.slot, old, new, change.how, attempt, source)
        if attempt or write.changed:
            self.writes.append(write)


def pick(array: Array, cell: Cell) -> Any:
    """One cell's value of a reference array: a NumPy number, or two numbers of a vector."""
    return array[0, ..., cell[0], cell[1]]


# Conditions


@dataclass(frozen=True)
class Read:
    """One value that a condition read. `cell` is its cell, None for parameters.

    `value` is plain data, `shown` its notation in a rule file. `element` is the cell's element, if relevant. `counted`
    lists the cells that a count includes.
    """

    text: str
    value: Any
    shown: str
    cell: Cell | None
    element: str | None
    counted: tuple[Cell, ...]


@dataclass(frozen=True, eq=False)
class Part:
    """One of the conditions that must all hold in a cell for a rule to fire.

    `substep` has the state that it reads; `let` is the `let` that contains it.
    """

    expr: Expr
    substep: RecordedSubstep
    cell: Cell
    let: str | None = None

    @property
    def text(self) -> str:
        """The condition in the notation of rule files."""
        return show_expr(self.substep.at.ruleset, self.expr)

    @cached_property
    def holds(self) -> bool:
        """True if the condition is met in the cell."""
        return bool(self.substep.value(self.expr, self.cell))

    @cached_property
    def reads(self) -> tuple[Read, ...]:
        """All values that the condition read, without repetitions."""
        reads: dict[str, Read] = {}
        for read in _reads(self.expr, self.substep, self.cell, HERE):
            reads.setdefault(read.text, read)
        return tuple(reads.values())


def _split(part: Part) -> Iterator[Part]:
    expr = part.expr
    if expr.op == "and":
        for arg in expr.args:
            yield from _split(replace(part, expr=arg))
    elif expr.op == "let" and expr.kind == FLAG:
        let, substep = part.substep.lets[expr.value]
        yield from _split(Part(let.value, substep, part.cell, _written(let.name)))
    elif not (expr.op == "const" and expr.value):
        yield part


def _reads(expr: Expr, substep: RecordedSubstep, cell: Cell, offset: Offset) -> Iterator[Read]:
    """The values that an expression reads when it is evaluated `offset` away from the cell."""
    if expr.op == "look":
        dy, dx = expr.value
        yield from _reads(expr.args[0], substep, cell, (offset[0] + dy, offset[1] + dx))
    elif expr.args and expr.op not in ("count", "sum"):
        for arg in expr.args:
            yield from _reads(arg, substep, cell, offset)
    elif expr.op != "const":
        yield _read(expr, substep, substep.neighbor_of(cell, offset), offset)
        if expr.op == "let":
            let, fixed = substep.lets[expr.value]
            yield from _reads(let.value, fixed, cell, offset)


def _read(expr: Expr, substep: RecordedSubstep, place: Cell, offset: Offset) -> Read:
    ruleset, state, value = substep.at.ruleset, substep.at.state, substep.value(expr, place)
    away, element, counted = offset != HERE, None, []
    if expr.op == "property" or (away and expr.op in ("field", "let")):
        element = element_name(ruleset, int(pick(state["element"], place)))
    if expr.op == "count":  # the neighbors with a weight where the argument holds
        holds, kernel = reference.evaluate(expr.args[0], substep.at), expr.value
        for dy, dx, weight in kernel.weights:
            there = substep.neighbor_of(place, (dy, dx))
            inside = there == (place[0] + dy, place[1] + dx)
            if weight and (inside or kernel.wrap) and pick(holds, there):
                counted.append(there)
    shown = plain(ruleset, expr.kind, value), show_at_cell(ruleset, expr.kind, value)
    text = show_offset(offset) if away and expr.op == "element" else show_expr(ruleset, look(expr, offset))
    where = None if expr.op in ("param", "coordinate") else place
    return Read(_written(text), *shown, where, element, tuple(counted))


def _written(name: str) -> str:
    """The name of a `let` in the file, without the number of a copy under loops."""
    return name.partition("#")[0]


def plain(ruleset: Ruleset, kind: Kind, value: Any) -> Any:
    """A cell's value as plain data: elements and directions by name, other values as numbers.

    Infinities, which may occur within a pass, become text, since JSON lacks them.
    """
    if kind.name in ("element", "direction"):
        return show_at_cell(ruleset, kind, value)
    numbers = [number if isfinite(number) else str(number) for number in value.reshape(-1).tolist()]
    return numbers if kind.name == "vec2" else numbers[0]


def show_at_cell(ruleset: Ruleset, kind: Kind, value: Any) -> str:
    """A cell's value in the notation of rule files; draws are in percent, like chances."""
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
class Trace:
    """One cell in one step, for some slots.

    `slots` are the slots before and after the step, without scratch fields, which exist only within a pass. `misses`
    are rules that would have written the cell but did not fire.
    """

    ruleset: Ruleset
    world: int
    cell: Cell
    step: int
    slots: tuple[Change, ...]
    writes: tuple[Write, ...]
    misses: tuple[Attempt, ...]

    def writer(self, slot: str = "element") -> NumberedRule | None:
        """The rule that last wrote a slot; None if no rule did."""
        rules = [write.attempt.rule for write in self.writes if write.slot.name == slot and write.attempt]
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
    """Explain the values of a cell after a step.

    Args:
        world: the batch before the first step. Its simulator runs all steps but the last.
        row: the cell's row, from 0.
        column: its column, from 0.
        step: the number of the step to explain, from 1.
        number: the index of the world in the batch.
        of: names of slots: the element, fields, and scratch fields such as ``pass.name``. By default, all but scratch
            fields.
        every_rule: include rules that failed in several parts of their condition, or concern other elements.

    Raises:
        IndexError: the world has no such cell, or the batch no such world.
        ValueError: a step below 1.
        KeyError: an unknown name, or a property that follows from the element.
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
    recorded = RecordedStep(world.sim.step(alone, step - 1), cell)
    writes = tuple(write for write in recorded.writes if write.slot.name in slots)
    misses = _misses(recorded, slots.values(), every_rule)
    if not every_rule:
        lines = {_line(write.attempt.rule) for write in writes if write.attempt}
        misses = tuple(miss for miss in misses if _line(miss.rule) not in lines)
    begin, end = recorded.begin, recorded.end
    names = [name for name in slots if name in end]
    changes = tuple(Change(slots[name], pick(begin[name], cell), pick(end[name], cell)) for name in names)
    return Trace(world.sim.ruleset, number, cell, int(alone.step[0]) + step, changes, writes, misses)


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
            raise KeyError(with_suggestion(f"no field `{name}`", name, known, "fields"))
    return {name: known[name] for name in wanted}


def _line(rule: NumberedRule) -> tuple[Span, str]:
    """A key shared by all rules of one line in one pass."""
    return rule.span, rule.pass_name


def _misses(step: RecordedStep, slots: Iterable[Slot], every_rule: bool) -> tuple[Attempt, ...]:
    """Rules that would have written the cell but did not fire; one per line and cell, unless `every_rule`."""
    misses: dict[Any, Attempt] = {}
    for substep in step.substeps:
        for numbered in substep.rules.values():
            offsets = [offset for slot in slots for offset in _writes_at(numbered.rule, slot)]
            for place in dict.fromkeys(substep.neighbor_of(step.cell, offset, -1) for offset in offsets):
                attempt = Attempt(numbered, substep, place)
                key = (numbered.number if every_rule else _line(numbered), place)
                if key not in misses and not attempt.happened and (every_rule or _nearly(attempt)):
                    misses[key] = attempt
    return tuple(misses.values())


def _nearly(attempt: Attempt) -> bool:
    """True if at most one part of a condition failed, not counting the test of the cell's element."""
    failed = list(islice((part.expr for part in attempt.parts if not part.holds), 2))
    if len(failed) != 1:
        return not failed
    return len(attempt.parts) > 1 and not (failed[0].op == "member" and failed[0].args[0].op == "element")


def _writes_at(rule: Rule, slot: Slot) -> Iterator[Offset]:
    """The offsets at which a rule writes a slot, from the cell in which its condition holds."""
    assigns = [rule] if isinstance(rule, Assign) else rule.effects
    yield from (assign.offset for assign in assigns if assign.field == slot.name)
    if slot.travels:
        yield from (offset for _, offset in _element_writes(rule))


def _element_writes(rule: Rule) -> list[tuple[bool, Offset]]:
    """The offsets at which a rule writes elements and their fields; True for arrivals, which are applied last."""
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
"""Maximum number of cells that a text lists for a count."""


def trace_text(trace: Trace, *, color: bool = False) -> str:
    """The whole trace as text without a final line break. `color`: with terminal escape codes."""
    blocks = [_head(trace)]
    # All writes of one rule in one substep are one block.
    events = groupby(trace.writes, lambda write: (write.attempt, _WITHOUT_RULE.get(write.how)))
    blocks += [_writes_text(trace, list(writes), color) for _, writes in events]
    blocks += [_miss_text(trace, miss, color) for miss in trace.misses]
    return "\n\n".join(blocks)


def _change(trace: Trace, change: Change) -> str:
    name, kind = change.slot.name, change.slot.kind
    old, new = (show_at_cell(trace.ruleset, kind, value) for value in (change.before, change.after))
    return f"{name}: {new}, as before" if old == new else f"{name}: {old} -> {new}"


def _head(trace: Trace) -> str:
    lines = [f"cell {_at(trace.cell)} in step {trace.step} of {trace.ruleset.name}"]
    for slot in trace.slots:
        change, rule = _change(trace, slot), trace.writer(slot.slot.name)
        lines.append(f"  {change}, by {rule.place}" if rule and " -> " in change else f"  {change}")
    if not any(write.attempt for write in trace.writes):
        lines.append("  no rule wrote it")
    return "\n".join(map(printable, lines))


def _writes_text(trace: Trace, writes: list[Write], color: bool) -> str:
    lines, attempt = [], writes[0].attempt
    for write in writes:
        if write.changed:
            moved = f", moved here from {_at(write.source)}" if write.source else ""
            lines.append(_painted(_change(trace, write), "32;1", color) + moved)
    if not lines:
        names = dict.fromkeys(write.slot.name for write in writes)
        lines = [f"{printable(', '.join(names))}: written again, as before"]
    if attempt is None:
        return "\n".join([*lines, f"  = {_WITHOUT_RULE[writes[0].how]}"])
    return "\n".join([*lines, *_source(trace, attempt, [Label(attempt.rule.span)])])


def _miss_text(trace: Trace, miss: Attempt, color: bool) -> str:
    span, failed = miss.rule.span, miss.failed
    labels = [Label(part.expr.span or span, _reads_text(part)) for part in failed]
    if not labels:
        labels = [
            Label(span, "its whole condition holds, but it lost to another rule that claims the same cell")
        ]
    elif all(label.span and label.span.line != span.line for label in labels):
        labels.append(Label(span, ""))
    head = _painted("almost" if len(failed) <= 1 else "not", "33;1", color)
    but = " and ".join(f"`{part.text}`" for part in failed) or f"`conflicts: {miss.gave_way}`"
    return "\n".join([f"{head}, but for {printable(but)}", *_source(trace, miss, labels)])


def _source(trace: Trace, attempt: Attempt, labels: list[Label]) -> list[str]:
    """The source lines of labels, then the rule and the parts of its condition that hold."""
    rule = attempt.rule
    label = f" ({rule.label})" if rule.label else ""
    where = f", asked at {_at(attempt.cell)}" if attempt.cell != trace.cell else ""
    notes = [f"pass {rule.pass_name} of {rule.pack}, substep {rule.substep}{label}{where}"]
    for part in attempt.held:
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
    """The trace as plain data for JSON; docs/tracing.md describes its keys.

    Rows and columns are counted from 0; steps, lines, text columns, rules and substeps from 1.
    """

    def values(change: Change) -> dict[str, Any]:
        kind, both = change.slot.kind, {"before": change.before, "after": change.after}
        return {key: plain(trace.ruleset, kind, value) for key, value in both.items()}

    return {
        "schema": SCHEMA,
        "ruleset": trace.ruleset.name,
        "world": trace.world,
        "cell": trace.cell,
        "step": trace.step,
        "slots": {
            change.slot.name: values(change) | {"writer": _data(trace.writer(change.slot.name))}
            for change in trace.slots
        },
        "writes": [
            {"slot": write.slot.name, **values(write), "how": write.how, "source": write.source}
            | (_attributes(write.attempt, "rule", "cell", "parts") if write.attempt else _NO_ATTEMPT)
            for write in trace.writes
        ],
        "almost": [_attributes(miss, "rule", "cell", "failed", "held", "gave_way") for miss in trace.misses],
    }


_NO_ATTEMPT: dict[str, Any] = {"rule": None, "cell": None, "parts": []}


def _attributes(value: object, *names: str) -> dict[str, Any]:
    return {name: _data(getattr(value, name)) for name in names}


def _data(value: Any) -> Any:
    """Rules, parts of conditions and their reads, as plain data."""
    match value:
        case tuple():
            return [_data(item) for item in value]
        case NumberedRule():
            numbered = _attributes(value, "number", "pack", "substep", "label")
            return numbered | {"pass": value.pass_name, "text": one_line(value.span), **_place(value.span)}
        case Part():
            return _attributes(value, "text", "holds", "let", "reads") | _place(value.expr.span)
        case Read():
            return _attributes(value, "text", "value", "cell", "element", "counted")
    return value


def _place(span: Span | None) -> dict[str, Any]:
    if span is None:
        return {"file": None, "line": None, "column": None}
    return {"file": span.source.name, "line": span.line, "column": span.column}


# All cells at once

SLOT = "last writer"
"""The field of the numbers. Names in rule files have no spaces, so there is no conflict."""


@dataclass(frozen=True)
class Provenance:
    """Worlds after a step, and the rules that wrote their elements.

    `numbers` is int16 [B, H, W] on the worlds' device: the number of the rule in `rules` that last wrote the element
    of a cell in the last step, 0 where none did. Rewriting the same element counts too.
    """

    world: World
    numbers: Array
    rules: tuple[NumberedRule, ...]

    def rule_at(self, row: int, column: int, world: int = 0) -> NumberedRule | None:
        """The rule that last wrote a cell's element, or None. Raises IndexError beyond the grid or batch."""
        number = int(self.numbers[world, row, column])
        return self.rules[number - 1] if number else None


class Recorder:
    """Steps worlds of a simulator and records the rules that wrote their elements. Recompiles the rules once."""

    def __init__(self, sim: Simulator):
        self.sim = sim
        self.rules = numbered_rules(sim.ruleset)
        self._marked = sim.of(_with_rule_marks(sim.ruleset))

    def step(self, world: World, steps: int = 1, **options: Any) -> Provenance:
        """Step worlds as `Simulator.step` does, with the same options, results and errors.

        After 0 steps, all numbers are 0.
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


def _with_rule_marks(ruleset: Ruleset) -> Ruleset:
    """The rules with a field for the number of the rule that last wrote a cell's element in this step."""
    numbers, passes = count(1), []
    for pass_ in ruleset.passes:
        substeps = []
        for substep in pass_.substeps:
            rules, late = list(substep.rules), list[tuple[bool, Assign]]()
            for place, rule in enumerate(substep.rules):
                number, writes = next(numbers), _element_writes(rule)
                mark = Expr("const", integer(number, number), value=number)
                if substep.policy in ("prove", "overwrite"):  # all rules fire where their conditions hold
                    for arrives, at in writes:
                        late.append((arrives, Assign(SLOT, at, ":=", mark, rule.mask, rule.span)))
                elif not isinstance(rule, Assign):  # each claimed cell has one writer
                    marks = (Assign(SLOT, at, ":=", mark, TRUE, rule.span) for _, at in writes)
                    rules[place] = replace(rule, effects=(*rule.effects, *marks))
            rules += [mark for _, mark in sorted(late, key=lambda mark: mark[0])]
            substeps.append(replace(substep, rules=tuple(rules)))
        passes.append(replace(pass_, substeps=tuple(substeps)))
    kind = integer(0, max(1, next(numbers) - 1))
    slot = Field(SLOT, kind, 0, "place", True, None, ruleset.elements[0].pack, ruleset.elements[0].span)
    return replace(ruleset, fields=(*ruleset.fields, slot), passes=tuple(passes))
