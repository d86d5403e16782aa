"""`python -m tests.fuzz`: random rules on all backends against the reference, and random damage to rule files."""

from __future__ import annotations

import os
import re
import time
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.dispatch import GuardedCommand
from powderdsl.cli.exits import FAILED, OK, BadInput
from powderdsl.cli.output import Show, counted, progress
from powderdsl.system.interrupts import Terminated
from powderdsl.system.writing import failure, scratch_folder
from tests.fuzz import COMPARED, COMPILED

if TYPE_CHECKING:
    from tests.fuzz.campaign import Tally
    from tests.fuzz.differential import Plan

MAX_SEED = 1 << 40


def _seeds(text: str) -> range:
    match = re.fullmatch(r"([0-9]{1,12})\.\.([0-9]{1,12})", text)
    if match is None or int(match[1]) >= int(match[2]):
        raise ValueError("is not a range of seeds: write FROM..TO, such as 0..1000")
    return range(int(match[1]), int(match[2]))


def _backends(text: str) -> tuple[str, ...]:
    """What is compared with the reference, each once. The reference may be among the names."""
    names = dict.fromkeys(text.replace(" ", "").split(","))
    names.pop("reference", None)
    if not names or not names.keys() <= {*COMPARED}:
        raise ValueError(f"is not what can be compared with the reference: {', '.join(COMPARED)}")
    return tuple(names)


@click.command("fuzz", cls=GuardedCommand, context_settings={"help_option_names": ["-h", "--help"]})
@opt.option("--seeds", opt.Parsed("FROM..TO", _seeds), "Which rulesets, or damaged files.  [default: 0..200]")
@opt.option("--seconds", (1, 10_000_000), "Run for this time, with as many seeds as it takes.")
@opt.option(
    "--backends",
    opt.Parsed("NAMES", _backends),
    f"What is compared: {', '.join(COMPARED)}.  [default: all; those that need a C++ compiler if there is one]",
)
@opt.option("--worlds", (1, 100), "Worlds of a ruleset.", 4, show_default=True)
@opt.option("--steps", (1, 10_000), "Steps of a world.", 3, show_default=True)
@opt.option("--level", tuple("0123"), "Optimization of native code. Users' is 2.", "0", show_default=True)
@opt.path("--save", "FOLDER", "Folder for what failed.", to="folder", default=Path("fuzz"), show_default=True)
@opt.option("--front-end", bool, "Damage rule files instead, and load them.")
@opt.option("--jobs", (1, 256), "Processes.  [default: one per processor]")
@opt.path("--replay", "FILE", "Only run the case of a file again.")
def command(
    seeds: range | None,
    seconds: int | None,
    backends: tuple[str, ...] | None,
    worlds: int,
    steps: int,
    level: str,
    folder: Path,
    front_end: bool,
    jobs: int | None,
    replay: Path | None,
) -> int:
    """Compare all backends with the reference on random rules and worlds.

    cuda-emulated: the kernels of the backend cuda, compiled for the CPU. It and native take seconds a ruleset.

    What differs is made small and saved as a file that `--replay` runs again. Ctrl-C ends a run with its report.
    Exit code: 0 if all agree, 1 if something was found.

    \b
        python -m tests.fuzz --seconds 60
        python -m tests.fuzz --seeds 0..5000 --backends torch,wasm,native
        python -m tests.fuzz --replay fuzz/seed7-native.yaml
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # one thread a process; they inherit it
    if seeds is not None and seconds is not None:
        raise BadInput("give --seeds or --seconds, not both")
    if front_end:
        return _front_end(seeds, seconds, folder, jobs or os.cpu_count() or 1)
    from powderdsl.targets.cpp.build import Building
    from tests.fuzz.differential import Plan

    building = Building(f"-O{level}")
    if replay is not None:
        return _replay(replay, building)
    plan = Plan(_there(backends), worlds, steps, building)
    return _campaign(plan, seeds, seconds, folder, jobs or os.cpu_count() or 1)


def _there(asked: tuple[str, ...] | None) -> tuple[str, ...]:
    """The backends asked for, by default all that are there. Raises CompileError (PD701) if one is not."""
    from powderdsl.targets.cpp.build import INSTALL, NoCompiler, find_compiler

    wanted = asked or COMPARED
    compiled = [name for name in wanted if name in COMPILED]
    try:
        if compiled:
            find_compiler()
    except NoCompiler as error:
        names = " and ".join(f"`{name}`" for name in compiled)
        if asked is None:
            click.echo(f"without {names}: {error}", err=True)
            return tuple(name for name in COMPARED if name not in COMPILED)
        helps = (f"leave {names} out of --backends, or {INSTALL}",)
        problem = f"{names} cannot be compared here"
        raise failure("PD701", problem, notes=(str(error),), helps=helps) from None
    return wanted


def _replay(path: Path, building: Any) -> int:
    from tests.fuzz.cases import read_case
    from tests.fuzz.differential import check_case

    case = read_case(path)
    if case.backend not in ("reference", *COMPARED):
        raise BadInput(f"{path}: no backend `{case.backend}`")
    if case.backend in COMPILED:
        _there((case.backend,))
    with scratch_folder(Path(gettempdir())) as scratch:
        found = check_case(case, replace(building, folder=scratch))
    if found is None:
        click.echo(f"{path}: {case.backend} and the reference agree")
        return OK
    click.echo(f"{path}: {case.backend} {found[1]}")
    return FAILED


@contextmanager
def _watched(
    events: Generator[Any, None, None], seconds: int | None, total: int
) -> Iterator[tuple[Show, list[KeyboardInterrupt]]]:
    """Shows how many seeds are done while events are heard. An interrupt ends that, and is there for the report."""
    interrupts: list[KeyboardInterrupt] = []
    with progress("fuzz" if seconds is None else f"fuzz for {seconds} s", total) as show:
        try:
            yield show, interrupts
        except KeyboardInterrupt as caught:
            interrupts.append(caught)
            click.echo("interrupted")
        finally:
            events.close()  # its processes end


def _exit(interrupts: list[KeyboardInterrupt], found: int) -> int:
    click.echo(f"{counted(found, 'problem')} found")
    for interrupt in interrupts:
        if isinstance(interrupt, Terminated):
            raise interrupt
    return FAILED if found else OK


def _campaign(plan: Plan, seeds: range | None, seconds: int | None, folder: Path, jobs: int) -> int:
    from tests.fuzz.campaign import Tally, run_campaign

    wanted, tally = seeds or (range(200) if seconds is None else range(MAX_SEED)), Tally()
    began = time.monotonic()
    until = began + (seconds if seconds is not None else float("inf"))
    events = run_campaign(plan, tally, iter(wanted), jobs, folder, until)
    with _watched(events, seconds, len(wanted)) as (show, interrupts):
        for event in events:
            show(tally.rulesets + tally.refused)
            if isinstance(event, Path):
                click.echo(f"found: {event}", err=True)
    _report(plan, tally, folder, time.monotonic() - began)
    return _exit(interrupts, len(tally.files))


def _report(plan: Plan, tally: Tally, folder: Path, seconds: float) -> None:
    from tests.fuzz.exercised import ON_CELLS, missing

    names = " and ".join(filter(None, (", ".join(plan.backends[:-1]), plan.backends[-1])))
    click.echo(
        f"{tally.rulesets:,} rulesets and {tally.worlds:,} worlds, {counted(plan.steps, 'step')} each, in {seconds:.0f} s: "
        f"{names} against the reference"
    )
    click.echo(f"{tally.refused:,} more texts were refused by the static checks")
    click.echo(f"{tally.used[ON_CELLS]:,} have passes that bit planes cannot carry")
    for group, lacking in missing(tally.used).items():
        click.echo(f"never exercised, {group}: {', '.join(lacking)}")
    click.echo()
    for name in tally.files:
        click.echo(f"python -m tests.fuzz --replay {folder / name}")


def _front_end(seeds: range | None, seconds: int | None, folder: Path, jobs: int) -> int:
    from tests.fuzz.damage import run_trials

    wanted = seeds or (range(2000) if seconds is None else range(MAX_SEED))
    began = time.monotonic()
    trials = run_trials(iter(wanted), jobs, folder, began + (seconds or float("inf")))
    kinds: Counter[str] = Counter()
    accepted, slowest, largest, found = 0, 0.0, 0.0, []
    with _watched(trials, seconds, len(wanted)) as (show, interrupts):
        for trial in trials:
            kinds[trial.kind] += 1
            show(kinds.total())
            accepted += trial.accepted
            slowest, largest = max(slowest, trial.seconds), max(largest, trial.megabytes)
            if trial.problem is not None:
                found.append(trial)
                click.echo(f"{folder / trial.file_name}: {trial.problem}", err=True)
    click.echo(
        f"{kinds.total():,} inputs loaded in {time.monotonic() - began:.0f} s, {accepted:,} of them good rules"
    )
    click.echo("  " + ", ".join(f"{kind} {number:,}" for kind, number in kinds.most_common()))
    click.echo(f"slowest {slowest:.2f} s of processor time, largest process {largest:.0f} MB")
    for trial in found:
        click.echo(f"powderdsl check {folder / trial.file_name}")
    return _exit(interrupts, len(found))
