"""Statements without names and draws: shapes of integers, as scenes have them."""

from __future__ import annotations

from collections.abc import Sequence

from powderdsl.diagnostics import Reporter, Span
from powderdsl.worlds.raster import (
    Arch,
    Box,
    Container,
    Disk,
    Frame,
    Line,
    Paint,
    Ramp,
    Setting,
    Shape,
    Slice,
    Square,
    Wave,
)
from powderdsl.worlds.scene.statements import SETTING, STATEMENTS, Statement, read_setting, read_statement


def parse_statement(span: Span, reporter: Reporter) -> Paint | Setting | None:
    """The statement of a scene at `span`, or None after reporting bad syntax (PD605) or numbers (PD606)."""
    if ":=" in span.text:
        return _setting(span, reporter)
    found = read_statement(span, reporter)
    if found is None:
        return None
    faults = [*_beyond_scenes(found)]
    for place, label in faults:
        reporter.error("PD605", "a scene is the same every time", place, label, helps=(_usage(found),))
    if faults or found.choice is None:
        return None
    element = found.choice.names[0]
    numbers = [None if one is None else int(one.value or 0) for one in found.numbers]
    return Paint(element.text, shape_of(found.kind, numbers), found.span, element.span)


def _setting(span: Span, reporter: Reporter) -> Setting | None:
    found = read_setting(span, reporter)
    if found is None:
        return None
    drawn = (
        [one for one in found.shape.numbers if one is not None and not one.is_number] if found.shape else []
    )
    for amount in drawn:
        place = amount.span or found.span
        reporter.error(
            "PD605", "a scene is the same every time", place, "a number, written out", helps=(SETTING,)
        )
    if drawn:
        return None
    shape: Shape = Box()
    if found.shape is not None:
        numbers = [None if one is None else int(one.value or 0) for one in found.shape.numbers]
        shape = shape_of(found.shape.kind, numbers)
    return Setting(found.name.text, found.value.text, shape, found.span, found.name.span, found.value.span)


def _usage(statement: Statement) -> str:
    return STATEMENTS.get(statement.kind, "statements of scenes: " + ", ".join(STATEMENTS))


def _beyond_scenes(statement: Statement) -> list[tuple[Span, str]]:
    """What only generators of tasks may say, with its place."""
    if statement.kind not in STATEMENTS:
        return [(statement.span, f"`{statement.kind}` is a statement of tasks")]
    found = []
    if statement.choice is not None and statement.choice.how != "one":
        found.append((statement.choice.span, "one element, by its name"))
    for amount in statement.numbers:
        if amount is not None and not amount.is_number and amount.span is not None:
            found.append((amount.span, "a number, written out"))
    if statement.where is not None:
        found.append((statement.where.span, "a scene has no regions"))
    if statement.over is not None:
        found.append((statement.over.span, "a scene paints over everything"))
    return found


def shape_of(kind: str, numbers: Sequence[int | None]) -> Shape:
    """The shape that a statement's numbers (in the order of `statements.NUMBERS`) describe."""
    n = [0 if one is None else one for one in numbers]
    match kind:
        case "line":
            return Line((n[0], n[1]), (n[2], n[3]), n[4])
        case "disk":
            return Disk((n[0], n[1]), n[2])
        case "square":
            return Square((n[0], n[1]), n[2])
        case "ramp":
            return Ramp((n[0], n[1]), (n[2], n[3]))
        case "wave":
            return Wave(n[0], n[1], n[2], n[3])
        case "frame":
            return Frame()
        case "fill":
            return Box()
    rows: Slice = (n[0], numbers[1])
    columns: Slice = (n[2], numbers[3])
    match kind:
        case "box":
            return Box(rows, columns)
        case "arch":
            return Arch(rows, columns, n[4])
        case "container":
            return Container(rows, columns, n[4])
    raise AssertionError(f"no shape for {kind}")
