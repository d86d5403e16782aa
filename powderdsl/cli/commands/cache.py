"""`powderdsl cache`: list and remove compiled code."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from powderdsl.cli.output import counted
from powderdsl.system.reports import table

if TYPE_CHECKING:
    from powderdsl.system.cache import Entry


@click.group("cache")
def command() -> None:
    """List or remove the compiled code that this machine keeps, or print its folder.

    Rules are checked, lowered and compiled once for each version of their text. The results are private to the user.
    Beyond 512 MB, those that were used least recently are removed.
    """


@command.command("list")
def list_entries() -> None:
    """List the files of compiled code, the most recently used first."""
    from powderdsl.system.cache import entries

    stored = entries(_folder())
    rows = [["code of", "size", "last used"]]
    for entry in stored:
        used = time.strftime("%Y-%m-%d %H:%M", time.localtime(entry.used))
        rows.append([entry.name, _megabytes([entry]), used])
    if stored:
        click.echo("\n".join(table(rows, indent="")))
    click.echo(f"{counted(len(stored), 'file')}, {_megabytes(stored)}", err=True)


@command.command("clear")
def clear_entries() -> None:
    """Remove compiled code. Running programs continue; code is compiled again when it is next needed."""
    from powderdsl.system.cache import clear

    removed = clear(_folder())
    click.echo(f"removed {counted(len(removed), 'file')}, {_megabytes(removed)}", err=True)


@command.command("path")
def print_path() -> None:
    """Print the folder on stdout."""
    click.echo(_folder())


def _folder() -> Path:
    """The folder of compiled code. An OSError, if others may write to it, ends the command with its message."""
    from powderdsl.system.cache import compiled_folder

    return compiled_folder()


def _megabytes(entries: Sequence[Entry]) -> str:
    return f"{sum(entry.size for entry in entries) / 1e6:.1f} MB"
