"""Every global name of a composition, resolved: what the checker looks words up in."""

from __future__ import annotations

from dataclasses import dataclass, field

from powderdsl.diagnostics import Label, Reporter, suggest
from powderdsl.model.builtins import DIRECTION_SETS, DIRECTIONS, KERNELS, KIND_WORDS, grid_kernel
from powderdsl.model.composition.compose import Composition
from powderdsl.model.composition.names import Named
from powderdsl.model.declarations import TypedDecl
from powderdsl.model.expressions.literals import read_bounds
from powderdsl.model.expressions.operands import Coercer, Items, Operand, Place, SetOf
from powderdsl.model.state import SNAP
from powderdsl.model.types import (
    CHANCE,
    DIRECTION,
    ELEMENT,
    FLAG,
    Expr,
    Field,
    Kind,
    Param,
    Property,
    Stream,
    Value,
    integer,
)
from powderdsl.syntax.ast import Syntax
from powderdsl.system.random import name_number


@dataclass
class Symbols:
    """Names known everywhere. Filled in order by `resolve_symbols`; frozen in use afterwards."""

    composition: Composition
    properties: dict[str, Property] = field(default_factory=dict)
    fields: dict[str, Field] = field(default_factory=dict)
    streams: dict[str, Stream] = field(default_factory=dict)
    params: dict[str, Param] = field(default_factory=dict)
    constants: dict[str, Operand] = field(default_factory=dict)
    """Elements, tags, sets, kernels, directions."""

    @property
    def ids(self) -> tuple[int, ...]:
        return tuple(element.id for element in self.composition.elements.values())

    @property
    def first_id(self) -> int:
        """The element that fields of elements hold unless their file says otherwise."""
        return min(self.ids, key=self.composition.order.__getitem__)

    def names(self, *, after_dot: bool = False) -> list[str]:
        """All words that an expression can use, for suggestions; `after_dot` those that follow a neighbor."""
        if after_dot:
            return [*self.properties, *self.fields, *self.streams, *DIRECTIONS]
        return [
            *self.constants,
            *self.properties,
            *self.fields,
            *self.streams,
            *(p.split(".")[1] for p in self.params),
        ]

    def is_declared(self, name: str, pack: str) -> bool:
        """Whether some pack declares the name, even if its declaration is wrong."""
        meant = self.composition.names.of(pack, name)
        return meant in self.composition.definitions or f"{pack}.{name}" in self.composition.params


def base_symbols(composition: Composition) -> Symbols:
    """Symbols with what needs no evaluation: directions, kernels, elements, tags, streams."""
    symbols = Symbols(composition)
    constants = symbols.constants
    constants |= {name: Place(offset) for name, offset in DIRECTIONS.items()}
    constants |= {name: Items(tuple(Place(o) for o in offsets)) for name, offsets in DIRECTION_SETS.items()}
    constants |= KERNELS
    constants |= {
        name: grid_kernel(name, k.decl.rows, k.decl.wrap)
        for name, k in composition.kernels.items()
        if k.decl.shape is None
    }
    constants |= {name: SetOf((element.id,), name) for name, element in composition.elements.items()}
    constants |= {name: SetOf(tuple(sorted(ids))) for name, ids in composition.tags.items()}
    symbols.streams |= {
        name: Stream(name, name_number(name), s.decl.bits) for name, s in composition.streams.items()
    }
    return symbols


_KINDS_ELSEWHERE = {
    "int": "0..9",
    "integer": "0..9",
    "number": "0..9",
    "uint8": "0..255",
    "float": "real(0..1)",
    "float32": "real(0..1)",
    "double": "real(0..1)",
    "bool": "flag",
    "boolean": "flag",
    "vector": "vec2(-100..100)",
    "vec": "vec2(-100..100)",
    "probability": "chance",
}
"""Kinds by the names that other languages give them, and how they are written here."""


def read_kind(syntax: Syntax, coercer: Coercer) -> Kind:
    """A kind as written: ``0..7``, ``flag``, ``element``, ``chance``, ``real(0..1)``, ``vec2(-10..10)``."""
    helps: tuple[str, ...] = (
        "kinds: LOW..HIGH, flag, element, direction, chance, real(LOW..HIGH), vec2(LOW..HIGH)",
    )
    if syntax.kind == "range":
        lo, hi = read_bounds(syntax, coercer)
        return integer(lo, hi)
    if syntax.kind == "name":
        plain = {"flag": FLAG, "element": ELEMENT, "direction": DIRECTION, "chance": CHANCE}.get(syntax.text)
        if plain is not None:
            return plain
        if syntax.text in ("real", "vec2"):
            raise coercer.fail(
                "PD401",
                f"`{syntax.text}` needs bounds",
                syntax.span,
                "no bounds",
                f"write `{syntax.text}(-100..100)`",
            )
    if syntax.kind == "call" and syntax.text in ("real", "vec2") and len(syntax.children) == 1:
        lo, hi = read_bounds(syntax.children[0], coercer)
        return Kind(syntax.text, lo, hi)
    word = syntax.text if syntax.kind in ("name", "call") else ""
    close = suggest(word, KIND_WORDS) if word else ()
    if word in _KINDS_ELSEWHERE:
        helps = (f"write `{_KINDS_ELSEWHERE[word]}`",)
    elif close and close[0].startswith("did"):
        helps = close
    raise coercer.fail("PD401", "not a kind", syntax.span, "expected a kind", *helps)


def default_of(kind: Kind, first_id: int = 0) -> Value:
    """The value of something whose file gives no default: zero or the nearest bound to it; the first element."""
    if kind.name in ("int", "real", "vec2"):
        zero = min(max(0, kind.lo), kind.hi)
        return int(zero) if kind.name == "int" else float(zero) if kind.name == "real" else (zero, zero)
    return first_id if kind.name == "element" else 0


def settled(default: Value, kind: Kind) -> Value:
    """A field's default as steps leave it: floats within bounds, and zero where they are smaller than SNAP."""
    if kind.name not in ("real", "vec2"):
        return default
    parts = default if isinstance(default, tuple) else (default,)
    kept = [min(max(float(part), kind.lo), kind.hi) for part in parts]
    row, *column = [part if abs(part) >= SNAP else 0.0 for part in kept]
    return (row, column[0]) if column else row


def field_from(named: Named[TypedDecl], kind: Kind, default: Value, of: frozenset[int] | None) -> Field:
    decl = named.decl
    resets = decl.resets is not None
    return Field(named.name, kind, default, decl.at, resets, of, named.pack, named.span, word=named.word)


def check_param_names(symbols: Symbols, reporter: Reporter) -> None:
    """A parameter may not hide a global word that its pack knows: a rule would read the other one without a sign."""
    composition = symbols.composition
    for named in composition.params.values():
        name = composition.names.of(named.pack, named.decl.name.text)
        other = composition.definitions.get(name)
        if other is not None and composition.names.knows(named.pack, name):
            reporter.error(
                "PD308",
                f"the parameter `{name}` hides another `{name}`",
                named.span,
                "the same word",
                secondary=[Label(other.span, "this one")],
                helps=["rename the parameter"],
            )


def number_value(expr: Expr, kind: Kind) -> Value:
    """The constant in an expression that `Coercer.of_kind` accepted."""
    if kind.name == "vec2":
        parts = [arg.value for arg in expr.args]
        return (float(parts[0]), float(parts[1]))
    assert expr.op == "const"
    return expr.value
