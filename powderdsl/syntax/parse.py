"""Text of one line -> syntax tree. Positions are offsets in the whole file, so that carets are exact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from powderdsl.diagnostics import Reporter, Span
from powderdsl.diagnostics.printable import shown_character
from powderdsl.syntax.hints import CUT, character_help, expected_words, token_help, was_cut
from powderdsl.syntax.yaml_tree import Node, Scalar
from powderdsl.system.writing import cache_folder

if TYPE_CHECKING:
    from lark import Lark, Tree
    from lark.exceptions import UnexpectedInput

MAX_LENGTH = 2000
MAX_DEPTH = 48


@dataclass(frozen=True)
class Syntax:
    """A node. `kind` is the grammar's rule or alias name; `text` is the token of leaves and operators.

    Equality ignores spans, so trees compare by meaning.
    """

    kind: str
    children: tuple[Syntax, ...]
    text: str
    span: Span = field(compare=False, repr=False)

    def child(self, kind: str) -> Syntax | None:
        return next((child for child in self.children if child.kind == kind), None)

    def dump(self, indent: str = "") -> str:
        """The tree as indented text, one node per line."""
        head = f"{indent}{self.kind}" + (f" {self.text}" if self.text else "")
        return "\n".join([head, *(child.dump(indent + "  ") for child in self.children)])


@dataclass(frozen=True)
class Language:
    """A part of the grammar: the noun for a line, its start symbols, and the codes of its errors.

    The codes are for syntax, for size, and for escapes in quotes.
    """

    noun: str
    starts: tuple[str, ...]
    syntax: str
    size: str
    escapes: str


RULES = Language("rule", ("rule", "expression", "header", "invariant"), "PD201", "PD202", "PD203")
STATEMENTS = Language(
    "statement", ("statement", "setting", "shape", "operand", "repeat", "choice"), "PD605", "PD605", "PD605"
)
LANGUAGES = {start: language for language in (RULES, STATEMENTS) for start in language.starts}


@cache
def parser(language: Language = RULES) -> Lark:
    """The parser of a language. Its tables, which take 0.2 s to build, are stored in the user's cache."""
    from lark import Lark, __version__

    grammar = Path(__file__).with_name("grammar.lark").read_text(encoding="utf-8")
    try:
        cache_file: str | bool = str(cache_folder("syntax") / f"{language.starts[0]}-{__version__}.lark")
    except (OSError, RuntimeError):  # no home folder, or one that is not writable
        cache_file = False
    return Lark(
        grammar,
        parser="lalr",
        lexer="basic",
        start=list(language.starts),
        propagate_positions=True,
        maybe_placeholders=False,
        cache=cache_file,
    )


@cache
def reserved_words(language: Language = RULES) -> frozenset[str]:
    """The keywords of a language, which cannot be names."""
    return frozenset(filter(str.isalpha, fixed_terminals(language).values()))


@cache
def fixed_terminals(language: Language) -> dict[str, str]:
    """The terminals of a language that have only one text, and this text."""
    terminals = parser(language).terminals
    return {terminal.name: terminal.pattern.value for terminal in terminals if terminal.pattern.type == "str"}


def line_of(node: Node | None, start: str, reporter: Reporter) -> Span | None:
    """The span of a line of text. Returns None for other nodes, and after reporting escapes, which would shift carets."""
    if not isinstance(node, Scalar):
        return None
    if node.style == "quoted" and node.content.text.split() != node.text.split():
        label = "a backslash, or doubled quotes"
        helps = ["write the line without quotes, or without the escapes"]
        language = LANGUAGES[start]
        message = f"escapes in a quoted {language.noun}"
        reporter.error(language.escapes, message, node.span, label, helps=helps)
        return None
    return node.content


def parse_scalar(scalar: Scalar, start: str, reporter: Reporter) -> Syntax | None:
    """Parse a YAML scalar from a start symbol; None after reporting a syntax error."""
    span = line_of(scalar, start, reporter)
    return None if span is None else parse_text(span, start, reporter)


def parse_text(line: Span, start: str, reporter: Reporter, usage: Sequence[str] = ()) -> Syntax | None:
    """Parse a line from a start symbol. Reports at most one syntax error, whose help is `usage` if given."""
    from lark.exceptions import UnexpectedInput

    language = LANGUAGES[start]
    length, first = line.end - line.start, Span(line.source, line.start, line.start + 1)
    helps = usage or ["give parts of it names with `let:`"]
    if length > MAX_LENGTH:
        message, label = f"a line of {length:,} characters", f"longer than {MAX_LENGTH:,}"
        reporter.error(language.size, message, first, label, helps=helps)
        return None
    try:
        tree = _tree(line.text, start)
    except UnexpectedInput as error:
        _report_syntax_error(error, line, language, reporter, usage)
        return None
    if depth(tree) > MAX_DEPTH:
        message = f"an expression nested more than {MAX_DEPTH} deep"
        notes = ["a long chain of `and`, `or` or `+` nests as well"]
        reporter.error(language.size, message, first, notes=notes, helps=helps)
        return None
    return _to_syntax(tree, line, Span(line.source, line.start, max(line.end, line.start + 1)))


@lru_cache(maxsize=1024)
def _tree(text: str, start: str) -> Tree:
    """The parsed line; editors ask for the same lines after each key. Raises UnexpectedInput."""
    return parser(LANGUAGES[start]).parse(text, start=start)


def depth(tree: Tree) -> int:
    """The depth of a tree, counted without recursion."""
    level: list[Any] = [tree]
    count = 0
    while level := [child for part in level for child in getattr(part, "children", ())]:
        count += 1
    return count


def _to_syntax(tree: Tree, line: Span, fallback: Span) -> Syntax:
    meta, first = tree.meta, line.start
    span = fallback if meta.empty else Span(line.source, first + meta.start_pos, first + meta.end_pos)
    nodes = [_to_syntax(child, line, span) for child in tree.children if not isinstance(child, str)]
    text = " ".join(child for child in tree.children if isinstance(child, str))  # its tokens
    return Syntax(str(tree.data), tuple(nodes), text, span)


def _report_syntax_error(
    error: UnexpectedInput, line: Span, language: Language, reporter: Reporter, usage: Sequence[str]
) -> None:
    from lark.exceptions import UnexpectedCharacters, UnexpectedToken

    source, text = line.source, line.source.text
    if isinstance(error, UnexpectedCharacters):
        at: int = error.pos_in_stream  # type: ignore[assignment]  # declared as None, set by this subclass
        start = line.start + at
        message = f"unexpected character {shown_character(text[start])}"
        fix = character_help(text, start, line.start)
        span, label = Span(source, start, start + 1), f"not part of a {language.noun}"
        reporter.error(language.syntax, message, span, label, helps=usage or ([fix] if fix else []))
        return
    assert isinstance(error, UnexpectedToken)
    token = error.token
    at_end = token.type == "$END"
    place = len(text[: line.end].rstrip()) if at_end else line.start + (token.start_pos or 0)
    start = min(max(place, line.start), max(len(text) - 1, 0))
    stop = start + (1 if at_end else len(token))
    accepted, fixed = set(error.accepts or error.expected or ()), fixed_terminals(language)
    expected = expected_words(accepted, fixed)
    cut = was_cut(text, line.start, line.end)
    fix = token_help("" if at_end else str(token), accepted, fixed, text[line.start : start], cut)
    helps = [CUT] if cut and usage else usage or ([fix] if fix else [])
    message = "the line ends too early" if at_end else f"unexpected `{token}`"
    span, label = Span(source, start, max(stop, start + 1)), f"expected {expected}" if expected else ""
    reporter.error(language.syntax, message, span, label, helps=helps)
