"""Output of commands: diagnostics, JSON, and progress."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from shlex import quote
from typing import IO, TYPE_CHECKING, Any

import click

from powderdsl.diagnostics.printable import printable, printable_streams, raw_stream, write_styled

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
    """Print a value as indented JSON. A dataclass becomes an object with a key for each field, without the final `_` of
    a field such as `from_`."""
    import json

    click.echo(json.dumps(value, indent=2, ensure_ascii=False, default=_json_value))


def _json_value(value: Any) -> Any:
    if is_dataclass(value):
        return {field.name.rstrip("_"): getattr(value, field.name) for field in fields(value)}
    if isinstance(value, frozenset):
        return sorted(value)
    return str(value)


def counted(number: int, thing: str, things: str = "") -> str:
    """`no errors`, `1 error`, `2 errors`; `things` is an irregular plural."""
    return f"{number or 'no'} {thing if number == 1 else things or f'{thing}s'}"


# Progress

SECONDS = 30
"""Time between two lines if stderr is not a terminal."""


Show = Callable[..., None]
"""``show(done, words="")`` shows the progress and a text."""


@contextmanager
def progress(title: str, total: float, *, lines: bool = False, resumes: Path | None = None) -> Iterator[Show]:
    """A bar that disappears at the end; other output appears above it.

    Args:
        total: the final value of `done`.
        lines: if stderr is not a terminal, write a line every `SECONDS` instead of nothing.
        resumes: the folder in which the same command resumes after an interruption, for the message.
    """
    try:
        with _bar(title, total, lines) as show:
            yield show
    except KeyboardInterrupt:
        if resumes is not None:
            click.echo(f"interrupted; run the same command again to resume {quote(str(resumes))}", err=True)
        raise


@contextmanager
def _bar(title: str, total: float, lines: bool) -> Iterator[Show]:
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
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    clock = TimeRemainingColumn(elapsed_when_finished=True)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), clock)
    console = Console(file=raw_stream(sys.stderr), highlight=False, soft_wrap=True)
    shown = TextColumn("{task.fields[words]}", markup=False)
    # Inside, stderr is rich's, which prints above the bar, and is escaped as well.
    # A pace over minutes includes pauses, such as updates of a network.
    with (
        Progress(*columns, shown, console=console, transient=True, speed_estimate_period=600) as bar,
        printable_streams(),
    ):
        task = bar.add_task(printable(title), total=total, words="")

        def show(done: float, words: str = "") -> None:
            bar.update(task, completed=done, words=printable(words))

        yield show
