"""Studies are checked before the first command runs: with every value of the study, as the commands themselves would."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli.study.measures import POLICIES, check_measure, check_unused
from powderdsl.cli.study.places import Places, Values, Word
from powderdsl.cli.task_sheets import knob_values
from powderdsl.compiler import load
from powderdsl.diagnostics import CompileError, Reporter, suggest
from powderdsl.experiments.studies.study import Study, StudyStep
from powderdsl.tasks.shipped import check_split, is_task, load_task

if TYPE_CHECKING:
    from powderdsl.tasks.task import Task

Words = Mapping[str, Sequence[Word]]
"""The words of a step, by option."""

PPO, WORLD_MODEL = "an agent", "a world model"
MAKES: dict[tuple[str, ...], str] = {
    ("train",): PPO,
    ("wm", "train"): WORLD_MODEL,
    ("wm", "finetune"): WORLD_MODEL,
}
"""What the runs of a command are."""
NEEDS: dict[tuple[str, ...], str] = {
    ("evaluate",): PPO,
    ("wm", "finetune"): WORLD_MODEL,
    ("wm", "eval"): WORLD_MODEL,
}
"""What kind of run a command works on."""
RUN_KINDS = {PPO: "ppo", WORLD_MODEL: "worldmodel"}
KNOBS: dict[tuple[str, ...], dict[str, str]] = {
    ("train",): {"n-lines": "lines", "n-disks": "disks", "complexity": "complexity"},
    ("wm", "train"): {"elements": "kinds", "lines": "lines", "disks": "disks", "squares": "squares"},
}
"""Options that are short for a knob."""
DEFAULT_TASK = "world-model"
DEFAULT_SPLITS = {("train",): "train", ("wm", "train"): "train", ("wm", "eval"): "designed"}
VARIETY = {"chances": "chances", "swap": "swaps", "leave-out": "leave_out", "first-ruleset": "first_ruleset"}
"""Options that say how rulesets vary, and the names of their values."""


def check_study(study: Study, reporter: Reporter, find: Callable[[tuple[str, ...]], click.Command]) -> None:
    """Report what a study's commands would refuse, measures that lead to no number, and settings that nothing uses.

    Args:
        find: the command of some words.
    """
    check = _StudyCheck(study, reporter, find)
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


def _first(words: Words, option: str) -> Word | None:
    given = words.get(option, ())
    return given[0] if given else None


class _StudyCheck:
    """The check of one study."""

    def __init__(self, study: Study, reporter: Reporter, find: Callable[[tuple[str, ...]], click.Command]):
        self.places, self.reporter, self.find = Places(study, reporter), reporter, find
        self.report, self.told = self.places.report, self.places.told
        self.done: set[tuple[object, ...]] = set()
        """Questions that have been answered: most words are the same with all values."""

    def asked(self, *question: object) -> bool:
        """Whether a question has been answered; now it has."""
        if question in self.done:
            return True
        self.done.add(question)
        return False

    def step(self, step: StudyStep) -> None:
        """All mistakes of a step."""
        self.works_on(step)
        used = self.places.names_of(step)
        if not self.places.known(used):
            return
        for values in self.places.values(used):
            words = self.places.words(step, values)
            given = self.converted(step, words)
            self.device(step, words)
            if step.command == ("train",):
                self.train(step, words, given)
            elif step.command == ("evaluate",):
                self.evaluate(step, words, values)
            elif step.command == ("wm", "train"):
                self.world_model(step, words, given)
            else:
                self.on_world_model(step, words, values)

    def works_on(self, step: StudyStep) -> None:
        """Whether a step works on what its command takes."""
        command = " ".join(step.command)
        needs = NEEDS.get(step.command)
        runs = [one.name for one in self.places.study.steps if needs and MAKES.get(one.command) == needs]
        if step.on is None:
            if step.command == ("wm", "train"):
                return
            what = f"the run of {needs}" if needs else "a task"
            fix = f"write `on: {runs[0]}`" if runs else "write `on:` and its name"
            self.report(None, step, f"`{command}` works on {what}, and this step has no `on`", helps=(fix,))
            return
        message, label = "", ""
        helps: tuple[str, ...] = ()
        if step.command == ("wm", "train"):
            message, label = f"`{command}` does not work on anything", "leave this out"
            helps = ("`task:` names its task",)
        elif step.on_step and step.command == ("train",):
            message, helps = f"`{command}` works on a task, not on a run", ("write the name of a task",)
        elif step.on_step:
            made = MAKES.get(self.places.maker(step).command)
            if made != needs:
                message = f"`{command}` works on the run of {needs}"
                label = f"its run is {made}" if made else "it has no run"
                helps = suggest(step.on, runs, "steps with such runs")
        if message:
            self.places.wrong.add(step.name)
            place = self.places.place("on", step.name)
            self.reporter.error("PD806", message, place, label, helps=helps)

    def converted(self, step: StudyStep, words: Words) -> dict[str, Any]:
        """The values of a step's options by the names of the command's parameters; those that cannot be are reported."""
        command = self.find(step.command)
        params: dict[str, click.Option] = {
            name[2:]: one for one in command.params if isinstance(one, click.Option) for name in one.opts
        }
        context = click.Context(command, info_name=step.name)
        found: dict[str, Any] = {}
        for option, given in words.items():
            param = params.get(option)
            if param is None:
                continue
            if not given:
                place = self.places.place("option", step.name, option)
                self.reporter.error("PD806", f"`{option}` has no value", place)
            elif len(given) > 1 and not param.multiple:
                self.report(given[1], step, f"`{option}` takes one value, found {len(given)}")
            elif param.is_flag:
                for word in given:
                    if word.filled not in ("yes", "no"):
                        self.report(word, step, f"`{option}` is `yes` or `no`, found `{word.filled}`")
            else:
                for word in given:
                    if not Template(word.text).is_valid():  # that is reported
                        continue
                    try:
                        value = param.process_value(
                            context, (word.filled,) if param.multiple else word.filled
                        )
                        if not param.multiple:
                            found[param.name or ""] = value
                    except click.ClickException as error:
                        self.done.add((step.name, option, word.filled))  # it is wrong: nothing else is asked
                        self.report(word, step, f"`{option}`: {' '.join(error.message.split())}")
        return found

    # What commands ask for

    def device(self, step: StudyStep, words: Words) -> None:
        """Whether the machine has the device of a step, which all of its runs would need."""
        from powderdsl.simulation.programs import find_device

        word = _first(words, "device")
        if word is not None and not self.asked(step.name, "device", word.filled):
            with self.told(word, step):
                find_device(word.filled)

    def task(self, step: StudyStep, word: Word | None, text: str) -> Task | None:
        """The task of some words; None after reporting that there is none."""
        found: Task | None = None
        with self.told(word, step):
            found = _task(text)
        return found

    def knobs_and_params(self, step: StudyStep, words: Words, name: str, task: Task) -> None:
        """Knobs of a task, and parameters of its rules, each alone."""
        known = {one.name: one for one in task.knobs}
        short = KNOBS.get(step.command, {})
        for option in ("knob", "set", *short):
            for word in words.get(option, ()):
                wrong = (step.name, option, word.filled) in self.done
                if wrong or self.asked(step.name, option, word.filled, name):
                    continue
                with self.told(word, step, here=True):
                    if option == "set":
                        param, _, value = word.filled.partition("=")
                        _task(name, (), ((param.strip(), value.strip()),))
                        continue
                    written = f"{short[option]}={word.filled}" if option in short else word.filled
                    for knob, number in knob_values((written,)).items():
                        if knob not in known or not known[knob].lo <= number <= known[knob].hi:
                            _task(name, ((knob, number),))

    def split(self, step: StudyStep, words: Words, task: Task) -> None:
        """The split of a step, or the usual one."""
        word = _first(words, "split")
        with self.told(word, step):
            check_split(task, DEFAULT_SPLITS[step.command] if word is None else word.filled)

    def run(self, step: StudyStep, word: Word) -> None:
        """Whether there is a run that `on` names, which is not a step before."""
        from powderdsl.experiments.runs import find_run

        if self.asked(step.name, "on", word.filled):
            return
        needs = NEEDS[step.command]
        try:
            find_run(word.filled, RUN_KINDS[needs])
        except CompileError as error:
            runs = [one.name for one in self.places.study.steps if MAKES.get(one.command) == needs]
            what = f"there is no step and no run `{word.written}`"
            if word.text in self.places.steps:
                what = f"the step `{word.text}` does not come before this one"
            notes = [note for one in error.diagnostics for note in one.notes]
            self.report(word, step, what, notes=notes, helps=suggest(word.text, runs, "steps"))

    # Agents

    def train(self, step: StudyStep, words: Words, given: Mapping[str, Any]) -> None:
        from powderdsl.rl.config import PRESETS, TrainConfig, preset

        on = _first(words, "on")
        task = self.task(step, on, on.filled) if on is not None else None
        if on is not None and task is not None:
            self.knobs_and_params(step, words, on.filled, task)
            self.split(step, words, task)
        start = given.get("preset_name", "paper")
        if start not in PRESETS:
            return
        options = {one.name or "": one.opts[0][2:] for one in self.find(step.command).params}
        known = {one.name for one in fields(TrainConfig)}
        asked = {name: value for name, value in given.items() if name in known}
        wrong = False
        for name, value in asked.items():
            with self.told(_first(words, options[name]), step) as failed:
                preset(start, "task", **{name: value})
            wrong |= bool(failed)
        if not wrong:
            with self.told(None, step):
                preset(start, "task", **asked)

    def evaluate(self, step: StudyStep, words: Words, values: Values) -> None:
        on, task = _first(words, "on"), self.task_of(step, values)
        if on is not None and not is_task(on.filled):
            self.run(step, on)
        elif on is not None and task is None:
            task = self.task(step, on, on.filled)
        if task is None:
            return
        if on is not None:
            self.knobs_and_params(step, words, on.filled, task)
        else:
            for word in (*words.get("knob", ()), *words.get("set", ())):
                self.report(word, step, f"`{word.option}` goes with a task: a run has its own")
        for word in words.get("splits", ()):
            for split in word.filled.split(","):
                with self.told(word, step):
                    check_split(task, split.strip())
        policies = POLICIES if step.on_step else POLICIES[1:]
        for word in words.get("policies", ()):
            for policy in word.filled.split(","):
                if policy.strip() not in policies:
                    helps = suggest(policy.strip(), policies, "policies")
                    self.report(word, step, f"there is no policy `{policy.strip()}`", helps=helps)

    def task_of(self, step: StudyStep, values: Values) -> Task | None:
        """The task that `evaluate` plays; None if it is not known, or wrong where it is first named."""
        step = self.places.maker(step) if step.on_step else step
        on = _first(self.places.words(step, values), "on")
        if on is None or step.command not in (("train",), ("evaluate",)) or not is_task(on.filled):
            return None
        try:
            return _task(on.filled)
        except CompileError:
            return None

    # World models

    def world_model(self, step: StudyStep, words: Words, given: Mapping[str, Any]) -> None:
        word = _first(words, "task")
        name = DEFAULT_TASK if word is None else word.filled
        task = self.task(step, word, name)
        if task is None:
            return
        self.knobs_and_params(step, words, name, task)
        self.split(step, words, task)
        self.rules(step, words, name)
        if words.get("packs") and words.get("held-out"):
            message = "`packs` says what stays, `held-out` what goes: give one of them"
            self.report(words["held-out"][0], step, message)
        varied = [words[option][0] for option in VARIETY if words.get(option)]
        if varied and not given.get("rulesets"):
            for word in varied:
                message = f"`{word.option}` says which rulesets are drawn: `rulesets` says how many"
                self.report(word, step, message)
        for word in words.get("swap", ()):
            known = [one.name for one in task.ruleset.properties]
            if not words.get("rules") and word.filled not in known:
                message = f"the rules {task.ruleset.name} have no property `{word.filled}`"
                self.report(
                    word, step, message, code="PD301", helps=suggest(word.filled, known, "properties")
                )
        for word in varied:
            value = given.get(VARIETY[word.option])
            if word.option in ("chances", "leave-out") and value is not None:
                from powderdsl.worldmodel.rulesets import Variety

                with self.told(word, step):
                    Variety(**{VARIETY[word.option]: value})

    def on_world_model(self, step: StudyStep, words: Words, values: Values) -> None:
        if step.command == ("wm", "finetune") and not words.get("packs"):
            self.report(None, step, "`wm finetune` needs `packs`: what is to be learned")
        if not step.on_step:
            for on in words.get("on", ()):
                self.run(step, on)
            return
        made = self.places.maker(step)
        learned: list[str] = []
        while made.command != ("wm", "train") and made.on_step:
            learned += [word.filled for word in self.places.words(made, values).get("packs", ())]
            made = self.places.maker(made)
        if made.command != ("wm", "train"):
            return
        before, word = self.places.words(made, values), _first(words, "task")
        trained_on = _first(before, "task")
        name = DEFAULT_TASK if trained_on is None else trained_on.filled
        try:
            task = _task(name) if word is None else self.task(step, word, word.filled)
        except CompileError:  # reported where it is trained
            return
        if task is None:
            return
        rules = _first(before, "rules")
        self.rules(step, words, name, None if rules is None else rules.filled)
        if step.command == ("wm", "eval"):
            if rules is None and not words.get("rules"):
                added = [one.filled for one in before.get("packs", ())]
                self.only(step, words, [*_task(name).ruleset.packs, *added, *learned])
            self.knobs_and_params(step, words, name if word is None else word.filled, task)
            self.split(step, words, task)

    def only(self, step: StudyStep, words: Words, packs: Sequence[str]) -> None:
        """Whether worlds can draw elements of some packs alone. Packs from files are not asked for their names."""
        if any("." in pack for pack in packs):
            return
        for word in words.get("only", ()):
            if word.filled not in packs:
                helps = suggest(word.filled, packs, "packs")
                message = f"the rules have no pack `{word.filled}`"
                self.report(word, step, message, code="PD304", helps=helps)

    def rules(self, step: StudyStep, words: Words, task: str, base: str | None = None) -> None:
        """The rules of a step, and packs that are added or left out. `base`: those that a network was trained on."""
        named = _first(words, "rules")
        if named is not None:
            base = named.filled
            if not self.asked(step.name, "rules", base):
                with self.told(named, step):
                    load(base)
        packs, held_out = words.get("packs", ()), words.get("held-out", ())
        question = (base or task, *(word.filled for word in (*packs, *held_out)))
        if (not packs and not held_out) or self.asked(step.name, "packs", question):
            return
        from powderdsl.worldmodel.rule_words import add, keep, leave_out

        try:
            start = base or "+".join(_task(task).rules)
            load(start)
        except CompileError:  # reported where it is named
            return
        change = add if step.command == ("wm", "finetune") else keep
        for given, alone, together in ((packs, add, change), (held_out, leave_out, leave_out)):
            wrong = []
            for word in given:
                with self.told(word, step) as failed:
                    # Leaving out a pack of the rules may need others to be left out as well.
                    if alone is add or word.filled not in load(start).packs:
                        load(alone(start, (word.filled,)))
                wrong += failed
            if given and not wrong:
                with self.told(given[0], step):
                    load(together(start, [word.filled for word in given]))
