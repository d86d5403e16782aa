"""`powderdsl bench`: how fast rules run, on each backend, for each batch and size."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import FAILED, OK, user_values
from powderdsl.cli.output import print_json, progress
from powderdsl.experiments.bench import (
    EQUAL,
    WORKLOADS,
    CellFigures,
    Plan,
    Report,
    measuring,
    read_program,
    report_data,
    report_text,
    this_machine,
)
from powderdsl.model.state import fitting
from powderdsl.targets.cpp.build import NoCompiler, find_compiler

MAX_SECONDS = 3600


def _seconds(text: str) -> float:
    seconds = float(text) if text.isascii() else 0
    if not 0 < seconds <= MAX_SECONDS:  # false for NaN
        raise ValueError(f"is not a number above 0, up to {MAX_SECONDS}")
    return seconds


SECONDS = opt.Parsed("FLOAT", _seconds)
EPILOG = "\b\nWorkloads:\n" + "\n".join(f"  {name:<7} {about}" for name, about in WORKLOADS.items())


@click.command("bench", cls=opt.Command, epilog=EPILOG)
@click.argument("rules", metavar="[RULES]", default="powderworld")
@opt.option(
    "--backend",
    opt.BACKEND,
    "Backend that runs the rules.  [default: wasm and native; on a GPU, torch and cuda, with --check torch-fused too]",
    to="backends",
    multiple=True,
)
@opt.option("--batch", (1, 1 << 20), "Number of worlds in a batch.", (1, 32), to="batches", multiple=True)
@opt.option("--size", opt.SIZE, "Rows and columns.  [default: 64]", to="sizes", multiple=True)
@opt.option("--only", opt.NAMES, "Use only these elements in the worlds.", ())
@opt.option("--threads", (1, 1024), "CPU threads.", (1,), multiple=True)
@opt.option(
    "--beside",
    click.Path(exists=True, dir_okay=False, path_type=Path),
    "Also measure your own program that makes the same steps: `load(state)` returns `run(steps)`.",
    to="programs",
    metavar="FILE.py",
    multiple=True,
)
@opt.option("--workload", list(WORKLOADS), "The worlds to start from.", Plan.workload)
@opt.device
@opt.option("--steps", (1, 1 << 20), "Maximum steps per call.", Plan.steps)
@opt.option("--seconds", SECONDS, "Measuring time per combination, in seconds.", Plan.seconds)
@opt.option("--rounds", (1, 1000), "Number of rounds; each measures all combinations in turn.", Plan.rounds)
@opt.option("--seed", (0, 2**63 - 1), "Seed of the start worlds.", Plan.seed)
@opt.parameters
@opt.option("--profile", bool, "Also measure the time of each pass.")
@opt.option("--check", bool, "Compare with the CPU, count kernels, and exit with 1 on a difference.")
@opt.option("--json", bool, "Print one JSON object instead of tables.", to="printed")
def command(
    rules: str,
    backends: tuple[str, ...],
    sizes: tuple[tuple[int, int], ...],
    device: str,
    settings: dict[str, str],
    programs: tuple[Path, ...],
    printed: bool,
    **measurement: Any,
) -> int:
    """Measure how fast rules run.

    --backend, --batch, --size and --threads may be repeated. Each round measures all combinations in turn; the table
    shows medians. With --check, a backend that cannot run gets a row with the reason.
    """
    ruleset = opt.load_rules(rules, settings)
    with user_values():
        plan = Plan(
            ruleset,
            backends=backends or _usual_backends(device, measurement["check"]),
            sizes=sizes or ((fitting(ruleset, 64),) * 2,),
            device=device,
            programs=[read_program(file) for file in programs],
            **measurement,
        )
    machine, figures = this_machine(plan.device), list[CellFigures]()
    parts = len(plan.cells) * (1 + plan.rounds + plan.profile)
    with user_values() if plan.programs else nullcontext(), progress("bench", parts) as show:
        for done, (what, cell) in enumerate(measuring(plan, figures)):
            show(done, f"{what} {cell}")
    report = Report(plan, machine, tuple(figures))
    if printed:
        print_json(report_data(report))
    else:
        click.echo(report_text(report))
    return OK if all(cell.check in ("", EQUAL) for cell in figures) else FAILED


def _usual_backends(device: str, check: bool) -> tuple[str, ...]:
    """The default backends: the one that starts instantly and the fastest on the device; with `check` on a GPU, all."""
    from powderdsl.simulation.programs import starting_backend

    first = starting_backend(device)
    if device != "cpu":
        return ("torch", *("torch-fused",) * check, *("cuda",) * device.startswith("cuda"))
    try:
        find_compiler()
    except NoCompiler as error:
        click.echo(f"without the backend `native`: {error}", err=True)
        return (first,)
    return (first, "native")
