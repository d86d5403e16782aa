"""Located YAML -> colors and ramps, as written."""

from __future__ import annotations

import re

from powderdsl.model.declarations import RampDecl
from powderdsl.model.schema import Reader
from powderdsl.syntax.parse import parse_scalar
from powderdsl.syntax.yaml_tree import Node, Scalar

Entries = dict[str, tuple[Scalar, Node]]


def color_of(reader: Reader, entries: Entries, key: str) -> str | None:
    """The color under a key, ``#RRGGBB``; None where there is none, which is reported if it should be one."""
    color = reader.scalar(entries, key)
    if color is None or re.fullmatch(r"#[0-9A-Fa-f]{6}", color.text):
        return color.text.upper() if color else None
    helps = [f'six hexadecimal digits in quotes: {key}: "#RRGGBB"']
    reader.reporter.error(
        "PD110", f"`{color.text}` is not a color", color.span, 'expected "#RRGGBB"', helps=helps
    )
    return None


def read_ramp(reader: Reader, entries: Entries, what: str) -> RampDecl | None:
    """The `color_by:` of an element's entries; None where there is none, or it lacks something, which is reported."""
    if "color_by" not in entries:
        return None
    key, node = entries["color_by"]
    found = reader.mapping(node, "color_by", f"`color_by` of {what}")
    over = reader.scalar(found, "over")
    line = parse_scalar(over, "expression", reader.reporter) if over else None
    start, end = color_of(reader, found, "from"), color_of(reader, found, "to")
    field = reader.scalar(found, "field")
    if field is None or end is None:
        return None
    return RampDecl(key, field, start, end, line)
