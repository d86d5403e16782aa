"""Check a study before its first command runs: each command with every value of the study.

Commands say why they refuse their words, but not where the study has these: the word is to blame that a mistake names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from importlib import import_module
from itertools import product
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli.commands import train, wm
from powderdsl.cli.exits import BadInput
from powderdsl.cli.options import find_played, given_settings
from powderdsl.compiler import load
from powderdsl.diagnostics import CompileError, Diagnostic, Label, Reporter, suggest
from powderdsl.experiments.runs import find_run
from powderdsl.experiments.studies.study import FLAG, READ, SIZES, Measure, Point, Study, StudyStep
from powderdsl.rl.config import TrainConfig, check_task, chosen_policies
from powderdsl.syntax.yaml_tree import Scalar
from powderdsl.system.reading import is_path
from powderdsl.tasks.shipped import check_split, load_task
from powderdsl.tasks.task import Task

if TYPE_CHECKING:
    from powderdsl.worldmodel.config import DataConfig

AGENT, NETWORK = "an agent", "a world model"
MAKES = {("train",): AGENT, ("wm", "train"): NETWORK, ("wm", "finetune"): NETWORK}
"""What the runs of commands train."""
WORKS_ON = {("evaluate",): AGENT, ("wm", "finetune"): NETWORK, ("wm", "eval"): NETWORK}
"""What the runs that commands work on have trained."""


def called(words: tuple[str, ...]) -> click.Command:
    command: click.Command = import_module(f"powderdsl.cli.commands.{words[0]}").command
    for word in words[1:]:
        assert isinstance(command, click.Group)
        command = command.commands[word]
    return command


def check_study(study: Study, reporter: Reporter, *, devices: bool = True) -> None:
    """Report what a study's commands would refuse, and measures of runs that no step evaluates.

    `devices`: whether it runs on this machine."""
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
        """Words that are to blame for mistakes, by step and option."""
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

        Words with mistakes are left out, which shows what is wrong with others.
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
        """A step without words that are to blame for mistakes."""
        words = [
            pair for pair in step.words if (step.name, pair[0], point.filled(pair[1])) not in self.refused
        ]
        return replace(step, words=tuple(words))

    def attempt(self, step: StudyStep, point: Point, run: Any) -> tuple[Any, Sequence[Diagnostic]]:
        """The settings of a step's run, and the mistakes in its words."""
        try:
            return self.call(step, point, run), ()
        except CompileError as error:
            # Where a value is out of range, mistakes in the file that uses it are consequences.
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
        """The settings of a step's run. Raises what its command would raise before it begins to work."""
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
        """The settings of the run that a command makes with these options; None for a command that evaluates `run`."""
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
            run = replace(run, data=data, **given_settings(values, type(run)))
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
    """Raise what `evaluate` raises before it plays. Of runs that the study does not make, only the path is checked."""
    if run is None:
        task = find_played(values["run"], values["knobs"], values["settings"], values["packs"])
        if not isinstance(task, Task):
            return
    elif values["knobs"] or values["settings"]:
        raise BadInput("--knob and --set go with a task: a run has its own")
    else:
        task = _task(run.task, run.knobs, run.params, (*run.packs, *values["packs"]))
    for split in values["splits"] or ():
        check_split(task, split)
    chosen_policies(values["policies"], task, trained=run is not None)


def _task(name: str, knobs: Mapping[str, int], params: Mapping[str, Any], packs: Sequence[str]) -> Task:
    """A task. Knobs within their ranges do not change what is checked, so that it is loaded once for all of them."""
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
    """The option and the word that a mistake names; no word where it names several options alike, or none."""
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
