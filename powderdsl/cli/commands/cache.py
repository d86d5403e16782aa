"""`powderdsl cache`: list and remove compiled code."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from powderdsl.cli import options as opt
from powderdsl.cli.output import counted, print_json
from powderdsl.system.reports import table

if TYPE_CHECKING:
    from powderdsl.targets.cache import Entry

UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}


def _age(text: str) -> float:
    """`30d`, `12h`: a time span in seconds."""
    match = re.fullmatch(r"([0-9]{1,6})([smhdw])", text)
    if match is None:
        raise ValueError("is not a time span: write 30d, 12h or 90m")
    return float(match[1]) * UNITS[match[2]]


@click.group("cache")
def command() -> None:
    """List or remove the compiled code that this machine keeps, or print its folder.

    Native code is compiled once for a ruleset, a compiler and a processor, and is private to the user. Beyond
    512 MB, the code that was used least recently is removed.
    """


@command.command("list")
@opt.option("--json", bool, "Print one JSON list with all details.", to="as_json")
def list_entries(as_json: bool) -> None:
    """List compiled code, the most recently used first."""
    from powderdsl.targets.cache import entries

    stored = entries(_folder())
    if as_json:
        print_json([{"key": entry.key, "used": entry.used, **vars(entry.about)} for entry in stored])
        return
    rows = [["program", "ruleset", "backend", "size", "last use", "made"]]
    for entry in stored:
        about = entry.about
        made = f"{about.seconds:.0f} s by {about.compiler}"
        used = f"used {_ago(entry.age)} ago"
        rows.append([entry.key[:12], about.ruleset or "?", about.backend, _megabytes([entry]), used, made])
    if stored:
        click.echo("\n".join(table(rows, indent="")))
    click.echo(f"{counted(len(stored), 'compiled program')}, {_megabytes(stored)}", err=True)


@command.command("clear")
@opt.option(
    "--older-than",
    opt.Parsed("AGE", _age),
    "Remove only what has not been used for this time, such as 30d.",
    0.0,
    show_default=False,
)
def clear_entries(older_than: float) -> None:
    """Remove compiled code. Running programs continue; code is compiled again when it is next needed."""
    from powderdsl.targets.cache import clear

    removed = clear(_folder(), older_than)
    click.echo(f"removed {counted(len(removed), 'compiled program')}, {_megabytes(removed)}", err=True)


@command.command("path")
def print_path() -> None:
    """Print the folder on stdout."""
    click.echo(_folder())


def _folder() -> Path:
    """The folder of compiled code. An OSError, if others may write to it, ends the command with its message."""
    from powderdsl.system.user_cache import cache_folder

    return cache_folder("native")


def _ago(seconds: float) -> str:
    """A span of time in its largest unit."""
    for unit in ("w", "d", "h", "m"):
        if seconds >= UNITS[unit]:
            return f"{seconds / UNITS[unit]:.0f} {unit}"
    return f"{seconds:.0f} s"


def _megabytes(entries: Sequence[Entry]) -> str:
    return f"{sum(entry.about.size for entry in entries) / 1e6:.1f} MB"
