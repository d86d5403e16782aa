"""Tables in plain text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import click

from powderdsl.diagnostics.printable import printable


class Painted(str):
    """A cell with colors of ours; what other cells have of a terminal's codes is escaped."""


def table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines with aligned columns, the first row as heading; numbers stand to the right."""
    if len(rows) < 2:
        yield "  none"
        return
    rows = [[cell if isinstance(cell, Painted) else printable(cell) for cell in row] for row in rows]
    widths = [max(_width(row[i]) for row in rows) for i in range(len(rows[0]))]
    right = [all(_bare(row[i]).isdigit() for row in rows[1:]) for i in range(len(rows[0]))]
    for row in rows:
        cells = []
        for cell, width, to_right in zip(row, widths, right, strict=True):
            gap = " " * (width - _width(cell))
            cells.append(gap + cell if to_right else cell + gap)
        yield ("  " + "  ".join(cells)).rstrip()


def _bare(cell: str) -> str:
    return click.unstyle(cell)


def _width(cell: str) -> int:
    return len(_bare(cell))
