"""`powderdsl study`: many runs over a grid of settings, with one table and one figure at the end."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import click

from powderdsl.cli import options as opt
from powderdsl.cli.dispatch import COMMANDS
from powderdsl.cli.exits import FAILED, OK, BadInput
from powderdsl.cli.output import counted, progress
from powderdsl.cli.study.checks import check_study
from powderdsl.diagnostics.printable import printable
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

EXECUTED = ("MODULE:CLASS",)
"""Metavars of options that execute code, which no study may name: it may come from a stranger."""


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
            if one.metavar in EXECUTED:
                continue
            found[words] |= {name[2:]: means for name in one.opts if name.startswith("--")}
    return found


def called(words: tuple[str, ...]) -> click.Command:
    """The click command that some words name."""
    found: click.Command = import_module(f"powderdsl.cli.commands.{COMMANDS[words[0]][0]}").command
    for word in words[1:]:
        assert isinstance(found, click.Group)
        found = found.commands[word]
    return found


@click.command("study")
@click.argument("study", metavar="STUDY", required=False)
@opt.choice("--size", SIZES, "Size of the study: values of its settings.", "small")
@opt.integer("--seeds", 1, 1000, "Runs of each combination.  [default: the study's]")
@opt.integer("--jobs", 1, 256, "Processes that run at a time.", 2)
@opt.integer("--threads", 1, 256, "Threads per process.", 1)
@opt.text("--only", "NAME=VALUE", "Run only combinations with this value. May be repeated.", multiple=True)
@opt.path("--out", "FOLDER", "Folder of the results.  [default: studies/STUDY-SIZE]")
@opt.flag("--dry-run", "Print the commands without running them.")
def command(
    study: str | None,
    size: str,
    seeds: int | None,
    jobs: int,
    threads: int,
    only: tuple[str, ...],
    out: Path | None,
    dry_run: bool,
) -> int:
    """Run a study: a file that names commands and the settings to vary, or a shipped one.

    Writes results.md, results.json and figure.png to its folder. The same call continues where it stopped, and adds to
    what is there. Without STUDY, lists those that come with powderdsl.
    """
    known = commands()
    if study is None:
        for name in shipped_studies():
            click.echo(f"{name:24} {load_study(name, known).about}")
        return OK
    found = load_study(study, known, lambda read, reporter: check_study(read, reporter, called))
    points = [point for point in found.points(size, seeds) if _chosen(found, point, only)]
    if not points:
        raise BadInput(f"no combination has {' and '.join(only)}")
    folder = out or Path("studies") / f"{found.name}-{size}"
    run = StudyRun(found, folder, size, threads)
    if dry_run:
        for point in points:
            for step in found.steps:
                click.echo(shlex.join(["powderdsl", *run.command(step, point, folder / "runs" / point.name)]))
        return OK
    run.prepare()
    try:
        outcomes = _with_progress(run, points, jobs)
    except KeyboardInterrupt:
        click.echo("interrupted; the same command resumes here", err=True)
        raise
    _report(found, size, folder, outcomes)
    return FAILED if any(one.problem for one in outcomes) else OK


def _chosen(study: Study, point: Point, only: tuple[str, ...]) -> bool:
    """Whether a combination has the values that were asked for."""
    values = dict(point.values)
    for text in only:
        name, equals, value = text.partition("=")
        if not equals or name not in values:
            raise BadInput(f"`--only {text}`: write NAME=VALUE, with one of {', '.join(values)} as NAME")
        if values[name] != value:
            return False
    return True


def _with_progress(run: StudyRun, points: list[Point], jobs: int) -> list[Outcome]:
    done = 0
    with progress(run.study.name, len(points)) as show:

        def told(one: Outcome) -> None:
            nonlocal done
            done += 1
            show(done)
            text = ", ".join(f"{name} {value:.4g}" for name, value in one.values.items())
            click.echo(f"{one.point.name}: {one.problem or text}", err=True)

        return run.run(points, jobs, told)


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
    lost = sum(one.problem is not None for one in outcomes)
    if lost:
        click.echo(f"{counted(lost, 'combination')} did not finish; the same command tries again", err=True)
