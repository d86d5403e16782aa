"""A study's file -> a checked `Study`: settings that are varied, commands in order, and the numbers to compare."""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, replace
from pathlib import Path
from string import Template
from typing import Any

from powderdsl.compiler import shipped_rules
from powderdsl.diagnostics import CompileError, Diagnostic, Label, Reporter, Source, Span, suggest
from powderdsl.model.schema import NAME_FORM, Entry, Form, Reader, Record, first_line, keyed, read_tree
from powderdsl.syntax.sources import find_source, shipped_names
from powderdsl.syntax.yaml_tree import Mapping as Mapping_
from powderdsl.syntax.yaml_tree import Node, Scalar
from powderdsl.system.reading import inside, is_path

SIZES = ("small", "paper")
SEED, SIZE = "seed", "size"
MAX_POINTS, MAX_CALLS = 10_000, 50_000
"""Combinations of a study, each with every seed; and calls of commands, a step for each of them."""

TEXT, FLAG = "text", "flag"
TASK, RUN, RUN_OR_TASK, RULES, PACKS = "TASK", "RUN", "RUN|TASK", "RULES", "PACK,PACK"
READ = (TASK, RUN, RUN_OR_TASK, RULES, PACKS)
"""What words of commands mean: FLAG, or what the help calls them. Those of READ name something to read; all others are text."""

Commands = Mapping[tuple[str, ...], Mapping[str, str]]
"""Commands that steps may call, with the meaning of each option (without dashes) and of the argument (``on``)."""

VALUE = Form(
    "[A-Za-z0-9_.+-]{1,60}", "a value here", "letters, digits and `_.+-`: folders are named after values"
)


class AxisDecl(Entry, noun="a setting"):
    """A setting that is varied, as written."""

    about: str = keyed("what it is, for the figure", "")
    small: tuple[Scalar, ...] = keyed("its values at the size `small`", (), required=True)
    paper: tuple[Scalar, ...] = keyed("its values at the size `paper`", (), required=True)
    sets: Node | None = keyed("for each value, other names and what they stand for with it", shape="mapping")


class Measure(Entry, noun="a measure"):
    """A number in the ``evaluation.json`` of a step's run: the keys that lead to it, joined by ``/``.

    On the scale ``log`` numbers are compared by their ratios: means are geometric.
    """

    of: Scalar = keyed("the step whose run was evaluated", MISSING)
    keys: Scalar = keyed(
        "keys of its evaluation.json that lead to the number, with `/` between", MISSING, name="value"
    )
    about: str = keyed("what it is, for the figure", "")
    expect: str | None = keyed(
        "what the number is expected to do along the first setting", choices=("rises", "falls")
    )
    scale: str = keyed(
        "`log` where ratios count, such as those of losses", "linear", choices=("linear", "log")
    )


class StudyDecl(Record, noun="a study"):
    """A study's file as written."""

    name: str = keyed("the study's name", "", name="study", required=True, form=NAME_FORM)
    about: str = keyed("what it asks, in a sentence", "")
    seeds: int = keyed("how many runs there are of each combination", 1, required=True, bounds=(1, 1000))
    vary: Node | None = keyed("settings that are varied", required=True, shape="mapping")
    steps: Node | None = keyed("commands, in order: a name each", required=True, shape="mapping")
    measures: Node | None = keyed(
        "numbers to compare, out of what steps evaluated", required=True, shape="mapping"
    )


@dataclass(frozen=True)
class StudyStep:
    """A call of a command, in whose words ``$NAME`` stands for a value; `means` has their meanings.

    `words` has the command's argument, called ``on``, and the words of its options. With `on_step` the argument names an
    earlier step, whose run is meant. `is_wrong`: it has a mistake, which is reported, and nothing follows from it.
    """

    key: Scalar
    command: tuple[str, ...]
    words: tuple[tuple[str, Scalar], ...]
    on_step: bool
    means: Mapping[str, str]
    is_wrong: bool = False

    @property
    def name(self) -> str:
        """The step's name, which the folder of its run has too."""
        return self.key.text

    @property
    def makes_run(self) -> bool:
        """True if the command writes a run, into a folder that it is given."""
        return "run" in self.means

    @property
    def on(self) -> Scalar | None:
        return dict(self.words).get("on")


@dataclass(frozen=True)
class Axis:
    """A setting that is varied, and its values for each of `SIZES`.

    `sets`: for each value, other names and what they stand for with it; empty if the values stand for themselves.
    """

    key: Scalar
    about: str
    values: Mapping[str, tuple[Scalar, ...]]
    sets: Mapping[str, Mapping[str, Scalar]]

    @property
    def name(self) -> str:
        """The setting's name. In words, ``$NAME`` stands for its value."""
        return self.key.text


@dataclass(frozen=True)
class Point:
    """One combination of values, and a seed. `names`: what each ``$NAME`` stands for; `spans`: where that is written."""

    values: tuple[tuple[str, str], ...]
    seed: int
    names: Mapping[str, str] = field(default_factory=dict, compare=False, repr=False)
    spans: Mapping[str, Span] = field(default_factory=dict, compare=False, repr=False)

    @property
    def name(self) -> str:
        """The name of its folder."""
        return ",".join([*(f"{name}={value}" for name, value in self.values), f"seed={self.seed}"])

    def filled(self, word: Scalar) -> str:
        """A word with values in place of their names."""
        return Template(word.text).safe_substitute(self.names)


@dataclass(frozen=True)
class Study:
    """A checked study. `folder`, that of its file, has the files that it names."""

    name: str
    about: str
    seeds: int
    axes: tuple[Axis, ...]
    steps: tuple[StudyStep, ...]
    measures: tuple[Measure, ...]
    source: Source
    folder: Path

    def points(self, size: str, seeds: int | None = None) -> Iterator[Point]:
        """Yield all combinations, each with every seed. Seeds vary slowest, so that early ends leave whole sets."""
        for seed in range(self.seeds if seeds is None else seeds):
            for values in itertools.product(*(axis.values[size] for axis in self.axes)):
                words: dict[str, Scalar] = {}
                for axis, value in zip(self.axes, values, strict=True):
                    words |= {axis.name: value, **axis.sets.get(value.text, {})}
                names = {name: word.text for name, word in words.items()}
                yield Point(
                    tuple((axis.name, names[axis.name]) for axis in self.axes),
                    seed,
                    {**names, SEED: str(seed), SIZE: size},
                    {name: word.span for name, word in words.items()},
                )

    def works_on(self, step: StudyStep) -> StudyStep | None:
        """The step whose run is meant by `on`: the step of this name, or what that works on if it makes no run."""
        if step.on is None or not step.on_step:
            return None
        other = next(other for other in self.steps if other.name == step.on.text)
        return other if other.makes_run else self.works_on(other)

    def command(self, step: StudyStep, point: Point, place: Path) -> list[str]:
        """The words of a step's command, whose runs lie in `place`.

        Raises CompileError (PD112) if a word names a path that leads out of the study's folder.
        """
        words, run = list(step.command), self.works_on(step)
        for name, word in step.words:
            text, means = point.filled(word), step.means.get(name, TEXT)
            if name == "on" and run is not None:
                words.append(str(place / run.name))
                continue
            try:
                text = confined(means, text, self.folder)
            except ValueError as error:
                message = f"the path `{text}` leaves the study's folder"
                raise CompileError([Diagnostic("PD112", message, Label(word.span, str(error)))]) from None
            if means != FLAG:
                words += [text] if name == "on" else [f"--{name}", text]
            elif text == "yes":
                words.append(f"--{name}")
        return [*words, "--run", str(place / step.name)] if step.makes_run else words

    def identity(self, size: str) -> dict[str, Any]:
        """The identity of a study's results, as JSON: values, seeds and measures may be added later."""
        steps = [
            [step.name, " ".join(step.command), *([name, word.text] for name, word in step.words)]
            for step in self.steps
        ]
        return {"study": self.name, "size": size, "varied": [axis.name for axis in self.axes], "steps": steps}


def confined(means: str, text: str, folder: Path) -> str:
    """A word for a command, from an untrusted study. Raises ValueError for a path that leads out of `folder`."""
    if means in (RULES, PACKS):
        mark = "[+,]" if means == PACKS else "[+]"
        return "".join(
            part if re.fullmatch(mark, part) else _pack(part.strip(), folder)
            for part in re.split(f"({mark})", text)
        )
    is_shipped_task = text in shipped_names("tasks")
    may_be_path = means == RUN or (means == RUN_OR_TASK and not is_shipped_task) or is_path(text)
    return str(inside(folder, text)) if means in READ and may_be_path else text


def _pack(text: str, folder: Path) -> str:
    if is_path(text):
        return str(inside(folder, text))
    if text.split("-")[0] not in shipped_rules() and os.path.isfile(text):
        raise ValueError("a name without `/` or `.yaml` means shipped rules, and there are none of this name")
    return text


def shipped_studies() -> list[str]:
    """Names of the studies that come with powderdsl."""
    return shipped_names("tasks/studies")


Check = Callable[[Study, Reporter], None]
"""Reports mistakes in a study."""


def check_paths(study: Study, reporter: Reporter) -> None:
    """Report paths that lead out of the study's folder with any of its values (PD112)."""
    for size, step in itertools.product(SIZES, study.steps):
        for point in study.points(size, 1):
            try:
                study.command(step, point, study.folder)
            except CompileError as error:
                reporter.add(error.diagnostics[0])


def load_study(name_or_path: str, commands: Commands, check: Check = check_paths) -> Study:
    """A shipped study by name, or a file. Raises CompileError with everything that is wrong."""
    reporter = Reporter()
    source = find_source(name_or_path, "tasks/studies", "study", reporter)
    return read_study(source, reporter, commands, check)


def read_study(source: Source, reporter: Reporter, commands: Commands, check: Check = check_paths) -> Study:
    """The checked study of a file's text. Raises CompileError with everything that is wrong.

    `check`, of words and measures, reads no file that lies out of the study's folder.
    """
    tree = read_tree(source, reporter, "a study starts with `study: NAME`")
    reporter.raise_if_errors()
    assert tree is not None
    study = _StudyReader(reporter, commands).study(tree)
    check(study, reporter)
    reporter.raise_if_errors()
    return study


class _StudyReader:
    """Reads one study, section by section."""

    def __init__(self, reporter: Reporter, commands: Commands):
        self.reader, self.error, self.commands = Reader(reporter), reporter.error, commands
        self.known = [SEED, SIZE]
        self.used: set[str] = set()
        self.is_hidden = False
        """Whether a mistake may hide that a name is used."""
        self.steps: dict[str, StudyStep] = {}

    def study(self, tree: Node) -> Study:
        decl = self.reader.record(StudyDecl, tree, "a study") or StudyDecl()
        axes = [self.axis(key, node) for key, node in self.reader.named(decl.vary, "a setting")]
        for key, node in self.reader.named(decl.steps, "a step"):
            self.step(key, node)
        named = self.reader.named(decl.measures, "a measure")
        measures = [measure for key, node in named if (measure := self.measure(key, node)) is not None]
        places = {key.text: node.span for key, node in self.reader.pairs(tree, "a mapping")}
        for size in SIZES:
            points = decl.seeds * math.prod(len(axis.values[size]) for axis in axes)
            if points > MAX_POINTS or points * len(self.steps) > MAX_CALLS:
                number = f"{MAX_POINTS:,} combinations" if points > MAX_POINTS else f"{MAX_CALLS:,} calls"
                place = places.get("study", first_line(tree))
                self.error("PD806", f"more than {number} at the size `{size}`", place, "vary less")
                self.reader.reporter.raise_if_errors()  # checks go through all of them
        names = {SEED: places["seeds"]} if decl.seeds > 1 else {}
        for axis in axes:
            settings = next(iter(axis.sets.values()), {}) or {axis.name: axis.key}
            names |= {name: settings[name].span for name in settings}
        for name, span in names.items():
            if not (self.is_hidden or name in self.used):
                helps = (f"write `${name}` in a step, or leave it out",)
                self.error("PD806", f"no step uses `${name}`", span, helps=helps)
        steps, source = tuple(self.steps.values()), tree.span.source
        folder = Path(source.name).parent
        return Study(decl.name, decl.about, decl.seeds, tuple(axes), steps, tuple(measures), source, folder)

    def axis(self, key: Scalar, node: Node) -> Axis:
        self.add_name(key)
        if isinstance(node, Mapping_):
            decl = self.reader.entry(AxisDecl, key, node)
        else:  # one list for every size
            words = self.reader.words(node)
            decl = AxisDecl(name=key, small=words, paper=words)
        assert decl is not None
        values = {"small": decl.small, "paper": decl.paper}
        for size, scalars in values.items():
            if not scalars:
                self.error("PD109", f"`{key.text}` has no values", key.span, f"none for `{size}`")
            for word in scalars:
                self.reader.read_form(VALUE, key.text, word)
        sets = {} if decl.sets is None else self.sets(decl.sets, [*decl.small, *decl.paper])
        return Axis(key, decl.about or key.text, values, sets)

    def sets(self, node: Node, values: list[Scalar]) -> dict[str, dict[str, Scalar]]:
        """Return the settings of each value: the same names for all values."""
        sets: dict[str, dict[str, Scalar]] = {}
        names: dict[str, Scalar] = {}
        entries = self.reader.pairs(node, "a mapping", "write `VALUE: {NAME: VALUE, …}`")
        for value, inner in entries:
            words = self.reader.pairs(inner, "a mapping", "write `{NAME: VALUE, …}`")
            sets[value.text] = {name.text: word for name, word in words if isinstance(word, Scalar)}
            names = {name.text: name for name, _ in words} | names
        for value, _ in entries:
            for name in sorted(names.keys() - sets[value.text].keys()):
                self.error("PD109", f"`{value.text}` does not set `{name}`", value.span, "others do")
        for scalar in names.values():
            self.add_name(scalar)
        for value in values:
            if value.text not in sets:
                self.error("PD109", f"`sets` does not say what `{value.text}` sets", value.span)
        return sets

    def add_name(self, name: Scalar) -> None:
        if name.text in self.known:
            self.error("PD111", f"`{name.text}` is given already", name.span, "choose another name")
        self.known.append(name.text)

    def step(self, key: Scalar, node: Node) -> None:
        named = node.get("command") if isinstance(node, Mapping_) else None
        command = tuple(named.text.split()) if isinstance(named, Scalar) else ()
        if not isinstance(node, Mapping_) or command not in self.commands:
            names = [" ".join(words) for words in self.commands]
            helps = suggest(" ".join(command), names) or (f"commands: {', '.join(names)}",)
            if isinstance(named, Scalar):
                self.error("PD806", f"no command `{named.text}` for a step", named.span, helps=helps)
            else:
                self.error("PD109", "a step lacks `command`", key.span, helps=helps)
            self.is_hidden = True
            return
        means = self.commands[command]
        words = [
            (name.text, word)
            for name, value in node.entries
            if name.text != "command"
            for word in self.step_words(command, name, value)
        ]
        words.sort(key=lambda pair: pair[0] != "on")
        is_wrong = node.get("on") is not None and "on" not in dict(words)
        on_step = any(name == "on" and word.text in self.steps for name, word in words)
        self.steps[key.text] = StudyStep(key, command, tuple(words), on_step, means, is_wrong)

    def step_words(self, command: tuple[str, ...], name: Scalar, value: Node) -> list[Scalar]:
        """Return the words of a step's option or of `on`; report invalid ones and omit them."""
        means, words = self.commands[command], self.reader.words(value)
        known = [word for word in words if self.names_are_known(word)]
        if name.text == "run" or name.text not in {*means, "on"}:
            helps = suggest(name.text, means.keys() - {"on", "run"}, "options")
            message = f"`{' '.join(command)}` has no option `{name.text}` for a study"
            self.error("PD806", message, name.span, helps=helps)
        elif name.text == "on" and not isinstance(value, Scalar):
            self.reader.shape(value, "a word")
        elif not words:
            self.error("PD806", f"`{name.text}` has no value", name.span)
        elif name.text == "on" and words[0].text.startswith("-"):
            self.error("PD806", "the value of `on` cannot begin with `-`", words[0].span)
        else:
            return known
        return []

    def measure(self, key: Scalar, node: Node) -> Measure | None:
        measure = self.reader.entry(Measure, key, node)
        if measure is None:
            self.is_hidden = True
            return None
        of = measure.of
        self.names_are_known(measure.keys)
        runs = [step.name for step in self.steps.values() if step.makes_run]
        if of.text not in runs:
            step = self.steps.get(of.text)
            helps = suggest(of.text, runs, "steps that make runs")
            if step is not None and step.on is not None and step.on_step:
                helps = (f"write `of: {step.on.text}`: what is found is kept with the run", *helps)
            self.error("PD806", f"no step `{of.text}` that makes a run", of.span, helps=helps)
        return measure if measure.about else replace(measure, about=key.text)

    def names_are_known(self, word: Scalar) -> bool:
        """Note the names that a text uses; return False after reporting ``$NAME`` that is not varied."""
        template = Template(word.text)
        if not template.is_valid():
            label = "no name follows: write `$NAME`, or `$$` for a dollar sign"
            self.error("PD806", "`$` begins the name of a setting", word.span, label)
        names = {*template.get_identifiers()}
        self.used |= names
        unknown = sorted(names - {*self.known})
        for name in unknown:
            helps = suggest(name, self.known, "settings")
            self.error("PD806", f"no setting `{name}` is varied", word.span, helps=helps)
        self.is_hidden |= bool(unknown)
        return template.is_valid() and not unknown
