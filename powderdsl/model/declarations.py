"""What a rule file declares, shapes and literals checked, names not yet: the value between reading and composing."""

from __future__ import annotations

from dataclasses import dataclass, field

from powderdsl.diagnostics import Source
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Scalar


@dataclass(frozen=True)
class TypedDecl:
    """A property, field or parameter as written: its kind and default are still syntax."""

    name: Scalar
    type: Syntax | None
    default: Syntax | None
    at: str = "place"
    of: Syntax | None = None
    resets: bool = False
    values: tuple[tuple[Scalar, Syntax], ...] = ()
    about: str = ""


@dataclass(frozen=True)
class ElementDecl:
    name: Scalar
    id: int | None
    id_scalar: Scalar | None
    color: str
    glyph: str
    about: str
    tags: tuple[Scalar, ...]
    values: tuple[tuple[Scalar, Syntax], ...]
    override: bool


@dataclass(frozen=True)
class AlsoDecl:
    element: Scalar
    tags: tuple[Scalar, ...]
    values: tuple[tuple[Scalar, Syntax], ...]


@dataclass(frozen=True)
class KernelDecl:
    name: Scalar
    rows: tuple[tuple[int, ...], ...]
    wrap: bool


@dataclass(frozen=True)
class StreamDecl:
    name: Scalar
    bits: int


@dataclass(frozen=True)
class Block:
    """A block of a pass: lets, then one action (a moment of rules, or further blocks, maybe in a loop), then the rest."""

    lets: tuple[tuple[Scalar, Syntax], ...]
    header: Syntax | None
    rules: tuple[Syntax, ...]
    blocks: tuple[Block, ...]
    symmetry: str | None
    policy: str | None
    then: tuple[Block, ...]


@dataclass(frozen=True)
class PassDecl:
    name: Scalar
    about: str
    after: tuple[Scalar, ...]
    before: tuple[Scalar, ...]
    scratch: tuple[TypedDecl, ...]
    block: Block


@dataclass(frozen=True)
class TestDecl:
    name: str
    scalar: Scalar
    given: Scalar | None
    legend: tuple[tuple[Scalar, Scalar], ...]
    steps: int
    expect: Scalar | None
    always: tuple[Syntax, ...]
    seed: int | None
    fields: tuple[tuple[Scalar, Scalar], ...] = ()
    expect_fields: tuple[tuple[Scalar, Scalar], ...] = ()
    often: tuple[tuple[Syntax, Syntax], ...] = ()
    """What becomes of cells, as `before -> after`, and how likely."""


@dataclass(frozen=True)
class PackDecl:
    """One pack file."""

    name: Scalar
    source: Source
    about: str
    needs: tuple[Scalar, ...]
    conflicts: tuple[Scalar, ...]
    tags: tuple[tuple[Scalar, str], ...]
    properties: tuple[TypedDecl, ...]
    fields: tuple[TypedDecl, ...]
    streams: tuple[StreamDecl, ...]
    params: tuple[TypedDecl, ...]
    kernels: tuple[KernelDecl, ...]
    sets: tuple[tuple[Scalar, Syntax], ...]
    elements: tuple[ElementDecl, ...]
    also: tuple[AlsoDecl, ...]
    passes: tuple[PassDecl, ...]
    tests: tuple[TestDecl, ...]
    invariants: tuple[Syntax, ...] = ()


@dataclass(frozen=True)
class RulesetDecl:
    """One ruleset file: a list of packs with a name."""

    name: Scalar
    source: Source
    about: str
    packs: tuple[Scalar, ...]
    slots: int | None
    matrix: tuple[Scalar, ...]
    params: tuple[tuple[Scalar, Syntax], ...] = field(default=())
    invariants: tuple[Syntax, ...] = ()
    rename: tuple[tuple[Scalar, Scalar], ...] = ()
    """Qualified names, and the names by which these definitions are known here."""
    left_out: tuple[PackDecl, ...] = ()
    """Packs of its own that are not loaded: the ids of their elements stay reserved."""
