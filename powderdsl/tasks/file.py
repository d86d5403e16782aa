"""A task file -> a checked `Task`. Everything that is wrong is reported at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from powderdsl.compiler import load_with_diagnostics, names_in_file, read
from powderdsl.diagnostics import CompileError, Reporter, Source, Span, suggest
from powderdsl.model.builtins import FUNCTIONS as RULE_FUNCTIONS
from powderdsl.model.check import resolve_names
from powderdsl.model.composition.palette import Palette
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.schema import Entries, Key, Reader, first_line
from powderdsl.model.state import fits, size_problem
from powderdsl.model.types import Expr, Ruleset
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.parse import parse_scalar
from powderdsl.syntax.parse import reserved_words as rule_words
from powderdsl.tasks.agents import read_agent, read_expert
from powderdsl.tasks.drawings import (
    BROKEN,
    Drawer,
    DrawingPlan,
    element_ids,
    read_items,
    read_lets,
    read_stamp,
    report_unknown,
)
from powderdsl.tasks.goals import ACTION_WORDS, FUNCTIONS, GoalChecker
from powderdsl.tasks.task import MAX_SIDE, Goal, Knob, Split, Stamp, Task
from powderdsl.worlds.raster import Size
from powderdsl.worlds.scene.amounts import Amount, filled_in, integers
from powderdsl.worlds.scene.read import can_be_called, two_integers
from powderdsl.worlds.scene.statements import (
    Statement,
    Word,
    read_amount,
    read_shape,
    reserved_words,
    text_span,
)

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
        "speed": Key("number", "the speed that blowing gives to cells"),
        "speed_field": Key("word", "the field that blowing sets; the ruleset's only vector, if it has one"),
        "brush": Key("any", "cells that an action changes: a number, or [rows, columns]; 10 by default"),
        "bins": Key("any", "places that it can act at: a number, or [rows, columns]; 16 by default"),
        "actions": Key("number", "how many actions an episode has", True),
        "steps_per_action": Key("number", "steps after each action; 1 by default"),
        "free_steps": Key("number", "steps after the last action, besides; 0 by default"),
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
            "number", "random plans that are simulated in each world; the best one is played", True
        ),
    },
    "move": {
        "choose": Key("word", "what it does: an element, `blow` or `nothing`", True),
        "toward": Key("word", "where it blows: `left`, `right`, `above`, `below`, or both as `above.right`"),
        "at": Key("any", "where: `[row, column]`, or `most(CELLS)`, the block with most of these cells"),
        "within": Key("line", "a shape: only its cells count for `most`"),
        "least": Key("number", "how many cells `most` must find for the move to apply; 1 by default"),
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
    rules = _read_rules(reader, entries, source, params, packs, palette)
    if rules is None:
        reporter.raise_if_errors()
        raise AssertionError("a task without rules was not reported")
    return _TaskReader(reader, entries, *rules, knobs or {}).task()


def _read_rules(
    reader: Reader,
    entries: Entries,
    source: Source,
    params: Mapping[str, Any] | None,
    packs: Sequence[str],
    palette: Palette | None,
) -> tuple[Ruleset, Typer, tuple[str, ...]] | None:
    """The ruleset, what checks expressions against it, and what was loaded.

    Mistakes in the rules are reported here.
    """
    word = reader.scalar(entries, "rules")
    if word is None or not word.text:
        return None
    written: dict[str, Any] = {}
    node = entries["params"][1] if "params" in entries else None
    for key, value in node.entries if isinstance(node, yaml_tree.Mapping) else ():
        if isinstance(value, yaml_tree.Scalar):
            written[key.text] = value.text
        else:
            reader.shape(value, "a single value")
    names = names_in_file(word.text, word.span, reader.reporter)
    if names is None:
        return None
    rules = (*names, *packs)
    try:
        ruleset, _ = load_with_diagnostics(*rules, params={**written, **(params or {})}, palette=palette)
    except CompileError as error:
        for one in error.diagnostics:
            place = one.primary.span or word.span
            reader.reporter.error(
                one.code, one.message, place, one.primary.text, notes=one.notes, helps=one.helps
            )
        return None
    loaded, decl = read(rules, Reporter())
    typer, _ = resolve_names(loaded, decl, Reporter(), palette)
    typer.reporter = typer.unknown.reporter = reader.reporter
    return ruleset, typer, rules


class _TaskReader:
    """Reads one task, section by section."""

    def __init__(
        self,
        reader: Reader,
        entries: Entries,
        ruleset: Ruleset,
        typer: Typer,
        rules: tuple[str, ...],
        given: Mapping[str, int],
    ):
        self.reader, self.reporter, self.entries = reader, reader.reporter, entries
        self.ruleset, self.typer, self.given = ruleset, typer, given
        self.rules = rules
        own, _ = read(rules[:1], Reporter())
        self.own = {pack.name.text for pack in own}
        """The packs of the task's own rules: it does not know the names of added ones."""
        self.taken: dict[str, Span] = {}
        self.broken: set[str] = set()

    def task(self) -> Task:
        name = self.reader.scalar(self.entries, "task")
        if name is not None:
            can_be_called(name, "a task", self.reporter)
        size = self.size()
        fill = self.fill()
        knobs = self.knobs()
        values = {knob.name: knob.value for knob in knobs}
        plan = DrawingPlan(
            "train",
            fill,
            values,
            self.names(read_lets(self.node("let"), self.reader)),
            self.regions(),
            self.stamps(),
            self.lists("parts", "a part"),
            self.lists("targets", "a target"),
            read_items(self.node("generate"), self.reader),
            frozenset(self.broken),
        )
        splits, used = self.splits(plan, size)
        agent = read_agent(self.reader, self.entries.get("agent"), self.ruleset, size)
        checker = GoalChecker(self.typer, frozenset(plan.regions), frozenset(plan.targets), plan.knobs)
        goal = self.goal(checker)
        node = self.node("expert")
        expert = (
            read_expert(self.reader, node, agent, size, self.ruleset, checker) if node and agent else None
        )
        self.unused(plan, used)
        self.typer.unknown.report()
        self.reporter.raise_if_errors()
        assert name is not None
        assert agent is not None
        about = self.reader.text(self.entries, "about")
        family = self.reader.scalar(self.entries, "family")
        word = family.text if family else ""
        return Task(
            name.text, about, self.ruleset, size, knobs, agent, goal, splits, expert, self.rules, word
        )

    def node(self, key: str) -> yaml_tree.Node | None:
        return self.entries[key][1] if key in self.entries else None

    # What worlds are made of

    def size(self) -> Size:
        node = self.node("size")
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
        scalar = self.reader.scalar(self.entries, "fill")
        if scalar is None:
            return 0
        ids = element_ids(Word(scalar.text, scalar.span), self.ruleset, self.reporter)
        return ids[0] if ids else 0

    def take(self, word: yaml_tree.Scalar | Word) -> None:
        """Report a new name that already means something, or that statements and expressions need."""
        if word.text in reserved_words() | rule_words() | {*ACTION_WORDS, *FUNCTIONS, *RULE_FUNCTIONS}:
            self.reporter.error("PD311", f"`{word.text}` is a reserved word", word.span, "taken")
        elif word.text in self.taken:
            message = f"`{word.text}` already means something"
            self.reporter.error("PD308", message, word.span, "second meaning")
        elif self._is_name(word.text):
            label = "the rules use this word"
            self.reporter.error("PD308", f"`{word.text}` hides another `{word.text}`", word.span, label)
        self.taken[word.text] = word.span

    def _is_name(self, word: str) -> bool:
        """Whether a word means something in the task's own rules."""
        symbols = self.typer.symbols
        owner = symbols.composition.names.owners.get(word)
        return (owner is None or owner[0] in self.own) and bool(
            self.ruleset.element(word) or symbols.constants.get(word)
        )

    def names(self, lets: list[tuple[Word, Any]]) -> list[tuple[Word, Any]]:
        for word, _ in lets:
            self.take(word)
        return lets

    def knobs(self) -> tuple[Knob, ...]:
        found: dict[str, Knob] = {}
        for key, node in self.reader.named(self.node("knobs"), "a knob"):
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
        bounds, default = (self.amount(entries, name) for name in ("range", "default"))
        if bounds is None or default is None:
            return None
        low, high = integers(bounds.args) or (None, None) if bounds.op == "draw" else (None, None)
        if low is None or high is None:
            self.reporter.error("PD803", "a knob's range has two integers", bounds.span, "such as `0..64`")
            return None
        value = filled_in(default, {name: knob.value for name, knob in above.items()})
        if not value.is_number:
            label = "an integer, or knobs that stand above this one"
            helps = suggest(default.span.text if default.span else "", above, "knobs above it")
            self.reporter.error("PD803", f"the default of `{key.text}`", default.span, label, helps=helps)
            return None
        usual = value.integer
        chosen = int(self.given.get(key.text, usual))
        for one, span in ((usual, default.span), (chosen, None if key.text in self.given else default.span)):
            if not low <= one <= high:
                message = f"the knob `{key.text}` must lie in {low}..{high}"
                self.reporter.error("PD803", message, span, f"{one} lies outside", notes=[f"it is {one}"])
        return Knob(key.text, usual, low, high, chosen, self.reader.text(entries, "about"), key.span)

    def amount(self, entries: Entries, key: str) -> Amount | None:
        span = text_span(self.reader.scalar(entries, key), self.reporter)
        return read_amount(span, self.reporter) if span is not None else None

    def regions(self) -> dict[str, tuple[Statement, ...]]:
        found = {}
        for key, node in self.reader.named(self.node("regions"), "a region"):
            self.take(key)
            shapes = []
            for item in node.items if isinstance(node, yaml_tree.Sequence) else (node,):
                span = text_span(item, self.reporter)
                if not isinstance(item, yaml_tree.Scalar):
                    self.reader.shape(item, "a shape, such as `box rows 1:5 columns 2:8`")
                elif span is not None:
                    shapes.append(read_shape(span, self.reporter))
            found[key.text] = tuple(one for one in shapes if one is not None)
        return found

    def stamps(self) -> dict[str, Stamp]:
        found = {}
        for key, node in self.reader.named(self.node("stamps"), "a stamp"):
            stamp = read_stamp(key, node, self.reader, self.ruleset)
            found[key.text] = stamp or Stamp(key.text, ((255,),))
        return found

    def lists(self, section: str, what: str) -> dict[str, Any]:
        return {
            key.text: read_items(node, self.reader)
            for key, node in self.reader.named(self.node(section), what)
        }

    # Splits

    def splits(self, plan: DrawingPlan, size: Size) -> tuple[tuple[Split, ...], set[str]]:
        """All splits, and the parts that any of them uses."""
        about = self.reader.text(self.entries, "about")
        plans = [("train", about, [plan])]
        for key, node in self.reader.named(self.node("splits"), "a split"):
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
        changes: dict[str, Any] = {"name": name}
        if "knobs" in entries:
            values = dict(plan.knobs)
            for word, amount in read_lets(entries["knobs"][1], self.reader):
                self.known(word, plan.knobs, "knob")
                if amount is BROKEN:
                    continue
                filled = filled_in(amount, plan.knobs)
                if filled.is_number:
                    values[word.text] = filled.integer
                else:
                    self.reporter.error("PD803", "a knob is one number", amount.span, "not an integer")
            changes["knobs"] = values
        if "let" in entries:
            here = dict.fromkeys(word.text for word, _ in plan.lets)
            other = {}
            for word, amount in read_lets(entries["let"][1], self.reader):
                self.known(word, here, "number")
                other[word.text] = amount
            changes["lets"] = [(word, other.get(word.text, amount)) for word, amount in plan.lets]
        if "parts" in entries:
            parts = dict(plan.parts)
            for key, node in self.reader.named(entries["parts"][1], "a part"):
                self.known(key, plan.parts, "part")
                parts[key.text] = read_items(node, self.reader)
            changes["parts"] = parts
        if "generate" in entries:
            changes["items"] = read_items(entries["generate"][1], self.reader)
        return replace(plan, **changes)

    def known(self, word: Word | yaml_tree.Scalar, known: Mapping[str, object], what: str) -> None:
        if word.text not in known:
            report_unknown(what, Word(word.text, word.span), known, self.reporter)

    def unused(self, plan: DrawingPlan, used: set[str]) -> None:
        """Warn of parts that nothing uses."""
        node = self.node("parts")
        for key, _ in node.entries if isinstance(node, yaml_tree.Mapping) else ():
            if key.text in plan.parts and key.text not in used:
                message = f"the part `{key.text}` is never used"
                self.reporter.report("PD507", message, key.span, "no list has it", helps=["remove it"])

    # What counts

    def goal(self, checker: GoalChecker) -> Goal:
        found: dict[str, Expr | None] = {}
        for section in ("reward", "end"):
            node = self.node(section)
            entries = self.reader.mapping(node, section, f"`{section}`") if node is not None else {}
            if isinstance(node, yaml_tree.Mapping) and not node.entries:
                helps = [", ".join(f"`{key}`: {row.about}" for key, row in TASK_KEYS[section].items())]
                self.reporter.error("PD109", f"`{section}` says nothing", node.span, "empty", helps=helps)
            for key in TASK_KEYS[section]:
                scalar = self.reader.scalar(entries, key)
                syntax = parse_scalar(scalar, "expression", self.reporter) if scalar else None
                if syntax is not None:
                    found[key] = checker.number(syntax) if section == "reward" else checker.condition(syntax)
        return Goal(*(found.get(name) for name in ("each", "final", "success", "failure", "shaped")))
