"""Drawing statements: the text of one line -> a `Paint`. Which cells that is, raster.py says."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import Any

from lark import Lark, Token, Tree
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken
from lark.utils import TextSlice

from powderdsl.diagnostics import Reporter, Source, Span, suggest
from powderdsl.worlds.raster import MAX_COORDINATE, Box, Disk, Frame, Line, Paint, Point, Shape, Slice

MAX_STATEMENT = 500

STATEMENTS = {
    "line": "line ELEMENT from (ROW, COLUMN) to (ROW, COLUMN) width NUMBER",
    "disk": "disk ELEMENT at (ROW, COLUMN) radius NUMBER",
    "box": "box ELEMENT rows A:B columns C:D",
    "frame": "frame ELEMENT",
}
"""Every statement and how it is written. A box may leave out rows, columns, and the ends of a range."""

_TERMINAL_WORDS = {
    "NAME": "an element",
    "NUMBER": "a number",
    "LPAR": "`(`",
    "RPAR": "`)`",
    "COMMA": "`,`",
    "COLON": "`:`",
    "$END": "the end of the statement",
}
"""What terminals are called in messages; keywords are called by themselves."""


@lru_cache(maxsize=1)
def _parser() -> Lark:
    return Lark(
        Path(__file__).with_name("scene.lark").read_text(encoding="utf-8"),
        parser="lalr",
        lexer="basic",
        start="statement",
        propagate_positions=True,
        maybe_placeholders=False,
    )


def parse_statement(span: Span, reporter: Reporter) -> Paint | None:
    """The statement that stands at `span`, or None after reporting bad syntax (PD605) or numbers (PD606)."""
    if len(span.text) > MAX_STATEMENT:
        start = Span(span.source, span.start, span.start + 1)
        reporter.error(
            "PD605", "a statement that never ends", start, f"longer than {MAX_STATEMENT} characters"
        )
        return None
    try:
        tree = _parser().parse(TextSlice(span.source.text, span.start, span.end))
    except UnexpectedInput as error:
        _report_syntax(error, span, reporter)
        return None
    reading = _Reading(span.source, reporter)
    shape = reading.shape(tree)
    if reading.failed:
        return None
    element = tree.children[0]
    return Paint(str(element), shape, _token_span(span.source, tree.meta), _token_span(span.source, element))


def _token_span(source: Source, token) -> Span:  # type: ignore[no-untyped-def]
    """The place of a token, or of a tree's meta."""
    return Span(source, token.start_pos, token.end_pos)


class _Reading:
    """Turns one parsed statement into a shape; reports numbers that will not do and remembers that it did."""

    def __init__(self, source: Source, reporter: Reporter):
        self.source = source
        self.reporter = reporter
        self.failed = False

    def shape(self, tree: Tree) -> Shape:
        parts: list[Any] = tree.children[1:]
        match str(tree.data):
            case "line":
                return Line(self.point(parts[0]), self.point(parts[1]), self.number(parts[2], "a width", 1))
            case "disk":
                return Disk(self.point(parts[0]), self.number(parts[1], "a radius", 1))
            case "box":
                ranges = {str(part.data): self.range(part.children[0], str(part.data)) for part in parts}
                return Box(**ranges)
            case "frame":
                return Frame()
        raise AssertionError(f"no shape for {tree.data}")

    def point(self, tree: Tree) -> Point:
        row: Any
        column: Any
        row, column = tree.children
        return self.number(row, "a row", -MAX_COORDINATE), self.number(column, "a column", -MAX_COORDINATE)

    def range(self, tree: Tree, axis: str) -> Slice:
        tokens: list[Any] = tree.children
        if tree.data == "single":
            start = self.number(tokens[0], "a row or column", 0)
            return start, start + 1
        colon = next(place for place, token in enumerate(tokens) if token.type == "COLON")
        start = self.number(tokens[0], "the start of a range", 0) if colon == 1 else 0
        stop = self.number(tokens[-1], "the end of a range", 0) if colon + 1 < len(tokens) else None
        if stop is not None and stop <= start and not self.failed:
            label = "the end must be above the start: a:b leaves b out"
            self._refuse(_token_span(self.source, tree.meta), f"a range without {axis}", label)
        return start, stop

    def number(self, token: Token, what: str, lowest: int) -> int:
        """A whole number from `lowest` to MAX_COORDINATE."""
        value = int(token) if re.fullmatch(r"[-+]?[0-9]{1,9}", token) else None
        span = _token_span(self.source, token)
        if value is None:
            self._refuse(span, f"{what} must be a whole number", "not a whole number")
        elif not lowest <= value <= MAX_COORDINATE:
            self._refuse(span, f"{what} must lie in {lowest}..{MAX_COORDINATE}", "out of range")
        return value if value is not None else max(lowest, 0)

    def _refuse(self, span: Span, message: str, label: str) -> None:
        self.failed = True
        self.reporter.error("PD606", message, span, label)


def _report_syntax(error: UnexpectedInput, statement: Span, reporter: Reporter) -> None:
    source = statement.source
    if isinstance(error, UnexpectedCharacters):
        start: int = error.pos_in_stream  # type: ignore[assignment]  # declared as None, set by this subclass
        char = source.text[start]
        reporter.error(
            "PD605", f"unexpected character `{char}`", Span(source, start, start + 1), helps=_usage(statement)
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
    word = next(iter(statement.text.split(maxsplit=1)), "")
    return (STATEMENTS[word],) if word in STATEMENTS else suggest(word, STATEMENTS, "statements")
