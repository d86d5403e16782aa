"""`powderdsl cache`: list and remove compiled code."""

from __future__ import annotations

import time
from collections.abc import Sequence

import click

from powderdsl.cli.output import counted
from powderdsl.system.cache import CachedFile, clear, compiled_folder, entries, fused_code
from powderdsl.system.reports import table


@click.group("cache")
def command() -> None:
    """List or remove the compiled code cached on this machine, or print its folder.

    Rules are checked, lowered and compiled once for each version of their text. Only the user can read the results.
    Above 512 MB, the least recently used are removed, except those of `torch-fused`.
    """


@command.command("list")
def list_entries() -> None:
    """List cached files, the most recently used first; those of `torch-fused` share one line."""
    stored = sorted([*entries(compiled_folder()), *fused_code()], key=lambda entry: -entry.used)
    rows = [["code of", "size", "last used"]]
    for entry in stored:
        used = time.strftime("%Y-%m-%d %H:%M", time.localtime(entry.used))
        rows.append([entry.name, _megabytes([entry]), used])
    if stored:
        click.echo("\n".join(table(rows, indent="")))
    click.echo(f"{counted(len(stored), 'file')}, {_megabytes(stored)}", err=True)


@command.command("clear")
def clear_entries() -> None:
    """Remove compiled code. Running programs continue; code is recompiled when needed."""
    removed = [*clear(compiled_folder()), *fused_code(remove=True)]
    click.echo(f"removed {counted(len(removed), 'file')}, {_megabytes(removed)}", err=True)


@command.command("path")
def print_path() -> None:
    """Print the folder on stdout."""
    click.echo(compiled_folder())


def _megabytes(entries: Sequence[CachedFile]) -> str:
    return f"{sum(entry.size for entry in entries) / 1e6:.1f} MB"
