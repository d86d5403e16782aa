"""The `agent:` and `expert:` sections of a task file: allowed actions, and a scripted player.

After reporting a mistake, readers continue with legal values; a file with mistakes does not yield a task.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from powderdsl.diagnostics import Reporter, Span, suggest
from powderdsl.model.builtins import DIRECTIONS, OCTANTS
from powderdsl.model.examples import WordProblem, read_word
from powderdsl.model.schema import Entry, Form, Reader, Record, first_line, keyed
from powderdsl.model.state import slot_name
from powderdsl.model.types import DIRECTION, Expr, Ruleset
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.parse import Syntax
from powderdsl.syntax.yaml_tree import Node, Scalar
from powderdsl.tasks.drawings import choice_ids, element_ids, limited, line_in, shape_in
from powderdsl.tasks.goals import GoalChecker, parts_of
from powderdsl.tasks.task import BLOW, MAX_SIDE, NO_CHANGE, Agent, Expert, ExpertMove, Measure
from powderdsl.worlds.raster import Shape, Size
from powderdsl.worlds.scene.read import two_integers
from powderdsl.worlds.scene.statements import amounts_of, constants

ACTS = {"blow": BLOW, "nothing": NO_CHANGE}
"""Words of `may:` that are not elements."""

MAX_ACTIONS, MAX_STEPS, MAX_PLANS, MAX_MOVES = 1_000_000, 100_000, 10_000, 256
"""Maximum numbers of actions of an episode, steps after one, plans of a search, and moves of an expert."""

SPEED = Form(
    r"-?(?![0.]*$)[0-9]{1,7}(\.[0-9]{1,6})?", "a speed: a number other than 0", "such as `20`", read=float
)


class AgentDecl(Entry, noun="an agent"):
    may: tuple[Scalar, ...] = keyed("elements it may place, `any`, `blow`, `nothing`", (), required=True)
    speed: Scalar | None = keyed("speed that blowing sets, not 0")
    speed_field: Scalar | None = keyed("field that blowing sets; by default the only vector field")
    brush: Node | None = keyed("size of a changed block, or [rows, columns]; 10 by default")
    bins: Node | None = keyed("number of positions, or [rows, columns]; 16 by default")
    actions: int = keyed("actions in an episode", 1, required=True, bounds=(1, MAX_ACTIONS))
    steps_per_action: int = keyed("steps after each action", 1, bounds=(0, MAX_STEPS))
    free_steps: int = keyed("additional steps after the last action", 0, bounds=(0, MAX_STEPS))


class ExpertDecl(Record, noun="an expert"):
    search: int = keyed(
        "number of random plans to simulate; the best is played",
        1,
        required=True,
        bounds=(1, MAX_PLANS),
    )


class MoveDecl(Record, noun="a move"):
    choose: Scalar | None = keyed("an element, `blow` or `nothing`", required=True)
    toward: Scalar | None = keyed("direction of blowing, such as `left` or `above.right`")
    at: Node | None = keyed("`[row, column]`, or `most(CELLS)`: the block with most such cells")
    within: Scalar | None = keyed("a shape that limits `most`")
    least: int | None = keyed("cells that `most` must find; 1 by default", bounds=(1, MAX_SIDE * MAX_SIDE))
    condition: Syntax | None = keyed("condition of the move", name="if")


def read_agent(reader: Reader, decl: AgentDecl, rules: Ruleset, size: Size) -> Agent:
    choices, place = _choices(reader, decl.may, rules), decl.name.span
    blows = BLOW in choices
    if blows and decl.speed is None:
        message, helps = "an agent that may blow needs `speed`", ["`speed: 20` is the paper's"]
        reader.reporter.error("PD109", message, place, "how fast?", helps=helps)
    return Agent(
        choices,
        _pair(reader, decl.brush, "brush", 10, size),
        _pair(reader, decl.bins, "bins", 16, size),
        decl.actions,
        decl.steps_per_action,
        decl.free_steps,
        _speed_field(reader, decl.speed_field, rules, blows, place),
        reader.read_form(SPEED, "speed", decl.speed) or 0.0 if decl.speed else 0.0,
    )


def _choices(reader: Reader, words: Sequence[Scalar], rules: Ruleset) -> tuple[int, ...]:
    """Element ids, ascending, then BLOW and NO_CHANGE."""
    elements: set[int] = set()
    for word in words:
        choice = line_in(word, "choice", reader) if word.text not in ACTS else None
        if choice is not None:
            elements |= set(choice_ids(choice, rules, reader.reporter, {}))
    acts = {ACTS[word.text] for word in words if word.text in ACTS}
    return (*sorted(elements), *sorted(acts, reverse=True))


def _speed_field(
    reader: Reader, named: Scalar | None, rules: Ruleset, blows: bool, agent: Span
) -> str | None:
    """The vector field that blowing sets: the one named, or the only one."""
    vectors = [field.name for field in rules.fields if field.kind.name == "vec2" and not field.resets]
    if named is not None and slot_name(rules, named.text) in vectors:
        return slot_name(rules, named.text) if blows else None
    if named is not None:
        helps = suggest(named.text, vectors, "vectors of these rules")
        message, place, label = f"`{named.text}` is not a vector field", named.span, "blowing sets a vector"
    elif not blows or len(vectors) == 1:
        return vectors[0] if blows else None
    elif vectors:
        helps = (f"`speed_field`: one of {', '.join(vectors)}",)
        message, place, label = "blowing could set several fields", agent, "which one?"
    else:
        helps = ("load a pack with a vector field",)
        message, place, label = "these rules have no field that blowing could set", agent, "no vector"
    reader.reporter.error("PD804", message, place, label, helps=helps)
    return None


def _pair(reader: Reader, node: Node | None, key: str, usual: int, size: Size) -> Size:
    """Rows and columns: one number for both, or a list of two."""
    if node is None:
        return min(usual, size[0]), min(usual, size[1])
    both = yaml_tree.Sequence((node, node), node.span) if isinstance(node, Scalar) else node
    pair = two_integers(both)
    if pair is None or not all(1 <= count <= most for count, most in zip(pair, size, strict=True)):
        label = f"one number, or [rows, columns], from 1 to {size[0]} and {size[1]}"
        reader.reporter.error("PD804", f"`{key}` does not fit the world", node.span, label)
        return 1, 1
    return pair


def read_expert(
    reader: Reader, node: Node, agent: Agent, size: Size, rules: Ruleset, checker: GoalChecker
) -> Expert | None:
    """The expert of a task, or None after reporting all mistakes in it."""
    if isinstance(node, yaml_tree.Mapping):
        decl = reader.record(ExpertDecl, node, "an expert")
        return None if decl is None else Expert((), decl.search)
    if not isinstance(node, yaml_tree.Sequence) or not node.items:
        reader.shape(node, "a list of moves", "each starts with `- choose: …`")
        return None
    if not limited(node, MAX_MOVES, "an expert of {} moves", reader.reporter):
        return None
    read = _Move(reader, agent, size, rules, checker).read
    moves = tuple(map(read, node.items))
    if moves[-1].condition is not None:
        message, helps = "the last move has a condition", ["add a move without `if:` for all other cases"]
        place = first_line(node.items[-1])
        reader.reporter.error("PD804", message, place, "what else?", helps=helps)
    return Expert(moves)


@dataclass(frozen=True)
class _Move:
    """A reader of the moves of an expert."""

    reader: Reader
    agent: Agent
    size: Size
    rules: Ruleset
    checker: GoalChecker

    def read(self, node: Node) -> ExpertMove:
        decl = self.reader.record(MoveDecl, node, "a move") or MoveDecl()
        choice = self.choice(decl.choose)
        cell, most = self.place(decl.at)
        if cell is not None and (decl.within is not None or decl.least is not None):
            fix = "remove `within` and `least`"
            self.wrong("only `at: most(CELLS)` counts cells", first_line(node), "not used", fix)
        toward, condition = self.toward(decl, choice), self.condition(decl.condition)
        within = self.within(decl.within)
        return ExpertMove(choice or 0, toward, cell, most, condition, within, decl.least or 1)

    def wrong(self, message: str, span: Span, label: str, *helps: str) -> None:
        self.reader.reporter.error("PD804", message, span, label, helps=helps)

    def choice(self, word: Scalar | None) -> int | None:
        """An index into the agent's choices; None if it is missing, or after a report."""
        if word is None:
            return None
        reporter = self.reader.reporter
        ids = (ACTS[word.text],) if word.text in ACTS else element_ids(word, self.rules, reporter)[:1]
        if ids and ids[0] not in self.agent.choices:
            message = f"the agent may not choose `{word.text}`"
            self.wrong(message, word.span, "not among its choices", f"add `{word.text}` to `may:`")
            return None
        return self.agent.choices.index(ids[0]) if ids else None

    def toward(self, decl: MoveDecl, choice: int | None) -> tuple[int, int]:
        """Rows and columns; (0, 0) for moves that do not blow."""
        word = decl.toward
        if choice is None or decl.choose is None:
            return 0, 0
        blows = self.agent.choices[choice] == BLOW
        if blows and word is None:
            message, helps = "a move that blows needs `toward`", ["`toward: right`"]
            self.reader.reporter.error("PD109", message, decl.choose.span, "where?", helps=helps)
        elif word is not None and not blows:
            self.wrong("only `choose: blow` has a direction", word.span, "not used", "remove `toward`")
        elif word is not None:
            try:
                ((octant, _),) = read_word(word.text, DIRECTION, {})
                return OCTANTS[int(octant)]
            except WordProblem as problem:
                close = suggest(word.text, DIRECTIONS, "directions")
                self.wrong(problem.message, word.span, problem.label, *close)
        return 0, 0

    def place(self, node: Node | None) -> tuple[tuple[int, int] | None, Measure | None]:
        """The cell, or the cells to count; neither after a report."""
        if node is None:
            return (0, 0), None
        if isinstance(node, yaml_tree.Sequence):
            cell = two_integers(node)
            if cell is None or not all(0 <= at < side for at, side in zip(cell, self.size, strict=True)):
                label = f"[row, column] within {self.size[0]}×{self.size[1]} cells"
                self.wrong("no such cell", node.span, label)
            return cell, None
        if not isinstance(node, Scalar):
            self.reader.shape(node, "[row, column] or `most(CELLS)`")
            return None, None
        syntax = self.reader.line(node)
        if syntax is None:
            return None, None
        if syntax.kind != "call" or syntax.text != "most" or len(syntax.children) != 1:
            self.wrong("this is not a place", node.span, "where?", "write `most(CELLS)`, or `[row, column]`")
            return None, None
        return None, self.checker.measured("count", syntax.children[0])

    def within(self, word: Scalar | None) -> Shape | None:
        statement = shape_in(word, self.reader)
        if statement is None:
            return None
        amounts = amounts_of(statement, {}, Reporter())
        numbers = None if amounts is None else constants(amounts)
        if numbers is None:
            message = "the shape of a move is the same in all worlds"
            self.reader.reporter.error("PD803", message, statement.span, "no draws or names here")
        return Shape(statement.kind, numbers or ())

    def condition(self, syntax: Syntax | None) -> Expr | None:
        condition = self.checker.condition(syntax) if syntax is not None else None
        if condition is None or syntax is None:
            return None
        # A move has no access to earlier values or the last action.
        parts = [part for part in parts_of(condition) if part.value not in ("taken", "left")]
        if any(part.op in ("start", "before", "action") for part in parts):
            message, label = "a move sees the current world", "earlier values are not available here"
            helps = ["use `count(…)`, `share(…)`, `taken` or `left`"]
            self.reader.reporter.error("PD406", message, syntax.span, label, helps=helps)
            return None
        return condition
