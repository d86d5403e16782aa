"""`powderdsl ogbench`: collect OGBench's datasets of Powderworld."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import OK, user_values
from powderdsl.cli.output import counted, progress


@click.command("ogbench")
@click.argument("level", metavar="LEVEL")
@opt.path("--out", "FOLDER", "Output folder.", required=True)
@opt.option("--episodes", (1, 1 << 30), "Training episodes.  [default: as in OGBench]")
@opt.option("--validation", (1, 1 << 30), "Validation episodes.  [default: a tenth]")
@opt.option("--seed", (0, (1 << 61) - 1), "Seed of the episodes.", 0)
@opt.machine
def command(level: str, out: Path, threads: int, backend: str, device: str, **how: Any) -> int:
    """Collect the dataset of LEVEL (easy, medium or hard): scripted play, in OGBench's file format.

    The files depend only on the options. After an interruption, the same command resumes.

    \b
        powderdsl ogbench easy --out data
        powderdsl ogbench hard --out data --episodes 100
    """
    from powderdsl.ogbench.levels import find_level

    with user_values():
        chosen = find_level(level)
    from powderdsl.ogbench.collect import collect
    from powderdsl.ogbench.episodes import LevelProgram

    with (
        user_values(),
        progress(chosen.name, how["episodes"] or chosen.play.episodes, lines=True, resumes=out) as show,
    ):
        files = collect(
            LevelProgram(chosen, backend=backend, device=device, threads=threads),
            out,
            **how,
            progress=lambda done, total: show(done, "episodes"),
        )
    size = sum(path.stat().st_size for path in files)
    names = ", ".join(path.name for path in files)
    click.echo(f"{out}: {names}, {counted(len(files), 'file')}, {size / 1e6:,.1f} MB", err=True)
    return OK
