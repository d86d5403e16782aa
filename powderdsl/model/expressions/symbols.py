"""The resolved global names of a composition, in which the checker looks up words; reports of unknown names."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Label, suggest
from powderdsl.model.builtins import (
    DIRECTION_SETS,
    DIRECTIONS,
    ELSEWHERE,
    KERNELS,
    KIND_WORDS,
    MAX_MAGNITUDE,
    grid_kernel,
)
from powderdsl.model.composition.compose import Composition
from powderdsl.model.composition.names import MAX_PLACES
from powderdsl.model.declarations import KernelDecl, StreamDecl, TagDecl
from powderdsl.model.expressions.operators import Items, Place, SetOf
from powderdsl.model.operations import FUNCTIONS
from powderdsl.model.state import SNAP
from powderdsl.model.types import CHANCE, DIRECTION, ELEMENT, FLAG, Kind, Stream, Value, integer
from powderdsl.syntax.parse import Syntax
from powderdsl.system.random import name_number

if TYPE_CHECKING:
    from powderdsl.model.expressions.typer import Typer


def add_constants(composition: Composition) -> None:
    """Define the constants that need no evaluation: directions, kernels, elements, tags, streams."""
    constants, names, elements = composition.constants, composition.names, composition.elements
    constants |= {name: Place(offset) for name, offset in DIRECTIONS.items()}
    constants |= {name: Items(tuple(map(Place, offsets))) for name, offsets in DIRECTION_SETS.items()}
    constants |= KERNELS
    for name, kernel in names.declared(KernelDecl).items():
        if kernel.shape is None:
            constants[name] = grid_kernel(name, kernel.rows, kernel.edges == "wrap")
    constants |= {name: SetOf((element.id,), name) for name, element in elements.items()}
    for tag in names.declared(TagDecl):
        constants[tag] = SetOf(tuple(element.id for element in elements.values() if tag in element.tags))
    for name, stream in names.declared(StreamDecl).items():
        composition.streams[name] = Stream(name, name_number(name), stream.bits)


# Literals, without floats: `2%` is 1/50


def read_number(syntax: Syntax, typer: Typer) -> Fraction:
    """The exact value of an integer, decimal or percentage literal."""
    text = syntax.text
    if syntax.kind == "integer" and len(text) > 1 and text[0] == "0":
        fix = f"write `{text.lstrip('0') or '0'}`"
        raise typer.fail("PD110", f"`{text}` starts with a zero", syntax.span, "not a plain number", fix)
    limit = f"the limit is {MAX_MAGNITUDE:,}"
    if "e" in text.lower() and abs(int(text.lower().split("e")[1])) > 12:
        raise typer.fail("PD402", f"`{text}` is too large or too small", syntax.span, limit)
    value = Fraction(text.removesuffix("%"))
    if syntax.kind == "percent":
        value /= 100
    if abs(value) > MAX_MAGNITUDE:
        raise typer.fail("PD402", f"`{text}` is too large", syntax.span, limit)
    return value


def read_bounds(syntax: Syntax, typer: Typer) -> tuple[int, int]:
    """The bounds of `LOW..HIGH`, integer literals."""
    if syntax.kind != "range":
        raise typer.fail("PD401", "expected a range", syntax.span, "such as `0..7`")
    bounds = []
    for end in syntax.children:
        sign, literal = (-1, end.children[0]) if end.kind == "neg" else (1, end)
        if literal.kind != "integer":
            raise typer.fail("PD405", "the ends of a range must be integers", end.span, "not an integer")
        bounds.append(sign * int(read_number(literal, typer)))
    lo, hi = bounds
    if lo > hi:
        label, fix = f"{lo} is above {hi}", f"write `{hi}..{lo}`"
        raise typer.fail("PD402", "the bounds are reversed", syntax.span, label, fix)
    return lo, hi


# Kinds and values

_KINDS_ELSEWHERE = {
    **dict.fromkeys(("int", "integer", "number"), "0..9"),
    "uint8": "0..255",
    **dict.fromkeys(("float", "float32", "double"), "real(0..1)"),
    **dict.fromkeys(("bool", "boolean"), "flag"),
    **dict.fromkeys(("vector", "vec"), "vec2(-100..100)"),
    "probability": "chance",
}
"""Kinds by their names in other languages, and their syntax here."""


def read_kind(syntax: Syntax, typer: Typer) -> Kind:
    """A kind as written: ``0..7``, ``flag``, ``element``, ``chance``, ``real(0..1)``, ``vec2(-10..10)``."""
    word = syntax.text if syntax.kind in ("name", "call") else ""
    plain = {"flag": FLAG, "element": ELEMENT, "direction": DIRECTION, "chance": CHANCE}.get(word)
    if syntax.kind == "range":
        return integer(*read_bounds(syntax, typer))
    if syntax.kind == "name" and plain is not None:
        return plain
    if syntax.kind == "call" and word in ("real", "vec2") and len(syntax.children) == 1:
        return Kind(word, *read_bounds(syntax.children[0], typer))
    if syntax.kind == "name" and word in ("real", "vec2"):
        fix = f"write `{word}(-100..100)`"
        raise typer.fail("PD401", f"`{word}` needs bounds", syntax.span, "no bounds", fix)
    close = suggest(word, KIND_WORDS) if word else ()
    helps: tuple[str, ...] = (
        "kinds: LOW..HIGH, flag, element, direction, chance, real(LOW..HIGH), vec2(LOW..HIGH)",
    )
    if word in _KINDS_ELSEWHERE:
        helps = (f"write `{_KINDS_ELSEWHERE[word]}`",)
    elif close and close[0].startswith("did"):
        helps = close
    raise typer.fail("PD401", "not a kind", syntax.span, "expected a kind", *helps)


def default_of(kind: Kind, first_id: int = 0) -> Value:
    """The default of a kind unless the file declares one: zero or the nearest bound; the first element."""
    if kind.name in ("int", "real", "vec2"):
        zero = min(max(0, kind.lo), kind.hi)
        return int(zero) if kind.name == "int" else float(zero) if kind.name == "real" else (zero, zero)
    return first_id if kind.name == "element" else 0


def clamp(default: Value, kind: Kind) -> Value:
    """A field's default after a step: floats clamped to bounds, and zero if smaller than SNAP."""
    if kind.name not in ("real", "vec2"):
        return default
    if isinstance(default, tuple):
        return clamp_number(default[0], kind), clamp_number(default[1], kind)
    return clamp_number(default, kind)


def clamp_number(value: float | Fraction, kind: Kind) -> float:
    number = min(max(float(value), kind.lo), kind.hi)
    return number if abs(number) >= SNAP else 0.0


# Unknown names


def report_unknown_names(typer: Typer, elsewhere: Callable[[], Mapping[str, str]] = dict) -> None:
    """Report every unknown name once, with all its places, then forget them.

    `elsewhere` gives the packs of words that are not loaded.
    """
    for (name, after_dot), places in typer.unknown.items():
        first, *others = sorted(places, key=lambda span: (span.source.name, span.start))
        label = (
            "no loaded pack defines such a field or property" if after_dot else "no loaded pack defines it"
        )
        more = [Label(span, "and here") for span in others[:MAX_PLACES]]
        notes = [f"and in {len(others) - MAX_PLACES} more places"] if len(others) > MAX_PLACES else []
        fix = _fix(name, places[first], after_dot, typer.symbols)
        if fix.startswith("load") and (pack := elsewhere().get(name)):
            fix = f"the pack `{pack}` defines it: add it to `needs`, or write `{name}?`"
        typer.reporter.error(
            "PD301", f"unknown name `{name}`", first, label, secondary=more, notes=notes, helps=[fix]
        )
    typer.unknown.clear()


def report_undeclared_needs(typer: Typer) -> None:
    """Report the names in rules and values so far from packs that their own pack does not need."""
    for (pack, word), span in typer.undeclared.items():
        owner = typer.symbols.names.pack(typer.symbols.names.of(pack, word))
        typer.reporter.report(
            "PD319", f"`{word}` comes from the pack `{owner}`, which `{pack}` does not need", span,
            "an error if that pack is not loaded",
            helps=[f"add `{owner}` to the `needs` of `{pack}`, or write `{word}?`"],
        )  # fmt: skip


def _fix(name: str, known_here: Iterable[str], after_dot: bool, symbols: Composition) -> str:
    """The fix for an unknown name. `known_here` are the local names of its scope."""
    elsewhere = [qualified for qualified in symbols.params if qualified.endswith(f".{name}")]
    if elsewhere:
        return f"write `{elsewhere[0]}`: parameters of other packs are written with their pack"
    if not after_dot and name.lower() in ELSEWHERE:
        return ELSEWHERE[name.lower()]
    params = (qualified.split(".")[1] for qualified in symbols.params)
    others = DIRECTIONS if after_dot else (*symbols.constants, *params, *known_here, *FUNCTIONS)
    close = suggest(name, (*symbols.properties, *symbols.fields, *symbols.streams, *others))
    if close and close[0].startswith("did"):
        return close[0]
    return f"load the pack that defines it, or write `{name}?` if that may be absent"
