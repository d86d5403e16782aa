"""The checked model of a ruleset, resolved, typed and unrolled. Frozen, printable, no torch, no NumPy.

Everything discrete has a declared range; every chance and count is explicit. The reference interpreter runs the model
directly, and `ir/lower.py` lowers it; neither needs the syntax.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, Any

from powderdsl.diagnostics import Span
from powderdsl.system.settings import UNMEANING, fingerprint

if TYPE_CHECKING:
    from powderdsl.model.declarations import PackDecl, RulesetDecl

Offset = tuple[int, int]
"""(rows down, columns right)."""

HERE: Offset = (0, 0)


def plus(a: Offset, b: Offset) -> Offset:
    return (a[0] + b[0], a[1] + b[1])


def minus(a: Offset, b: Offset) -> Offset:
    return (a[0] - b[0], a[1] - b[1])


Value = int | float | Fraction | tuple[float, float]


@dataclass(frozen=True)
class Kind:
    """The type of a value. `lo` and `hi` are inclusive bounds of ``int``, ``real`` and ``vec2`` components.

    ``flag``        a mask over cells
    ``int``         lo..hi
    ``element``     an element id
    ``direction``   0..7: right, right-down, down, … as octants, counted clockwise on the screen
    ``chance``      an exact probability in 0..1 (constants, parameters, properties)
    ``draw``        a random number strictly between lo and hi: a stream's draw, plus integers
    ``real``        float32;  ``vec2``  two float32, (rows, columns)
    """

    name: str
    lo: float = 0
    hi: float = 0

    def __str__(self) -> str:
        match self.name:
            case "int":
                return f"{self.lo:g}..{self.hi:g}"
            case "real" | "vec2":
                return f"{self.name}({self.lo:g}..{self.hi:g})" if self.hi > self.lo else self.name
        return self.name


FLAG, ELEMENT, DIRECTION, CHANCE = Kind("flag"), Kind("element"), Kind("direction"), Kind("chance")
REAL, VEC2, DRAW = Kind("real"), Kind("vec2"), Kind("draw", 0, 1)


def integer(lo: float, hi: float) -> Kind:
    return Kind("int", lo, hi)


@dataclass(frozen=True)
class Expr:
    """A typed expression. `op` is a key of `operations.OPERATIONS`; `value` is the operation's further argument."""

    op: str
    kind: Kind
    args: tuple[Expr, ...] = ()
    value: Any = None
    span: Span | None = field(default=None, compare=False, repr=False)

    def walk(self) -> Iterator[Expr]:
        """This expression and all its subexpressions."""
        yield self
        for arg in self.args:
            yield from arg.walk()


@dataclass(frozen=True)
class ColorRamp:
    """An element's color by the value of a field: `start` up to `lo`, `end` from `hi`, and interpolated between.

    Red, green and blue are rounded to the nearest integer, halves up. `real`: the field's values are float32.
    """

    field: str
    start: str
    end: str
    lo: int
    hi: int
    real: bool = False


@dataclass(frozen=True)
class Element:
    """An element. `id` is its number in worlds of this ruleset; `glyph` is one ASCII character.

    `name` is plain, or qualified where an earlier pack has an element of that name; `word` is that of its file then.
    """

    name: str
    pack: str
    id: int
    color: str = field(metadata=UNMEANING)
    glyph: str = field(metadata=UNMEANING)
    about: str = field(metadata=UNMEANING)
    tags: frozenset[str] = field(metadata=UNMEANING)
    span: Span = field(compare=False, repr=False)
    word: str = field(default="", repr=False)
    ramp: ColorRamp | None = field(default=None, metadata=UNMEANING)
    """The color as a function of a field; without a ramp it is `color` everywhere."""

    @property
    def qualified(self) -> str:
        """The name that does not depend on the other loaded packs."""
        return f"{self.pack}.{self.word or self.name}"


@dataclass(frozen=True)
class Property:
    """A constant of each element; `stored` has the ids whose cells may have their own value."""

    name: str
    kind: Kind
    values: tuple[Value | str, ...]
    """By element id, `slots` of them; a string names a parameter."""
    stored: frozenset[int]
    pack: str
    span: Span = field(compare=False, repr=False)
    word: str = field(default="", repr=False, metadata=UNMEANING)


@dataclass(frozen=True)
class Tint:
    """The tint of cells in pictures by a vector field: toward `color`, by its length / `full`, at most `most`."""

    color: str
    full: int
    most: float


@dataclass(frozen=True)
class Field:
    """State of a cell. `at` is ``element`` (travels with it) or ``place``; `of` limits it to some elements.
    `own` are the defaults of single elements, by id, in the order of ids. `word` is as in `Element`."""

    name: str
    kind: Kind
    default: Any
    at: str
    resets: bool
    of: frozenset[int] | None
    pack: str
    span: Span = field(compare=False, repr=False)
    own: tuple[tuple[int, Any], ...] = ()
    word: str = field(default="", repr=False, metadata=UNMEANING)
    tint: Tint | None = field(default=None, metadata=UNMEANING)

    @property
    def defaults(self) -> tuple[Any, ...]:
        """All values that a fresh cell may have."""
        return (self.default, *(value for _, value in self.own))


@dataclass(frozen=True)
class Stream:
    """A source of random numbers. `ident` is hashed; `bits` is the resolution of a draw."""

    name: str
    ident: int
    bits: int


@dataclass(frozen=True)
class Param:
    """A number that a user may override without editing the file. `name` is ``pack.name``."""

    name: str
    kind: Kind
    default: Any
    about: str = field(metadata=UNMEANING)
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True)
class Kernel:
    """Weights by offset, row by row from the top left. `wrap`: the grid wraps; otherwise, it ends at its edges."""

    name: str
    weights: tuple[tuple[int, int, int], ...]
    wrap: bool

    @property
    def radius(self) -> int:
        return max((max(abs(dy), abs(dx)) for dy, dx, _ in self.weights), default=0)


@dataclass(frozen=True)
class Assign:
    """`field := value` at the cell `offset` away from each cell of the mask. `op` is ``:=``, ``+=`` or ``-=``."""

    field: str
    offset: Offset
    op: str
    value: Expr
    mask: Expr
    """Always true for an effect, which applies where its rule fires."""
    span: Span = dataclasses.field(compare=False, repr=False)

    @property
    def change(self) -> tuple[float, float]:
        """The bounds of the value that it sets or adds."""
        kind = self.value.kind
        return (-kind.hi, -kind.lo) if self.op == "-=" else (kind.lo, kind.hi)


@dataclass(frozen=True)
class Transform:
    """Cells of the mask become the target element."""

    mask: Expr
    target: Expr
    effects: tuple[Assign, ...]
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True)
class Swap:
    """Cells of the mask exchange contents with the neighbor `offset` away."""

    mask: Expr
    offset: Offset
    effects: tuple[Assign, ...]
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True)
class Move:
    """Cells of the mask move their contents to the neighbor `offset` away and leave a fresh element behind.

    `leaving` is None for cells that leave behind the neighbor's contents: they trade places, also in rows.
    """

    mask: Expr
    offset: Offset
    leaving: Expr | None
    effects: tuple[Assign, ...]
    span: Span = field(compare=False, repr=False)


Rule = Transform | Swap | Move | Assign


def writes_of(rule: Rule) -> tuple[Assign, ...]:
    """The assignments of a rule: the rule itself, or its effects."""
    return (rule,) if isinstance(rule, Assign) else rule.effects


def alike(first: Rule, second: Rule) -> bool:
    """True if two transforms have the same result."""
    if not isinstance(first, Transform) or not isinstance(second, Transform):
        return False
    return first.target == second.target and first.effects == second.effects


def footprint(rule: Rule) -> tuple[Offset, ...]:
    """The cells that a rule claims, seen from the cell where its condition holds."""
    return (HERE, rule.offset) if isinstance(rule, (Swap, Move)) else (HERE,)


@dataclass(frozen=True)
class Let:
    """A value that is computed once, at its place in the pass."""

    name: str
    value: Expr
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True)
class Substep:
    """One simultaneous sub-step: first `lets` in order, then all `rules`, which read the world before.

    Writes land in this order: assignments, then transforms, swaps and moves, then effects.
    `policy` says what happens to rules that claim one cell: ``prove`` (shown to be impossible), ``drop_both``,
    ``first_wins``, ``overwrite`` (nothing is dropped: later rules overwrite what earlier ones wrote).
    """

    lets: tuple[Let, ...]
    rules: tuple[Rule, ...]
    policy: str
    label: str
    """The loop variables of this copy, for messages: ``side = left``."""

    @cached_property
    def values(self) -> dict[str, Expr]:
        return {let.name: let.value for let in self.lets}


@dataclass(frozen=True)
class Pass:
    """A named, ordered part of a step. `scratch` fields start at their default when the pass starts."""

    name: str
    pack: str
    scratch: tuple[Field, ...]
    substeps: tuple[Substep, ...]
    span: Span = field(compare=False, repr=False)


def substeps(passes: Iterable[Pass]) -> Iterator[tuple[Pass, Substep]]:
    """Every substep with its pass, in execution order."""
    for pass_ in passes:
        for substep in pass_.substeps:
            yield pass_, substep


Cell = tuple[tuple[float, float], ...] | None
"""The drawn value of a cell: lowest and highest value of each component (the same but in ranges that are
expected); () is what a fresh cell of its element has, None is anything."""


@dataclass(frozen=True)
class FieldGrid:
    """A field, or a property that rules assign, drawn cell by cell in rows from the top.

    `everywhere`: one value was given for all cells, and applies to those whose element can have it.
    """

    name: str
    cells: tuple[tuple[Cell, ...], ...]
    everywhere: bool
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True)
class Often:
    """A test's claim: of the cells where `before` held at the start, a fraction `chance` meets `after` in the end."""

    before: Expr
    after: Expr
    chance: Fraction
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True)
class Example:
    """A test of a pack: a world drawn in ASCII, and the expected world some steps later."""

    name: str
    given: tuple[str, ...]
    legend: tuple[tuple[str, str], ...]
    steps: int
    expect: tuple[str, ...] | None
    always: tuple[Expr, ...]
    pack: str
    span: Span = field(compare=False, repr=False)
    seed: int | None = None
    fields: tuple[FieldGrid, ...] = ()
    """Values of fields in the start world."""
    expect_fields: tuple[FieldGrid, ...] = ()
    often: tuple[Often, ...] = ()
    params: tuple[tuple[str, float], ...] = ()
    """Values of parameters; all others have those of the rules."""
    scope: tuple[str, ...] = field(default=(), compare=False)
    """The packs in its scope. With other packs added, its result may differ."""


@dataclass(frozen=True)
class Unchanging:
    """Cells with one of these elements keep it forever."""

    ids: frozenset[int]


@dataclass(frozen=True)
class Total:
    """The sum of an integer over all cells is ``constant``, ``never rises`` or ``never falls`` from step to step.

    For a count, `ids` are the counted elements, and `value` is an int, 1 or 0.
    """

    value: Expr
    trend: str
    ids: frozenset[int] | None


@dataclass(frozen=True)
class Never:
    """If the condition holds in no cell at the start, it never holds in a cell after `steps` consecutive steps."""

    condition: Expr
    steps: int


@dataclass(frozen=True)
class Local:
    """A cell after a step depends only on cells at most `radius` rows and columns away."""

    radius: int


@dataclass(frozen=True)
class Symmetric:
    """Stepping commutes with turning the world. `turn` is ``mirrored`` or ``rotated``."""

    turn: str


@dataclass(frozen=True)
class Bounded:
    """Once a field's numbers lie in lo..hi everywhere, they stay there. Both parts of a vector are numbers."""

    field: str
    lo: int
    hi: int


Claim = Unchanging | Total | Never | Local | Symmetric | Bounded


@dataclass(frozen=True)
class Invariant:
    """A claim of a pack about every world that starts without the elements `without`, in cells and fields.

    `pack` is the ruleset's name if a ruleset makes the claim.
    """

    claim: Claim
    without: frozenset[int]
    pack: str
    span: Span = field(compare=False, repr=False)
    scope: tuple[str, ...] = field(default=(), compare=False)
    """The packs in its scope. With other packs added, it may no longer hold."""


@dataclass(frozen=True)
class Declared:
    """The files that a ruleset was checked from."""

    packs: tuple[PackDecl, ...]
    ruleset: RulesetDecl | None


@dataclass(frozen=True)
class MatrixChannel:
    """A channel of `World.matrix()`: whether a cell has the element `id`, or a field or property, or a component of it.

    Without an id and a source (its pack is not loaded), or for an id without an element, it is always 0.
    """

    name: str
    source: str = ""
    id: int | None = None
    part: str = ""


@dataclass(frozen=True)
class Ruleset:
    """A checked ruleset. `slots` is the number of ids, some of which may be vacant.

    `name` names what is loaded: a ruleset, and the packs left out of it and added to it.
    """

    name: str = field(metadata=UNMEANING)
    about: str = field(metadata=UNMEANING)
    packs: tuple[str, ...] = field(metadata=UNMEANING)
    elements: tuple[Element, ...]
    slots: int
    properties: tuple[Property, ...]
    fields: tuple[Field, ...]
    streams: tuple[Stream, ...]
    params: tuple[Param, ...]
    passes: tuple[Pass, ...]
    matrix: tuple[MatrixChannel, ...]
    order: tuple[str, ...] = ()
    """The names of all that a cell stores besides its element, in the order of `model/composition/compose.py`."""
    tests: tuple[Example, ...] = field(default=(), metadata=UNMEANING)
    invariants: tuple[Invariant, ...] = field(default=(), metadata=UNMEANING)
    side_multiple: int = field(default=1, metadata=UNMEANING)
    """The rows and columns of all worlds are multiples of this number."""
    declared: Declared = field(default=Declared((), None), compare=False, repr=False)
    """The files that it was checked from."""

    def added_to(self, scope: tuple[str, ...]) -> tuple[str, ...]:
        """The loaded packs outside a scope, in load order."""
        return tuple(pack for pack in self.packs if pack not in scope)

    def element(self, name: str) -> Element | None:
        """The element of a plain or qualified name."""
        return next((e for e in self.elements if name in (e.name, e.qualified)), None)

    @cached_property
    def text_key(self) -> str:
        """A text that differs if two rulesets differ in anything, including locations in files."""
        return fingerprint(replace(self, declared=Ruleset.declared), whole=True)

    @property
    def palette(self) -> tuple[str | None, ...]:
        """The qualified name of the element of each id, `slots` of them, or None."""
        names = {element.id: element.qualified for element in self.elements}
        return tuple(names.get(number) for number in range(self.slots))

    def property(self, name: str) -> Property | None:
        return next((p for p in self.properties if p.name == name), None)

    def with_params(self, values: dict[str, Value]) -> Ruleset:
        """The ruleset with other defaults of parameters, which `definitions.set_params` has checked."""
        params = tuple(replace(p, default=values.get(p.name, p.default)) for p in self.params)
        return replace(self, params=params)
