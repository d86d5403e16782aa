"""`powderdsl render`: draw a world as a picture."""

from __future__ import annotations

from pathlib import Path

import click

from powderdsl.cli import options as opt


@click.command("render")
@click.argument("world", metavar="WORLD")
@opt.option("--rules", "RULES", "Rules whose elements the world has.", required=True)
@opt.output("--out", "FILE", "The .png file to write.", ".png", required=True)
@opt.option("--size", opt.SIZE, "Rows and columns of a scene, such as 48x64.")
@opt.option("--scale", (1, 64), "Pixels per cell.  [default: about 400 a side]")
def command(world: str, rules: str, out: Path, size: tuple[int, int] | None, scale: int | None) -> None:
    """Draw a world as a picture, without running it.

    WORLD is a saved .npz, a .txt drawing, a .png, a scene file, or a shipped scene's name. The worlds of a
    saved batch stand side by side.
    """
    ruleset = opt.load_rules(rules, {})
    from powderdsl.cli.pictures import pictures
    from powderdsl.cli.start_worlds import start
    from powderdsl.worlds.media import write_png

    # Nothing runs, so the backend that takes no compiling will do.
    shown = start(ruleset, world, size, None, None, backend="reference")
    write_png(out, pictures(shown, most=len(shown), factor=scale))
