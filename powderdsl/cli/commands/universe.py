"""`powderdsl universe`: print and check the rule pack generated from a seed."""

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
@opt.option("--about", bool, "Print the laws in words instead of YAML, one per line.")
@opt.option("--quick", bool, "Only print the pack, without checking or running it.")
def command(seed: int, out: Path | None, about: bool, quick: bool) -> int:
    """Print the rule pack generated from a seed: invented elements under new laws.

    The same seed gives the same pack; `universe:SEED` is a valid RULES in every command. A report of checking and
    running it for some steps goes to stderr.

    \b
        powderdsl universe 7 --about
        powderdsl run universe:7 --watch

    Exit code: 0, or 1 if the pack fails: it has diagnostics, unproven claims, or worlds in which nothing moves, nothing
    reacts or one element takes over.
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
