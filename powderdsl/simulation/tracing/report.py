"""A trace as text, like a diagnostic with carets under what mattered, and as plain data for JSON."""

from __future__ import annotations

from itertools import groupby
from typing import Any

from powderdsl.diagnostics import Label, Span
from powderdsl.diagnostics.printable import printable
from powderdsl.diagnostics.render import source_lines
from powderdsl.model.state import Slot
from powderdsl.model.text import one_line, place_of
from powderdsl.simulation.provenance import NumberedRule
from powderdsl.simulation.tracing.trace import HOW, Cell, Miss, Part, Read, Trace, Write, plain, show_at_cell

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
