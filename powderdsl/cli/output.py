"""Output of commands: diagnostics, JSON, and progress."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from shlex import quote
from typing import IO, TYPE_CHECKING, Any

import click

from powderdsl.diagnostics.printable import printable, printable_streams, raw_stream, write_styled
from powderdsl.system.reports import as_json

if TYPE_CHECKING:
    from powderdsl.diagnostics import Diagnostic


def color_wanted(stream: IO[Any]) -> bool:
    """True if output should be colored: on a terminal that supports it, or with FORCE_COLOR, and never with NO_COLOR."""
    if os.environ.get("NO_COLOR") or os.environ.get("FORCE_COLOR"):
        return not os.environ.get("NO_COLOR")
    return stream.isatty() and os.environ.get("TERM") != "dumb"


def write_diagnostics(diagnostics: Iterable[Diagnostic], stream: IO[str]) -> None:
    """Write diagnostics as full texts with carets, separated by empty lines."""
    from powderdsl.diagnostics.diagnostic import render_text

    color = color_wanted(stream)
    texts = (render_text(diagnostic, color=color) for diagnostic in diagnostics)
    write_styled(stream, "\n\n".join(texts) + "\n")


def print_json(value: Any) -> None:
    """Print a value as indented JSON; dataclasses are objects (`system.reports.as_json`)."""
    click.echo(as_json(value))


def counted(number: int, thing: str, things: str = "") -> str:
    """`no errors`, `1 error`, `2 errors`; `things` is the plural of words without a simple one."""
    return f"{number or 'no'} {thing if number == 1 else things or f'{thing}s'}"


# Progress

SECONDS = 30
"""Time between two lines where there is no terminal."""


Show = Callable[..., None]
"""``show(done, words="")`` shows how much is done, with words beside it."""


@contextmanager
def progress(
    title: str, total: float, *, lines: bool = False, resumes: Path | None = None, rounds: int = 0
) -> Iterator[Show]:
    """A bar that disappears at the end; other output appears above it.

    Args:
        total: the final value of `done`.
        lines: where stderr is not a terminal, write a line every `SECONDS`; otherwise nothing.
        resumes: the folder in which the same command continues after an interruption; a line then says so.
        rounds: the work between two pauses, such as updates of a network, that the remaining time has to count.
    """
    try:
        with _bar(title, total, lines, rounds) as show:
            yield show
    except KeyboardInterrupt:
        if resumes is not None:
            click.echo(f"interrupted; the same command continues in {quote(str(resumes))}", err=True)
        raise


@contextmanager
def _bar(title: str, total: float, lines: bool, rounds: int) -> Iterator[Show]:
    if not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        last = time.monotonic()

        def show_line(done: float, words: str = "") -> None:
            nonlocal last
            if lines and time.monotonic() - last > SECONDS:
                last = time.monotonic()
                click.echo(f"{done:,.0f} of {total:,.0f}  {words}".rstrip(), err=True)

        yield show_line
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    clock: ProgressColumn = TimeRemainingColumn(elapsed_when_finished=True)
    remaining = Remaining(total, rounds)
    if rounds:
        clock = TextColumn("{task.fields[left]}")
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), clock)
    console = Console(file=raw_stream(sys.stderr), highlight=False, soft_wrap=True)
    shown = TextColumn("{task.fields[words]}", markup=False)
    # Inside, stderr is rich's, which prints above the bar: what goes there is escaped as well.
    with Progress(*columns, shown, console=console, transient=True) as bar, printable_streams():
        task = bar.add_task(printable(title), total=total, words="", left="")

        def show(done: float, words: str = "") -> None:
            left = remaining.after(done, time.monotonic()) if rounds else ""
            bar.update(task, completed=done, words=printable(words), left=left)

        yield show


class Remaining:
    """The time that work takes that pauses after every `rounds` of it, judged by whole rounds."""

    def __init__(self, total: float, rounds: int):
        self.total, self.rounds = total, rounds
        self.start: tuple[float, float] | None = None
        self.pace = 0.0
        """Seconds for each unit of work, pauses included; 0 before the first pause is over."""
        self.whole = 0.0

    def after(self, done: float, now: float) -> str:
        """The remaining time as ``h:mm:ss``, when `done` is done at the time `now`, in seconds."""
        if self.start is None:
            self.start = done, now
        first, began = self.start
        whole = (done - first) // self.rounds * self.rounds
        if whole > self.whole:
            self.whole, self.pace = whole, (now - began) / whole
        if not self.pace:
            return "-:--:--"
        return str(timedelta(seconds=round(self.pace * (self.total - done))))
