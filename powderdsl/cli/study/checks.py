"""Check a study before its first command runs, with every value of the study, as the commands would check it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli.options import knob_values
from powderdsl.cli.study.measures import POLICIES, check_measure, check_unused
from powderdsl.cli.study.places import Places, Values, Word
from powderdsl.compiler import load
from powderdsl.diagnostics import CompileError, Reporter, suggest
from powderdsl.experiments.studies.study import Study, StudyStep
from powderdsl.tasks.shipped import check_split, is_task, load_task

if TYPE_CHECKING:
    from powderdsl.tasks.task import Task

PPO, WORLD_MODEL = "ppo", "worldmodel"
KINDS = {PPO: "an agent", WORLD_MODEL: "a world model"}
"""Kinds of runs, and what they are of."""
MAKES = {("train",): PPO, ("wm", "train"): WORLD_MODEL, ("wm", "finetune"): WORLD_MODEL}
"""What kind of run a command makes."""
NEEDS = {("evaluate",): PPO, ("wm", "finetune"): WORLD_MODEL, ("wm", "eval"): WORLD_MODEL}
"""What kind of run a command works on."""
SHORT_KNOBS = ("lines", "disks", "complexity", "kinds", "squares")
"""Knobs that have options of their own, whose values have the same names."""
DEFAULT_TASK = "world-model"
DEFAULT_SPLITS = {("train",): "train", ("wm", "train"): "train", ("wm", "eval"): "designed"}
VARIETY = {"chances": "chances", "swap": "swaps", "leave-out": "leave_out", "first-ruleset": "first_ruleset"}
"""Options that say how rulesets vary, and the names of their values."""


@dataclass(frozen=True)
class Call:
    """A step with some values of the study.

    `words`: those of each option. `given`: values of options by the names of the command's parameters.
    """

    step: StudyStep
    values: Values
    words: Mapping[str, Sequence[Word]]
    given: Mapping[str, Any]

    def all(self, *options: str) -> list[Word]:
        """The words of some options, in this order."""
        return [word for option in options for word in self.words.get(option, ())]

    def first(self, option: str) -> Word | None:
        """The word of an option that takes one."""
        return next(iter(self.all(option)), None)


def check_study(
    study: Study,
    reporter: Reporter,
    find: Callable[[tuple[str, ...]], click.Command],
    *,
    devices: bool = True,
) -> None:
    """Report what a study's commands would refuse, measures that lead to no number, and settings that nothing uses.

    Args:
        find: the command of some words. devices: whether the study runs on this machine, with its devices.
    """
    check = _StudyCheck(study, reporter, find, devices)
    for step in study.steps:
        check.step(step)
    for measure in study.measures:
        check_measure(check.places, measure, check.task_of)
    check_unused(check.places)


Pairs = tuple[tuple[str, Any], ...]


def _task(text: str, knobs: Pairs = (), params: Pairs = ()) -> Task:
    path = Path(text)
    return _loaded(text, knobs, params, path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=64)
def _loaded(text: str, knobs: Pairs, params: Pairs, stamp: int) -> Task:
    """A task, once for all of its uses; `stamp` tells versions of a file apart."""
    return load_task(text, knobs=dict(knobs), params=dict(params))


class _StudyCheck:
    """The check of one study."""

    def __init__(
        self,
        study: Study,
        reporter: Reporter,
        find: Callable[[tuple[str, ...]], click.Command],
        devices: bool,
    ):
        self.devices = devices
        self.places, self.reporter, self.find = Places(study, reporter), reporter, find
        self.report, self.told = self.places.report, self.places.told
        self.done: set[tuple[object, ...]] = set()
        """Questions that have been answered: most words are the same with all values."""

    def first_time(self, *question: object) -> bool:
        """Whether a question has not been answered before."""
        new = question not in self.done
        self.done.add(question)
        return new

    def step(self, step: StudyStep) -> None:
        """Report all mistakes of a step."""
        self.works_on(step)
        used = self.places.names_of(step)
        if not self.places.known(used):
            return
        for values in self.places.values(used):
            words = self.places.words(step, values)
            call = Call(step, values, words, self.converted(step, words))
            self.device(call)
            match step.command:
                case ("train",):
                    self.train(call)
                case ("evaluate",):
                    self.evaluate(call)
                case ("wm", "train"):
                    self.world_model(call)
                case _:
                    self.on_world_model(call)

    def works_on(self, step: StudyStep) -> None:
        """Whether a step works on what its command takes."""
        command, needs = " ".join(step.command), NEEDS.get(step.command)
        runs = self.steps_with(needs)
        message, label = "", ""
        helps: tuple[str, ...] = ()
        if step.command == ("wm", "train"):
            if step.on is not None:
                message, label = f"`{command}` does not work on anything", "leave this out"
                helps = ("`task:` names its task",)
        elif step.on is None:
            what = f"the run of {KINDS[needs]}" if needs else "a task"
            message = f"`{command}` works on {what}, and this step has no `on`"
            helps = (f"write `on: {runs[0]}`" if runs else "write `on:` and its name",)
        elif step.on_step and needs is None:
            message, helps = f"`{command}` works on a task, not on a run", ("write the name of a task",)
        elif step.on_step and needs is not None:
            made = MAKES.get(self.places.maker(step).command)
            if made != needs:
                message = f"`{command}` works on the run of {KINDS[needs]}"
                label = f"its run is {KINDS[made]}" if made else "it has no run"
                helps = suggest(str(step.on), runs, "steps with such runs")
        if message:
            self.places.wrong.add(step.name)
            span = self.places.place("step" if step.on is None else "on", step.name)
            self.reporter.error("PD806", message, span, label, helps=helps)

    def steps_with(self, kind: str | None) -> list[str]:
        """The names of the steps whose runs are of a kind."""
        return [one.name for one in self.places.study.steps if kind and MAKES.get(one.command) == kind]

    def options_of(self, step: StudyStep) -> dict[str, click.Option]:
        """The options of a step's command, by their names without dashes."""
        params = self.find(step.command).params
        return {name[2:]: one for one in params if isinstance(one, click.Option) for name in one.opts}

    def converted(self, step: StudyStep, words: Mapping[str, Sequence[Word]]) -> dict[str, Any]:
        """The values of a step's options by the names of the command's parameters; what cannot be converted is reported."""
        params = self.options_of(step)
        context = click.Context(self.find(step.command), info_name=step.name)
        found: dict[str, Any] = {}
        for option, given in words.items():
            param = params.get(option)
            if param is None:
                continue
            if not given:
                place = self.places.place("option", step.name, option)
                self.reporter.error("PD806", f"`{option}` has no value", place)
            elif len(given) > 1 and not param.multiple:
                self.report(given[1], f"`{option}` takes one value, found {len(given)}")
            elif param.is_flag:
                for word in given:
                    if word.filled not in ("yes", "no"):
                        self.report(word, f"`{option}` is `yes` or `no`, found `{word.filled}`")
            else:
                for word in given:
                    if not Template(word.text).is_valid():  # that is reported
                        continue
                    value = (word.filled,) if param.multiple else word.filled
                    try:
                        value = param.process_value(context, value)
                    except click.ClickException as error:
                        self.done.add((step.name, option, word.filled))  # it is wrong: nothing else is asked
                        self.report(word, f"`{option}`: {' '.join(error.message.split())}")
                    else:
                        found |= {} if param.multiple else {param.name or "": value}
        return found

    # What several commands take

    def device(self, call: Call) -> None:
        """Whether the machine has the device of a step, which all of its runs would need."""
        word = call.first("device")
        if self.devices and word is not None and self.first_time(word.step, "device", word.filled):
            from powderdsl.simulation.programs import find_device  # imports torch

            with self.told(word):
                find_device(word.filled)

    def task(self, where: Word | StudyStep, text: str) -> Task | None:
        """The task that a text names; None after reporting that there is none."""
        found: Task | None = None
        with self.told(where):
            found = _task(text)
        return found

    def knobs_and_params(self, call: Call, name: str, task: Task) -> None:
        """Check knobs of a task, and parameters of its rules, one by one."""
        known = {one.name: one for one in task.knobs}
        options = self.options_of(call.step)
        short = {name: str(one.name) for name, one in options.items() if one.name in SHORT_KNOBS}
        for word in call.all("knob", "set", *short):
            wrong = (word.step, word.option, word.filled) in self.done
            if wrong or not self.first_time(word.step, word.option, word.filled, name):
                continue
            with self.told(word, here=True):
                if word.option == "set":
                    param, _, value = word.filled.partition("=")
                    _task(name, (), ((param.strip(), value.strip()),))
                    continue
                written = f"{short[word.option]}={word.filled}" if word.option in short else word.filled
                for knob, number in knob_values((written,)).items():
                    if knob not in known or not known[knob].lo <= number <= known[knob].hi:
                        _task(name, ((knob, number),))

    def split(self, call: Call, task: Task) -> None:
        """The split of a step, or the usual one."""
        word = call.first("split")
        with self.told(word or call.step):
            check_split(task, DEFAULT_SPLITS[call.step.command] if word is None else word.filled)

    def run(self, word: Word, kind: str) -> None:
        """Whether `on`, where it does not name an earlier step, names a run."""
        from powderdsl.experiments.runs import find_run

        if not self.first_time(word.step, "on", word.filled):
            return
        try:
            find_run(word.filled, kind)
        except CompileError as error:
            what = f"there is no step and no run `{word.written}`"
            if word.text in self.places.steps:
                what = f"the step `{word.text}` does not come before this one"
            notes = [note for one in error.diagnostics for note in one.notes]
            self.report(word, what, notes=notes, helps=suggest(word.text, self.steps_with(kind), "steps"))

    # Agents

    def train(self, call: Call) -> None:
        from powderdsl.rl.config import PRESETS, TrainConfig, check_task, preset

        on = call.first("on")
        task = None if on is None else self.task(on, on.filled)
        if on is not None and task is not None:
            self.knobs_and_params(call, on.filled, task)
            self.split(call, task)
        start = call.given.get("preset_name", "paper")
        if start not in PRESETS:
            return
        known = {one.name for one in fields(TrainConfig)}
        asked = {name: value for name, value in call.given.items() if name in known}
        wrong = False
        for option, param in self.options_of(call.step).items():
            if param.name in asked:
                with self.told(call.first(option) or call.step) as failed:
                    preset(start, "task", **{param.name: asked[param.name]})
                wrong |= bool(failed)
        if not wrong:
            with self.told(call.step):
                config = preset(start, "task", **asked)
                if task is not None:
                    check_task(config, task)

    def evaluate(self, call: Call) -> None:
        on, task = call.first("on"), self.task_of(call.step, call.values)
        if on is not None and not is_task(on.filled):
            self.run(on, PPO)
        elif on is not None and task is None:
            task = self.task(on, on.filled)
        if task is None:
            return
        if on is not None:
            self.knobs_and_params(call, on.filled, task)
        else:
            for word in call.all("knob", "set"):
                self.report(word, f"`{word.option}` goes with a task: a run has its own")
        for word in call.all("splits"):
            for split in word.filled.split(","):
                with self.told(word):
                    check_split(task, split.strip())
        there = {"trained": bool(call.step.on_step), "expert": task.expert is not None}
        known = [one for one in POLICIES if there.get(one, True)]
        for word in call.all("policies"):
            for policy in map(str.strip, word.filled.split(",")):
                if policy not in known:
                    helps = suggest(policy, known, "policies")
                    self.report(word, f"there is no policy `{policy}`", helps=helps)

    def task_of(self, step: StudyStep, values: Values) -> Task | None:
        """The task that `evaluate` plays; None if it is not known, or wrong where it is first named."""
        step = self.places.maker(step) if step.on_step else step
        on = next(iter(self.places.words(step, values).get("on", ())), None)
        if on is None or step.command not in (("train",), ("evaluate",)) or not is_task(on.filled):
            return None
        try:
            return _task(on.filled)
        except CompileError:
            return None

    # World models

    def world_model(self, call: Call) -> None:
        word = call.first("task")
        name = DEFAULT_TASK if word is None else word.filled
        task = self.task(word or call.step, name)
        if task is None:
            return
        self.knobs_and_params(call, name, task)
        self.split(call, task)
        self.rules(call, name)
        if call.all("packs") and call.all("held-out"):
            message = "`packs` says what stays, `held-out` what goes: give one of them"
            self.report(call.all("held-out")[0], message)
        varied = [word for option in VARIETY if (word := call.first(option))]
        if not call.given.get("rulesets"):
            for word in varied:
                self.report(word, f"`{word.option}` says which rulesets are drawn: `rulesets` says how many")
        known = [one.name for one in task.ruleset.properties]
        for word in () if call.all("rules") else call.all("swap"):
            if word.filled not in known:
                message = f"the rules {task.ruleset.name} have no property `{word.filled}`"
                helps = suggest(word.filled, known, "properties")
                self.report(word, message, code="PD301", helps=helps)
        for word in varied:
            value = call.given.get(VARIETY[word.option])
            if word.option in ("chances", "leave-out") and value is not None:
                from powderdsl.worldmodel.config import Variety

                with self.told(word):
                    Variety(**{VARIETY[word.option]: value})

    def on_world_model(self, call: Call) -> None:
        """A step that works on the run of a world model."""
        step = call.step
        if step.command == ("wm", "finetune") and not call.all("packs"):
            self.report(step, "`wm finetune` needs `packs`: what is to be learned")
        if not step.on_step:
            for on in call.all("on"):
                self.run(on, WORLD_MODEL)
            return
        made = self.places.maker(step)
        learned: list[str] = []
        while made.command != ("wm", "train") and made.on_step:
            learned += [word.filled for word in self.places.words(made, call.values).get("packs", ())]
            made = self.places.maker(made)
        if made.command != ("wm", "train"):
            return
        trained, word = Call(made, call.values, self.places.words(made, call.values), {}), call.first("task")
        trained_on, rules = trained.first("task"), trained.first("rules")
        name = DEFAULT_TASK if trained_on is None else trained_on.filled
        try:
            task = _task(name) if word is None else self.task(word, word.filled)
        except CompileError:  # reported where it is trained
            return
        if task is None:
            return
        self.rules(call, name, None if rules is None else rules.filled)
        if step.command == ("wm", "eval"):
            if rules is None and not call.all("rules"):
                added = [one.filled for one in trained.all("packs")]
                self.only(call, [*_task(name).ruleset.packs, *added, *learned])
            self.knobs_and_params(call, name if word is None else word.filled, task)
            self.split(call, task)

    def only(self, call: Call, packs: Sequence[str]) -> None:
        """Whether worlds can draw elements of some packs alone. The names of packs in files are not known here."""
        if any("." in pack for pack in packs):
            return
        for word in call.all("only"):
            if word.filled not in packs:
                helps = suggest(word.filled, packs, "packs")
                self.report(word, f"the rules have no pack `{word.filled}`", code="PD304", helps=helps)

    def rules(self, call: Call, task: str, base: str | None = None) -> None:
        """The rules of a step, and packs that are added or left out. `base`: those that a network was trained on."""
        named = call.first("rules")
        if named is not None:
            base = named.filled
            if self.first_time(named.step, "rules", base):
                with self.told(named):
                    load(base)
        packs, held_out = call.all("packs"), call.all("held-out")
        question = (base or task, *(word.filled for word in (*packs, *held_out)))
        if (not packs and not held_out) or not self.first_time(call.step.name, "packs", question):
            return
        from powderdsl.worldmodel.rule_words import add, keep, leave_out

        try:
            start = base or "+".join(_task(task).rules)
            load(start)
        except CompileError:  # reported where it is named
            return
        change = add if call.step.command == ("wm", "finetune") else keep
        for given, alone, together in ((packs, add, change), (held_out, leave_out, leave_out)):
            wrong = []
            for word in given:
                with self.told(word) as failed:
                    # Leaving out a pack of the rules may need others to be left out as well.
                    if alone is add or word.filled not in load(start).packs:
                        load(alone(start, (word.filled,)))
                wrong += failed
            if given and not wrong:
                with self.told(given[0]):
                    load(together(start, [word.filled for word in given]))
