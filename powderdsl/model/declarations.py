"""Declarations of rule files: shapes and literals are checked, names are not resolved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

from powderdsl.diagnostics import Source
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Scalar

Pair = tuple[Scalar, Syntax]
"""A name and its value."""


@dataclass(frozen=True)
class TypedDecl:
    """A property, field or parameter as written: its kind and default are still syntax."""

    name: Scalar
    type: Syntax | None = None
    default: Syntax | None = None
    at: str = "place"
    of: Syntax | None = None
    resets: str | None = None
    values: tuple[Pair, ...] = ()
    """The values of single elements."""
    about: str = ""
    tint: TintDecl | None = None


@dataclass(frozen=True)
class TintDecl:
    """How a field tints cells in pictures, as written."""

    key: Scalar
    color: str
    full: int
    most: Syntax | None


@dataclass(frozen=True)
class RampDecl:
    """How an element's color follows a field, as written. `start` is None for the element's own color."""

    key: Scalar
    field: Scalar
    start: str | None
    end: str
    over: Syntax | None


@dataclass(frozen=True)
class ElementDecl:
    name: Scalar
    id: int | None = None
    id_scalar: Scalar | None = None
    color: str = "#000000"
    glyph: str = ""
    about: str = ""
    tags: tuple[Scalar, ...] = ()
    values: tuple[Pair, ...] = ()
    override: bool = False
    ramp: RampDecl | None = None


@dataclass(frozen=True)
class AlsoDecl:
    """Tags, values, a color and a ramp that a pack adds to an element of another pack, or a ruleset to one of its packs'."""

    name: Scalar
    tags: tuple[Scalar, ...] = ()
    values: tuple[Pair, ...] = ()
    ramp: RampDecl | None = None
    color: str | None = None


@dataclass(frozen=True)
class KernelDecl:
    name: Scalar
    rows: tuple[tuple[int, ...], ...]
    wrap: bool
    shape: Syntax | None = None
    """`box(5)`, instead of rows."""


@dataclass(frozen=True)
class StreamDecl:
    name: Scalar
    bits: int = 16


@dataclass(frozen=True)
class TagDecl:
    name: Scalar
    about: str


@dataclass(frozen=True)
class SetDecl:
    name: Scalar
    members: Syntax


@dataclass(frozen=True)
class Block:
    """A block of a pass: lets, then one action (a substep of rules, or further blocks, maybe in a loop), then the rest."""

    lets: tuple[Pair, ...] = ()
    header: Syntax | None = None
    rules: tuple[Syntax, ...] = ()
    blocks: tuple[Block, ...] = ()
    symmetry: str | None = None
    conflicts: str | None = None
    then: tuple[Block, ...] = ()

    def walk(self) -> Iterator[Block]:
        """This block and all blocks in it, as they are written."""
        yield self
        for block in (*self.blocks, *self.then):
            yield from block.walk()

    @property
    def lines(self) -> tuple[Syntax, ...]:
        """The lines of this block alone: its values, its loop, its rules."""
        return (*(value for _, value in self.lets), *([self.header] if self.header else []), *self.rules)


@dataclass(frozen=True)
class PassDecl:
    name: Scalar
    block: Block
    about: str = ""
    after: tuple[Scalar, ...] = ()
    before: tuple[Scalar, ...] = ()
    scratch: tuple[TypedDecl, ...] = ()
    override: bool = False


@dataclass(frozen=True)
class TestDecl:
    name: Scalar
    given: Scalar | None
    legend: tuple[tuple[Scalar, Scalar], ...]
    steps: int
    expect: Scalar | None
    always: tuple[Syntax, ...]
    seed: int | None
    fields: tuple[tuple[Scalar, Scalar], ...]
    expect_fields: tuple[tuple[Scalar, Scalar], ...]
    often: tuple[tuple[Syntax, Syntax], ...]
    """Changes of cells, as `before -> after`, and their chances."""


Definition = TagDecl | TypedDecl | StreamDecl | KernelDecl | SetDecl | ElementDecl | PassDecl


@dataclass(frozen=True)
class PackDecl:
    """One pack file."""

    name: Scalar
    source: Source
    about: str = ""
    needs: tuple[Scalar, ...] = ()
    provides: tuple[Scalar, ...] = ()
    conflicts: tuple[Scalar, ...] = ()
    tags: tuple[TagDecl, ...] = ()
    properties: tuple[TypedDecl, ...] = ()
    fields: tuple[TypedDecl, ...] = ()
    streams: tuple[StreamDecl, ...] = ()
    params: tuple[TypedDecl, ...] = ()
    kernels: tuple[KernelDecl, ...] = ()
    sets: tuple[SetDecl, ...] = ()
    elements: tuple[ElementDecl, ...] = ()
    also: tuple[AlsoDecl, ...] = ()
    passes: tuple[PassDecl, ...] = ()
    tests: tuple[TestDecl, ...] = ()
    invariants: tuple[Syntax, ...] = ()
    side_multiple: int = 1

    @property
    def definitions(self) -> tuple[Definition, ...]:
        """All its definitions in the shared namespace; passes have a namespace of their own."""
        tables: tuple[Sequence[Definition], ...]
        tables = self.tags, self.properties, self.fields, self.streams, self.kernels, self.sets, self.elements
        return tuple(chain.from_iterable(tables))

    @property
    def entries(self) -> tuple[ElementDecl | AlsoDecl, ...]:
        """Its entries for single elements."""
        return (*self.elements, *self.also)

    @property
    def lines(self) -> Iterator[Syntax]:
        """The lines of its passes."""
        return (line for one in self.passes for block in one.block.walk() for line in block.lines)


@dataclass(frozen=True)
class RulesetDecl:
    """One ruleset file. `packs`, `slots`, `matrix`, `params` and `rename` are as written, without what it inherits.

    `base` is the ruleset that it extends; `beside` are rulesets that were named before it, of which it is not a part.
    """

    name: Scalar
    source: Source
    about: str = ""
    packs: tuple[Scalar, ...] = ()
    slots: int | None = None
    matrix: tuple[Scalar, ...] = ()
    params: tuple[Pair, ...] = ()
    invariants: tuple[Syntax, ...] = ()
    also: tuple[AlsoDecl, ...] = ()
    rename: tuple[tuple[Scalar, Scalar], ...] = ()
    """Qualified names, and the names by which these definitions are known here."""
    left_out: tuple[PackDecl, ...] = ()
    """Packs of its own that are not loaded: the ids of their elements stay reserved."""
    extends: Scalar | None = None
    without: tuple[Scalar, ...] = ()
    base: RulesetDecl | None = None
    beside: tuple[RulesetDecl, ...] = ()

    @property
    def members(self) -> tuple[str, ...]:
        """Names of its packs: the packs of its base that it keeps, then its own."""
        gone = {scalar.text for scalar in self.without}
        kept = [name for name in self.base.members if name not in gone] if self.base else []
        return tuple(dict.fromkeys([*kept, *(scalar.text for scalar in self.packs)]))

    def lister(self, pack: str) -> RulesetDecl | None:
        """The ruleset in whose file one of its packs is listed: this one, or one that it extends."""
        inherited = self.base is not None and pack in self.base.members
        if inherited and pack not in {scalar.text for scalar in self.without}:
            assert self.base is not None
            return self.base.lister(pack)
        return self if pack in {scalar.text for scalar in self.packs} else None

    @property
    def lineage(self) -> tuple[RulesetDecl, ...]:
        """This ruleset, all that it extends and all beside it, each once, bases first."""
        found: dict[str, RulesetDecl] = {}
        for one in (*self.beside, self.base):
            if one is not None:
                found |= {inherited.source.name: inherited for inherited in one.lineage}
        found.pop(self.source.name, None)
        return (*found.values(), self)

    @property
    def placing(self) -> RulesetDecl:
        """The ruleset whose packs come first in ids and channels: the last that says `slots` or `matrix`."""
        return self if self.slots or self.matrix or self.base is None else self.base.placing

    @property
    def placed(self) -> tuple[str, ...]:
        """The packs of that ruleset, except packs that others of the same name replace."""
        sources = {one.source.name for one in self.placing.lineage}
        listers = {name: self.lister(name) for name in self.placing.members}
        return tuple(name for name, one in listers.items() if one is None or one.source.name in sources)

    @property
    def renames(self) -> tuple[tuple[Scalar, Scalar], ...]:
        """Its own renames after the inherited ones; the last one for a name counts."""
        return tuple(pair for one in self.lineage for pair in one.rename)
