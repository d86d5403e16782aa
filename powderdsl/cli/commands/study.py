"""`powderdsl study`: run a grid of settings and seeds, and write a table and a figure."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache, partial
from importlib import import_module
from importlib.util import find_spec
from itertools import count, islice, product
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli import options as opt
from powderdsl.cli.commands import train, wm
from powderdsl.cli.exits import FAILED, OK, BadInput
from powderdsl.cli.output import counted, progress
from powderdsl.compiler import load
from powderdsl.diagnostics import CompileError, Diagnostic, Label, Reporter, suggest, with_suggestion
from powderdsl.diagnostics.printable import printable
from powderdsl.experiments.runs import find_run
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
    READ,
    SIZE,
    SIZES,
    TEXT,
    Measure,
    Point,
    Study,
    StudyStep,
    load_study,
    shipped_studies,
)
from powderdsl.rl.config import TrainConfig, check_task, chosen_policies
from powderdsl.syntax.yaml_tree import Scalar
from powderdsl.system.reading import is_path
from powderdsl.system.writing import writing
from powderdsl.tasks.shipped import check_split, load_task
from powderdsl.tasks.task import Task

if TYPE_CHECKING:
    from powderdsl.worldmodel.config import DataConfig

JOBS = 2
"""The default number of processes at a time."""
MAX_SHARDS = 1_000_000

CALLED = (("train",), ("evaluate",), ("wm", "train"), ("wm", "finetune"), ("wm", "eval"))
"""Commands that a study may call: those that write or evaluate runs."""

NOT_FOR_STUDIES = ("DIR", "DATASET", "MODULE:CLASS", "--ignore-actions")
"""Options that studies cannot set, by metavar or name: folders, which the study chooses, and modules, which would be
imported although a study may be untrusted."""


def called(words: tuple[str, ...]) -> click.Command:
    command: click.Command = import_module(f"powderdsl.cli.commands.{words[0]}").command
    for word in words[1:]:
        assert isinstance(command, click.Group)
        command = command.commands[word]
    return command


def commands() -> Mapping[tuple[str, ...], Mapping[str, str]]:
    """The commands of `CALLED`, with their options, ``run``, and their argument (``on``)."""
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
seeds_option = opt.option("--seeds", (1, 1000), "Number of runs per combination.  [default: the study's]")


def _shard(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,7})/([0-9]{1,7})", text)
    number, of = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= number <= of <= MAX_SHARDS:
        raise ValueError("is not a shard: write 1/4 to 4/4 for four shards")
    return number, of


SHARD = opt.Parsed("I/N", _shard)


def selected(study: Study, size: str, seeds: int | None, only: Mapping[str, str]) -> list[Point]:
    """The selected combinations. Raises BadInput if there are none."""
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
    """A shard of some points: consecutive ones, which mixes large and small settings."""
    number, of = shard or (1, 1)
    return list(points[len(points) * (number - 1) // of : len(points) * number // of])


class StudyCommand(click.Command):
    """`study STUDY`, or the separate command `study collect FOLDER…`."""

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
    """Merge the results of a study that ran in several folders or parts.

    Writes results.md, results.json and figure.png, as if the study had run in one folder. Exits with 1 if results of
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
@opt.option("--size", SIZES, "Size of the study, which selects values of its settings.", "small")
@seeds_option
@opt.option("--jobs", (1, 256), "Number of processes at a time.  [default: 2; with --ray, as many as fit]")
@opt.option("--threads", (1, 256), "Threads per process.", 1)
@only_option
@click.option("--shard", type=SHARD, help="Run only part I of N, for job arrays.")
@opt.option("--ray", "ADDRESS", "Run on a Ray cluster: `auto`, or HOST:PORT of its head.")
@opt.path("--out", "FOLDER", "Folder for the results.  [default: studies/STUDY-SIZE]")
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
    """Run a study: a shipped one, or a file that lists commands and the settings to vary.

    Writes results.md, results.json and figure.png to its folder. The same command resumes the study and adds to the
    results. Combinations that another process is running are skipped. Without STUDY, list the shipped studies;
    `powderdsl study collect FOLDER…` merges results of several folders.
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
    outcomes = {
        outcome.point: (run.finished(outcome.point) if outcome.held else None)
        or outcome  # it may have finished
        for outcome in _with_progress(run, points, jobs, ray)
    }
    finished = [outcomes.get(point) or run.finished(point) for point in every]
    locked, missing = sum(outcome.held for outcome in outcomes.values()), finished.count(None)
    if locked:
        click.echo(
            f"the study is not complete: other processes are running {counted(locked, 'combination')}",
            err=True,
        )
    if missing:
        name = shlex.quote(str(folder))
        click.echo(f"{counted(missing, 'combination')} of other parts are not done in {name}")
    if locked or missing:  # whoever finishes last writes the table, or `collect`
        return _status([*outcomes.values()])
    return _report(loaded, size, folder, [outcome for outcome in finished if outcome is not None])


def _with_progress(run: StudyRun, points: list[Point], jobs: int | None, ray: str | None) -> list[Outcome]:
    done = count(1)
    with progress(run.study.name, len(points), resumes=run.folder) as show:

        def report(outcome: Outcome) -> None:
            show(next(done))
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


# The check before the first command runs: each command with every value of the study. A command's error names the word
# at fault, by which its location in the study is found.

AGENT, NETWORK = "an agent", "a world model"
MAKES = {("train",): AGENT, ("wm", "train"): NETWORK, ("wm", "finetune"): NETWORK}
"""What each command trains."""
WORKS_ON = {("evaluate",): AGENT, ("wm", "finetune"): NETWORK, ("wm", "eval"): NETWORK}
"""What the run that each command works on must have trained."""


def check_study(study: Study, reporter: Reporter, *, devices: bool = True) -> None:
    """Report what a study's commands would reject, and measures of runs that no step evaluates.

    `devices`: also check devices, as the study runs on this machine."""
    check = _StudyCheck(study, reporter, devices)
    points = [point for size in SIZES for point in study.points(size, 1)]
    for step, point in product(study.steps, points):
        check.run_of(step, point)
    for measure in study.measures:
        check.measure(measure)


class _StudyCheck:
    """The check of one study, which loads each task and ruleset once."""

    def __init__(self, study: Study, reporter: Reporter, devices: bool):
        self.study, self.reporter, self.devices = study, reporter, devices
        self.runs: dict[tuple[object, ...], Any] = {}
        self.refused: set[tuple[str, str, str]] = set()
        """Words at fault, by step and option."""
        self.wrong = {step.name for step in study.steps if step.is_wrong}
        """Steps with mistakes, whose consequences are not reported."""
        self.rules = cache(lambda rules, params: load(rules, params=dict(params)))
        self.changed_rules = cache(lambda rules, *more: wm.rules_of(rules or _rules_of(more[0]), *more))

    def run_of(self, step: StudyStep, point: Point) -> Any:
        """Return the settings of the run that a step makes; None if it makes none, or after reporting its mistakes."""
        maker = self.study.works_on(step)
        run = None if maker is None else self.run_of(maker, point)
        if step.is_wrong or (run is None and maker is not None):
            return None
        key = (step.name, id(run), *(point.filled(word) for _, word in step.words))
        if key not in self.runs:
            self.runs[key] = self.checked(step, point, run)
        return self.runs[key]

    def checked(self, step: StudyStep, point: Point, run: Any) -> Any:
        """The settings of a step's run; None after reporting all mistakes in its words.

        Words with mistakes are left out, to find mistakes in the others.
        """
        rest, reported = self.unrefused(step, point), set[str]()
        while rest.on == step.on:
            settings, mistakes = self.attempt(rest, point, run)
            if not mistakes:
                return settings if rest == step else None
            self.wrong.add(step.name)
            for mistake in mistakes:
                name, word = _blamed(mistake, rest, point)
                self.report(mistake, step, point, name, word)
                if word is None or mistake.message in reported:
                    return None
                reported.add(mistake.message)
                self.refused.add((step.name, name, point.filled(word)))
            rest = self.unrefused(rest, point)
        return None

    def unrefused(self, step: StudyStep, point: Point) -> StudyStep:
        """A step without the words at fault."""
        words = [
            pair for pair in step.words if (step.name, pair[0], point.filled(pair[1])) not in self.refused
        ]
        return replace(step, words=tuple(words))

    def attempt(self, step: StudyStep, point: Point, run: Any) -> tuple[Any, Sequence[Diagnostic]]:
        """The settings of a step's run, and the mistakes in its words."""
        try:
            return self.call(step, point, run), ()
        except CompileError as error:
            # If a value is out of range, mistakes in the file that uses it are consequences.
            own = [mistake for mistake in error.diagnostics if mistake.primary.span is None]
            if step.on is not None and own and own[0].code == "PD620":
                steps = [
                    other.name
                    for other in self.study.steps
                    if MAKES.get(other.command) == WORKS_ON[step.command]
                ]
                name = point.filled(step.on)
                message = f"no step before this one and no run `{name}`"
                own = [Diagnostic("PD806", message, Label(None), helps=suggest(name, steps, "steps"))]
            return None, own or error.diagnostics
        except (click.ClickException, ValueError, TypeError) as error:
            message = error.format_message() if isinstance(error, click.ClickException) else str(error)
            return None, (Diagnostic("PD806", " ".join(message.split()), Label(None)),)

    def report(
        self, mistake: Diagnostic, step: StudyStep, point: Point, name: str, word: Scalar | None
    ) -> None:
        """Report a mistake where the value of a word is written, and where it is used."""
        if mistake.primary.span is not None and (word is None or step.means.get(name) in READ):
            self.reporter.add(mistake)  # in the file that the word names
            return
        if word is None:
            self.reporter.add(replace(mistake, primary=Label(step.key.span)))
            return
        names = Template(word.text).get_identifiers()
        span = point.spans.get(names[0]) if len(names) == 1 else None
        used = () if span is None else (Label(word.span, f"as `{point.filled(word)}`"),)
        self.reporter.add(replace(mistake, primary=Label(span or word.span), secondary=used))

    def call(self, step: StudyStep, point: Point, run: Any) -> Any:
        """The settings of a step's run. Raises the errors of its command before it begins to work."""
        command, arguments = called(step.command), self.study.command(step, point, self.study.folder)
        several = {name[2:] for option in command.params if option.multiple for name in option.opts}
        names = set[str]()
        for name, word in step.words:
            text = point.filled(word)
            if step.means.get(name) == FLAG and text not in ("yes", "no"):
                raise ValueError(f"`{name}` is `yes` or `no`, found `{text}`")
            if name in names and name not in several:
                raise ValueError(f"`{name}` takes one value, found `{text}` too")
            names.add(name)
        maker, needs = self.study.works_on(step), WORKS_ON.get(step.command)
        if step.on is not None and step.on_step and (maker is None or MAKES[maker.command] != needs):
            works_on = f"the run of {needs}" if needs else "no run"
            raise ValueError(f"`{' '.join(step.command)}` works on {works_on}, not on `{step.on.text}`")
        context = command.make_context(" ".join(step.command), arguments[len(step.command) :])
        if self.devices and "device" in names:
            from powderdsl.simulation.programs import find_device  # imports torch

            find_device(context.params["device"])
        return self.settings(step.command, context.params, run)

    def settings(self, command: tuple[str, ...], values: Mapping[str, Any], run: Any) -> Any:
        """The settings of the run that a command with these options makes; None for a command that evaluates `run`."""
        match command:
            case ("train",):
                config = train.new_config(values)
                check_task(config, _task(config.task, config.knobs, config.params, config.packs))
                return config
            case ("evaluate",):
                _check_evaluation(values, run)
                return None
            case ("wm", "train"):
                model = wm.new_config(values, self.changed_rules)
                self.check_data(model.data)
                return model
        from powderdsl.worldmodel.evaluation import unseen_data
        from powderdsl.worldmodel.training import KIND, with_packs

        if run is None:
            find_run(values["run"], KIND)
            return None
        if command == ("wm", "finetune"):
            data = with_packs(run.data, run.data.rules or _rules_of(run.data.task), values["packs"])
            run = replace(run, data=data, **opt.given_settings(values, type(run)))
            self.check_data(run.data)
            return run
        self.check_data(unseen_data(run.data, **wm.tested_on(values)))
        return None

    def check_data(self, data: DataConfig) -> None:
        from powderdsl.worldmodel.worlds import check_data

        task = _task(data.task, data.knobs, {} if data.rules else data.params, ())
        own = self.rules(data.rules, tuple(data.params.items())) if data.rules else task.ruleset
        check_data(data, task, own)

    # Measures

    def measure(self, measure: Measure) -> None:
        """Report a measure of a run that no step evaluates."""
        maker = next((step for step in self.study.steps if step.name == measure.of.text), None)
        if maker is None or maker.command not in MAKES:
            return  # reported by the reader
        tests = [step for step in self.study.steps if not step.makes_run]
        if not any(self.study.works_on(step) == maker or step.name in self.wrong for step in tests):
            command = "evaluate" if MAKES[maker.command] == AGENT else "wm eval"
            helps = [f"add a step such as `tested: {{command: {command}, on: {maker.name}}}`"]
            self.reporter.error("PD806", f"no step evaluates `{maker.name}`", measure.of.span, helps=helps)


def _check_evaluation(values: Mapping[str, Any], run: TrainConfig | None) -> None:
    """Raise the errors of `evaluate` before it plays. For runs made outside the study, only the path is checked."""
    if run is None:
        task = opt.find_played(values["run"], values["knobs"], values["settings"], values["packs"])
        if not isinstance(task, Task):
            return
    elif values["knobs"] or values["settings"]:
        raise BadInput("--knob and --set require a task: a run has its own values")
    else:
        task = _task(run.task, run.knobs, run.params, (*run.packs, *values["packs"]))
    for split in values["splits"] or ():
        check_split(task, split)
    chosen_policies(values["policies"], task, trained=run is not None)


def _task(name: str, knobs: Mapping[str, int], params: Mapping[str, Any], packs: Sequence[str]) -> Task:
    """A task, loaded once for all values of its knobs within their ranges, as those do not affect the check."""
    more = str(Path(name).absolute()) if is_path(name) else name, tuple(params.items()), tuple(packs)
    task = _load_task((), *more)
    ranges = {knob.name: range(knob.lo, knob.hi + 1) for knob in task.knobs}
    wrong = tuple((knob, value) for knob, value in knobs.items() if value not in ranges.get(knob, ()))
    return _load_task(wrong, *more) if wrong else task


@lru_cache(maxsize=64)
def _load_task(
    knobs: tuple[tuple[str, int], ...], name: str, params: tuple[tuple[str, Any], ...], packs: tuple[str, ...]
) -> Task:
    return load_task(name, knobs=dict(knobs), params=dict(params), packs=packs)


def _rules_of(task: str) -> str:
    return "+".join(_task(task, {}, {}, ()).rules)


def _blamed(mistake: Diagnostic, step: StudyStep, point: Point) -> tuple[str, Scalar | None]:
    """The option and the word that a mistake names; no word if it names several options or none."""
    named = {*re.findall(r"(?:[`'(]|--|found )([\w.%:/-]+)", mistake.message)}
    variables = {name[2:]: option.name for option in called(step.command).params for name in option.opts}
    suspects: list[tuple[int, str, Scalar]] = []
    for name, word in step.words:
        text = point.filled(word)
        parts = {name, variables.get(name), text, *re.split("[-,=+]", text)}
        suspects.append((len(parts & named), name, word))
    most = max(score for score, _, _ in [*suspects, (1, "", step.key)])
    best = {name: word for score, name, word in suspects if score == most}
    return next(iter(best.items())) if len(best) == 1 else ("", None)
