"""The `agent:` and the `expert:` of a task file: the actions it may take, and how a good player acts."""

from __future__ import annotations

import re

from powderdsl.diagnostics import Span, suggest
from powderdsl.model.schema import Entries, Reader, first_line
from powderdsl.model.state import slot_name
from powderdsl.model.types import Expr, Ruleset
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.parse import parse_scalar
from powderdsl.tasks.drawings import choice_ids, element_ids
from powderdsl.tasks.goals import GoalChecker, parts_of
from powderdsl.tasks.task import BLOW, NO_CHANGE, Agent, Expert, ExpertMove, Measure
from powderdsl.worlds.raster import Shape, Size
from powderdsl.worlds.scene.amounts import integers
from powderdsl.worlds.scene.read import two_integers
from powderdsl.worlds.scene.statements import Word, read_choice, read_shape, text_span

MAX_ACTIONS = 1_000_000
MAX_STEPS = 100_000
ACTS = {"blow": BLOW, "nothing": NO_CHANGE}
"""Words of `may:` that are not elements."""


def read_agent(
    reader: Reader, entry: tuple[yaml_tree.Scalar, yaml_tree.Node] | None, ruleset: Ruleset, size: Size
) -> Agent | None:
    """The agent; None if it is missing or empty, which is reported."""
    if entry is None:
        return None
    entries = reader.mapping(entry[1], "agent", "an agent")
    if not entries:
        return None
    choices = _choices(reader, entries, ruleset)
    speed = _read_speed(reader, entries)
    field = _speed_field(reader, entries, ruleset, BLOW in choices, entry[0].span)
    if BLOW in choices and "speed" not in entries:
        message, helps = "an agent that may blow lacks `speed`", ["`speed: 20` is the paper's"]
        reader.reporter.error("PD109", message, entry[0].span, "how fast?", helps=helps)
    brush, bins = _pair(reader, entries, "brush", 10, size), _pair(reader, entries, "bins", 16, size)
    actions = reader.number(entries, "actions", 1, MAX_ACTIONS)
    steps = reader.number(entries, "steps_per_action", 0, MAX_STEPS)
    free = reader.number(entries, "free_steps", 0, MAX_STEPS)
    return Agent(
        choices,
        brush,
        bins,
        actions or 1,
        1 if steps is None else steps,
        free or 0,
        field,
        speed or 0.0,
    )


def _choices(reader: Reader, entries: Entries, ruleset: Ruleset) -> tuple[int, ...]:
    """Element ids, ascending, then BLOW and NO_CHANGE."""
    found: set[int] = set()
    acts: set[int] = set()
    words = reader.words(entries["may"][1]) if "may" in entries else ()
    for word in words:
        if word.text in ACTS:
            acts.add(ACTS[word.text])
            continue
        span = text_span(word, reader.reporter)
        choice = read_choice(span, reader.reporter) if span else None
        if choice is not None:
            found |= set(choice_ids(choice, ruleset, reader.reporter, {}))
    if "may" in entries and not words:
        label = "nothing is allowed"
        reader.reporter.error("PD804", "an agent that may do nothing", entries["may"][0].span, label)
    return (*sorted(found), *sorted(acts, reverse=True))


def _read_speed(reader: Reader, entries: Entries) -> float | None:
    value = reader.scalar(entries, "speed")
    if value is None:
        return None
    if not re.fullmatch(r"-?[0-9]{1,7}(\.[0-9]{1,6})?", value.text) or float(value.text) == 0:
        reader.reporter.error("PD110", "`speed` must be a number other than 0", value.span, "such as `20`")
        return None
    return float(value.text)


def _speed_field(
    reader: Reader,
    entries: Entries,
    ruleset: Ruleset,
    blows: bool,
    span: Span,
) -> str | None:
    """The vector that blowing sets: the one named, or the only one there is."""
    vectors = [one.name for one in ruleset.fields if one.kind.name == "vec2" and not one.resets]
    named = reader.scalar(entries, "speed_field")
    if named is not None and slot_name(ruleset, named.text) not in vectors:
        helps = suggest(named.text, vectors, "vectors of these rules")
        message = f"`{named.text}` is not a vector field"
        reader.reporter.error("PD804", message, named.span, "blowing sets a vector", helps=helps)
        return None
    if not blows:
        return None
    if named is not None:
        return slot_name(ruleset, named.text)
    if not vectors:
        message, helps = (
            "these rules have no field that blowing could set",
            ("load a pack with a vector field",),
        )
        reader.reporter.error("PD804", message, span, "no vector", helps=helps)
    elif len(vectors) > 1:
        message, helps = "blowing could set several fields", (f"`speed_field`: one of {', '.join(vectors)}",)
        reader.reporter.error("PD804", message, span, "which one?", helps=helps)
    return vectors[0] if len(vectors) == 1 else None


def _pair(
    reader: Reader,
    entries: Entries,
    key: str,
    usual: int,
    size: Size,
) -> Size:
    """Rows and columns: one number for both, or a list of two."""
    if key not in entries:
        return min(usual, size[0]), min(usual, size[1])
    node = entries[key][1]
    pair = two_integers(
        yaml_tree.Sequence((node, node), node.span) if isinstance(node, yaml_tree.Scalar) else node
    )
    if pair is None or not all(1 <= one <= most for one, most in zip(pair, size, strict=True)):
        label = f"one number, or [rows, columns], from 1 to {size[0]} and {size[1]}"
        reader.reporter.error("PD804", f"`{key}` does not fit the world", node.span, label)
        return min(usual, size[0]), min(usual, size[1])
    return pair


MAX_PLANS = 10_000
MAX_MOVES = 256
SIDES = {"above": (-1, 0), "below": (1, 0), "left": (0, -1), "right": (0, 1)}
MOST = "most(CELLS)"


def read_expert(
    reader: Reader, node: yaml_tree.Node, agent: Agent, size: Size, ruleset: Ruleset, checker: GoalChecker
) -> Expert | None:
    """The expert of a task, or None after reporting what is wrong with it."""
    if isinstance(node, yaml_tree.Mapping):
        entries = reader.mapping(node, "expert", "an expert")
        plans = reader.number(entries, "search", 1, MAX_PLANS)
        return None if plans is None else Expert((), plans)
    if not isinstance(node, yaml_tree.Sequence) or not node.items:
        reader.shape(node, "a list of moves", "each starts with `- choose: …`")
        return None
    if len(node.items) > MAX_MOVES:
        message = f"an expert of {len(node.items)} moves"
        reader.reporter.error("PD508", message, first_line(node), f"the limit is {MAX_MOVES}")
        return None
    found = [_Move(reader, agent, size, ruleset, checker).read(item) for item in node.items]
    moves = tuple(move for move in found if move is not None)
    if len(moves) < len(found):
        return None
    if moves[-1].condition is not None:
        message, helps = "the last move has a condition", ["add a move without `if:` for all other cases"]
        place = first_line(node.items[-1])
        reader.reporter.error("PD804", message, place, "what else?", helps=helps)
        return None
    return Expert(moves)


class _Move:
    """Reads a move."""

    def __init__(
        self, reader: Reader, agent: Agent, size: Size, ruleset: Ruleset, checker: GoalChecker
    ) -> None:
        self.reader, self.agent, self.size = reader, agent, size
        self.ruleset, self.checker = ruleset, checker

    def read(self, node: yaml_tree.Node) -> ExpertMove | None:
        entries = self.reader.mapping(node, "move", "a move")
        choice = self.choice(entries)
        toward = self.toward(entries, choice)
        place = self.place(entries, node)
        condition, legal = self.condition(entries)
        within = self.within(entries)
        least = self.reader.number(entries, "least", 1, self.size[0] * self.size[1])
        given = (("within", within), ("least", least))
        if choice is None or toward is None or place is None or not legal:
            return None
        if any(key in entries and value is None for key, value in given):
            return None
        cell, most = place
        if most is None and any(key in entries for key, _ in given):
            message, helps = "only `at: most(CELLS)` counts cells", ["remove `within` and `least`"]
            self.reader.reporter.error("PD804", message, first_line(node), "not used", helps=helps)
            return None
        return ExpertMove(choice, toward, cell, most, condition, within, least or 1)

    def choice(self, entries: Entries) -> int | None:
        word = self.reader.scalar(entries, "choose")
        if word is None:
            return None
        if word.text in ACTS:
            id: int | None = ACTS[word.text]
        else:
            ids = element_ids(Word(word.text, word.span), self.ruleset, self.reader.reporter)
            id = ids[0] if ids else None
        if id is None:
            return None
        if id not in self.agent.choices:
            message = f"the agent may not choose `{word.text}`"
            helps = [f"add `{word.text}` to `may:`"]
            self.reader.reporter.error("PD804", message, word.span, "not among its choices", helps=helps)
            return None
        return self.agent.choices.index(id)

    def toward(self, entries: Entries, choice: int | None) -> tuple[int, int] | None:
        """Rows and columns; (0, 0) of what does not blow."""
        word = self.reader.scalar(entries, "toward")
        blows = choice is not None and self.agent.choices[choice] == BLOW
        if word is None:
            if not blows:
                return 0, 0
            message = "a move that blows lacks `toward`"
            place = entries["choose"][1].span
            self.reader.reporter.error("PD109", message, place, "where?", helps=["`toward: right`"])
            return None
        if choice is not None and not blows:
            message = "only `choose: blow` has a direction"
            self.reader.reporter.error("PD804", message, word.span, "not used", helps=["remove `toward`"])
            return None
        parts = word.text.split(".")
        for part in parts:
            if part not in SIDES:
                helps = list(suggest(part, SIDES, "directions"))
                message = f"unknown direction `{part}`"
                self.reader.reporter.error("PD804", message, word.span, "not a direction", helps=helps)
                return None
        rows, columns = (sum(SIDES[part][axis] for part in parts) for axis in (0, 1))
        if max(abs(rows), abs(columns)) > 1 or abs(rows) + abs(columns) != len(parts):
            message, helps = f"`{word.text}` is not one direction", ["write one of them, or `above.right`"]
            self.reader.reporter.error("PD804", message, word.span, "contradicts itself", helps=helps)
            return None
        return rows, columns

    def place(
        self, entries: Entries, move: yaml_tree.Node
    ) -> tuple[tuple[int, int] | None, Measure | None] | None:
        if "at" not in entries:
            return (0, 0), None
        node = entries["at"][1]
        if isinstance(node, yaml_tree.Sequence):
            cell = two_integers(node)
            if cell is None or not all(0 <= one < side for one, side in zip(cell, self.size, strict=True)):
                label = f"[row, column] within {self.size[0]}×{self.size[1]} cells"
                self.reader.reporter.error("PD804", "no such cell", node.span, label)
                return None
            return cell, None
        if not isinstance(node, yaml_tree.Scalar):
            self.reader.shape(node, f"[row, column] or `{MOST}`")
            return None
        syntax = parse_scalar(node, "expression", self.reader.reporter)
        if syntax is None:
            return None
        if syntax.kind != "call" or syntax.text != "most" or len(syntax.children) != 1:
            helps = [f"write `{MOST}`, or `[row, column]`"]
            self.reader.reporter.error("PD804", "this is not a place", node.span, "where?", helps=helps)
            return None
        found = self.checker.measured("count", syntax.children[0])
        return None if found is None else (None, found)

    def within(self, entries: Entries) -> Shape | None:
        """The shape, None without one or after a report."""
        span = text_span(entries["within"][1], self.reader.reporter) if "within" in entries else None
        statement = read_shape(span, self.reader.reporter) if span is not None else None
        if statement is None:
            return None
        numbers = integers(statement.numbers)
        if numbers is None:
            message = "the shape of a move is the same in all worlds"
            self.reader.reporter.error("PD803", message, statement.span, "no draws or names here")
            return None
        return Shape(statement.kind, numbers)

    def condition(self, entries: Entries) -> tuple[Expr | None, bool]:
        """The condition, None for a move without one; and whether it is legal."""
        scalar = self.reader.scalar(entries, "if")
        if scalar is None:
            return None, "if" not in entries
        syntax = parse_scalar(scalar, "expression", self.reader.reporter)
        found = self.checker.condition(syntax) if syntax is not None else None
        if found is None:
            return None, False
        for part in parts_of(found):
            if part.op in ("start", "before") or (
                part.op == "action" and part.value not in ("taken", "left")
            ):
                message = "a move sees the world as it is now"
                label = "what was before is not known here"
                helps = ["use `count(…)`, `share(…)`, `taken` or `left`"]
                self.reader.reporter.error("PD406", message, scalar.span, label, helps=helps)
                return None, False
        return found, True
