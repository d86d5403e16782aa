"""Drawing statements: the text of one line -> a `Statement`. `worlds.raster` says which cells its shape covers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from lark import Lark, Token, Tree
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken
from lark.tree import Meta
from lark.utils import TextSlice

from powderdsl.diagnostics import Reporter, Source, Span, suggest
from powderdsl.diagnostics.printable import shown_character
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.hints import CUT, TERMINAL_WORDS, was_cut
from powderdsl.syntax.parse import depth, words_of
from powderdsl.worlds.raster import MAX_COORDINATE
from powderdsl.worlds.scene.amounts import Amount, number

MAX_STATEMENT = 500
MAX_DEPTH = 25

STATEMENTS = {
    "line": "line ELEMENT from (ROW, COLUMN) to (ROW, COLUMN) width NUMBER",
    "disk": "disk ELEMENT at (ROW, COLUMN) radius NUMBER",
    "square": "square ELEMENT at (ROW, COLUMN) half NUMBER",
    "box": "box ELEMENT rows A:B columns C:D",
    "ramp": "ramp ELEMENT from (ROW, COLUMN) to (ROW, COLUMN)",
    "arch": "arch ELEMENT rows A:B columns C:D width NUMBER",
    "container": "container ELEMENT rows A:B columns C:D width NUMBER",
    "wave": "wave ELEMENT at ROW height NUMBER length NUMBER phase NUMBER",
    "frame": "frame ELEMENT",
    "fill": "fill ELEMENT",
}
"""Every statement and how it is written. A box may leave out rows, columns, and the ends of a range."""

GENERATOR_STATEMENTS = {
    **STATEMENTS,
    "scatter": "scatter ELEMENT chance NUMBER%",
    "stamp": "stamp NAME at (ROW, COLUMN)",
    "part": "part NAME",
}
"""Those of a generator, which also has random cells, pictures, and named lists of statements."""

SETTING = "FIELD := VALUE in SHAPE"
"""How a scene gives cells a field's value; without `in`, all cells."""

_POINT = (("a row", -MAX_COORDINATE), ("a column", -MAX_COORDINATE))
_ROWS = (("the start of a range", 0), ("the end of a range", 0))
NUMBERS: dict[str, tuple[tuple[str, int], ...]] = {
    "line": (*_POINT, *_POINT, ("a width", 1)),
    "disk": (*_POINT, ("a radius", 1)),
    "square": (*_POINT, ("half a side", 1)),
    "box": (*_ROWS, *_ROWS),
    "ramp": (*_POINT, *_POINT),
    "arch": (*_ROWS, *_ROWS, ("a width", 1)),
    "container": (*_ROWS, *_ROWS, ("a width", 1)),
    "wave": (("a row", -MAX_COORDINATE), ("a height", 0), ("a length", 2), ("a phase", -MAX_COORDINATE)),
    "frame": (),
    "fill": (),
    "scatter": (("a chance", 0),),
    "stamp": _POINT,
    "part": (),
}
"""The numbers of each statement in order: what they are called, and their lowest value."""

RANGES = {"box": 2, "arch": 2, "container": 2}
"""How many ranges the first numbers of a statement are: pairs of a start and an end, None for an open end."""


@dataclass(frozen=True)
class Word:
    """A name as written, and where."""

    text: str
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True)
class ElementChoice:
    """Elements one of which is used: ``one`` or ``some`` of `names`, ``any`` but them, or the ``first`` few of them."""

    how: str
    names: tuple[Word, ...]
    span: Span = field(compare=False, repr=False)
    count: Amount | None = None


@dataclass(frozen=True)
class Statement:
    """A statement as written. `numbers` are those of NUMBERS; a region's shape has no `choice`."""

    kind: str
    numbers: tuple[Amount | None, ...]
    span: Span = field(compare=False, repr=False)
    choice: ElementChoice | None = None
    name: Word | None = None
    where: Word | None = None
    over: ElementChoice | None = None


@dataclass(frozen=True)
class WrittenSetting:
    """A field and its value as written; without a `shape` all cells are meant."""

    name: Word
    value: Word
    shape: Statement | None
    span: Span = field(compare=False, repr=False)


_WORDS = {
    **TERMINAL_WORDS,
    "NUMBER": "a number",
    "COLON": "`:`",
    "PERCENT": "`%`",
    "__ANON_0": "`..`",
    "ASSIGN": "`:=`",
    "$END": "the end of the statement",
}
"""Names of terminals in messages; keywords stand for themselves."""


@lru_cache(maxsize=1)
def _parser() -> Lark:
    return Lark(
        Path(__file__).with_name("scene.lark").read_text(encoding="utf-8"),
        parser="lalr",
        lexer="basic",
        start=["statement", "setting", "shape", "amount", "repeat", "choice"],
        propagate_positions=True,
        maybe_placeholders=False,
    )


@lru_cache(maxsize=1)
def reserved_words() -> frozenset[str]:
    """Words of statements, which cannot name knobs, draws or regions."""
    return words_of(_parser())


def text_span(node: yaml_tree.Node | None, reporter: Reporter) -> Span | None:
    """The place of a line of text; None if the node is not one, or after reporting escapes, where carets would be wrong."""
    if not isinstance(node, yaml_tree.Scalar):
        return None
    if node.style == "quoted" and node.content.text.split() != node.text.split():
        reporter.error("PD605", "escapes in a quoted statement", node.span, "escaped or doubled quotes")
        return None
    return node.content


def read_statement(span: Span, reporter: Reporter) -> Statement | None:
    """The statement at `span`, or None after reporting PD605 or PD606."""
    return _read("statement", span, reporter)


def read_shape(span: Span, reporter: Reporter) -> Statement | None:
    """The shape of a region at `span`: a statement without an element. None after reporting PD605 or PD606."""
    return _read("shape", span, reporter)


def read_setting(span: Span, reporter: Reporter) -> WrittenSetting | None:
    """The `FIELD := VALUE in SHAPE` at `span`, or None after reporting PD605 or PD606."""
    return _read("setting", span, reporter)


def read_amount(span: Span, reporter: Reporter, *, repeat: bool = False) -> Amount | None:
    """A number as written, or the one after ``repeat``. None after reporting PD605 or PD606."""
    return _read("repeat" if repeat else "amount", span, reporter)


def read_choice(span: Span, reporter: Reporter) -> ElementChoice | None:
    """A choice among elements as written. None after reporting PD605."""
    return _read("choice", span, reporter)


def _read(start: str, span: Span, reporter: Reporter) -> Any:
    """The value of the text at `span`, by the start symbol of the grammar; None after a report."""
    if len(span.text) > MAX_STATEMENT:
        first = Span(span.source, span.start, span.start + 1)
        label = f"longer than {MAX_STATEMENT} characters"
        reporter.error("PD605", "a statement that is too long", first, label)
        return None
    try:
        tree: Any = _parser().parse(TextSlice(span.source.text, span.start, span.end), start=start)
    except UnexpectedInput as error:
        _report_syntax(error, span, reporter)
        return None
    if depth(tree) > MAX_DEPTH:
        reporter.error("PD605", "numbers nested too deep", span, f"more than {MAX_DEPTH} deep")
        return None
    reading = _Reading(span.source, reporter)
    found = getattr(reading, start)(tree)
    return None if reading.failed else found


class _Reading:
    """Turns one parse tree into what was written, a method for each start symbol. `failed`: after a report."""

    def __init__(self, source: Source, reporter: Reporter):
        self.source = source
        self.reporter = reporter
        self.failed = False

    def span(self, place: Token | Meta) -> Span:
        return Span(self.source, place.start_pos or 0, place.end_pos or 0)

    def statement(self, tree: Any) -> Statement:
        painted, *rest = tree.children
        kind, parts = str(painted.data), list(painted.children)
        named = kind in ("stamp", "part")
        first = parts.pop(0)
        clauses = {str(one.data): one.children[0] for one in rest}
        return Statement(
            kind,
            self.numbers(kind, parts),
            self.span(tree.meta),
            None if named else self.choice(first),
            self.word(first) if named else None,
            self.word(clauses["where"]) if "where" in clauses else None,
            self.choice(clauses["over"]) if "over" in clauses else None,
        )

    def shape(self, tree: Tree) -> Statement:
        kind = str(tree.data)
        return Statement(kind, self.numbers(kind, tree.children), self.span(tree.meta))

    def setting(self, tree: Tree) -> WrittenSetting:
        name, _, worth, *shapes = tree.children
        span = self.span(worth.meta)
        value = Word("".join(span.text.split()), span)
        shape = self.shape(shapes[0]) if shapes else None
        return WrittenSetting(self.word(name), value, shape, self.span(tree.meta))

    def word(self, token: Any) -> Word:
        return Word(str(token), self.span(token))

    def choice(self, tree: Tree) -> ElementChoice:
        how, parts = str(tree.data), list(tree.children)
        count = self.amount(parts.pop(0), "how many", 0) if how == "first" else None
        tokens = parts if how == "one" else parts[0].children if parts else []
        return ElementChoice(how, tuple(map(self.word, tokens)), self.span(tree.meta), count)

    def numbers(self, kind: str, parts: Sequence[Any]) -> tuple[Amount | None, ...]:
        """The numbers of a statement in the order of NUMBERS; ranges that are not written are open at both ends."""
        found: list[Amount | None] = []
        ranges = {str(one.data): one.children[0] for one in parts if one.data in ("rows", "columns")}
        for axis in ("rows", "columns")[: RANGES.get(kind, 0)]:
            found += self.range(ranges[axis], axis) if axis in ranges else (number(0), None)
        for part in parts:
            if part.data not in ranges:
                for one in part.children if part.data == "point" else (part,):
                    found.append(self.amount(one, *NUMBERS[kind][len(found)]))
        return tuple(found)

    def range(self, tree: Tree, axis: str) -> tuple[Amount, Amount | None]:
        parts: list[Any] = tree.children
        if tree.data == "single":
            start = self.amount(parts[0], "a row or column", 0)
            if start.is_number:
                return start, number(start.integer + 1, start.span)
            return start, Amount("add", (start, number(1)), None, start.span)
        colon = next(i for i, part in enumerate(parts) if getattr(part, "type", "") == "COLON")
        start = self.amount(parts[0], "the start of a range", 0) if colon == 1 else number(0)
        if colon + 1 == len(parts) or getattr(parts[-1], "type", "") == "END":
            return start, None
        stop = self.amount(parts[-1], "the end of a range", 0)
        if stop.is_number and start.is_number and stop.integer <= start.integer and not self.failed:
            label = "the end must be above the start: a:b leaves b out"
            self.refuse(self.span(tree.meta), f"a range without {axis}", label)
        return start, stop

    def amount(self, tree: Tree, what: str = "a number", lowest: int = -MAX_COORDINATE) -> Amount:
        """An amount. If it is a number as written, it must be at least `lowest`."""
        found = self.any_amount(tree, what)
        if found.is_number and not lowest <= found.integer <= MAX_COORDINATE:
            assert found.span is not None
            self.refuse(found.span, f"{what} must lie in {lowest}..{MAX_COORDINATE}", "out of range")
        return found

    def repeat(self, tree: Any) -> Amount:
        return self.amount(tree.children[0])

    def any_amount(self, tree: Tree, what: str) -> Amount:
        span, op = self.span(tree.meta), str(tree.data)
        parts: list[Any] = tree.children
        if op == "name":
            return Amount("name", (), str(parts[0]), span)
        if op == "number":
            return self.written(parts[0], span, what)
        args = tuple(self.any_amount(part, what) for part in parts)
        if op == "neg" and args[0].is_number:
            return number(-args[0].integer, span)
        if op == "draw" and all(arg.is_number for arg in args) and args[0].integer > args[1].integer:
            self.refuse(span, "a range without numbers", "the first must not be above the second")
        return Amount(op, args, None, span)

    def written(self, token: str, span: Span, what: str) -> Amount:
        """An integer as written; an amount of no known kind after a report."""
        if re.fullmatch(r"[0-9]{1,9}", token):
            return number(int(token), span)
        label = "not an integer" if not token.isdecimal() or not token.isascii() else "too large"
        self.refuse(span, f"{what} must be an integer", label)
        return Amount("broken", (), None, span)

    def refuse(self, span: Span, message: str, label: str) -> None:
        self.failed = True
        self.reporter.error("PD606", message, span, label)


def _report_syntax(error: UnexpectedInput, statement: Span, reporter: Reporter) -> None:
    source, label = statement.source, ""
    if isinstance(error, UnexpectedCharacters):
        start: int = error.pos_in_stream  # type: ignore[assignment]  # declared as None, set by this subclass
        end, message = start + 1, f"unexpected character {shown_character(source.text[start])}"
    else:
        assert isinstance(error, UnexpectedToken)
        token, accepted = error.token, set(error.accepts or error.expected or ())
        label = "expected " + ", ".join(sorted({_WORDS.get(name, f"`{name.lower()}`") for name in accepted}))
        start, end, message = token.start_pos or 0, token.end_pos or 0, f"unexpected `{token}`"
        if token.type == "$END":
            # Point behind the last character, which is where the missing word belongs.
            start = statement.start + len(statement.text.split("#")[0].rstrip())
            end, message = start + 1, "the statement ends too early"
    reporter.error("PD605", message, Span(source, start, end), label, helps=_usage(statement))


def _usage(statement: Span) -> tuple[str, ...]:
    """How the statement is written, if its first word says which it is; otherwise the word that was meant."""
    if was_cut(statement.source.text, statement.start, statement.end):
        return (CUT,)
    if ":=" in statement.text:
        return (SETTING,)
    word = next(iter(statement.text.split(maxsplit=1)), "")
    if word in GENERATOR_STATEMENTS:
        return (GENERATOR_STATEMENTS[word],)
    return suggest(word, GENERATOR_STATEMENTS, "statements")
