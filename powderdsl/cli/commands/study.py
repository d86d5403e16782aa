"""`powderdsl study`: many runs over a grid of settings and seeds, with one table and one figure at the end."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import FAILED, OK, BadInput
from powderdsl.cli.output import counted, progress
from powderdsl.cli.study.checks import called, check_study
from powderdsl.diagnostics import suggest, with_suggestion
from powderdsl.diagnostics.printable import printable
from powderdsl.experiments.studies.run import (
    Outcome,
    StudyRun,
    check_cluster,
    collected,
    read_folders,
    run_on_ray,
)
from powderdsl.experiments.studies.study import (
    FLAG,
    MAX_POINTS,
    SIZE,
    SIZES,
    TEXT,
    Point,
    Study,
    load_study,
    shipped_studies,
)
from powderdsl.system.writing import writing

JOBS = 2
"""Processes at a time, unless the user says."""
MAX_SHARDS = 1_000_000

CALLED = (("train",), ("evaluate",), ("wm", "train"), ("wm", "finetune"), ("wm", "eval"))
"""Commands that steps of a study may call: those that write runs and evaluate them."""

NOT_FOR_STUDIES = ("DIR", "DATASET", "MODULE:CLASS", "--ignore-actions")
"""Options that studies do not have, by their metavar or name: folders, which the study chooses, and modules, which would be
imported, while a study may come from a stranger."""


def commands() -> Mapping[tuple[str, ...], Mapping[str, str]]:
    """The commands of `CALLED`, with the meaning of their options, of ``run``, and of their argument (``on``)."""
    known: dict[tuple[str, ...], dict[str, str]] = {words: {} for words in CALLED}
    for words, meanings in known.items():
        for parameter in called(words).params:
            names = [name[2:] for name in parameter.opts if name.startswith("--")]
            if isinstance(parameter, click.Argument):
                names = ["on"]
            if names == ["run"] or not {parameter.metavar, *parameter.opts} & {*NOT_FOR_STUDIES}:
                means = FLAG if getattr(parameter, "is_flag", False) else parameter.metavar or TEXT
                meanings.update(dict.fromkeys(names, means))
    return known


# Parts of a study: the combinations that `--only`, `--seeds` and `--shard` select

only_option = opt.pairs(
    "--only",
    "NAME=VALUE,…",
    "Run only combinations with these values of a setting, or `seed=0,1`. May be repeated.",
    "only",
)
seeds_option = opt.option("--seeds", (1, 1000), "Runs of each combination.  [default: the study's]")


def _shard(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,7})/([0-9]{1,7})", text)
    number, of = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= number <= of <= MAX_SHARDS:
        raise ValueError("is not a part: write 1/4 to 4/4 for four parts")
    return number, of


SHARD = opt.Parsed("I/N", _shard)


def selected(study: Study, size: str, seeds: int | None, only: Mapping[str, str]) -> list[Point]:
    """The combinations that were asked for. Raises BadInput if there are none."""
    points = every = list(islice(study.points(size, seeds), MAX_POINTS + 1))
    if len(every) > MAX_POINTS:
        raise BadInput(f"--seeds: a study has at most {MAX_POINTS:,} combinations")
    for name, text in only.items():
        known = {point.names[name] for point in every if name in point.names and name != SIZE}
        if not known:
            message = f"--only: no setting is called `{name}`"
            raise BadInput(with_suggestion(message, name, every[0].names, "settings"))
        for value in sorted({*text.split(",")} - known):
            there = suggest(value, known) or (f"it has {', '.join(sorted(known)[:20])}",)
            raise BadInput(f"--only: `{name}` has no value `{value}` here; {there[0]}")
        points = [point for point in points if point.names[name] in text.split(",")]
    if not points:
        raise BadInput(f"no combination has {' and '.join(map('='.join, only.items()))}")
    return points


def part(points: Sequence[Point], shard: tuple[int, int] | None) -> list[Point]:
    """A shard of some points: consecutive ones, so that a shard has large and small settings."""
    number, of = shard or (1, 1)
    return list(points[len(points) * (number - 1) // of : len(points) * number // of])


class StudyCommand(click.Command):
    """`study STUDY`, or `study collect FOLDER…`, which is a command of its own."""

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        if args[:1] == [collect.name]:
            return collect.make_context(f"{info_name} {collect.name}", args[1:], parent, **extra)
        return super().make_context(info_name, args, parent, **extra)


@click.command("collect")
@click.argument(
    "folders", metavar="FOLDER…", nargs=-1, required=True, type=click.Path(path_type=Path, file_okay=False)
)
@seeds_option
@only_option
@opt.path("--out", "FOLDER", "Folder for the table and the figure.  [default: the first FOLDER]")
def collect(folders: tuple[Path, ...], seeds: int | None, only: dict[str, str], out: Path | None) -> int:
    """Merge the results of a study that ran in several folders, or in parts.

    Writes results.md, results.json and figure.png, as the study does that ran in one piece. Exits with 1 if results of
    some combinations are missing.
    """
    runs = read_folders(folders, commands())
    study, size = runs[0].study, runs[0].size
    outcomes = [collected(runs, point) for point in selected(study, size, seeds, only)]
    folder = out or folders[0]
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return _report(study, size, folder, outcomes)


@click.command("study", cls=StudyCommand)
@click.argument("study", metavar="STUDY", required=False)
@opt.option("--size", SIZES, "Size of the study: values of its settings.", "small")
@seeds_option
@opt.option("--jobs", (1, 256), "Processes that run at a time.  [default: 2; with --ray, as many as fit]")
@opt.option("--threads", (1, 256), "Threads per process.", 1)
@only_option
@click.option("--shard", type=SHARD, help="Run only part I of N parts: for job arrays.")
@opt.option("--ray", "ADDRESS", "Run on a Ray cluster: `auto`, or HOST:PORT of its head.")
@opt.path("--out", "FOLDER", "Folder of the results.  [default: studies/STUDY-SIZE]")
@opt.option("--dry-run", bool, "Print the commands without running them.")
def command(
    study: str | None,
    size: str,
    seeds: int | None,
    jobs: int | None,
    threads: int,
    only: dict[str, str],
    shard: tuple[int, int] | None,
    ray: str | None,
    out: Path | None,
    dry_run: bool,
) -> int:
    """Run a study: a file that names commands and the settings to vary, or a shipped one.

    Writes results.md, results.json and figure.png to its folder. The same call continues where it stopped, and adds to
    what is there. Combinations that another process holds are left to it. Without STUDY, lists those that come with
    powderdsl; `powderdsl study collect FOLDER…` merges results of several folders.
    """
    known = commands()
    if study is None:
        for name in shipped_studies():
            click.echo(f"{name:24} {load_study(name, known).about}")
        return OK
    # The nodes of a cluster have devices that this machine may lack.
    loaded = load_study(study, known, partial(check_study, devices=ray is None))
    every = selected(loaded, size, seeds, only)
    points = part(every, shard)
    folder = out or Path("studies") / f"{loaded.name}-{size}"
    run = StudyRun(loaded, folder, size, threads)
    if dry_run:
        for point in points:
            for step in loaded.steps:
                words = loaded.command(step, point, folder / "runs" / point.name)
                click.echo(shlex.join(["powderdsl", *words]))
        return OK
    if ray is not None:
        check_cluster(ray)
    run.prepare()
    outcomes = {outcome.point: outcome for outcome in _with_progress(run, points, jobs, ray)}
    finished = [outcomes.get(point) or run.finished(point) for point in every]
    locked, missing = sum(outcome.held for outcome in outcomes.values()), finished.count(None)
    if locked:
        click.echo(
            f"the study is not complete: other processes hold {counted(locked, 'combination')}", err=True
        )
    if missing:
        name = shlex.quote(str(folder))
        click.echo(f"other parts have {counted(missing, 'combination')} that are not done in {name}")
    if locked or missing:  # whoever finishes last writes the table, or `collect`
        return _status([*outcomes.values()])
    return _report(loaded, size, folder, [outcome for outcome in finished if outcome is not None])


def _with_progress(run: StudyRun, points: list[Point], jobs: int | None, ray: str | None) -> list[Outcome]:
    done = 0
    with progress(run.study.name, len(points), resumes=run.folder) as show:

        def report(outcome: Outcome) -> None:
            nonlocal done
            done += 1
            show(done)
            text = ", ".join(f"{name} {value:.4g}" for name, value in outcome.values.items())
            click.echo(f"{outcome.point.name}: {outcome.problem or text}", err=True)

        if ray is not None:
            return run_on_ray(run, points, ray, jobs, report)
        return run.run(points, jobs or JOBS, report)


def _report(study: Study, size: str, folder: Path, outcomes: list[Outcome]) -> int:
    """Write the results, and return the exit status."""
    from powderdsl.experiments.runs import write_json
    from powderdsl.experiments.studies.results import as_data, as_markdown, write_figure
    from powderdsl.system.writing import write_text

    text = printable(as_markdown(study, size, outcomes), lines=True)  # it may be shown by `cat`
    write_json(folder / "results.json", as_data(study, size, outcomes))
    write_text(folder / "results.md", text)
    sys.stdout.write(text)
    if find_spec("matplotlib") is None:
        click.echo("no figure: pip install 'powderdsl[plot]'", err=True)
    else:
        write_figure(folder / "figure.png", study, size, outcomes)
        click.echo(str(folder / "figure.png"))
    return _status(outcomes)


def _status(outcomes: Sequence[Outcome]) -> int:
    """The exit status, after a line about combinations that did not finish."""
    lost = sum(outcome.problem is not None and not outcome.held for outcome in outcomes)
    if lost:
        click.echo(
            f"{counted(lost, 'combination')} did not finish; running the study again tries them again",
            err=True,
        )
    return FAILED if any(outcome.problem for outcome in outcomes) else OK
