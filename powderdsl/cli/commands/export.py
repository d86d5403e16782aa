"""`powderdsl export`: write rules as a WebAssembly module that runs in any page."""

from __future__ import annotations

from pathlib import Path

import click

from powderdsl.cli import options as opt
from powderdsl.system.writing import replacing


@click.command("export")
@click.argument("rules", metavar="RULES")
@opt.output("--out", "FILE", "The .wasm file to write.", ".wasm", required=True)
@opt.option("--size", opt.SIZE, "Rows and columns.", "64")
@opt.parameters
def command(rules: str, out: Path, size: tuple[int, int], settings: dict[str, str]) -> None:
    """Write rules as a WebAssembly module, for a page or a game.

    The module is a world of one size. It imports nothing, and a page needs fifteen lines of JavaScript to run it:
    docs/export.md.
    """
    ruleset = opt.load_rules(rules, settings)
    from powderdsl.simulation.standalone import standalone_module

    code = standalone_module(ruleset, size)
    with replacing(out, follow=True) as temporary:
        temporary.write_bytes(code)
    click.echo(f"{out}: {ruleset.name}, {size[0]}×{size[1]} cells, {len(code):,} bytes")
