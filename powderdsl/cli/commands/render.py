"""`powderdsl render`: draw a world as a picture."""

from __future__ import annotations

from pathlib import Path

import click

from powderdsl.cli import options as opt


@click.command("render")
@opt.rules
@opt.world
@opt.size
@opt.output("--out", "FILE", "The .png file to write.", ".png", required=True)
@opt.option("--scale", (1, 64), "Pixels per cell.  [default: about 400 pixels per side]")
def command(
    rules: str, world: str | None, out: Path, size: tuple[int, int] | None, scale: int | None
) -> None:
    """Draw a world as a picture, without running it.

    The worlds of a saved batch are drawn side by side. Without --world, draw the one that `powderdsl run` starts from.
    """
    ruleset = opt.load_rules(rules, {})
    from powderdsl.cli.pictures import pictures
    from powderdsl.cli.start_worlds import start
    from powderdsl.worlds.media import write_png

    # Nothing runs, so use the backend that needs no compiling.
    shown = start(ruleset, world, size, None, None, backend="reference")
    write_png(out, pictures(shown, most=len(shown), factor=scale))
