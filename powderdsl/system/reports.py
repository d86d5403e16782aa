"""Output of commands and studies: aligned tables."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

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
