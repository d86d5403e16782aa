"""`powderdsl universe`: the rule pack of a seed, and what is known about it."""

from __future__ import annotations

import re
from pathlib import Path

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import FAILED, OK
from powderdsl.system.writing import write_text
from powderdsl.universes import MAX_SEED, universe_text


@click.command("universe")
@click.argument("seed", type=opt.Integer(0, MAX_SEED))
@opt.output("--out", "FILE", "The .yaml file to write instead of printing the pack.", ".yaml")
@opt.option("--about", bool, "Print the laws in words instead, one per line.")
@opt.option("--quick", bool, "Print the pack only: do not check it, and run no world.")
def command(seed: int, out: Path | None, about: bool, quick: bool) -> int:
    """Print the rule pack of a seed: invented elements under laws that nobody has seen.

    The same seed gives the same pack, and `universe:SEED` names it wherever RULES are named. What checking it and running
    it for some steps show goes to stderr.

    \b
        powderdsl universe 7 --about
        powderdsl run universe:7 --watch

    Exit code: 0, or 1 if the pack does not pass: it has remarks, claims that are not proven, or worlds in which nothing
    moves, nothing reacts or one element takes over.
    """
    text = universe_text(seed)
    if out is not None:
        write_text(out, text)
    else:
        click.echo(
            "\n".join(re.findall('^    about: "(.*)"$', text, re.MULTILINE)) if about else text.rstrip()
        )
    if quick:
        return OK
    from powderdsl.testing.lawful import findings

    results = findings(seed)
    click.echo("\n".join(results.lines), err=True)
    return FAILED if results.faults else OK
