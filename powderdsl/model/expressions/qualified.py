"""Names after a dot that belong to a pack, ``pack.name``, and those that may be absent, ``below.name?``."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Span
from powderdsl.model.expressions.operands import Absent, Operand, Place, SetOf, Unresolved, look
from powderdsl.model.expressions.scope import Scope
from powderdsl.model.types import Expr
from powderdsl.syntax.ast import Syntax

if TYPE_CHECKING:
    from powderdsl.model.expressions.typer import Typer


def of_pack(typer: Typer, syntax: Syntax, scope: Scope) -> Operand | None:
    """``pack.name``, or ``below.pack.name``: what one pack defines, whatever others call theirs."""
    (pack,) = syntax.children
    if pack.kind not in ("name", "attribute"):
        return None
    name = typer.symbols.composition.names.qualified(pack.text, syntax.text)
    if name is None or is_own_word(typer, pack, scope):
        return None
    found = typer.find(name, syntax.span, Scope("", {}, scope.orientation))
    if pack.kind == "name":
        return found
    if not isinstance(found, Expr):
        return None
    place = typer.place(typer.evaluate(pack.children[0], scope), pack.children[0].span)
    return look(found, place.offset, syntax.span)


def is_own_word(typer: Typer, word: Syntax, scope: Scope) -> bool:
    """Whether a word before a dot is a place, a vector or a name of its block, and not the name of a pack.

    Elements, tags and numbers have nothing after a dot: `salt.salt` is the element of the pack `salt`.
    """
    found = typer.find(word.text, word.span, Scope("", scope.locals, scope.orientation))
    if word.text in scope.locals or isinstance(found, Place):
        return True
    return isinstance(found, Expr) and found.kind.name == "vec2"


def optional_attribute(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    """``pack.name?``, ``below.name?``: absent unless a loaded pack defines it."""
    try:
        return typer.attribute(certain(typer, syntax, scope), scope)
    except Unresolved as asleep:
        typer.absent.add(asleep.name)
        return Absent(asleep.name)


def certain(typer: Typer, syntax: Syntax, scope: Scope) -> Syntax:
    """An attribute without its question mark. Raises Unresolved if nothing that is loaded has its name."""
    (before,) = syntax.children
    span, symbols = syntax.span, typer.symbols
    plain = replace(syntax, kind="attribute", span=Span(span.source, span.start, span.end - 1))
    qualified = f"{before.text}.{syntax.text}"
    if qualified in symbols.params:
        return plain
    if symbols.composition.names.qualified(before.text, syntax.text) is not None:
        return plain
    if before.kind in ("name", "attribute"):
        found = typer.find(before.text, before.span, scope)
        if found is None or isinstance(found, SetOf):  # a pack that has an element of its name
            raise Unresolved(qualified)
    if typer.find(syntax.text, syntax.span, scope) is None:
        raise Unresolved(syntax.text)
    return plain
