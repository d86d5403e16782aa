"""Drawing statements: the text of one line -> a `Statement`; one without names and draws is also a `Paint`.

Which cells a shape covers, raster.py says.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from lark import Lark, Token, Tree
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken
from lark.utils import TextSlice

from powderdsl.diagnostics import Reporter, Source, Span, suggest
from powderdsl.diagnostics.printable import shown_character
from powderdsl.syntax.hints import CUT, was_cut
from powderdsl.worlds.raster import MAX_COORDINATE
from powderdsl.worlds.scene.amounts import Amount, number

MAX_STATEMENT = 500
MAX_DEPTH = 24

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
"""Those of a generator: besides, cells at random, pictures, and lists of statements with a name."""

SETTING = "FIELD := VALUE in SHAPE"
"""How a scene gives cells a field's value. Without `in` it is given everywhere."""

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
"""The numbers of each statement in order: what they are called, and the lowest that will do."""

RANGES = {"box": 2, "arch": 2, "container": 2}
"""Statements whose first numbers are that many ranges: pairs of a start and an end, None for an open end."""


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


_TERMINAL_WORDS = {
    "NAME": "a name",
    "NUMBER": "a number",
    "LPAR": "`(`",
    "RPAR": "`)`",
    "COMMA": "`,`",
    "COLON": "`:`",
    "PLUS": "`+`",
    "MINUS": "`-`",
    "STAR": "`*`",
    "SLASH": "`/`",
    "PERCENT": "`%`",
    "__ANON_0": "`..`",
    "ASSIGN": "`:=`",
    "$END": "the end of the statement",
}
"""What terminals are called in messages; keywords are called by themselves."""


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
    patterns = [terminal.pattern for terminal in _parser().terminals]
    return frozenset(one.value for one in patterns if one.type == "str" and one.value.isalpha())


def read_statement(span: Span, reporter: Reporter, *, shape: bool = False) -> Statement | None:
    """The statement (or a region's shape) that stands at `span`, or None after reporting PD605 or PD606."""
    tree = _parse(span, "shape" if shape else "statement", reporter)
    if tree is None:
        return None
    reading = _Reading(span.source, reporter)
    found = reading.statement(tree, shape)
    return None if reading.failed else found


@dataclass(frozen=True)
class WrittenSetting:
    """A field and its value as written; without a `shape` it is meant everywhere."""

    name: Word
    value: Word
    shape: Statement | None
    span: Span = field(compare=False, repr=False)


def read_setting(span: Span, reporter: Reporter) -> WrittenSetting | None:
    """The `FIELD := VALUE in SHAPE` that stands at `span`, or None after reporting PD605 or PD606."""
    tree = _parse(span, "setting", reporter)
    if tree is None:
        return None
    reading = _Reading(span.source, reporter)
    parts: list[Any] = tree.children
    name, _, worth, *shapes = parts
    shape = reading.statement(shapes[0], True) if shapes else None
    place = _token_span(span.source, worth.meta)
    value = Word("".join(place.text.split()), place)
    written = WrittenSetting(reading.word(name), value, shape, _token_span(span.source, tree.meta))
    return None if reading.failed else written


def read_amount(span: Span, reporter: Reporter, *, repeat: bool = False) -> Amount | None:
    """A number as written, or the one after ``repeat``. None after reporting PD605 or PD606."""
    tree = _parse(span, "repeat" if repeat else "amount", reporter)
    if tree is None:
        return None
    reading = _Reading(span.source, reporter)
    part: Any = tree.children[0] if repeat else tree
    found = reading.amount(part, "a number", -MAX_COORDINATE)
    return None if reading.failed else found


def read_choice(span: Span, reporter: Reporter) -> ElementChoice | None:
    """A choice among elements as written. None after reporting PD605."""
    tree = _parse(span, "choice", reporter)
    return None if tree is None else _Reading(span.source, reporter).choice(tree)


def _parse(span: Span, start: str, reporter: Reporter) -> Tree | None:
    if len(span.text) > MAX_STATEMENT:
        first = Span(span.source, span.start, span.start + 1)
        label = f"longer than {MAX_STATEMENT} characters"
        reporter.error("PD605", "a statement that never ends", first, label)
        return None
    try:
        tree = _parser().parse(TextSlice(span.source.text, span.start, span.end), start=start)
    except UnexpectedInput as error:
        _report_syntax(error, span, reporter)
        return None
    if max((depth for depth, _ in _depths(tree)), default=0) > MAX_DEPTH:
        reporter.error("PD605", "numbers nested too deep", span, f"more than {MAX_DEPTH} deep")
        return None
    return tree


def _depths(tree: Tree) -> list[tuple[int, Tree]]:
    """Every part of a tree and how deep it lies, without recursion."""
    found, stack = [], [(0, tree)]
    while stack:
        depth, part = stack.pop()
        found.append((depth, part))
        stack += [(depth + 1, child) for child in part.children if isinstance(child, Tree)]
    return found


def _token_span(source: Source, token) -> Span:  # type: ignore[no-untyped-def]
    """The place of a token, or of a tree's meta."""
    return Span(source, token.start_pos, token.end_pos)


class _Reading:
    """Turns one parse tree into a statement; reports numbers that will not do and remembers that it did."""

    def __init__(self, source: Source, reporter: Reporter):
        self.source = source
        self.reporter = reporter
        self.failed = False

    def statement(self, tree: Tree, shape: bool) -> Statement:
        painted: Any = tree if shape else tree.children[0]
        rest: list[Any] = [] if shape else tree.children[1:]
        kind = str(painted.data)
        parts: list[Any] = list(painted.children)
        choice = self.choice(parts.pop(0)) if not shape and kind not in ("stamp", "part") else None
        name = self.word(parts.pop(0)) if kind in ("stamp", "part") else None
        where = next((self.word(one.children[0]) for one in rest if one.data == "where"), None)
        over = next((self.choice(one.children[0]) for one in rest if one.data == "over"), None)
        span = _token_span(self.source, tree.meta)
        return Statement(kind, self.numbers(kind, parts), span, choice, name, where, over)

    def word(self, token: Token) -> Word:
        return Word(str(token), _token_span(self.source, token))

    def choice(self, tree: Tree) -> ElementChoice:
        parts: list[Any] = list(tree.children)
        how = str(tree.data)
        count = self.amount(parts.pop(0), "how many", 0) if how == "first" else None
        tokens = [parts[0]] if how == "one" else parts[0].children if parts else []
        words = tuple(self.word(token) for token in tokens)
        return ElementChoice(how, words, _token_span(self.source, tree.meta), count)

    def numbers(self, kind: str, parts: list[Any]) -> tuple[Amount | None, ...]:
        """The numbers of a statement in the order of NUMBERS; ranges that are not written are open at both ends."""
        table = NUMBERS[kind]
        found: list[Amount | None] = []
        if kind in RANGES:
            written = {str(one.data): one.children[0] for one in parts if one.data in ("rows", "columns")}
            for axis in ("rows", "columns"):
                found += self.range(written[axis], axis) if axis in written else (number(0), None)
            parts = [one for one in parts if one.data not in ("rows", "columns")]
        for part in parts:
            for child in part.children if part.data == "point" else (part,):
                found.append(self.amount(child, *table[len(found)]))
        return tuple(found)

    def range(self, tree: Tree, axis: str) -> tuple[Amount, Amount | None]:
        parts: list[Any] = tree.children
        if tree.data == "single":
            start = self.amount(parts[0], "a row or column", 0)
            return start, Amount(
                "add", (start, number(1)), None, start.span
            ) if not start.is_number else number(int(start.value or 0) + 1, start.span)
        colon = next(i for i, part in enumerate(parts) if getattr(part, "type", "") == "COLON")
        start = self.amount(parts[0], "the start of a range", 0) if colon == 1 else number(0)
        stop = None
        if colon + 1 < len(parts) and getattr(parts[-1], "type", "") != "END":
            stop = self.amount(parts[-1], "the end of a range", 0)
        if (
            stop is not None
            and stop.is_number
            and start.is_number
            and int(stop.value or 0) <= int(start.value or 0)
            and not self.failed
        ):
            label = "the end must be above the start: a:b leaves b out"
            self._refuse(_token_span(self.source, tree.meta), f"a range without {axis}", label)
        return start, stop

    def amount(self, tree: Any, what: str, lowest: int) -> Amount:
        """An amount. If it is a number as written, it must be at least `lowest`."""
        found = self._amount(tree, what, max(lowest, 0))
        if found.is_number and not lowest <= int(found.value or 0) <= MAX_COORDINATE:
            assert found.span is not None
            self._refuse(found.span, f"{what} must lie in {lowest}..{MAX_COORDINATE}", "out of range")
        return found

    def _amount(self, tree: Tree, what: str, instead: int) -> Amount:
        span = _token_span(self.source, tree.meta)
        op = str(tree.data)
        token: Any = tree.children[0]
        if op == "name":
            return Amount("name", (), str(token), span)
        if op != "number":
            parts: list[Any] = tree.children
            args = tuple(self._amount(part, what, instead) for part in parts)
            if op == "neg" and args[0].is_number:
                return number(-int(args[0].value or 0), span)
            if op == "draw" and args[0].is_number and args[1].is_number:
                low, high = (int(arg.value or 0) for arg in args)
                if low > high:
                    self._refuse(span, "a range without numbers", "the first must not be above the second")
            return Amount(op, args, None, span)
        if not re.fullmatch(r"[0-9]{1,9}", token):
            message = f"{what} must be an integer"
            label = "not an integer" if not token.isdecimal() or not token.isascii() else "too large"
            self._refuse(span, message, label)
            return number(instead, span)
        return number(int(token), span)

    def _refuse(self, span: Span, message: str, label: str) -> None:
        self.failed = True
        self.reporter.error("PD606", message, span, label)


def _report_syntax(error: UnexpectedInput, statement: Span, reporter: Reporter) -> None:
    source = statement.source
    if isinstance(error, UnexpectedCharacters):
        start: int = error.pos_in_stream  # type: ignore[assignment]  # declared as None, set by this subclass
        char = source.text[start]
        reporter.error(
            "PD605",
            f"unexpected character {shown_character(char)}",
            Span(source, start, start + 1),
            helps=_usage(statement),
        )
        return
    assert isinstance(error, UnexpectedToken)
    token, accepted = error.token, set(error.accepts or error.expected or ())
    expected = ", ".join(sorted({_TERMINAL_WORDS.get(name, f"`{name.lower()}`") for name in accepted}))
    if token.type == "$END":
        # Point behind the last character, which is where the missing word belongs.
        start = statement.start + len(statement.text.split("#")[0].rstrip())
        place = Span(source, start, start + 1)
        reporter.error(
            "PD605", "the statement ends too early", place, f"expected {expected}", helps=_usage(statement)
        )
        return
    reporter.error(
        "PD605",
        f"unexpected `{token}`",
        _token_span(source, token),
        f"expected {expected}",
        helps=_usage(statement),
    )


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
