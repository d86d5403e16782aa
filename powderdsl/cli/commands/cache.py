"""`powderdsl cache`: list and remove compiled code."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from powderdsl.cli.output import counted, print_json

UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}


class AgeType(click.ParamType):
    """`30d`, `12h`: a time span in seconds."""

    name = "AGE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        if isinstance(value, float):
            return value
        match = re.fullmatch(r"([0-9]{1,6})([smhdw])", str(value))
        if match is None:
            self.fail(f"`{value}` is not a time span: write 30d, 12h or 90m", param, ctx)
        return float(match[1]) * UNITS[match[2]]


@click.group("cache")
def command() -> None:
    """List or remove the compiled code that this machine keeps, or print its folder.

    Native code is compiled once for a ruleset, a compiler and a processor, and is private to the user. Beyond
    512 MB, the code that was used least recently is removed.
    """


@command.command("list")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON list with all details.")
def list_entries(as_json: bool) -> None:
    """List compiled code, the most recently used first."""
    from powderdsl.targets.cache import entries

    found = entries(_folder())
    if as_json:
        rows = [{"key": one.key, "used": one.used, **asdict(one.about)} for one in found]
        print_json(rows)
        return
    for one in found:
        size = f"{one.about.size / 1e6:.1f} MB"
        used = f"used {_ago(one.age)} ago"
        made = f"{one.about.seconds:.0f} s by {one.about.compiler}"
        name = one.about.ruleset or "?"
        click.echo(f"{one.key[:12]}  {name:<20}  {one.about.backend}  {size:>8}  {used:<16}  {made}")
    total = sum(one.about.size for one in found) / 1e6
    click.echo(f"{counted(len(found), 'compiled program')}, {total:.1f} MB", err=True)


@command.command("clear")
@click.option(
    "--older-than",
    type=AgeType(),
    default=0.0,
    show_default=False,
    help="Remove only what has not been used for this time, such as 30d.",
)
def clear_entries(older_than: float) -> None:
    """Remove compiled code. Running programs continue; code is compiled again when it is next needed."""
    from powderdsl.targets.cache import clear

    gone = clear(_folder(), older_than)
    size = sum(one.about.size for one in gone) / 1e6
    click.echo(f"removed {counted(len(gone), 'compiled program')}, {size:.1f} MB", err=True)


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
