"""Text of one line -> syntax tree. Positions are offsets in the whole file, so carets are always right."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from lark import Lark, Token, Tree
from lark import __version__ as lark_version
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken
from lark.utils import TextSlice

from powderdsl.diagnostics import Reporter, Source, Span
from powderdsl.diagnostics.printable import shown_character
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.hints import character_help, expected_words, token_help, was_cut
from powderdsl.syntax.yaml_tree import Scalar
from powderdsl.system.user_cache import cache_folder

MAX_LENGTH = 2000
MAX_DEPTH = 48
STARTS = ("rule", "expression", "header", "invariant")


@lru_cache(maxsize=1)
def parser() -> Lark:
    """The one parser of the line language. Its tables are kept in the user's cache: making them takes 0.1 s."""
    grammar = Path(__file__).with_name("grammar.lark").read_text(encoding="utf-8")
    try:
        kept: str | bool = str(cache_folder("syntax") / f"grammar-{lark_version}.lark")
    except (OSError, RuntimeError):  # no home folder, or one that cannot be written
        kept = False
    return Lark(
        grammar,
        parser="lalr",
        lexer="basic",
        start=list(STARTS),
        propagate_positions=True,
        maybe_placeholders=False,
        cache=kept,
    )


def reserved_words() -> frozenset[str]:
    """Words of the grammar that cannot be names."""
    return words_of(parser())


def words_of(grammar: Lark) -> frozenset[str]:
    """The keywords of a grammar."""
    patterns = [terminal.pattern for terminal in grammar.terminals]
    return frozenset(one.value for one in patterns if one.type == "str" and one.value.isalpha())


def parse_scalar(scalar: Scalar, start: str, reporter: Reporter) -> Syntax | None:
    """Parse a YAML scalar as one of STARTS; None after reporting a syntax error."""
    span = scalar.content
    if scalar.style == "quoted" and " ".join(span.text.split()) != " ".join(scalar.text.split()):
        label = "a backslash, or doubled quotes"
        helps = ["write the line without quotes, or without the escapes"]
        reporter.error("PD203", "escapes in a quoted rule", scalar.span, label, helps=helps)
        return None
    return parse_text(span.source, span.start, span.end, start, reporter)


def parse_text(source: Source, begin: int, end: int, start: str, reporter: Reporter) -> Syntax | None:
    """Parse characters `begin` to `end` of a source. Reports at most one syntax error."""
    first, helps = Span(source, begin, begin + 1), ["give parts of it names with `let:`"]
    if end - begin > MAX_LENGTH:
        message, label = f"a line of {end - begin:,} characters", f"longer than {MAX_LENGTH:,}"
        reporter.error("PD202", message, first, label, helps=helps)
        return None
    try:
        tree = parser().parse(TextSlice(source.text, begin, end), start=start)
    except UnexpectedInput as error:
        _report_syntax_error(error, source, begin, end, reporter)
        return None
    if depth(tree) > MAX_DEPTH:
        message = f"an expression nested more than {MAX_DEPTH} deep"
        notes = ["a long chain of `and`, `or` or `+` nests as well"]
        reporter.error("PD202", message, first, notes=notes, helps=helps)
        return None
    return _convert(tree, source, Span(source, begin, max(end, begin + 1)))


def depth(tree: Tree) -> int:
    """How many parts of a tree lie inside one another, counted without recursion."""
    level: list[Any] = [tree]
    count = 0
    while level := [child for part in level for child in getattr(part, "children", ())]:
        count += 1
    return count


def _convert(tree: Tree | Token, source: Source, fallback: Span) -> Syntax:
    if isinstance(tree, Token):
        start = tree.start_pos if tree.start_pos is not None else fallback.start
        stop = tree.end_pos if tree.end_pos is not None else fallback.end
        return Syntax("token", (), str(tree), Span(source, start, stop))
    meta = tree.meta
    span = fallback if meta.empty else Span(source, meta.start_pos, meta.end_pos)
    children = [_convert(child, source, span) for child in tree.children]
    text = " ".join(child.text for child in children if child.kind == "token")
    nodes = tuple(child for child in children if child.kind != "token")
    return Syntax(str(tree.data), nodes, text, span)


def _report_syntax_error(
    error: UnexpectedInput, source: Source, begin: int, end: int, reporter: Reporter
) -> None:
    text = source.text
    if isinstance(error, UnexpectedCharacters):
        start: int = error.pos_in_stream  # type: ignore[assignment]  # declared as None, set by this subclass
        message = f"unexpected character {shown_character(text[start])}"
        fix = character_help(text, start, begin)
        span, label = Span(source, start, start + 1), "not part of a rule"
        reporter.error("PD201", message, span, label, helps=[fix] if fix else [])
        return
    assert isinstance(error, UnexpectedToken)
    token = error.token
    at_end = token.type == "$END"
    place = len(text[:end].rstrip()) if at_end or token.start_pos is None else token.start_pos
    start = min(max(place, begin), max(len(text) - 1, 0))
    stop = start + (1 if at_end else len(token))
    accepted = set(error.accepts or error.expected or ())
    expected = expected_words(accepted)
    fix = token_help("" if at_end else str(token), accepted, text[begin:start], was_cut(text, begin, end))
    message = "the line ends too early" if at_end else f"unexpected `{token}`"
    span, label = Span(source, start, max(stop, start + 1)), f"expected {expected}" if expected else ""
    reporter.error("PD201", message, span, label, helps=[fix] if fix else [])
