"""Words that stand where a property's value should."""

from __future__ import annotations

from powderdsl.model.expressions.typer import Typer
from powderdsl.model.types import Property
from powderdsl.syntax.ast import Syntax

_FLAGS = {"on": "yes", "true": "yes", "y": "yes", "off": "no", "false": "no", "n": "no", "none": "no"}
"""Words that people write for yes and no."""


def not_a_value(prop: Property, syntax: Syntax, typer: Typer) -> None:
    """Report a word as a property's value that names nothing."""
    word = syntax.text.lower()
    meant = word if word in ("yes", "no") else _FLAGS.get(word)
    match prop.kind.name:
        case "flag":
            form, example = "`yes` or `no`", "`yes`, `no`"
        case "chance":
            form, example = "a chance", "a chance such as `5%`"
        case _:
            form, example = f"a number in {prop.kind}", f"a number from {prop.kind.lo:g} to {prop.kind.hi:g}"
    fix = (
        f"write `{meant}`"
        if meant and prop.kind.name == "flag"
        else f"write {example}, or a parameter of this pack"
    )
    typer.fail("PD110", f"`{syntax.text}` is not {form}", syntax.span, f"the value of `{prop.name}`", fix)
