"""`powderdsl study`: many runs over a grid of settings, with one table and one figure at the end."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.exits import FAILED, OK
from powderdsl.cli.output import counted, progress
from powderdsl.cli.study import selection
from powderdsl.cli.study.checks import check_study
from powderdsl.diagnostics.printable import printable
from powderdsl.experiments.studies import cluster
from powderdsl.experiments.studies.file import load_study, shipped_studies
from powderdsl.experiments.studies.run import Outcome, StudyRun
from powderdsl.experiments.studies.study import (
    FILE,
    FLAG,
    RULES,
    RUN,
    RUN_OR_TASK,
    SIZES,
    TASK,
    TEXT,
    Point,
    Study,
)
from powderdsl.system.writing import not_writable

JOBS = 2
"""Processes at a time, unless the user says."""

CALLED: tuple[tuple[str, ...], ...] = (
    ("train",),
    ("evaluate",),
    ("wm", "train"),
    ("wm", "finetune"),
    ("wm", "eval"),
)
"""Commands that steps of a study may call: those that write runs and evaluate them."""


MEANS = {
    "TASK": TASK,
    "RUN": RUN,
    "RUN|TASK": RUN_OR_TASK,
    "RULES": RULES,
    "PACK…": RULES,
    "FILE": FILE,
    "FILE.json": FILE,
}
"""The meaning of arguments and options, by their metavar."""

NOT_FOR_STUDIES = ("MODULE:CLASS", "--ignore-actions")
"""Options without a use in studies, by their metavar or name. Modules would be imported, and a study may come from a
stranger."""


def commands() -> Mapping[tuple[str, ...], Mapping[str, str]]:
    """These commands, with the meaning of their options and of their argument (``on``).

    Options that name folders are left out, but for `run`, which the study gives: a step writes where the study says.
    """
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for words in CALLED:
        found[words] = {}
        for one in called(words).params:
            if isinstance(one, click.Argument):
                found[words]["on"] = MEANS[one.metavar or ""]
                continue
            means = (
                FLAG if isinstance(one, click.Option) and one.is_flag else MEANS.get(one.metavar or "", TEXT)
            )
            if isinstance(one.type, click.Path) and means != FILE and "--run" not in one.opts:
                continue
            if {one.metavar, *one.opts} & {*NOT_FOR_STUDIES}:
                continue
            found[words] |= {name[2:]: means for name in one.opts if name.startswith("--")}
    return found


def called(words: tuple[str, ...]) -> click.Command:
    """The click command that some words name."""
    found: click.Command = import_module(f"powderdsl.cli.commands.{words[0]}").command
    for word in words[1:]:
        assert isinstance(found, click.Group)
        found = found.commands[word]
    return found


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
@selection.seeds
@selection.only
@opt.path("--out", "FOLDER", "Folder for the table and the figure.  [default: the first FOLDER]")
def collect(folders: tuple[Path, ...], seeds: int | None, only: tuple[str, ...], out: Path | None) -> int:
    """Merge the results of a study that ran in several folders, or in parts.

    Writes results.md, results.json and figure.png, as the study does that ran in one piece. Exits with 1 if results of
    some combinations are missing.
    """
    from powderdsl.experiments.studies.collect import collected, read_folders

    runs = read_folders(folders, commands())
    study, size = runs[0].study, runs[0].size
    outcomes = collected(runs, selection.selected(study, size, seeds, only))
    folder = out or folders[0]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise not_writable(folder, error) from None
    _report(study, size, folder, outcomes)
    return _status(outcomes)


@click.command("study", cls=StudyCommand)
@click.argument("study", metavar="STUDY", required=False)
@opt.choice("--size", SIZES, "Size of the study: values of its settings.", "small")
@selection.seeds
@opt.integer("--jobs", 1, 256, "Processes that run at a time.  [default: 2; with --ray, as many as fit]")
@opt.integer("--threads", 1, 256, "Threads per process.", 1)
@selection.only
@click.option("--shard", type=selection.SHARD, help="Run only part I of N parts: for job arrays.")
@opt.text("--ray", "ADDRESS", "Run on a Ray cluster: `auto`, or HOST:PORT of its head.")
@opt.path("--out", "FOLDER", "Folder of the results.  [default: studies/STUDY-SIZE]")
@opt.flag("--dry-run", "Print the commands without running them.")
def command(
    study: str | None,
    size: str,
    seeds: int | None,
    jobs: int | None,
    threads: int,
    only: tuple[str, ...],
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
    check = partial(check_study, find=called, devices=ray is None)
    found = load_study(study, known, check)
    every = selection.selected(found, size, seeds, only)
    points = selection.part(every, shard)
    folder = out or Path("studies") / f"{found.name}-{size}"
    run = StudyRun(found, folder, size, threads)
    if dry_run:
        for point in points:
            for step in found.steps:
                click.echo(shlex.join(["powderdsl", *run.command(step, point, folder / "runs" / point.name)]))
        return OK
    if ray is not None:
        cluster.require_ray()
        cluster.check_address(ray)
    run.prepare()
    try:
        outcomes = _with_progress(run, points, jobs, ray)
    except KeyboardInterrupt:
        click.echo("interrupted; the same command resumes here", err=True)
        raise
    own = {one.point: one for one in outcomes}
    found_of = [own[point] if point in own else run.finished(point) for point in every]
    held, missing = sum(one.held for one in outcomes), sum(one is None for one in found_of)
    if held:
        click.echo(
            f"the study is not complete: other processes hold {counted(held, 'combination')}", err=True
        )
    if missing:
        name = shlex.quote(str(folder))
        click.echo(f"other parts have {counted(missing, 'combination')} that are not done in {name}")
    if held or missing:  # whoever finishes last writes the table, or `collect`
        _tell_lost(outcomes)
    else:
        _report(found, size, folder, [one for one in found_of if one is not None])
    return _status(outcomes)


def _status(outcomes: Sequence[Outcome]) -> int:
    return FAILED if any(one.problem for one in outcomes) else OK


def _with_progress(run: StudyRun, points: list[Point], jobs: int | None, ray: str | None) -> list[Outcome]:
    done = 0
    with progress(run.study.name, len(points)) as show:

        def told(one: Outcome) -> None:
            nonlocal done
            done += 1
            show(done)
            text = ", ".join(f"{name} {value:.4g}" for name, value in one.values.items())
            click.echo(f"{one.point.name}: {one.problem or text}", err=True)

        if ray is not None:
            return cluster.run_on_ray(run, points, ray, jobs, told, partial(click.echo, err=True))
        return run.run(points, jobs or JOBS, told)


def _report(study: Study, size: str, folder: Path, outcomes: list[Outcome]) -> None:
    from powderdsl.experiments.runs.folder import write_json
    from powderdsl.experiments.studies.results import as_data, as_markdown, write_figure
    from powderdsl.system.writing import write_text

    text = printable(as_markdown(study, size, outcomes), lines=True)  # somebody will `cat` it
    write_json(folder / "results.json", as_data(study, size, outcomes))
    write_text(folder / "results.md", text)
    sys.stdout.write(text)
    if find_spec("matplotlib") is None:
        click.echo("no figure: pip install 'powderdsl[plot]'", err=True)
    else:
        write_figure(folder / "figure.png", study, size, outcomes)
        click.echo(str(folder / "figure.png"))
    _tell_lost(outcomes)


def _tell_lost(outcomes: Sequence[Outcome]) -> None:
    lost = sum(one.problem is not None and not one.held for one in outcomes)
    if lost:
        click.echo(
            f"{counted(lost, 'combination')} did not finish; running the study again tries them again",
            err=True,
        )
