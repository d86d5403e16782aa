"""The `expert:` of a task file: how a good player acts, as moves or as a search among random plans."""

from __future__ import annotations

from powderdsl.diagnostics import suggest
from powderdsl.model.schema import Entries, Reader, first_line
from powderdsl.model.types import Expr, Ruleset
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.parse import parse_scalar
from powderdsl.tasks.agents import ACTS
from powderdsl.tasks.drawings import element_ids
from powderdsl.tasks.goals import GoalChecker, parts_of
from powderdsl.tasks.task import BLOW, Agent, Expert, ExpertMove, Measure
from powderdsl.worlds.raster import Shape, Size
from powderdsl.worlds.scene.amounts import integers
from powderdsl.worlds.scene.read import two_integers
from powderdsl.worlds.scene.statements import Word, read_shape, text_span

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
