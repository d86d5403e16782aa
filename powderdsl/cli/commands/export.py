"""`powderdsl export`: write rules as a WebAssembly module for any web page, or a task's environment as C."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import BadInput
from powderdsl.system.writing import replacing, write_text


@click.command("export")
@click.argument("rules", metavar="RULES|TASK")
@opt.output(
    "--out", "FILE", "The .wasm file to write, or with --env the .h file.", ".wasm", ".h", required=True
)
@opt.option("--size", opt.SIZE, "Rows and columns.  [default: 64]")
@opt.option(
    "--env", bool, "Write the environment of TASK: a C header, and a .cpp file beside it.", to="as_env"
)
@opt.option("--split", "SPLIT", "With --env: the set of worlds.", "train")
@opt.option("--worlds", (1, 4096), "With --env: number of start worlds.", 64)
@opt.option("--observation", ("ids", "compact", "matrix", "rgb"), "With --env: form of observations.", "ids")
@opt.option(
    "--actions", ("multidiscrete", "discrete", "full"), "With --env: form of actions.", "multidiscrete"
)
@opt.knobs("With --env: set a knob.")
@opt.parameters
def command(
    rules: str,
    out: Path,
    size: tuple[int, int] | None,
    as_env: bool,
    worlds: int,
    settings: dict[str, str],
    **how: Any,
) -> None:
    """Write rules as a WebAssembly module for a web page or game, or a task's environment as C.

    The module is a world of a fixed size without imports; docs/export.md shows the fifteen lines of JavaScript that run
    it. An environment is compiled into your program and contains the worlds in which its episodes begin.

    \b
        powderdsl export RULES --out rules.wasm
        powderdsl export --env TASK --out env.h
    """
    if out.suffix.lower() != (".h" if as_env else ".wasm"):
        raise BadInput(f"{out}: --env, and only --env, writes a .h file")
    if as_env:
        if size is not None:
            raise BadInput("--size is for rules: a task has its own size")
        from powderdsl.envs.header import c_environment
        from powderdsl.envs.mixed import environment

        env = environment(rules, params=settings, **how)
        texts, source = c_environment(env, worlds, out.name), out.with_suffix(".cpp")
        write_text(source, texts.source)
        write_text(out, texts.header)
        click.echo(f"{out}, {source}: {env.task.name}, {worlds} start worlds of {env.split}")
        return
    ruleset, (rows, columns) = opt.load_rules(rules, settings), size or (64, 64)
    from powderdsl.simulation.standalone import standalone_module

    code = standalone_module(ruleset, (rows, columns))
    with replacing(out, follow=True) as temporary:
        temporary.write_bytes(code)
    click.echo(f"{out}: {ruleset.name}, {rows}×{columns} cells, {len(code):,} bytes")
