"""Output of commands and studies: aligned tables, and JSON of dataclasses."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from powderdsl.diagnostics.printable import printable

_STYLE = re.compile(r"\x1b\[[0-9;]*m")


class Painted(str):
    """A cell with our own colors; in other cells, terminal codes are escaped."""


def table(rows: Sequence[Sequence[str]], indent: str = "  ") -> Iterator[str]:
    """Lines with aligned columns, the first row as heading. Columns of numbers are aligned to the right."""
    if len(rows) < 2:
        yield f"{indent}none"
        return
    rows = [[cell if isinstance(cell, Painted) else printable(cell) for cell in row] for row in rows]
    widths = [max(map(_width, column)) for column in zip(*rows, strict=True)]
    right = [
        all(cell[:1].isdigit() or cell in ("", "?", "–") for cell in column[1:])
        for column in zip(*rows, strict=True)
    ]
    for row in rows:
        cells = []
        for cell, width, to_right in zip(row, widths, right, strict=True):
            gap = " " * (width - _width(cell))
            cells.append(gap + cell if to_right else cell + gap)
        yield (indent + "  ".join(cells)).rstrip()


def _width(cell: str) -> int:
    return len(_STYLE.sub("", cell))


def as_json(value: Any) -> str:
    """Indented JSON. A dataclass becomes an object with a key for each field, without the final `_` of a field such as
    `from_`."""
    import json

    return json.dumps(value, indent=2, ensure_ascii=False, default=_json_value)


def _json_value(value: Any) -> Any:
    if is_dataclass(value):
        return {field.name.rstrip("_"): getattr(value, field.name) for field in fields(value)}
    if isinstance(value, frozenset):
        return sorted(value)
    return str(value)
