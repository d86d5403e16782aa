"""How long work shows on stderr how far it is: a bar on a terminal, elsewhere a line now and then, or nothing."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import click

from powderdsl.diagnostics.printable import printable, printable_streams, unguarded

SECONDS = 30
"""Between two lines, where there is no terminal."""


class Show(Protocol):
    """Says how much is done, with words that stand beside it."""

    def __call__(self, done: float, words: str = "") -> None: ...


@contextmanager
def progress(title: str, total: float | None = None, *, lines: bool = False) -> Iterator[Show]:
    """A bar that goes at the end; what is printed meanwhile stands above it.

    Args:
        total: what `done` will be at the end. Without it the bar only says that something happens, and for how long.
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
