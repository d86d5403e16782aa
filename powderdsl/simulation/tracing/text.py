"""A trace as text: like a diagnostic, the source line of each rule with a caret under what mattered."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby

from powderdsl.diagnostics import Label
from powderdsl.diagnostics.printable import printable
from powderdsl.diagnostics.render import source_lines
from powderdsl.model.state import Slot
from powderdsl.model.text import place_of
from powderdsl.model.types import Ruleset
from powderdsl.simulation.provenance import NumberedRule
from powderdsl.simulation.tracing.parts import Part, Read, show_at_cell
from powderdsl.simulation.tracing.scenes import Cell
from powderdsl.simulation.tracing.trace import Cause, Miss, Trace
from powderdsl.simulation.tracing.writes import HOW

MAX_MISSES = 12
"""Rules that nearly happened which a text shows, unless all are asked for."""

MAX_CELLS = 9
"""Cells that a count names in a text."""


def trace_text(trace: Trace, *, color: bool = False, every_rule: bool = False) -> str:
    """The whole trace. Ends without a line break."""
    blocks = [_head(trace)]
    for _, group in groupby(trace.causes, key=_event):
        causes = list(group)
        if any(one.write.changed for one in causes):
            blocks.append(_cause(trace, causes, color))
    if again := list(_written_again(trace)):
        blocks.append("\n".join(["written again, as it was:", *again]))
    shown = trace.misses if every_rule else trace.misses[:MAX_MISSES]
    blocks += [_miss(trace, one, color) for one in shown]
    if len(shown) < len(trace.misses):
        blocks.append(f"{len(trace.misses) - len(shown)} more rules nearly happened: --all")
    return "\n\n".join(blocks)


def _event(cause: Cause) -> tuple[int, int, object]:
    """What the writes of one rule in one substep have in common."""
    write = cause.write
    return (
        id(write.scene),
        write.rule.number if write.rule else 0,
        write.how if write.rule is None else write.cell,
    )


def _head(trace: Trace) -> str:
    lines = [f"cell {at(trace.cell)} in step {trace.step} of {trace.ruleset.name}"]
    for slot in trace.slots:
        if slot.name not in trace.after:
            continue  # a scratch field lives in its pass
        before, after = (_value(trace.ruleset, slot, held[slot.name]) for held in (trace.before, trace.after))
        rule = trace.writer(slot.name)
        by = f", by {rule.place}" if rule else ""
        change = f"{before} -> {after}" if before != after else f"{after}, as before"
        lines.append(f"  {slot.name}: {change}{by if before != after else ''}")
    if not any(one.write.rule for one in trace.causes):
        lines.append("  no rule wrote it")
    return "\n".join(map(printable, lines))


def _cause(trace: Trace, causes: list[Cause], color: bool) -> str:
    lines = []
    for one in causes:
        write = one.write
        if write.changed:
            before, after = (_value(trace.ruleset, write.slot, held) for held in (write.before, write.after))
            moved = f", moved here from {at(write.source)}" if write.source else ""
            lines.append(_painted(f"{write.slot.name}: {before} -> {after}", "32;1", color) + moved)
    first = causes[0]
    rule = first.write.rule
    if rule is None:
        return "\n".join([*lines, f"  = {HOW[first.write.how]}"])
    places, gutter = source_lines([Label(rule.span)])
    margin = " " * gutter
    notes = [_rule_note(rule, first.write.cell, trace.cell)]
    notes += [_part_text(part, first.write.cell) for part in first.parts]
    return "\n".join([*lines, *places, *(f"{margin} = {printable(note)}" for note in notes)])


def _written_again(trace: Trace) -> Iterator[str]:
    """Writes that changed nothing, a line a rule."""
    for _, group in groupby(trace.causes, key=_event):
        causes = list(group)
        rule = causes[0].write.rule
        if rule is not None and not any(one.write.changed for one in causes):
            names = ", ".join(dict.fromkeys(one.write.slot.name for one in causes))
            yield printable(f"  {names}: {rule.place}, pass {rule.pass_name}")


def _miss(trace: Trace, miss: Miss, color: bool) -> str:
    notes = [_rule_note(miss.rule, miss.cell, trace.cell)]
    if not miss.failed:
        labels = [
            Label(miss.rule.span, "all of its condition holds: it gave way to a rule that claims a cell too")
        ]
    else:
        labels = []
        for part in miss.failed:
            labels.append(Label(part.span or miss.rule.span, _reads_text(part, miss.cell)))
        if all(label.span and label.span.line != miss.rule.span.line for label in labels):
            labels.append(Label(miss.rule.span, ""))
    notes += [_part_text(part, miss.cell) for part in miss.parts if part.holds]
    places, gutter = source_lines(labels)
    head = _painted("almost" if len(miss.failed) <= 1 else "not", "33;1", color)
    but = " and ".join(f"`{part.text}`" for part in miss.failed) or f"`conflicts: {miss.policy}`"
    return "\n".join(
        [
            f"{head}, but for {printable(but)}",
            *places,
            *(f"{' ' * gutter} = {printable(one)}" for one in notes),
        ]
    )


def _rule_note(rule: NumberedRule, asked: Cell | None, cell: Cell) -> str:
    label = f" ({rule.label})" if rule.label else ""
    where = f", asked at {at(asked)}" if asked not in (None, cell) else ""
    return f"pass {rule.pass_name} of {rule.pack}, substep {rule.moment + 1}{label}{where}"


def _part_text(part: Part, asked: Cell | None) -> str:
    """`holds: text; values`."""
    values = _reads_text(part, asked)
    come = f" (`{part.of}`, {place_of(part.span)})" if part.of and part.span else ""
    return f"{'holds' if part.holds else 'fails'}: {part.text}{come}{'; ' if values else ''}{values}"


def _reads_text(part: Part, asked: Cell | None) -> str:
    return ", ".join(_read_text(read, asked) for read in part.reads)


def _read_text(read: Read, asked: Cell | None) -> str:
    text = f"{read.text} is {read.shown}"
    there = at(read.cell) if read.cell and read.cell != asked else ""
    where = " at ".join(filter(None, [read.element, there])) if there else read.element or ""
    if read.counted:
        cells = " ".join(at(cell) for cell in read.counted[:MAX_CELLS])
        where = cells + (" …" if len(read.counted) > MAX_CELLS else "")
    return f"{text} ({where})" if where else text


def at(cell: Cell | None) -> str:
    """`row,column`."""
    return "" if cell is None else f"{cell[0]},{cell[1]}"


def _value(ruleset: Ruleset, slot: Slot, value: object) -> str:
    return show_at_cell(ruleset, slot.kind, value)


def _painted(text: str, style: str, color: bool) -> str:
    return f"\x1b[{style}m{printable(text)}\x1b[0m" if color else printable(text)
