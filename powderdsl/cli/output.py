"""What commands print: diagnostics, JSON, tables, and progress."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, Any, Protocol

import click

from powderdsl.diagnostics.printable import printable, printable_streams, unguarded, write_styled

if TYPE_CHECKING:
    from powderdsl.diagnostics import Diagnostic


def color_wanted(stream: IO[Any]) -> bool:
    """Whether to use color: on a terminal that supports it, and without NO_COLOR (https://no-color.org)."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def write_diagnostics(diagnostics: Iterable[Diagnostic], stream: IO[str]) -> None:
    """Write diagnostics as full texts with carets, separated by empty lines."""
    from powderdsl.diagnostics.render import render_text

    color = color_wanted(stream)
    write_styled(stream, "\n\n".join(render_text(one, color=color) for one in diagnostics) + "\n")


def print_json(value: Any) -> None:
    """Print a value as indented JSON."""
    import json

    click.echo(json.dumps(value, indent=2, ensure_ascii=False))


def counted(number: int, thing: str) -> str:
    """`no errors`, `1 error`, `2 errors`."""
    return f"{number or 'no'} {thing}{'' if number == 1 else 's'}"


# Tables


class Painted(str):
    """A cell with our own colors; in other cells, terminal codes are escaped."""


def table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines with aligned columns, the first row as heading; numbers are aligned to the right."""
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


# Progress

SECONDS = 30
"""Time between two lines where there is no terminal."""


class Show(Protocol):
    """Shows how much is done, with words beside it."""

    def __call__(self, done: float, words: str = "") -> None: ...


@contextmanager
def progress(title: str, total: float | None = None, *, lines: bool = False) -> Iterator[Show]:
    """A bar that disappears at the end; other output appears above it.

    Args:
        total: the final value of `done`. Without it the bar only shows that work continues, and for how long.
        lines: where stderr is not a terminal, write a line every `SECONDS`; otherwise nothing.
    """
    if not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        yield _lines(total) if lines else _silent
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    clock = TimeElapsedColumn() if total is None else TimeRemainingColumn(elapsed_when_finished=True)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), clock)
    console = Console(file=unguarded(sys.stderr), highlight=False, soft_wrap=True)
    shown = TextColumn("{task.fields[words]}", markup=False)
    # Inside, stderr is rich's, which prints above the bar: what goes there is escaped as well.
    with Progress(*columns, shown, console=console, transient=True) as bar, printable_streams():
        task = bar.add_task(printable(title), total=total, words="")

        def show(done: float, words: str = "") -> None:
            bar.update(task, completed=done, words=printable(words))

        yield show


def _silent(done: float, words: str = "") -> None:
    pass


def _lines(total: float | None) -> Show:
    last, of = time.monotonic(), "" if total is None else f" of {total:,.0f}"

    def show(done: float, words: str = "") -> None:
        nonlocal last
        if time.monotonic() - last > SECONDS:
            last = time.monotonic()
            click.echo(f"{done:,.0f}{of}  {words}".rstrip(), err=True)

    return show
