"""Declarations of rule files, with shapes and literals checked but names not yet resolved.

The fields of these records are the keys of rule files, from which messages and the docs list them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, field, replace
from typing import Any

from powderdsl.diagnostics import Label, Reporter, Source, Span
from powderdsl.model.builtins import MAX_RADIUS, MAX_SIDE_MULTIPLE
from powderdsl.model.schema import E, Entry, Form, R, Reader, Record, first_line, keyed, keys_of, read_tree
from powderdsl.syntax.parse import Syntax
from powderdsl.syntax.yaml_tree import Mapping as YamlMapping
from powderdsl.syntax.yaml_tree import Node, Scalar, Sequence

Pair = tuple[Scalar, Syntax]
"""A name and its value."""

Words = tuple[Scalar, ...]

COLOR = Form(
    "#[0-9A-Fa-f]{6}",
    "a color",
    'expected "#RRGGBB"',
    'six hexadecimal digits in quotes: {}: "#RRGGBB"',
    str.upper,
)
GLYPH = Form("[!->@-~]", "a glyph", "expected one printable ASCII character, not `?`", 'quote it: glyph: "#"')
STEPS = Form(
    "[0-9]{1,5} steps?",
    "a number of steps",
    "expected `50 steps`",
    "write `50 steps`",
    lambda text: int(text.split()[0]),
)


class Definition(Entry):
    """A definition in a file, or an addition to a definition of another file."""

    pack: str = ""
    """The pack or ruleset of the file."""
    values: tuple[Pair, ...] = ()
    """Values of single elements: for an element, by property or field; for a property or field, by element."""

    @property
    def qualified(self) -> str:
        """The name, which does not depend on the other loaded packs."""
        return f"{self.pack}.{self.name.text}"

    @property
    def span(self) -> Span:
        return self.name.span


class TagDecl(Definition, noun="a tag"):
    about: str = keyed("what its elements have in common", "", short=True)


class PropertyDecl(Definition, noun="a property", others="an element"):
    type: Syntax | None = keyed("its kind", required=True, short=True)
    default: Syntax | None = keyed("its value for all other elements")
    about: str = keyed("a one-sentence description", "")


class TintDecl(Entry, noun="a tint"):
    """The tint that a field gives cells in pictures, as written."""

    color: str = keyed("the color that cells are tinted toward", MISSING, name="to", form=COLOR)
    full: int = keyed("the length of the vector at full tint", MISSING, bounds=(1, 1000))
    most: Syntax | None = keyed("the maximum share of the color; `100%` by default")


class FieldDecl(Definition, noun="a field", others="an element"):
    type: Syntax | None = keyed("its kind", required=True)
    at: str = keyed(
        "`element`: moves with the element; `place`: stays in the cell",
        "place",
        required=True,
        choices=("element", "place"),
    )
    default: Syntax | None = keyed("its value in fresh cells")
    of: Syntax | None = keyed("the elements that have it; all by default")
    resets: str | None = keyed("`step`: reset to the default at the start of each step", choices=("step",))
    tint: TintDecl | None = keyed("how a vector field tints cells in pictures")
    about: str = keyed("a one-sentence description", "")


class ScratchDecl(Entry, noun="a scratch field"):
    type: Syntax | None = keyed("its kind", short=True)


class ParamDecl(Definition, noun="a parameter"):
    type: Syntax | None = keyed("its kind", required=True)
    default: Syntax | None = keyed("its value unless overridden", required=True, short=True)
    about: str = keyed("a one-sentence description", "")


TypedDecl = PropertyDecl | FieldDecl | ParamDecl


class RampDecl(Entry, noun="a color_by"):
    """The color of an element as a function of a field, as written. `start` is None for the element's own color."""

    field: Scalar = keyed("the field that determines the color", MISSING)
    start: str | None = keyed(
        "the color at the low end; the element's own by default", name="from", form=COLOR
    )
    end: str = keyed("the color at the high end", MISSING, name="to", form=COLOR)
    over: Syntax | None = keyed("the range `LOW..HIGH`; the field's by default")


class ElementDecl(Definition, noun="an element", others="a property or field"):
    id: Scalar | None = keyed("the preferred id; a free one by default", bounds=(0, 255), shape="number")
    color: str = keyed('its color in quotes: "#RRGGBB"', "#000000", required=True, form=COLOR)
    ramp: RampDecl | None = keyed("how its color depends on a field", name="color_by")
    glyph: str = keyed("its character in drawings; a letter of its name by default", "", form=GLYPH)
    about: str = keyed("a one-sentence description", "")
    tags: Words = keyed("its tags", ())
    override: bool = keyed("`yes` replaces an element of another pack", False)

    @property
    def number(self) -> int | None:
        """The requested id."""
        return int(self.id.text) if self.id else None


class AlsoDecl(Definition, others="a property or field"):
    """Tags, values, a color and a ramp that a pack adds to an element of another pack, or a ruleset to one of its packs'."""

    tags: Words = keyed("tags to add", (), short=True)
    color: str | None = keyed("another color", form=COLOR)
    ramp: RampDecl | None = keyed("how its color depends on a field", name="color_by")


class KernelDecl(Definition, noun="a kernel"):
    rows: tuple[tuple[int, ...], ...] = keyed(
        "rows of integer weights; odd numbers of rows and columns", (), shape="words"
    )
    shape: Syntax | None = keyed("a shape with its radius instead: `disc(3)`")
    edges: str | None = keyed(
        "what lies outside the grid; `nothing` by default",
        choices=("nothing", "wrap"),
    )


class StreamDecl(Definition, noun="a stream"):
    bits: int = keyed("the bits of a draw", 16, choices=("16", "32"))
    about: str = keyed("a one-sentence description", "")


class SetDecl(Definition, noun="a set"):
    members: Syntax = keyed("its elements", MISSING, short=True)


class Block(Record, noun="a block", prefixes=("for ", "repeat ")):
    """A block of a pass: lets, then one action (a substep of rules, or further blocks, maybe in a loop), then the rest."""

    lets: tuple[Pair, ...] = keyed(
        "named values, computed in order before the block's action", (), name="let"
    )
    header: Syntax | None = None
    rules: tuple[Syntax, ...] = keyed(
        "a rule, a list of rules (one substep), or a list of blocks", (), name="do", shape="block"
    )
    blocks: tuple[Block, ...] = ()
    then: tuple[Block, ...] = keyed("what happens afterwards; the same forms as `do`", (), shape="block")
    symmetry: str | None = keyed(
        "the orientations in which the rules apply",
        choices=("mirror", "rotations", "all"),
    )
    conflicts: str | None = keyed(
        "which rules win when several claim the same cell",
        choices=("drop_both", "first_wins", "overwrite"),
    )

    def walk(self) -> Iterator[Block]:
        """This block and all nested blocks, in order."""
        yield self
        for block in (*self.blocks, *self.then):
            yield from block.walk()

    @property
    def lines(self) -> tuple[Syntax, ...]:
        """The lines of this block: its values, its loop and its rules."""
        return (*(value for _, value in self.lets), *([self.header] if self.header else []), *self.rules)


class PassDecl(Block, Definition, noun="a pass"):
    about: str = keyed("a one-sentence description", "")
    after: Words = keyed("passes that run before this one", ())
    before: Words = keyed("passes that run after this one", ())
    override: bool = keyed("`yes` replaces a pass of another pack", False)
    scratch: tuple[ScratchDecl, ...] = keyed("fields that exist only during this pass: names and kinds", ())


class TestDecl(Entry, noun="a test"):
    given: Scalar | None = keyed("the start world, an ASCII drawing", shape="text")
    legend: tuple[tuple[Scalar, Scalar], ...] = keyed(
        "characters and their elements, where glyphs do not suffice", (), maps="characters to elements"
    )
    fields: tuple[tuple[Scalar, Scalar], ...] = keyed(
        "field values in the start world; `.` is the default",
        (),
        maps="fields to drawings",
    )
    params: tuple[Pair, ...] = keyed("parameter values for this test", (), maps="parameters to values")
    steps: int = keyed("the number of steps: `50 steps`", 1, name="after", shape="text", form=STEPS)
    expect: Scalar | None = keyed("the world at the end; `?` matches anything", shape="text")
    expect_fields: tuple[tuple[Scalar, Scalar], ...] = keyed(
        "field values at the end; `?` matches anything, `LOW..HIGH` a range", (), maps="fields to drawings"
    )
    always: tuple[Syntax, ...] = keyed("conditions that hold in every cell after every step", ())
    often: tuple[tuple[Syntax, Syntax], ...] = keyed(
        "changes of cells and their chances: `egg -> hen: 2%`", (), shape="any"
    )
    """Changes of cells, as `before -> after`, and their chances."""
    seed: int | None = keyed("the seed; five seeds by default", bounds=(0, 2**31 - 1))


SHARED = ("elements", "tags", "properties", "fields", "streams", "kernels", "sets")
"""The sections of a pack whose names share a namespace, in the order in which they take names."""


class PackDecl(Record, noun="a pack"):
    """One pack file."""

    name: Scalar = keyed("the pack's name", MISSING, name="pack")
    source: Source
    about: str = keyed("a description; most entries can have one", "")
    needs: Words = keyed("packs to load with this one", ())
    provides: Words = keyed("packs whose place it can take when other packs need them", ())
    conflicts: Words = keyed("packs that must not be loaded with this one", ())
    tags: tuple[TagDecl, ...] = keyed("tags and their descriptions", ())
    properties: tuple[PropertyDecl, ...] = keyed("numbers that every element has", ())
    fields: tuple[FieldDecl, ...] = keyed("state of cells", ())
    streams: tuple[StreamDecl, ...] = keyed("shared sources of random numbers", (), shape="any")
    params: tuple[ParamDecl, ...] = keyed("numbers that users can override", ())
    side_multiple: int = keyed("a divisor of the sides of all worlds", 1, bounds=(1, MAX_SIDE_MULTIPLE))
    kernels: tuple[KernelDecl, ...] = keyed("neighborhoods for `count` and `sum`", ())
    sets: tuple[SetDecl, ...] = keyed("names for sets of elements", ())
    elements: tuple[ElementDecl, ...] = keyed("the pack's elements", ())
    also: tuple[AlsoDecl, ...] = keyed("tags, values and colors for elements of other packs", ())
    passes: tuple[PassDecl, ...] = keyed("what happens in a step", ())
    invariants: tuple[Syntax, ...] = keyed("statements that hold in every world", (), shape="invariants")
    tests: tuple[TestDecl, ...] = keyed("small worlds and expected results", (), shape="list")

    @property
    def entries(self) -> tuple[ElementDecl | AlsoDecl, ...]:
        """The pack's entries for single elements."""
        return (*self.elements, *self.also)

    @property
    def lines(self) -> Iterator[Syntax]:
        return (line for pass_ in self.passes for block in pass_.walk() for line in block.lines)


class RulesetDecl(Record, noun="a ruleset"):
    """One ruleset file. `packs`, `slots`, `matrix`, `params` and `rename` are as written, without inherited values.

    `base` is the ruleset that it extends; `beside` are unrelated rulesets named before it.
    """

    name: Scalar = keyed("the ruleset's name", MISSING, name="ruleset")
    source: Source
    about: str = keyed("a one-sentence description", "")
    extends: Scalar | None = keyed("a ruleset to inherit from")
    packs: Words = keyed("its packs, in addition to inherited ones", ())
    without: Words = keyed("inherited packs to leave out", ())
    slots: int | None = keyed("the number of element ids, including unused ones", bounds=(1, 256))
    matrix: Words = keyed("the channels of `World.matrix()`", ())
    rename: tuple[tuple[Scalar, Scalar], ...] = keyed(
        "other names for definitions: `pack.word: name`", (), maps="qualified names to names"
    )
    """Qualified names, and the new names of these definitions."""
    params: tuple[Pair, ...] = keyed("values of parameters", (), maps="parameters to values")
    also: tuple[AlsoDecl, ...] = keyed("tags, values and colors for elements of its packs", ())
    invariants: tuple[Syntax, ...] = keyed("statements that hold in every world", (), shape="invariants")
    left_out: Mapping[str, PackDecl] = field(default_factory=dict)
    """Its packs that are not loaded; the ids of their elements stay reserved."""
    base: RulesetDecl | None = None
    beside: tuple[RulesetDecl, ...] = ()

    @property
    def members(self) -> dict[str, RulesetDecl]:
        """The ruleset's packs, first those kept from its base, each with the ruleset that lists it."""
        members = self.base.members if self.base else {}
        for scalar in self.without:
            members.pop(scalar.text, None)
        for scalar in self.packs:
            members.setdefault(scalar.text, self)
        return members

    @property
    def lineage(self) -> tuple[RulesetDecl, ...]:
        """This ruleset, those that it extends and those beside it, each once, bases first."""
        lineage: dict[str, RulesetDecl] = {}
        for start in filter(None, (*self.beside, self.base)):
            for ruleset in start.lineage:
                lineage[ruleset.source.name] = ruleset
        lineage.pop(self.source.name, None)
        return (*lineage.values(), self)

    @property
    def layout_ruleset(self) -> RulesetDecl:
        """The ruleset whose packs come first in ids and channels: the last one with `slots` or `matrix`."""
        return self if self.slots or self.matrix or self.base is None else self.base.layout_ruleset

    @property
    def leading_packs(self) -> list[str]:
        """The packs of `layout_ruleset`, except those replaced by others of the same name."""
        members, leading = self.members, self.layout_ruleset.members
        return [name for name, ruleset in leading.items() if members.get(name, ruleset) is ruleset]

    @property
    def renames(self) -> dict[str, tuple[Scalar, Scalar]]:
        """The ruleset's own renames and the inherited ones, by qualified name."""
        renames = {}
        for ruleset in self.lineage:
            for old, new in ruleset.rename:
                renames[old.text] = old, new
        return renames


# Located YAML -> declarations of one pack or ruleset file

SIDES = range(1, 2 * MAX_RADIUS + 2, 2)
"""Numbers of rows and columns of kernels: the cell's own weight is in the middle."""

WEIGHT = re.compile("-?[0-9]{1,3}")


def read_file(source: Source, reporter: Reporter) -> PackDecl | RulesetDecl | None:
    """Parse and shape-check a rule file, reporting as much as possible; None if the file is unusable."""
    tree = read_tree(source, reporter, "a pack starts with `pack: NAME`")
    if tree is None:
        return None
    reader = _PackReader(reporter)
    if not isinstance(tree, YamlMapping):
        reader.shape(tree, "a pack: a mapping that starts with `pack: NAME`")
        return None
    if tree.get("ruleset") is not None:
        return reader.ruleset(tree)
    if tree.entries and not any(
        key.text in keys_of(PackDecl) for key, _ in tree.entries if key.text != "about"
    ):
        key = tree.entries[0][0]
        drawn = key.text in ("scene", "scenes")
        reporter.error(
            "PD109", "a file without `pack` or `ruleset`", key.span, "this is a drawn world" if drawn else "not a rule file",
            helps=["use it as a world, not as rules" if drawn else "a pack starts with `pack: NAME`"],
        )  # fmt: skip
        return None
    return reader.file(PackDecl, tree)


class _PackReader(Reader):
    """Reads the records of rule files. Its methods check what the declarations of keys cannot express."""

    owner = ""
    """The pack or ruleset whose file this is."""

    def file(self, kind: type[R], tree: YamlMapping) -> R | None:
        name = tree.get(kind.NOUN.removeprefix("a "))
        self.owner = name.text if isinstance(name, Scalar) else ""
        record = self.record(kind, tree, kind.NOUN, source=tree.span.source)
        return record if record is not None and self.name(record.name, kind.NOUN) else None  # type: ignore[attr-defined]  # files have names

    def ruleset(self, tree: YamlMapping) -> RulesetDecl | None:
        """Read a ruleset, and report missing parts; None if its name is unreadable."""
        ruleset = self.file(RulesetDecl, tree)
        if tree.get("extends") is not None:
            return ruleset
        if tree.get("packs") is None:
            start, keys = tree.span.start, keys_of(RulesetDecl)
            self.reporter.error(
                "PD109", "a ruleset lacks `packs`", Span(tree.span.source, start, start + 1), "`packs` is missing",
                helps=[f"`packs`: {keys['packs'].about}", f"`extends`: {keys['extends'].about}"],
            )  # fmt: skip
        if ruleset is not None and ruleset.without:
            first = ruleset.without[0]
            self.reporter.error(
                "PD304", f"`{first.text}` is left out, but nothing includes it", first.span, "this ruleset does not extend another",
                helps=["remove `without`, or add `extends`"],
            )  # fmt: skip
        return ruleset

    def build(self, kind: type[R], **values: Any) -> R | None:
        if kind is RulesetDecl:
            values["rename"] = tuple(
                pair for pair in values.get("rename", ()) if self.name(pair[1], "a name")
            )
        elif kind is PackDecl:
            values["streams"] = tuple(self.streams(values.get("streams")))
            values["tests"] = tuple(self.tests(values.get("tests")))
        elif kind is TestDecl:
            values["often"] = tuple(self.often(values.get("often")))
        return super().build(kind, **values)

    def entry(self, kind: type[E], name: Scalar, node: Node) -> E | None:
        record: Any
        if kind is KernelDecl:
            record = self.kernel(name, node)
        elif kind is PassDecl:
            record = self.block(PassDecl, node, f"the pass `{name.text}`", name=name)
        else:
            record = super().entry(kind, name, node)
        if isinstance(record, Definition):
            record = replace(record, pack=self.owner)
        return record

    # Definitions

    def streams(self, node: Node | None) -> Iterator[StreamDecl]:
        if node is None or isinstance(node, YamlMapping):
            yield from self.entries(StreamDecl, node)
            return
        for word in self.words(node):
            if self.name(word, StreamDecl.NOUN):
                yield StreamDecl(name=word, pack=self.owner)

    def kernel(self, key: Scalar, node: Node) -> KernelDecl | None:
        """Rows of weights, a shape with its radius, or a mapping with one of them and `edges`."""
        if not isinstance(node, YamlMapping):
            is_shape = isinstance(node, Scalar) and not node.text[:1].isdigit()
            node = YamlMapping(((replace(key, text="shape" if is_shape else "rows"), node),), node.span)
        entries = self.mapping(KernelDecl, node, f"the kernel `{key.text}`")
        if len({"shape", "rows"} & entries.keys()) != 1:
            both = "rows" in entries
            self.reporter.error(
                "PD109", f"the kernel `{key.text}` has {'rows and a shape' if both else 'no rows'}",
                entries["shape"][0].span if both else key.span, "one of them" if both else "`rows` is missing",
                helps=["`rows`: rows of integer weights; or `shape`: a shape and its radius, such as `disc(3)`"],
            )  # fmt: skip
            return None
        values = self.values(KernelDecl, entries)
        if "rows" in entries:
            values["rows"] = self.kernel_rows(key, entries["rows"][1], values["rows"])
        return KernelDecl(name=key, **values) if values.get("rows") or "shape" in values else None

    def kernel_rows(self, key: Scalar, node: Node, words: tuple[Scalar, ...]) -> tuple[tuple[int, ...], ...]:
        """Rows of weights with a cell in the middle; none after a report."""
        rows = [word.text.split() for word in words]
        wrong = [
            word.span
            for word, row in zip(words, rows, strict=True)
            if len(row) not in SIDES or len(row) != len(rows[0]) or not all(map(WEIGHT.fullmatch, row))
        ]
        if not words:
            self.shape(node, "rows of weights", 'write ["1 1 1", "1 0 1", "1 1 1"]')
        elif wrong or len(rows) not in SIDES:
            self.reporter.error(
                "PD110", f"the kernel `{key.text}` is not made of rows of weights", [*wrong, key.span][0],
                f"{len(rows)} rows, the first of {len(rows[0])} weights",
                helps=[f"write rows of equal length, an odd number of rows and of integers in each, at most {SIDES[-1]}"],
            )  # fmt: skip
        else:
            return tuple(tuple(map(int, row)) for row in rows)
        return ()

    # Passes

    def block(self, kind: type[Block], node: Node, what: str, **known: Any) -> Block:
        entries = self.mapping(kind, node, what)
        values = known | self.values(kind, entries)
        actions = [entry for key, entry in entries.items() if key.startswith(("do", *Block.PREFIXES))]
        if len(actions) > 1:
            self.reporter.error(
                "PD107", "a block with two actions", actions[1][0].span, "the second one",
                secondary=[Label(actions[0][0].span, "the first one")],
                helps=["put the next action under `then:`"],
            )  # fmt: skip
        if actions:
            key, body = actions[0]
            values["header"] = self.line(key, "header") if key.text != "do" else None
            values["rules"], values["blocks"] = self.body(body)
        elif "then" not in entries and isinstance(node, YamlMapping) and len(entries) == len(node.entries):
            self.reporter.error(
                "PD109", "a block that does nothing", first_line(node), "it lacks `do:`, `for …:` or `repeat …:`",
                helps=["put the rules under `do:`"],
            )  # fmt: skip
        if "then" in entries:
            rules, values["then"] = self.body(entries["then"][1])
            if rules:
                values["then"] = (Block(rules=rules),)
        return kind(**values)

    def body(self, node: Node) -> tuple[tuple[Syntax, ...], tuple[Block, ...]]:
        """A rule or a list of rules (one substep), or a block or a list of blocks (one after the other)."""
        items = node.items
        if not items or (isinstance(node, Scalar) and not node.text):
            helps = ["write rules, or omit the key"]
            self.reporter.error("PD109", "no rules here", node.span, "nothing here", helps=helps)
            return (), ()
        is_block = isinstance(items[0], YamlMapping)
        other = next((item for item in items if isinstance(item, YamlMapping) != is_block), None)
        if other is not None:
            self.reporter.error(
                "PD204", "rules and blocks in one list", first_line(other), "not like the first item",
                notes=["a list of rules is one substep; blocks of a list run one after another"],
                helps=["put each group of rules under its own `- do:`; quote a rule that contains `: `"],
            )  # fmt: skip
            return (), ()
        if is_block:
            return (), tuple(self.block(Block, item, Block.NOUN) for item in items)
        return self.lines(node, "rule"), ()

    # Tests

    def tests(self, node: Node | None) -> Iterator[TestDecl]:
        if isinstance(node, Sequence):
            for item in node.items:
                if isinstance(item, YamlMapping) and len(item.entries) == 1:
                    test = self.entry(TestDecl, *item.entries[0])
                    assert test is not None
                    yield test
                else:
                    self.shape(item, "a test: `- what it shows:` with its keys indented below")
        elif node is not None:
            self.shape(node, "a list")

    def often(self, node: Node | None) -> Iterator[tuple[Syntax, Syntax]]:
        """`before -> after: CHANCE`, in one mapping or a list of them."""
        for part in node.items if node else ():
            for key, value in self.pairs(part, "a mapping from changes to chances", "write `egg -> hen: 2%`"):
                change, chance = self.line(key, "rule"), self.line(value)
                if change is None or chance is None:
                    continue
                if change.kind == "transform" and len(change.children) == 2:
                    yield change, chance
                    continue
                self.reporter.error(
                    "PD110", "`often` lists changes of cells", key.span, "not of the form `A -> B`",
                    helps=["write the state of a cell before and after: `egg -> hen: 2%`"],
                )  # fmt: skip
