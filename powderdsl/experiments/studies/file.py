"""A study's file -> a checked `Study`. All mistakes are reported at once."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from string import Template

from powderdsl.compiler import shipped
from powderdsl.diagnostics import Reporter, Source, Span, suggest
from powderdsl.experiments.studies.study import (
    EXPECTED,
    FLAG,
    SCALES,
    SEED,
    SIZE,
    SIZES,
    TEXT,
    Axis,
    Measure,
    Study,
    StudyStep,
    confined,
    filled,
    maker,
)
from powderdsl.model.schema import Key, Reader
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.sources import read_source

STUDY_KEYS: dict[str, dict[str, Key]] = {
    "study": {
        "study": Key("word", "the study's name", True),
        "about": Key("text", "what it asks, in a sentence"),
        "seeds": Key("number", "how many runs there are of each combination", True),
        "vary": Key("mapping", "settings that are varied", True),
        "steps": Key("mapping", "commands, in order: a name each", True),
        "measures": Key("mapping", "numbers to compare, out of what steps evaluated", True),
    },
    "axis": {
        "about": Key("line", "what it is, for the figure"),
        **{size: Key("any", f"its values at the size `{size}`", True) for size in SIZES},
        "sets": Key("mapping", "for each value, other names and what they stand for with it"),
    },
    "measure": {
        "of": Key("word", "the step whose run was evaluated", True),
        "value": Key("line", "keys of its evaluation.json that lead to the number, with `/` between", True),
        "about": Key("line", "what it is, for the figure"),
        "expect": Key(
            "word", "what the number is expected to do along the first setting: `rises` or `falls`"
        ),
        "scale": Key("word", "`log` where ratios count, such as those of losses; otherwise `linear`"),
    },
}

MAX_POINTS = 10_000


def shipped_studies() -> list[str]:
    """Names of the studies that come with powderdsl."""
    return sorted(path.stem for path in (shipped("tasks") / "studies").glob("*.yaml"))


Commands = Mapping[tuple[str, ...], Mapping[str, str]]
"""Commands that steps may call; what their options are (without dashes), and what their argument (``on``) is."""

Check = Callable[[Study, Reporter], None]
"""Reports what the commands of a study would refuse."""


def load_study(name_or_path: str, commands: Commands, check: Check | None = None) -> Study:
    """A shipped study by name, or a file.

    Args:
        commands: those that steps may call.

    Raises:
        CompileError: with everything that is wrong.
    """
    reporter = Reporter()
    path = Path(name_or_path)
    if name_or_path in shipped_studies():
        path = shipped("tasks") / "studies" / f"{name_or_path}.yaml"
    elif path.suffix.lower() not in (".yaml", ".yml"):
        helps = suggest(name_or_path, shipped_studies()) or ("shipped: " + ", ".join(shipped_studies()),)
        reporter.error("PD801", f"no study `{name_or_path[:80]}`", None, helps=helps)
    source = None if reporter.has_errors else read_source(path, reporter)
    reporter.raise_if_errors()
    assert source is not None
    return read_study(source, reporter, commands, check)


def read_study(source: Source, reporter: Reporter, commands: Commands, check: Check | None = None) -> Study:
    """The checked study of a file's text. Raises CompileError with everything that is wrong."""
    tree = yaml_tree.parse_yaml(source, reporter)
    if tree is None and not reporter.has_errors:
        helps = ["a study starts with `study: NAME`"]
        reporter.error("PD107", f"{source.name} is empty", None, helps=helps)
    reporter.raise_if_errors()
    assert tree is not None
    read = _StudyReader(Reader(reporter, STUDY_KEYS), commands)
    study = read.study(tree, source.text)
    # What lies elsewhere is not even read.
    if read.check_paths(study) and check is not None:
        check(study, reporter)
    reporter.raise_if_errors()
    return study


class _StudyReader:
    """Reads one study, section by section."""

    def __init__(self, reader: Reader, commands: Commands):
        self.reader, self.reporter, self.commands = reader, reader.reporter, commands
        self.axes: list[Axis] = []
        self.set_names: list[str] = []
        self.steps: list[StudyStep] = []
        self.words: list[tuple[str, str, Span]] = []
        """The meaning, text and location of each word of a command."""
        self.places: dict[tuple[str, ...], Span] = {}

    def study(self, tree: yaml_tree.Node, text: str) -> Study:
        entries = self.reader.mapping(tree, "study", "a study")
        name = self.reader.scalar(entries, "study")
        if name is not None and not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,59}", name.text):
            label = "letters, digits, `-` and `_`, up to 60"
            self.reporter.error("PD111", "a study's name is a word", name.span, label)
        seeds = self.reader.number(entries, "seeds", 1, 1000) or 1
        if "seeds" in entries:
            self.places["seeds",] = entries["seeds"][1].span
        for key, node in self.section(entries, "vary", "a setting"):
            self.axes.append(self.axis(key, node))
        for key, node in self.section(entries, "steps", "a step"):
            step = self.step(key, node)
            if step is not None:
                self.steps.append(step)
        measures = tuple(
            measure
            for key, node in self.section(entries, "measures", "a measure")
            if (measure := self.measure(key, node)) is not None
        )
        for size in SIZES:
            points = seeds
            for axis in self.axes:
                points *= len(axis.values[size])
            if points > MAX_POINTS and name is not None:
                label = f"at most {MAX_POINTS:,}"
                self.reporter.error(
                    "PD806", f"{points:,} combinations at the size `{size}`", name.span, label
                )
        about = self.reader.text(entries, "about")
        word = "" if name is None else name.text
        folder = Path(tree.span.source.name).parent
        return Study(
            word, about, seeds, tuple(self.axes), tuple(self.steps), measures, text, folder, self.places
        )

    def check_paths(self, study: Study) -> bool:
        """Report paths that lead out of the study's folder, with any of its values; whether all are inside."""
        inside = True
        points = [point for size in SIZES for point in study.points(size, 1)]
        for means, text, span in self.words:
            if means in (TEXT, FLAG):
                continue
            for word in dict.fromkeys(filled(text, point, size) for point in points for size in SIZES):
                try:
                    confined(means, word, study.folder, study.folder)
                except ValueError as error:
                    inside = False
                    self.reporter.error(
                        "PD112", f"the path `{word}` leaves the study's folder", span, str(error)
                    )
        return inside

    def section(
        self, entries: dict[str, tuple[yaml_tree.Scalar, yaml_tree.Node]], key: str, what: str
    ) -> list[tuple[yaml_tree.Scalar, yaml_tree.Node]]:
        return list(self.reader.named(entries.get(key, (None, None))[1], what))

    def axis(self, key: yaml_tree.Scalar, node: yaml_tree.Node) -> Axis:
        if key.text in (SEED, SIZE, *self.set_names):
            self.reporter.error("PD111", f"`{key.text}` is given already", key.span, "choose another name")
        self.places["axis", key.text] = key.span
        sets: dict[str, dict[str, str]] = {}
        if isinstance(node, yaml_tree.Mapping):
            entries = self.reader.mapping(node, "axis", "a setting")
            lists = {size: entries[size][1] for size in SIZES if size in entries}
            about = self.reader.text(entries, "about")
            if "sets" in entries:
                sets = self.sets(key, entries["sets"][1], lists)
        else:  # one list for every size
            lists, about = dict.fromkeys(SIZES, node), ""
        values = {size: tuple(word.text for word in self.reader.words(one)) for size, one in lists.items()}
        for size, one in lists.items():
            if not values[size]:
                self.reporter.error("PD109", f"`{key.text}` has no values", key.span, f"none for `{size}`")
            for word in self.reader.words(one):
                self.places.setdefault(("value", key.text, word.text), word.span)
                if not re.fullmatch(r"[A-Za-z0-9_.+-]{1,60}", word.text):
                    label = "letters, digits and `_.+-`: folders are named after values"
                    self.reporter.error("PD110", "this cannot be a value here", word.span, label)
        return Axis(key.text, about or key.text, {size: values.get(size) or ("",) for size in SIZES}, sets)

    def sets(
        self, key: yaml_tree.Scalar, node: yaml_tree.Node, lists: Mapping[str, yaml_tree.Node]
    ) -> dict[str, dict[str, str]]:
        """What each value sets: the same names for all of them."""
        if not isinstance(node, yaml_tree.Mapping):
            self.reader.shape(node, "a mapping", "write `VALUE: {NAME: VALUE, …}`, each on its own line")
            return {}
        taken = (SEED, SIZE, *(axis.name for axis in self.axes), *self.set_names)
        found = {
            value.text: self.set_by((key.text, value.text), inner, taken) for value, inner in node.entries
        }
        names = dict.fromkeys(name for one in found.values() for name in one)
        self.set_names += names
        for value, _ in node.entries:
            for name in (name for name in names if name not in found[value.text]):
                self.reporter.error("PD109", f"`{value.text}` does not set `{name}`", value.span, "others do")
        for word in (one for listed in lists.values() for one in self.reader.words(listed)):
            if word.text not in found:
                self.reporter.error("PD109", f"`sets` does not say what `{word.text}` sets", word.span)
        return found

    def set_by(self, of: tuple[str, str], node: yaml_tree.Node, taken: tuple[str, ...]) -> dict[str, str]:
        """The names and values of one entry of `sets`."""
        if not isinstance(node, yaml_tree.Mapping):
            self.reader.shape(node, "a mapping", "write `{NAME: VALUE, …}`")
            return {}
        found = {}
        for name, word in node.entries:
            if name.text in taken:
                label = "choose another name"
                self.reporter.error("PD111", f"`{name.text}` is given already", name.span, label)
            if isinstance(word, yaml_tree.Scalar):
                found[name.text] = word.text
                self.places["set", *of, name.text] = word.span
            else:
                self.reader.shape(word, "a word")
        return found

    def step(self, key: yaml_tree.Scalar, node: yaml_tree.Node) -> StudyStep | None:
        if not isinstance(node, yaml_tree.Mapping):
            self.reader.shape(node, "a mapping", "write `command:`, and options of that command")
            return None
        self.places["step", key.text] = key.span
        given: dict[str, yaml_tree.Node] = {name.text: value for name, value in node.entries}
        word = given.get("command")
        if not isinstance(word, yaml_tree.Scalar):
            names = ", ".join(f"`{' '.join(one)}`" for one in self.commands)
            self.reporter.error("PD109", "a step lacks `command`", key.span, "", helps=[f"one of {names}"])
            return None
        command = tuple(word.text.split())
        options = self.commands.get(command)
        if options is None:
            helps = suggest(word.text, [" ".join(one) for one in self.commands], "commands")
            self.reporter.error("PD806", f"no command `{word.text}` for a step", word.span, helps=helps)
            return None
        found: list[tuple[str, tuple[str, ...]]] = []
        for name, value in node.entries:
            if name.text in ("command", "on"):
                continue
            if name.text not in options or name.text in ("on", "run"):
                helps = suggest(name.text, options.keys() - {"on", "run"}, "options")
                text = f"`{word.text}` has no option `{name.text}` for a study"
                self.reporter.error("PD806", text, name.span, helps=helps)
            words = self.reader.words(value)
            self.places["option", key.text, name.text] = name.span
            for number, one in enumerate(words):
                self.check_names(one.text, one.span)
                self.words.append((options.get(name.text, TEXT), one.text, one.span))
                self.places["word", key.text, name.text, str(number)] = one.span
            found.append((name.text, tuple(one.text for one in words)))
        on = given.get("on")
        target = None
        if isinstance(on, yaml_tree.Scalar):
            target = on.text
            self.places["on", key.text] = self.places["word", key.text, "on", "0"] = on.span
            self.check_names(target, on.span)
            if target.startswith("-"):
                self.reporter.error("PD806", "what a step works on cannot begin with `-`", on.span)
        elif on is not None:
            self.reader.shape(on, "a word")
        on_step = target in [step.name for step in self.steps]
        if isinstance(on, yaml_tree.Scalar) and not on_step:
            self.words.append((options.get("on", TEXT), on.text, on.span))
        return StudyStep(key.text, command, target, on_step, tuple(found), "run" in options, options)

    def measure(self, key: yaml_tree.Scalar, node: yaml_tree.Node) -> Measure | None:
        entries = self.reader.mapping(node, "measure", "a measure")
        of, value = self.reader.scalar(entries, "of"), self.reader.scalar(entries, "value")
        expect = self.reader.choice(entries, "expect", EXPECTED)
        scale = self.reader.choice(entries, "scale", SCALES) or "linear"
        if of is None or value is None:
            return None
        steps = {step.name: step for step in self.steps}
        made = [name for name, step in steps.items() if step.makes_run]
        if of.text in steps and of.text not in made:
            judged = maker(steps, of.text)
            fix = f"`of: {judged.name}`: what is found is kept with the run" if judged.makes_run else ""
            helps = (f"write {fix}",) if fix else suggest(of.text, made, "steps")
            self.reporter.error("PD806", f"the step `{of.text}` makes no run", of.span, helps=helps)
        elif of.text not in made:
            helps = suggest(of.text, made, "steps")
            self.reporter.error("PD806", f"no step `{of.text}` that makes a run", of.span, helps=helps)
        self.check_names(value.text, value.span)
        self.places["of", key.text], self.places["keys", key.text] = of.span, value.span
        keys = tuple(value.text.split("/"))
        about = self.reader.text(entries, "about") or key.text
        return Measure(key.text, of.text, keys, about, expect, scale)

    def check_names(self, text: str, span: Span) -> None:
        """Report ``$NAME`` that is not varied."""
        known = [*(axis.name for axis in self.axes), *self.set_names, SEED, SIZE]
        if not Template(text).is_valid():
            message, label = "`$` begins the name of a setting", "no name follows"
            self.reporter.error(
                "PD806", message, span, label, helps=["write `$NAME`, or `$$` for a dollar sign"]
            )
        for name in Template(text).get_identifiers():
            if name not in known:
                helps = suggest(name, known, "settings")
                self.reporter.error("PD806", f"no setting `{name}` is varied", span, helps=helps)
