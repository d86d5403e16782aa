"""`powderdsl trace`: explain the contents of a cell after a step."""

from __future__ import annotations

import re
import sys
from typing import Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import user_values
from powderdsl.cli.output import color_wanted, print_json
from powderdsl.diagnostics.printable import write_styled


def _cell(text: str) -> tuple[int, int]:
    """`3,4`: row 3, column 4, both from 0."""
    match = re.fullmatch(r"([0-9]{1,9}),([0-9]{1,9})", text)
    if match is None:
        raise ValueError("is not a cell: write ROW,COLUMN from 0, such as 3,4")
    return int(match[1]), int(match[2])


CELL = opt.Parsed("ROW,COLUMN", _cell)


@click.command("trace", cls=opt.Command)
@opt.rules
@opt.world
@opt.size
@opt.option("--seed", (0, 2**63 - 1), "Seed of all random numbers.  [default: 0]")
@opt.option("--at", CELL, "Row and column of the cell, from 0.", to="cell", required=True)
@opt.option("--step", (1, 10**9), "Step of the run, from 1.", required=True)
@opt.option("--of", opt.NAMES, "Explain only `element`, or these fields.")
@opt.option("--number", (0, 1 << 20), "Number of the world in a saved batch.", 0)
@opt.option("--all", bool, "List every rule that did not fire, and why.", to="every_rule")
@opt.option("--json", bool, "Print one JSON object.", to="as_json")
@opt.backend("auto", "Backend that runs the steps before it.")
@opt.parameters
def command(
    rules: str,
    world: str | None,
    size: tuple[int, int] | None,
    seed: int | None,
    cell: tuple[int, int],
    step: int,
    as_json: bool,
    backend: str,
    settings: dict[str, str],
    **how: Any,
) -> None:
    """Explain the contents of a cell after a step.

    Prints which rules wrote it in that step, what they read, and which rules nearly wrote it. The world is that of
    `powderdsl run` with the same --world, --size and --seed.
    """
    ruleset = opt.load_rules(rules, settings)
    from powderdsl.cli.start_worlds import start
    from powderdsl.simulation.tracing import trace, trace_data, trace_text

    worlds = start(ruleset, world, size, None, seed, backend=backend, steps=step)
    with user_values():
        history = trace(worlds, *cell, step, **how)
    if as_json:
        print_json(trace_data(history))
    else:
        text = trace_text(history, color=color_wanted(sys.stdout))
        write_styled(sys.stdout, f"{text}\n")
