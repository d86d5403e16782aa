"""A task file -> a checked `Task`. Everything that is wrong is reported at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from powderdsl.compiler import load_with_diagnostics, names_in_file, read
from powderdsl.diagnostics import CompileError, Reporter, Source, suggest
from powderdsl.model.check import resolve_names
from powderdsl.model.composition.palette import Palette
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.operations import FUNCTIONS as RULE_FUNCTIONS
from powderdsl.model.schema import Entries, Key, Reader, first_line
from powderdsl.model.state import fits, size_problem
from powderdsl.model.types import Expr, Ruleset
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.parse import STATEMENTS, line_of, reserved_words
from powderdsl.tasks.agents import read_agent, read_expert
from powderdsl.tasks.drawings import (
    Drawer,
    DrawingPlan,
    element_ids,
    pass_on,
    read_items,
    read_lets,
    read_stamp,
)
from powderdsl.tasks.goals import ACTION_WORDS, FUNCTIONS, GoalChecker
from powderdsl.tasks.task import MAX_SIDE, Goal, Knob, Split, Stamp, Task
from powderdsl.worlds.raster import Size
from powderdsl.worlds.scene.amounts import Written, constants, number, read_amount, report_unknown
from powderdsl.worlds.scene.read import can_be_called, two_integers
from powderdsl.worlds.scene.statements import Statement, read_line, read_shape

MAX_ACTIONS, MAX_STEPS, MAX_PLANS = 1_000_000, 100_000, 10_000
"""The most actions of an episode, steps after one, and plans of a search."""

_VARIANT = {
    "knobs": Key("mapping", "other values for knobs"),
    "let": Key("mapping", "other values or ranges for names of `let`"),
    "parts": Key("mapping", "other statements for parts"),
    "generate": Key("any", "other statements altogether"),
}

TASK_KEYS: dict[str, dict[str, Key]] = {
    "task": {
        "task": Key("word", "the task's name", True),
        "about": Key("text", "what is to be done, in a sentence"),
        "family": Key("word", "what tasks of its kind have in common, such as `build` or `herd`"),
        "rules": Key(
            "word", "the rules of its worlds: a shipped ruleset, packs joined by `+`, or a file", True
        ),
        "params": Key("mapping", "other values for the rules' parameters"),
        "size": Key("any", "[rows, columns]", True),
        "fill": Key("word", "the element that is everywhere before anything is drawn", True),
        "knobs": Key("mapping", "integers that are set from outside"),
        "let": Key("mapping", "numbers and draws that statements and regions share, in order"),
        "regions": Key("mapping", "names for sets of cells: a shape each, or a list of shapes"),
        "stamps": Key("mapping", "pictures that statements paint"),
        "parts": Key("mapping", "lists of statements with a name"),
        "targets": Key("mapping", "pictures that rewards compare worlds with: lists of statements"),
        "generate": Key("any", "statements, later ones over earlier ones"),
        "agent": Key("mapping", "what an agent may do, and for how long", True),
        "reward": Key("mapping", "what counts: `each`, `final`, or both; and `shaped`, for training"),
        "end": Key("mapping", "conditions that end an episode: `success`, `failure`"),
        "expert": Key("any", "how a good player acts: a list of moves, or `search: N`"),
        "splits": Key("mapping", "other sets of worlds beside `train`"),
    },
    "knob": {
        "default": Key("line", "its value unless another is set; it may depend on knobs above it", True),
        "range": Key("line", "the values it may have: `LOW..HIGH`", True),
        "about": Key("text", "what it does, in a sentence"),
    },
    "stamp": {
        "art": Key("text", "ASCII art; `?` leaves a cell as it is"),
        "legend": Key("mapping", "what the characters mean, where glyphs will not do"),
        "scene": Key("word", "instead of art: a shipped scene, or a world's file beside the task's"),
    },
    "agent": {
        "may": Key("words", "elements it may place, `any`, `blow`, `nothing`", True),
        "speed": Key("word", "a number other than 0: the speed that blowing gives to cells"),
        "speed_field": Key("word", "the field that blowing sets; the ruleset's only vector, if it has one"),
        "brush": Key("any", "cells that an action changes: a number, or [rows, columns]; 10 by default"),
        "bins": Key("any", "places that it can act at: a number, or [rows, columns]; 16 by default"),
        "actions": Key("number", "how many actions an episode has", True, bounds=(1, MAX_ACTIONS)),
        "steps_per_action": Key("number", "steps after each action; 1 by default", bounds=(0, MAX_STEPS)),
        "free_steps": Key(
            "number", "steps after the last action, besides; 0 by default", bounds=(0, MAX_STEPS)
        ),
    },
    "reward": {
        "each": Key("line", "given after every action"),
        "final": Key("line", "given with the last action, after the free steps"),
        "shaped": Key("line", "given after every action in place of both, where training asks for it"),
    },
    "end": {
        "success": Key("line", "the episode ends, and the task is done"),
        "failure": Key("line", "the episode ends, and the task is not done"),
    },
    "expert": {
        "search": Key(
            "number",
            "random plans that are simulated in each world; the best one is played",
            True,
            bounds=(1, MAX_PLANS),
        ),
    },
    "move": {
        "choose": Key("word", "what it does: an element, `blow` or `nothing`", True),
        "toward": Key("word", "where it blows: `left`, `right`, `above`, `below`, or both as `above.right`"),
        "at": Key("any", "where: `[row, column]`, or `most(CELLS)`, the block with most of these cells"),
        "within": Key("word", "a shape, in one line: only its cells count for `most`"),
        "least": Key(
            "number",
            "how many cells `most` must find for the move to apply; 1 by default",
            bounds=(1, MAX_SIDE * MAX_SIDE),
        ),
        "if": Key("line", "when: a condition; the first move whose condition holds is played"),
    },
    "split": {
        "about": Key("text", "what it is for, in a sentence"),
        **_VARIANT,
        "stands": Key("list", "fixed worlds: a list of such changes, each with a name under `stand`"),
    },
    "stand": {
        "stand": Key("word", "its name", True),
        "about": Key("text", "what it shows, in a sentence"),
        **_VARIANT,
    },
}


MAX_VARIANTS = 256
"""Worlds that the stands of one split may have."""


def read_task(
    source: Source,
    reporter: Reporter,
    *,
    knobs: Mapping[str, int] | None = None,
    params: Mapping[str, Any] | None = None,
    packs: Sequence[str] = (),
    palette: Palette | None = None,
) -> Task:
    """The checked task of a file's text; warnings stay with the reporter.

    `packs` are added to its rules; `palette` has ids that were recorded.

    Raises:
        CompileError: with everything that is wrong in the file, and in its rules.
    """
    tree = yaml_tree.parse_yaml(source, reporter)
    if tree is None and not reporter.has_errors:
        helps = ["a task starts with `task: NAME`"]
        reporter.error("PD107", f"{source.name} is empty", None, helps=helps)
    reporter.raise_if_errors()
    assert tree is not None
    reader = Reader(reporter, TASK_KEYS)
    entries = reader.mapping(tree, "task", "a task")
    values = reader.values(entries, "task")
    word = values.get("rules")
    written = _written_params(reader, values.get("params"))
    names = names_in_file(word.text, word.span, reporter) if word is not None and word.text else None
    if word is None or names is None:
        reporter.raise_if_errors()
        raise AssertionError("a task without rules was not reported")
    rules = (*names, *packs)
    try:
        ruleset, _ = load_with_diagnostics(*rules, params={**written, **(params or {})}, palette=palette)
    except CompileError as error:
        pass_on(error, reporter, word.span)
        reporter.raise_if_errors()
        raise
    loaded, decl = read(rules, Reporter())
    typer, _ = resolve_names(loaded, decl, Reporter(), palette)
    typer.reporter = typer.unknown.reporter = reporter
    return _TaskReader(reader, entries, values, ruleset, typer, rules, knobs or {}).task()


def _written_params(reader: Reader, node: yaml_tree.Node | None) -> dict[str, str]:
    """The text of each parameter of the rules that the file sets."""
    params = {}
    for key, value in node.entries if isinstance(node, yaml_tree.Mapping) else ():
        if isinstance(value, yaml_tree.Scalar):
            params[key.text] = value.text
        else:
            reader.shape(value, "a single value")
    return params


class _TaskReader:
    """Reads one task, section by section."""

    def __init__(
        self,
        reader: Reader,
        entries: Entries,
        values: dict[str, Any],
        ruleset: Ruleset,
        typer: Typer,
        rules: tuple[str, ...],
        given: Mapping[str, int],
    ):
        self.reader, self.reporter, self.entries, self.values = reader, reader.reporter, entries, values
        self.ruleset, self.typer, self.rules, self.given = ruleset, typer, rules, given
        own, _ = read(rules[:1], Reporter())
        self.own = {pack.name.text for pack in own}
        """The packs of the task's own rules: it does not know the names of added ones."""
        self.taken: set[str] = set()
        self.broken: set[str] = set()

    def task(self) -> Task:
        name, family = self.values.get("task"), self.values.get("family")
        if name is not None:
            can_be_called(name, "a task", self.reporter)
        size, fill, knobs = self.size(), self.fill(), self.knobs()
        lets = read_lets(self.values.get("let"), self.reader)
        for word, _ in lets:
            self.take(word)
        plan = DrawingPlan(
            "train",
            fill,
            {knob.name: knob.value for knob in knobs},
            lets,
            self.regions(),
            self.stamps(),
            self.lists("parts", "a part"),
            self.lists("targets", "a target"),
            read_items(self.values.get("generate"), self.reader),
            frozenset(self.broken),
        )
        splits, used = self.splits(plan, size)
        checker = GoalChecker(self.typer, frozenset(plan.regions), frozenset(plan.targets), plan.knobs)
        agent = expert = None
        if "agent" in self.entries:
            agent = read_agent(self.reader, *self.entries["agent"], self.ruleset, size)
        goal = self.goal(checker)
        if agent is not None and agent.choices and "expert" in self.values:
            node = self.values["expert"]
            expert = read_expert(self.reader, node, agent, size, self.ruleset, checker)
        parts = self.values.get("parts")
        for key, _ in parts.entries if isinstance(parts, yaml_tree.Mapping) else ():
            if key.text in plan.parts and key.text not in used:
                message = f"the part `{key.text}` is never used"
                self.reporter.report("PD507", message, key.span, "no list has it", helps=["remove it"])
        self.typer.unknown.report()
        self.reporter.raise_if_errors()
        assert name is not None
        assert agent is not None
        return Task(
            name.text,
            self.values.get("about", ""),
            self.ruleset,
            size,
            knobs,
            agent,
            goal,
            splits,
            expert,
            self.rules,
            family.text if family else "",
        )

    # What worlds are made of

    def size(self) -> Size:
        node = self.values.get("size")
        if node is None:
            return 64, 64
        size = two_integers(node)
        if size is None or not all(1 <= one <= MAX_SIDE for one in size):
            label = f"two integers from 1 to {MAX_SIDE}"
            helps = ["size: [64, 64]"]
            self.reporter.error("PD607", "a size is [rows, columns]", first_line(node), label, helps=helps)
            return 64, 64
        if not fits(self.ruleset, size):
            self.reporter.error("PD607", size_problem(self.ruleset, size), first_line(node), "does not fit")
        return size

    def fill(self) -> int:
        name = self.values.get("fill")
        ids = element_ids(name, self.ruleset, self.reporter) if name else ()
        return ids[0] if ids else 0

    def take(self, word: Written) -> None:
        """Report a new name that already means something, or that statements and expressions need."""
        keywords = reserved_words() | reserved_words(STATEMENTS)
        if word.text in keywords | {*ACTION_WORDS, *FUNCTIONS, *RULE_FUNCTIONS}:
            self.reporter.error("PD311", f"`{word.text}` is a reserved word", word.span, "taken")
        elif word.text in self.taken:
            message = f"`{word.text}` already means something"
            self.reporter.error("PD308", message, word.span, "second meaning")
        elif self.is_name(word.text):
            label = "the rules use this word"
            self.reporter.error("PD308", f"`{word.text}` hides another `{word.text}`", word.span, label)
        self.taken.add(word.text)

    def is_name(self, word: str) -> bool:
        """Whether a word means something in the task's own rules."""
        symbols = self.typer.symbols
        owner = symbols.composition.names.owners.get(word)
        return (owner is None or owner[0] in self.own) and bool(
            self.ruleset.element(word) or symbols.constants.get(word)
        )

    def knobs(self) -> tuple[Knob, ...]:
        found: dict[str, Knob] = {}
        for key, node in self.reader.named(self.values.get("knobs"), "a knob"):
            self.take(key)
            self.broken.add(key.text)
            knob = self.knob(key, self.reader.mapping(node, "knob", "a knob"), found)
            if knob is not None:
                self.broken.discard(key.text)
                found[key.text] = knob
        for name in self.given:
            if name not in self.taken:
                helps = suggest(name, found, "knobs") or ("the task has no knobs",)
                self.reporter.error("PD803", f"no knob `{name}`", None, helps=helps)
        return tuple(found.values())

    def knob(self, key: yaml_tree.Scalar, entries: Entries, above: Mapping[str, Knob]) -> Knob | None:
        bounds, default = (self.line(entries, name, "operand") for name in ("range", "default"))
        if bounds is None or default is None:
            return None
        ends = bounds.children if bounds.kind == "range" else ()
        amounts = [read_amount(part, {}, Reporter()) for part in ends]
        low, high = constants(amounts) or (None, None) if ends else (None, None)
        if low is None or high is None:
            self.reporter.error("PD803", "a knob's range has two integers", bounds.span, "such as `0..64`")
            return None
        if read_amount(bounds, {}, self.reporter) is None:
            return None
        names = {name: number(knob.value) for name, knob in above.items()}
        unread = Reporter()
        amount = read_amount(default, names, unread)
        if any(diagnostic.code == "PD606" for diagnostic in unread.diagnostics):
            read_amount(default, names, self.reporter)
            return None
        if amount is None or amount.op != "const":
            label = "an integer, or knobs that stand above this one"
            helps = suggest(default.span.text, above, "knobs above it")
            self.reporter.error("PD803", f"the default of `{key.text}`", default.span, label, helps=helps)
            return None
        usual = int(amount.value)
        chosen = int(self.given.get(key.text, usual))
        for one, span in ((usual, default.span), (chosen, None if key.text in self.given else default.span)):
            if not low <= one <= high:
                message = f"the knob `{key.text}` must lie in {low}..{high}"
                self.reporter.error("PD803", message, span, f"{one} lies outside", notes=[f"it is {one}"])
        return Knob(key.text, usual, low, high, chosen, self.reader.text(entries, "about"), key.span)

    def line(self, entries: Entries, key: str, start: str) -> Syntax | None:
        span = line_of(self.reader.scalar(entries, key), start, self.reporter)
        return read_line(span, start, self.reporter) if span is not None else None

    def regions(self) -> dict[str, tuple[Statement, ...]]:
        found = {}
        for key, node in self.reader.named(self.values.get("regions"), "a region"):
            self.take(key)
            shapes = []
            for item in node.items if isinstance(node, yaml_tree.Sequence) else (node,):
                span = line_of(item, "shape", self.reporter)
                if not isinstance(item, yaml_tree.Scalar):
                    self.reader.shape(item, "a shape, such as `box rows 1:5 columns 2:8`")
                elif span is not None:
                    shapes.append(read_shape(span, self.reporter))
            found[key.text] = tuple(one for one in shapes if one is not None)
        return found

    def stamps(self) -> dict[str, Stamp]:
        found = {}
        for key, node in self.reader.named(self.values.get("stamps"), "a stamp"):
            stamp = read_stamp(key, node, self.reader, self.ruleset)
            found[key.text] = stamp or Stamp(key.text, ((255,),))
        return found

    def lists(self, section: str, what: str) -> dict[str, Any]:
        named = self.reader.named(self.values.get(section), what)
        return {key.text: read_items(node, self.reader) for key, node in named}

    # Splits

    def splits(self, plan: DrawingPlan, size: Size) -> tuple[tuple[Split, ...], set[str]]:
        """All splits, and the parts that any of them uses."""
        plans = [("train", self.values.get("about", ""), [plan])]
        for key, node in self.reader.named(self.values.get("splits"), "a split"):
            entries = self.reader.mapping(node, "split", "a split")
            base = self.varied(plan, entries, key.text)
            variants = self.stands(base, entries["stands"][1]) if "stands" in entries else [base]
            if key.text == "train":
                label = "it is what the task itself says"
                helps = ["choose another name, or change `generate`, `let` and `parts` of the task"]
                message = "the split `train` is there already"
                self.reporter.error("PD302", message, key.span, label, helps=helps)
            plans.append((key.text, self.reader.text(entries, "about"), variants))
        splits, used = [], set()
        for name, about, variants in plans:
            drawers = [Drawer(variant, self.ruleset, size, self.reporter) for variant in variants]
            splits.append(Split(name, about, tuple(drawer.generator() for drawer in drawers)))
            used |= {part for drawer in drawers for part in drawer.used_parts}
        return tuple(splits), used

    def stands(self, base: DrawingPlan, node: yaml_tree.Node) -> list[DrawingPlan]:
        if not isinstance(node, yaml_tree.Sequence) or not node.items:
            self.reader.shape(node, "a list of stands", "each starts with `- stand: NAME`")
            return [base]
        if len(node.items) > MAX_VARIANTS:
            message = f"{len(node.items)} stands"
            self.reporter.error("PD508", message, first_line(node), f"the limit is {MAX_VARIANTS}")
            return [base]
        found = []
        for item in node.items:
            entries = self.reader.mapping(item, "stand", "a stand")
            name = self.reader.scalar(entries, "stand")
            found.append(self.varied(base, entries, name.text if name else "?"))
        return found

    def varied(self, plan: DrawingPlan, entries: Entries, name: str) -> DrawingPlan:
        """The plan with what a split or stand changes."""
        nodes = {key: node for key, (_, node) in entries.items()}
        knobs = dict(plan.knobs)
        values = {name: number(value) for name, value in plan.knobs.items()}
        for word, syntax in read_lets(nodes.get("knobs"), self.reader):
            self.known(word, plan.knobs, "knob")
            amount = None if syntax is None else read_amount(syntax, values, self.reporter)
            if amount is not None and amount.op == "const":
                knobs[word.text] = int(amount.value)
            elif amount is not None:
                self.reporter.error("PD803", "a knob is one number", amount.span, "not an integer")
        lets = {word.text: (word, syntax) for word, syntax in plan.lets}
        for word, syntax in read_lets(nodes.get("let"), self.reader):
            self.known(word, lets, "number")
            if word.text in lets:
                lets[word.text] = lets[word.text][0], syntax
        parts = dict(plan.parts)
        for key, node in self.reader.named(nodes.get("parts"), "a part"):
            self.known(key, plan.parts, "part")
            parts[key.text] = read_items(node, self.reader)
        items = read_items(nodes["generate"], self.reader) if "generate" in nodes else plan.items
        return replace(plan, name=name, knobs=knobs, lets=list(lets.values()), parts=parts, items=items)

    def known(self, word: Written, known: Mapping[str, object], what: str) -> None:
        if word.text not in known:
            report_unknown(what, word, known, self.reporter)

    def goal(self, checker: GoalChecker) -> Goal:
        expressions: dict[str, Expr | None] = {}
        for section, check in (("reward", checker.number), ("end", checker.condition)):
            node = self.values.get(section)
            if isinstance(node, yaml_tree.Mapping) and not node.entries:
                helps = [", ".join(f"`{key}`: {row.about}" for key, row in TASK_KEYS[section].items())]
                self.reporter.error("PD109", f"`{section}` says nothing", node.span, "empty", helps=helps)
            elif node is not None:
                lines = self.reader.read(node, section, f"`{section}`")
                expressions |= {key: check(syntax) for key, syntax in lines.items()}
        return Goal(*(expressions.get(key) for key in ("each", "final", "success", "failure", "shaped")))
