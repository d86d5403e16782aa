"""Lists of statements of a task file: YAML -> statements as written, and repetitions of them."""

from __future__ import annotations

from dataclasses import dataclass, field

from powderdsl.diagnostics import Reporter, Span
from powderdsl.model.schema import Reader, first_line
from powderdsl.syntax import yaml_tree
from powderdsl.worlds.scene.amounts import Amount
from powderdsl.worlds.scene.read import not_a_statement
from powderdsl.worlds.scene.statements import Statement, Word, read_amount, read_statement, text_span

BROKEN = Amount("broken")
"""A number whose mistake has been reported: what depends on it is not a second one."""

MAX_STATEMENTS = 2_000
"""Statements of one list."""


@dataclass(frozen=True)
class Repeat:
    """Statements that are done `count` times, with names of their own."""

    count: Amount
    lets: tuple[tuple[Word, Amount], ...]
    statements: tuple[Statement, ...]
    span: Span = field(compare=False, repr=False)


Item = Statement | Repeat


def read_items(node: yaml_tree.Node | None, reader: Reader, *, nested: bool = False) -> tuple[Item, ...]:
    """The items of a list of statements. `nested` lists, those of a repetition, hold no repetitions."""
    reporter = reader.reporter
    if node is None or (isinstance(node, yaml_tree.Scalar) and node.text == ""):
        return ()
    if not isinstance(node, yaml_tree.Sequence):
        reader.shape(node, "a list of statements", "write one `- statement` a line")
        return ()
    if len(node.items) > MAX_STATEMENTS:
        message = f"a list of {len(node.items):,} statements"
        reporter.error("PD508", message, first_line(node), f"the limit is {MAX_STATEMENTS:,}")
        return ()
    found: list[Item | None] = []
    for item in node.items:
        if isinstance(item, yaml_tree.Mapping):
            if not nested:
                found.append(_repeat(item, reader))
            elif not _is_let(item):
                _not_a_statement(item, reporter, nested)
        elif isinstance(item, yaml_tree.Sequence):
            reader.shape(item, "a statement")
        elif span := text_span(item, reporter):
            found.append(read_statement(span, reporter))
    return tuple(item for item in found if item is not None)


def _is_let(item: yaml_tree.Mapping) -> bool:
    return [key.text for key, _ in item.entries] == ["let"]


def _repeat(item: yaml_tree.Mapping, reader: Reader) -> Repeat | None:
    """`repeat COUNT:` with a list below it, among whose items `let:` gives names."""
    if len(item.entries) != 1 or not item.entries[0][0].text.startswith("repeat"):
        _not_a_statement(item, reader.reporter, nested=False)
        return None
    key, body = item.entries[0]
    count = read_amount(key.content, reader.reporter, repeat=True)
    lets: list[tuple[Word, Amount]] = []
    for one in body.items if isinstance(body, yaml_tree.Sequence) else ():
        if isinstance(one, yaml_tree.Mapping) and _is_let(one):
            lets += read_lets(one.entries[0][1], reader)
    if isinstance(body, yaml_tree.Scalar) and body.text == "":
        reader.reporter.error("PD109", "a repetition of nothing", key.span, "no statements stand below it")
        return None
    statements = tuple(one for one in read_items(body, reader, nested=True) if isinstance(one, Statement))
    return Repeat(count, tuple(lets), statements, key.span) if count is not None else None


def read_lets(node: yaml_tree.Node | None, reader: Reader) -> list[tuple[Word, Amount]]:
    """The names of a `let:` and their numbers, in order; BROKEN after a report."""
    found = []
    for key, value in reader.named(node, "a number"):
        if not isinstance(value, yaml_tree.Scalar):
            reader.shape(value, "a number")
        span = text_span(value, reader.reporter)
        amount = read_amount(span, reader.reporter) if span is not None else None
        found.append((Word(key.text, key.span), amount or BROKEN))
    return found


def _not_a_statement(item: yaml_tree.Mapping, reporter: Reporter, nested: bool) -> None:
    word = next(iter(item.entries[0][0].text.split()), "") if item.entries else ""
    if nested and word == "repeat":
        fix = "repetitions do not stand in repetitions: multiply the counts"
    elif word == "let":
        fix = "`let:` stands at the top of the file, or in a repetition"
    else:
        fix = "say `48:end` for `48:`, or quote the statement; `repeat 0..5:` has a list below it"
    not_a_statement(item, reporter, fix)
