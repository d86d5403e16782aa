"""A task file -> a checked `Task`. All mistakes are reported at once."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

from powderdsl.compiler import load_with_diagnostics, names_in_file, read
from powderdsl.diagnostics import CompileError, Reporter, Source, suggest
from powderdsl.model.check import resolve_names
from powderdsl.model.composition.compose import Palette
from powderdsl.model.definitions import describe_kind, param_value
from powderdsl.model.expressions.symbols import report_unknown_names
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.operations import FUNCTIONS as RULE_FUNCTIONS
from powderdsl.model.schema import NAME_FORM, Entry, Reader, Record, first_line, keyed, read_tree
from powderdsl.model.state import fits, size_problem
from powderdsl.model.types import Ruleset
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.parse import STATEMENTS, Syntax, reserved_words
from powderdsl.syntax.yaml_tree import Node, Scalar
from powderdsl.tasks.agents import AgentDecl, read_agent, read_expert
from powderdsl.tasks.drawings import (
    Drawer,
    DrawingPlan,
    StampDecl,
    element_ids,
    limited,
    line_in,
    pass_on,
    read_items,
    read_lets,
    read_stamp,
    shape_in,
)
from powderdsl.tasks.goals import ACTION_WORDS, FUNCTIONS, GoalChecker
from powderdsl.tasks.task import MAX_SIDE, Goal, Knob, Origin, ParamRange, Split, Task
from powderdsl.worlds.raster import Size
from powderdsl.worlds.scene.read import two_integers
from powderdsl.worlds.scene.statements import Statement, Written, number, read_amount, report_unknown


class KnobDecl(Entry, noun="a knob"):
    default: Scalar | None = keyed("default value; may use knobs above it", required=True, shape="line")
    range: Scalar | None = keyed("allowed values: `LOW..HIGH`", required=True, shape="line")
    about: str = keyed("its effect, in a sentence", "")


class RewardDecl(Record, noun="a reward"):
    each: Syntax | None = keyed("given after every action")
    final: Syntax | None = keyed("given once, after the free steps")
    shaped: Syntax | None = keyed("replaces both during training, if requested")


class EndDecl(Record, noun="an end"):
    success: Syntax | None = keyed("ends the episode as solved")
    failure: Syntax | None = keyed("ends the episode as failed")


class Laws(Record):
    """The rules that worlds run under."""

    params: tuple[tuple[Scalar, Scalar], ...] = keyed(
        "parameter values; each world draws from a range such as `1%..20%`",
        (),
        maps="parameters to values or ranges",
    )
    rulesets: tuple[Scalar, ...] = keyed("rules that worlds use in turn; `universe:0..63` stands for 64", ())


class Variant(Record):
    """Changes to a task's worlds."""

    knobs: Node | None = keyed("other values for knobs", shape="mapping")
    let: Node | None = keyed("other values or ranges for names of `let`", shape="mapping")
    parts: Node | None = keyed("other statements for parts", shape="mapping")
    generate: Node | None = keyed("statements that replace the task's")


class StandDecl(Variant, noun="a stand"):
    stand: Scalar | None = keyed("its name", required=True)
    about: str = keyed("its purpose, in a sentence", "")


class SplitDecl(Variant, Laws, Entry, noun="a split"):
    about: str = keyed("its purpose, in a sentence", "")
    stands: Node | None = keyed("fixed worlds: a list of changes, each named by `stand`", shape="list")


class TaskDecl(Laws, noun="a task"):
    """A task's file as written."""

    name: str = keyed("the task's name", "", name="task", required=True, form=NAME_FORM)
    about: str = keyed("the goal, in a sentence", "")
    family: str = keyed("a group of similar tasks, such as `build`", "", shape="word")
    rules: Scalar | None = keyed("a shipped ruleset, packs joined by `+`, or a file", required=True)
    size: Node | None = keyed("[rows, columns]", required=True)
    fill: Scalar | None = keyed("the element that fills the world first", required=True)
    knobs: tuple[KnobDecl, ...] = keyed("integers that users may set", ())
    let: Node | None = keyed("numbers and draws shared by statements and regions", shape="mapping")
    regions: Node | None = keyed("names for shapes, or for lists of shapes", shape="mapping")
    stamps: tuple[StampDecl, ...] = keyed("pictures to paint", ())
    parts: Node | None = keyed("named lists of statements", shape="mapping")
    targets: Node | None = keyed("pictures that rewards compare worlds with", shape="mapping")
    generate: Node | None = keyed("statements that draw the start world")
    agent: AgentDecl | None = keyed("what an agent may do, and how often", required=True)
    reward: RewardDecl | None = keyed("`each`, `final` and `shaped`")
    end: EndDecl | None = keyed("`success` and `failure`")
    expert: Node | None = keyed("a list of moves, or `search: N`")
    splits: tuple[SplitDecl, ...] = keyed("other sets of worlds, in addition to `train`", ())


RANGE = ".."
"""Between the ends of a range."""

NUMBERS = re.compile(r"([0-9]{1,10})\.\.([0-9]{1,10})")

MAX_RULESETS = 4096
"""Rulesets of one split."""

Drawn = tuple[dict[str, ParamRange], tuple[tuple[str, ...], ...]]
"""The parameters and the rulesets of a split."""

MAX_VARIANTS = 256
"""Maximum number of stands of a split."""


def read_task(
    source: Source,
    reporter: Reporter,
    *,
    knobs: Mapping[str, int] | None = None,
    params: Mapping[str, Any] | None = None,
    packs: Sequence[str] = (),
    palette: Palette | None = None,
    rules: Sequence[str] | None = None,
) -> Task:
    """The checked task of a file's text; warnings stay with the reporter.

    `packs` are added to its rules, which `rules` replace; `palette` has recorded ids. Raises CompileError with all
    mistakes in the file and its rules.
    """
    tree = read_tree(source, reporter, "a task starts with `task: NAME`")
    reporter.raise_if_errors()
    assert tree is not None
    reader = Reader(reporter)
    decl = reader.record(TaskDecl, tree, "a task")
    word = decl.rules if decl is not None else None
    names = names_in_file(word.text, word.span, reporter) if word is not None and word.text else None
    if decl is None or word is None or names is None:
        reporter.raise_if_errors()
        raise AssertionError("a task without rules was not reported")
    given = params or {}
    written = {name.text: value.text for name, value in decl.params if RANGE not in value.text}
    origin = Origin(source, dict(knobs or {}), dict(given), tuple(packs))
    rules = (*(rules or names), *packs)
    try:
        ruleset, _ = load_with_diagnostics(*rules, params={**written, **given}, palette=palette)
    except CompileError as error:
        pass_on(error, reporter, word.span)
        reporter.raise_if_errors()
        raise
    loaded, composed = read(rules, Reporter())
    typer, _ = resolve_names(loaded, composed, Reporter(), palette)
    typer.reporter = reporter
    return _TaskReader(reader, decl, ruleset, typer, rules, origin).task()


def task_under(task: Task, rules: Sequence[str]) -> Task:
    """The same task, read under other rules, as for `compiler.load`. Raises CompileError if they do not fit."""
    origin = task.origin
    assert origin is not None
    knobs, params, packs = origin.knobs, origin.params, origin.packs
    try:
        other = read_task(origin.source, Reporter(), knobs=knobs, params=params, packs=packs, rules=rules)
    except CompileError as error:
        note = f"worlds of the split have the rules {'+'.join(map(str, rules))}"
        raise CompileError(
            [replace(mistake, notes=(*mistake.notes, note)) for mistake in error.diagnostics]
        ) from None
    return other.with_shaped_reward() if origin.shaped else other


class _TaskReader:
    """Reads one task, section by section."""

    def __init__(
        self,
        reader: Reader,
        decl: TaskDecl,
        ruleset: Ruleset,
        typer: Typer,
        rules: tuple[str, ...],
        origin: Origin,
    ):
        self.reader, self.reporter, self.decl = reader, reader.reporter, decl
        self.ruleset, self.typer, self.rules, self.values = ruleset, typer, rules, origin.knobs
        self.origin = origin
        own, _ = read(rules[:1], Reporter())
        self.own = {pack.name.text for pack in own}
        """The packs of the task's own rules: it cannot use names of added packs."""
        self.taken: set[str] = set()
        self.broken: set[str] = set()

    def task(self) -> Task:
        decl = self.decl
        size, fill, knobs = self.size(), self.fill(), self.knobs()
        lets = read_lets(decl.let, self.reader)
        for word, _ in lets:
            self.take(word)
        regions = self.regions()
        plan = DrawingPlan(
            "train",
            fill,
            {knob.name: knob.value for knob in knobs},
            lets,
            regions,
            {stamp.name.text: read_stamp(stamp, self.reader, self.ruleset) for stamp in decl.stamps},
            self.lists(decl.parts, "a part"),
            self.lists(decl.targets, "a target"),
            read_items(decl.generate, self.reader),
            frozenset(self.broken),
        )
        splits, used = self.splits(plan, size)
        checker = GoalChecker(self.typer, frozenset(plan.regions), frozenset(plan.targets), plan.knobs)
        agent = expert = None
        if decl.agent is not None:
            agent = read_agent(self.reader, decl.agent, self.ruleset, size)
        goal = self.goal(checker)
        if agent is not None and agent.choices and decl.expert is not None:
            expert = read_expert(self.reader, decl.expert, agent, size, self.ruleset, checker)
        for key, _ in decl.parts.entries if isinstance(decl.parts, yaml_tree.Mapping) else ():
            if key.text in plan.parts and key.text not in used:
                message = f"the part `{key.text}` is never used"
                self.reporter.report("PD507", message, key.span, "no list includes it", helps=["remove it"])
        report_unknown_names(self.typer)
        self.reporter.raise_if_errors()
        assert agent is not None
        return Task(
            decl.name,
            decl.about,
            self.ruleset,
            size,
            knobs,
            agent,
            goal,
            splits,
            expert,
            self.rules,
            decl.family,
            self.origin,
        )

    # Contents of worlds

    def size(self) -> Size:
        node = self.decl.size
        if node is None:
            return 64, 64
        size = two_integers(node)
        if size is None or not all(1 <= side <= MAX_SIDE for side in size):
            label = f"two integers from 1 to {MAX_SIDE}"
            helps = ["size: [64, 64]"]
            self.reporter.error("PD607", "a size is [rows, columns]", first_line(node), label, helps=helps)
            return 64, 64
        if not fits(self.ruleset, size):
            self.reporter.error("PD607", size_problem(self.ruleset, size), first_line(node), "does not fit")
        return size

    def fill(self) -> int:
        name = self.decl.fill
        ids = element_ids(name, self.ruleset, self.reporter) if name else ()
        return ids[0] if ids else 0

    def take(self, word: Written) -> None:
        """Report a new name that is already in use or reserved."""
        keywords, symbols = reserved_words() | reserved_words(STATEMENTS), self.typer.symbols
        means = self.ruleset.element(word.text) or symbols.constants.get(word.text)
        if word.text in keywords | {*ACTION_WORDS, *FUNCTIONS, *RULE_FUNCTIONS}:
            self.reporter.error("PD311", f"`{word.text}` is a reserved word", word.span, "taken")
        elif word.text in self.taken:
            message = f"`{word.text}` already means something"
            self.reporter.error("PD308", message, word.span, "second meaning")
        elif means and symbols.names.pack(word.text) in (None, *self.own):
            label = "the rules use this word"
            self.reporter.error("PD308", f"`{word.text}` hides another `{word.text}`", word.span, label)
        self.taken.add(word.text)

    def knobs(self) -> tuple[Knob, ...]:
        knobs: dict[str, Knob] = {}
        for decl in self.decl.knobs:
            self.take(decl.name)
            self.broken.add(decl.name.text)
            knob = self.knob(decl, knobs)
            if knob is not None:
                self.broken.discard(knob.name)
                knobs[knob.name] = knob
        for name in self.values:
            if name not in self.taken:
                helps = suggest(name, knobs, "knobs") or ("the task has no knobs",)
                self.reporter.error("PD803", f"no knob `{name}`", None, helps=helps)
        return tuple(knobs.values())

    def knob(self, decl: KnobDecl, above: Mapping[str, Knob]) -> Knob | None:
        key = decl.name
        bounds, default = (line_in(word, "operand", self.reader) for word in (decl.range, decl.default))
        if bounds is None or default is None:
            return None
        if bounds.kind != "range":
            self.reporter.error("PD803", "a knob's range has two integers", bounds.span, "such as `0..64`")
            return None
        ends = read_amount(bounds, {}, self.reporter)
        names = {name: number(knob.value) for name, knob in above.items()}
        amount = read_amount(default, names, self.reporter)
        if ends is None or amount is None:
            return None
        if amount.op != "const":
            self.reporter.error("PD803", f"the default of `{key.text}`", default.span, "not an integer")
            return None
        low, high, usual = int(ends.kind.lo), int(ends.kind.hi), int(amount.value)
        chosen = int(self.values.get(key.text, usual))
        written = None if key.text in self.values else default.span
        for value, span in ((usual, default.span), (chosen, written)):
            if not low <= value <= high:
                message = f"the knob `{key.text}` must lie in {low}..{high}"
                self.reporter.error("PD803", message, span, f"{value} lies outside", notes=[f"it is {value}"])
        return Knob(key.text, usual, low, high, chosen, decl.about, key.span)

    def regions(self) -> dict[str, tuple[Statement, ...]]:
        regions = {}
        for key, node in self.reader.named(self.decl.regions, "a region"):
            self.take(key)
            shapes = []
            for item in node.items:
                if not isinstance(item, Scalar):
                    self.reader.shape(item, "a shape, such as `box rows 1:5 columns 2:8`")
                shapes.append(shape_in(item, self.reader))
            regions[key.text] = tuple(shape for shape in shapes if shape is not None)
        return regions

    def lists(self, node: Node | None, what: str) -> dict[str, Any]:
        return {key.text: read_items(item, self.reader) for key, item in self.reader.named(node, what)}

    # Splits

    def splits(self, plan: DrawingPlan, size: Size) -> tuple[tuple[Split, ...], set[str]]:
        """All splits, and the parts that any of them uses."""
        train = self.params(self.decl.params, {}), self.rulesets(self.decl.rulesets)
        plans = [("train", self.decl.about, [plan], train)]
        for decl in self.decl.splits:
            base = self.varied(plan, decl, decl.name.text)
            if decl.name.text == "train":
                label = "it is the task itself"
                helps = ["choose another name, or change `generate`, `let` and `parts` of the task"]
                message = "the split `train` already exists"
                self.reporter.error("PD302", message, decl.name.span, label, helps=helps)
            variants = [base] if decl.stands is None else self.stands(base, decl.stands)
            laws = self.params(decl.params, train[0]), self.rulesets(decl.rulesets) or train[1]
            plans.append((decl.name.text, decl.about, variants, laws))
            self.held_out(decl, train, laws)
        splits, used, visits = [], set(), count()
        for name, about, variants, (params, rulesets) in plans:
            drawers = [Drawer(variant, self.ruleset, size, self.reporter, visits) for variant in variants]
            generators = tuple(drawer.generator() for drawer in drawers)
            splits.append(Split(name, about, generators, tuple(params.values()), rulesets))
            used |= {part for drawer in drawers for part in drawer.used_parts}
        return tuple(splits), used

    def params(
        self, entries: Sequence[tuple[Scalar, Scalar]], train: Mapping[str, ParamRange]
    ) -> dict[str, ParamRange]:
        """The parameters that worlds draw: those of `train` and of some entries, except those set by the user."""
        known = {param.name: param for param in self.ruleset.params}
        ranges = dict(train)
        for word, value in entries:
            name = _qualified(word, known)
            if name is None:
                report_unknown("parameter", word, known, self.reporter)
                continue
            if name in self.origin.params or (entries is self.decl.params and RANGE not in value.text):
                continue
            kind, (low, dots, high) = known[name].kind, value.text.partition(RANGE)
            ends = [param_value(kind, end) for end in (low, high if dots else low)]
            if None in ends or ends[0] > ends[1]:  # type: ignore[operator]  # of two numbers
                message = f"the parameter `{word.text}` cannot be `{value.text}`"
                helps = [f"write {describe_kind(kind)}, or a range of two, the smaller first: `LOW..HIGH`"]
                self.reporter.error("PD402", message, value.span, "not such a value", helps=helps)
                continue
            first, last = (float(end) for end in ends)  # type: ignore[arg-type]  # None is reported
            ranges[name] = ParamRange(name, first, last, kind.name in ("int", "flag"))
        return ranges

    def rulesets(self, words: Sequence[Scalar]) -> tuple[tuple[str, ...], ...]:
        """The rules of each word; a range of numbers in a word is expanded."""
        rulesets: list[tuple[str, ...]] = []
        for word in words:
            numbers = NUMBERS.search(word.text)
            texts = [word.text]
            if numbers is not None:
                first, last = map(int, numbers.groups())
                if first > last:
                    message = f"`{numbers[0]}` is an empty range"
                    self.reporter.error("PD110", message, word.span, "write the smaller number first")
                    continue
                if (total := len(rulesets) + last - first + 1) > MAX_RULESETS:
                    label = f"the limit is {MAX_RULESETS:,}"
                    self.reporter.error("PD508", f"{total:,} rulesets in a split", word.span, label)
                    continue
                before, after = word.text[: numbers.start()], word.text[numbers.end() :]
                texts = [f"{before}{number}{after}" for number in range(first, last + 1)]
            for text in texts:
                names = names_in_file(text, word.span, self.reporter)
                if names is None:
                    break  # the others lack the same
                rulesets.append(tuple(names))
        return tuple(rulesets)

    def held_out(self, decl: SplitDecl, train: Drawn, own: Drawn) -> None:
        """Report laws of a split that training has too."""
        shown = {*train[1]} or {self.rules}
        if decl.rulesets and (common := [rules for rules in own[1] if rules in shown]):
            names = ", ".join("+".join(rules) for rules in common[:3])
            label, helps = f"{names}: also in `train`", ["choose rules that training does not have"]
            message = f"the split `{decl.name.text}` has {len(common)} rulesets of `train`"
            self.reporter.report("PD807", message, decl.rulesets[0].span, label, helps=helps)
        for word, value in decl.params:
            name = _qualified(word, own[0])
            usual, drawn = (laws[0].get(name) if name else None for laws in (train, own))
            if usual and drawn and drawn.low <= usual.high and usual.low <= drawn.high:
                label = f"`train` draws from {usual.low:g}..{usual.high:g}"
                message = f"the ranges of `{word.text}` in `{decl.name.text}` and in `train` overlap"
                self.reporter.report(
                    "PD807", message, value.span, label, helps=["choose ranges that do not overlap"]
                )

    def stands(self, base: DrawingPlan, node: Node) -> list[DrawingPlan]:
        if not isinstance(node, yaml_tree.Sequence) or not node.items:
            self.reader.shape(node, "a list of stands", "each starts with `- stand: NAME`")
            return [base]
        if not limited(node, MAX_VARIANTS, "{} stands", self.reporter):
            return [base]
        plans = []
        for item in node.items:
            decl = self.reader.record(StandDecl, item, "a stand")
            if decl is not None:
                plans.append(self.varied(base, decl, decl.stand.text if decl.stand else "?"))
        return plans

    def varied(self, plan: DrawingPlan, decl: Variant, name: str) -> DrawingPlan:
        """The plan with the changes of a split or stand."""
        knobs = dict(plan.knobs)
        values = {name: number(value) for name, value in plan.knobs.items()}
        for word, syntax in read_lets(decl.knobs, self.reader):
            self.known(word, plan.knobs, "knob")
            amount = None if syntax is None else read_amount(syntax, values, self.reporter)
            if amount is not None and amount.op == "const":
                knobs[word.text] = int(amount.value)
            elif amount is not None:
                self.reporter.error("PD803", "a knob is one number", amount.span, "not an integer")
        lets = {word.text: (word, syntax) for word, syntax in plan.lets}
        for word, syntax in read_lets(decl.let, self.reader):
            self.known(word, lets, "number")
            if word.text in lets:
                lets[word.text] = lets[word.text][0], syntax
        parts = dict(plan.parts)
        for key, node in self.reader.named(decl.parts, "a part"):
            self.known(key, plan.parts, "part")
            parts[key.text] = read_items(node, self.reader)
        items = plan.items if decl.generate is None else read_items(decl.generate, self.reader)
        return replace(plan, name=name, knobs=knobs, lets=list(lets.values()), parts=parts, items=items)

    def known(self, word: Written, known: Mapping[str, object], what: str) -> None:
        if word.text not in known:
            report_unknown(what, word, known, self.reporter)

    def goal(self, checker: GoalChecker) -> Goal:
        reward, end = self.decl.reward or RewardDecl(), self.decl.end or EndDecl()
        lines = (reward.each, reward.final, reward.shaped)
        each, final, shaped = (checker.number(line) if line else None for line in lines)
        ends = (end.success, end.failure)
        success, failure = (checker.condition(line) if line else None for line in ends)
        return Goal(each, final, success, failure, shaped)


def _qualified(word: Scalar, names: Iterable[str]) -> str | None:
    """The parameter that a word names, with or without its pack; None if there are none or several."""
    fitting = [name for name in names if name == word.text or name.endswith(f".{word.text}")]
    return fitting[0] if len(fitting) == 1 else None
