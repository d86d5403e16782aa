"""Located YAML -> declarations of one pack or ruleset file. Checks shapes and literals, not names."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from powderdsl.diagnostics import Label, Reporter, Source, Span
from powderdsl.model.builtins import MAX_RADIUS
from powderdsl.model.declarations import (
    AlsoDecl,
    Block,
    ElementDecl,
    KernelDecl,
    PackDecl,
    PassDecl,
    RampDecl,
    RulesetDecl,
    SetDecl,
    StreamDecl,
    TagDecl,
    TestDecl,
    TintDecl,
    TypedDecl,
)
from powderdsl.model.schema import KEYS, Entries, Reader, first_line
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Mapping, Node, Scalar, Sequence, parse_yaml

MAX_WEIGHTS = 2 * MAX_RADIUS + 1
"""In a row or a column of a kernel."""


def read_file(source: Source, reporter: Reporter) -> PackDecl | RulesetDecl | None:
    """Parse and shape-check a rule file. Reports everything it can; None if the file is unusable."""
    tree = parse_yaml(source, reporter)
    if tree is None:
        if not reporter.has_errors:
            helps = ["a pack starts with `pack: NAME`"]
            reporter.error("PD107", f"{source.name} is empty", None, helps=helps)
        return None
    reader = _PackReader(reporter, source)
    if not isinstance(tree, Mapping):
        reader.shape(tree, "a pack: a mapping that starts with `pack: NAME`")
        return None
    if tree.get("ruleset") is not None:
        return reader.ruleset(tree)
    if tree.entries and not any(key.text in KEYS["pack"] for key, _ in tree.entries if key.text != "about"):
        key = tree.entries[0][0]
        drawn = key.text in ("scene", "scenes")
        reporter.error(
            "PD109", "a file without `pack` or `ruleset`", key.span, "this is a drawn world" if drawn else "not a rule file",
            helps=["name it as a world, not among the rules" if drawn else "a pack starts with `pack: NAME`"],
        )  # fmt: skip
        return None
    return reader.pack(tree)


class _PackReader(Reader):
    def __init__(self, reporter: Reporter, source: Source):
        super().__init__(reporter)
        self.source = source
        self.sections = {
            "tags": ("a tag", self.tag),
            "properties": ("a property", self.property),
            "fields": ("a field", self.field),
            "params": ("a parameter", self.param),
            "kernels": ("a kernel", self.kernel),
            "sets": ("a set", self.set),
            "elements": ("an element", self.element),
            "passes": ("a pass", self.pass_),
        }
        """For each section of a pack: a noun for its entries and their reader, which returns None after an error."""

    # Files

    def ruleset(self, tree: Mapping) -> RulesetDecl | None:
        values = self.read(tree, "ruleset", "a ruleset")
        name = values.pop("ruleset", None)
        if name is None or not self.name(name, "a ruleset"):
            return None
        if tree.get("extends") is None:
            self.needs_no_base(tree, values.get("without", ()))
        params = self.pairs(values.pop("params", None), "a mapping from parameters to values")
        values["params"] = tuple((key, line) for key, node in params if (line := self.line(node)))
        values["rename"] = tuple(self.renamed(values.pop("rename", None)))
        also = self.pairs(values.pop("also", None), "a mapping from elements to tags")
        values["also"] = tuple(self.also(key, node) for key, node in also)
        return RulesetDecl(name, self.source, **values)

    def renamed(self, node: Node | None) -> Iterator[tuple[Scalar, Scalar]]:
        for key, value in self.pairs(node, "a mapping from names: `pack.word: name`"):
            if not isinstance(value, Scalar):
                self.shape(value, "a name")
            elif self.name(value, "a name"):
                yield key, value

    def needs_no_base(self, tree: Mapping, without: tuple[Scalar, ...]) -> None:
        """Report missing and meaningless keys of a ruleset that extends none."""
        if tree.get("packs") is None:
            start = tree.span.start
            self.reporter.error(
                "PD109", "a ruleset lacks `packs`", Span(self.source, start, start + 1), "`packs` is missing",
                helps=[f"`packs`: {KEYS['ruleset']['packs'].about}", f"`extends`: {KEYS['ruleset']['extends'].about}"],
            )  # fmt: skip
        if without:
            self.reporter.error(
                "PD304", f"`{without[0].text}` is left out of nothing", without[0].span, "this ruleset extends none",
                helps=["remove `without`, or say which ruleset this one `extends`"],
            )  # fmt: skip

    def pack(self, tree: Mapping) -> PackDecl | None:
        values = self.read(tree, "pack", "a pack")
        name = values.pop("pack", None)
        if name is None or not self.name(name, "a pack"):
            return None
        for section, (noun, read) in self.sections.items():
            entries = self.named(values.pop(section, None), noun)
            values[section] = tuple(found for key, node in entries if (found := read(key, node)))
        values["streams"] = tuple(self.streams(values.pop("streams", None)))
        also = self.pairs(values.pop("also", None), "a mapping from elements to tags")
        values["also"] = tuple(self.also(key, node) for key, node in also)
        values["tests"] = tuple(self.tests(values.pop("tests", None)))
        return PackDecl(name, self.source, **values)

    # Definitions

    def tag(self, key: Scalar, node: Node) -> TagDecl:
        return TagDecl(key, node.text if isinstance(node, Scalar) else "")

    def set(self, key: Scalar, node: Node) -> SetDecl | None:
        line = self.line(node)
        return SetDecl(key, line) if line else None

    def property(self, key: Scalar, node: Node) -> TypedDecl:
        if isinstance(node, Scalar):
            return TypedDecl(key, type=self.line(node))
        return TypedDecl(key, **self.read(node, "property", f"the property `{key.text}`"))

    def field(self, key: Scalar, node: Node) -> TypedDecl:
        entries = self.mapping(node, "field", f"the field `{key.text}`")
        values = self.values(entries, "field")
        tint = values.pop("tint", None)
        return TypedDecl(
            key, **values, tint=None if tint is None else self.tint(key, entries["tint"][0], tint)
        )

    def tint(self, field: Scalar, key: Scalar, node: Node) -> TintDecl | None:
        """A tint; None if something is wrong with it."""
        found = self.read(node, "tint", f"`tint` of `{field.text}`")
        color = self.color(found, "to")
        if color is None or "full" not in found:
            return None
        return TintDecl(key, color, found["full"], found.get("most"))

    def param(self, key: Scalar, node: Node) -> TypedDecl:
        if isinstance(node, Scalar):
            return TypedDecl(key, default=self.line(node))
        return TypedDecl(key, **self.read(node, "param", f"the parameter `{key.text}`"))

    def streams(self, node: Node | None) -> Iterator[StreamDecl]:
        if not isinstance(node, Mapping):
            yield from (StreamDecl(word) for word in self.words(node) if self.name(word, "a stream"))
            return
        for key, value in self.named(node, "a stream"):
            entries = self.mapping(value, "stream", f"the stream `{key.text}`")
            bits = self.values(entries, "stream").get("bits", 16)
            if bits not in (16, 32):
                place = entries["bits"][1].span
                self.reporter.error("PD110", "`bits` must be 16 or 32", place, "neither of them")
            yield StreamDecl(key, bits)

    def kernel(self, key: Scalar, node: Node) -> KernelDecl | None:
        """Rows of weights, a shape with its radius, or a mapping with one of them and `edges`."""
        if isinstance(node, Scalar) and not node.text[:1].isdigit():
            shape = self.line(node)
            return KernelDecl(key, (), False, shape) if shape else None
        wrap = False
        if isinstance(node, Mapping):
            entries = self.mapping(node, "kernel", f"the kernel `{key.text}`")
            values = self.values(entries, "kernel")
            wrap = values.get("edges") == "wrap"
            if len({"shape", "rows"} & entries.keys()) != 1:
                both = "rows" in entries
                self.reporter.error(
                    "PD109", f"the kernel `{key.text}` has {'rows and a shape' if both else 'no rows'}",
                    entries["shape"][0].span if both else key.span, "one of them" if both else "`rows` is missing",
                    helps=["`rows`: rows of integer weights; or `shape`: a shape and its radius, such as `disc(3)`"],
                )  # fmt: skip
                return None
            if "shape" in entries:
                return KernelDecl(key, (), wrap, values["shape"]) if "shape" in values else None
            node = entries["rows"][1]
        rows = self.kernel_rows(key, node)
        return KernelDecl(key, rows, wrap) if rows else None

    def kernel_rows(self, key: Scalar, node: Node) -> tuple[tuple[int, ...], ...] | None:
        """Rows of weights with a cell in the middle; reports what they lack."""
        words = self.words(node)
        if not words:
            self.shape(node, "rows of weights", 'write ["1 1 1", "1 0 1", "1 1 1"]')
            return None
        rows = [word.text.split() for word in words]
        faults = (
            (word.span, _row_fault(row, len(rows[0]), key.text))
            for word, row in zip(words, rows, strict=True)
        )
        wrong = [(span, fault) for span, fault in faults if fault]
        if not wrong and (len(rows) > MAX_WEIGHTS or len(rows) % 2 == 0):
            fault = "has no middle" if len(rows) <= MAX_WEIGHTS else "is too high"
            label = f"{len(rows)} rows" + (" are an even number" if len(rows) % 2 == 0 else "")
            fix = f"write an odd number of rows, at most {MAX_WEIGHTS}, the cell's own in the middle"
            wrong = [(key.span, (f"kernel `{key.text}` {fault}", label, fix))]
        for span, (message, label, fix) in wrong[:1]:
            self.reporter.error("PD110", message, span, label, helps=[fix])
        return None if wrong else tuple(tuple(int(weight) for weight in row) for row in rows)

    def element(self, key: Scalar, node: Node) -> ElementDecl:
        entries = self.mapping(node, "element", f"the element `{key.text}`")
        values = self.values(entries, "element")
        glyph = values.get("glyph")
        if glyph is not None and not (re.fullmatch(r"[!-~]", glyph.text) and glyph.text != "?"):
            self.reporter.error(
                "PD110", f"`{glyph.text}` is not a glyph", glyph.span, "expected one printable ASCII character, not `?`",
                helps=['quote it: glyph: "#"'],
            )  # fmt: skip
            glyph = None
        values["color"] = self.color(values, "color") or ElementDecl.color
        values["glyph"] = glyph.text if glyph else ""
        return ElementDecl(key, id_scalar=self.scalar(entries, "id"), **self.with_ramp(key, entries, values))

    def also(self, key: Scalar, node: Node) -> AlsoDecl:
        if not isinstance(node, Mapping):
            return AlsoDecl(key, self.words(node))
        entries = self.mapping(node, "also", f"`{key.text}`")
        values = self.values(entries, "also")
        values["color"] = self.color(values, "color")
        return AlsoDecl(key, **self.with_ramp(key, entries, values))

    def with_ramp(self, element: Scalar, entries: Entries, values: dict[str, Any]) -> dict[str, Any]:
        """The values with the ramp that `color_by` describes; without one if something is wrong with it."""
        node = values.pop("color_by", None)
        if node is None:
            return values
        found = self.read(node, "color_by", f"`color_by` of `{element.text}`")
        start, end = self.color(found, "from"), self.color(found, "to")
        if end is None or "field" not in found:
            return values
        key = entries["color_by"][0]
        return values | {"ramp": RampDecl(key, found["field"], start, end, found.get("over"))}

    def color(self, values: dict[str, Any], key: str) -> str | None:
        """The color under a key, ``#RRGGBB``; None if it is absent, or after reporting that it is not a color."""
        color = values.get(key)
        if color is None or re.fullmatch(r"#[0-9A-Fa-f]{6}", color.text):
            return color.text.upper() if color else None
        self.reporter.error(
            "PD110", f"`{color.text}` is not a color", color.span, 'expected "#RRGGBB"',
            helps=[f'six hexadecimal digits in quotes: {key}: "#RRGGBB"'],
        )  # fmt: skip
        return None

    # Passes

    def pass_(self, key: Scalar, node: Node) -> PassDecl:
        entries = self.mapping(node, "pass", f"the pass `{key.text}`")
        values = self.values(entries, "pass")
        scratch = self.named(values.get("scratch"), "a scratch field")
        return PassDecl(
            key,
            self.block(entries, values, node),
            values.get("about", ""),
            values.get("after", ()),
            values.get("before", ()),
            tuple(TypedDecl(name, type=self.line(value)) for name, value in scratch),
            values.get("override", False),
        )

    def block(self, entries: Entries, values: dict[str, Any], node: Node) -> Block:
        lets = self.named(values.get("let"), "a value")
        actions = [entry for key, entry in entries.items() if key.startswith(("do", "for ", "repeat "))]
        if len(actions) > 1:
            self.reporter.error(
                "PD107", "a block with two actions", actions[1][0].span, "the second one",
                secondary=[Label(actions[0][0].span, "the first one")],
                helps=["put what comes next under `then:`"],
            )  # fmt: skip
        header = None
        rules: tuple[Syntax, ...] = ()
        blocks: tuple[Block, ...] = ()
        then: tuple[Block, ...] = ()
        if actions:
            key, body = actions[0]
            header = self.line(key, "header") if key.text != "do" else None
            rules, blocks = self.body(body)
        elif "then" not in entries and isinstance(node, Mapping) and len(entries) == len(node.entries):
            self.reporter.error(
                "PD109", "a block that does nothing", first_line(node), "it lacks `do:`, `for …:` or `repeat …:`",
                helps=["put the rules under `do:`"],
            )  # fmt: skip
        if "then" in entries:
            then_rules, then_blocks = self.body(entries["then"][1])
            then = (Block(rules=then_rules),) if then_rules else then_blocks
        return Block(
            tuple((name, line) for name, value in lets if (line := self.line(value))),
            header,
            rules,
            blocks,
            values.get("symmetry"),
            values.get("conflicts"),
            then,
        )

    def body(self, node: Node) -> tuple[tuple[Syntax, ...], tuple[Block, ...]]:
        """A rule or a list of rules (one substep), or a block or a list of blocks (one after the other)."""
        items = node.items if isinstance(node, Sequence) else (node,)
        if not items or (isinstance(node, Scalar) and not node.text):
            helps = ["write rules, or leave the key out"]
            self.reporter.error(
                "PD109", "a place for rules without any", node.span, "nothing here", helps=helps
            )
            return (), ()
        other = next(
            (one for one in items if isinstance(one, Mapping) != isinstance(items[0], Mapping)), None
        )
        if other is not None:
            self.reporter.error(
                "PD204", "rules and blocks in one list", first_line(other), "not of the kind of the first item",
                notes=["a list of rules is one substep; a list of blocks happens one after the other"],
                helps=["put each group of rules under a `- do:` of its own; quote a rule that has `: ` in it"],
            )  # fmt: skip
            return (), ()
        if isinstance(items[0], Mapping):
            entries = [self.mapping(item, "block", "a block") for item in items]
            return (), tuple(map(self.block, entries, (self.values(one, "block") for one in entries), items))
        return self.lines(node, "rule"), ()

    # Tests

    def tests(self, node: Node | None) -> Iterator[TestDecl]:
        if isinstance(node, Sequence):
            for item in node.items:
                if isinstance(item, Mapping) and len(item.entries) == 1:
                    yield self.test(*item.entries[0])
                else:
                    self.shape(item, "a test: `- what it shows:` with its keys indented below")
        elif node is not None:
            self.shape(node, "a list")

    def test(self, name: Scalar, node: Node) -> TestDecl:
        entries = self.mapping(node, "test", f"the test `{name.text}`")
        values = self.values(entries, "test")
        after = self.scalar(entries, "after")
        steps = re.fullmatch(r"([0-9]{1,5}) steps?", after.text.strip() if after else "1 step")
        if after and not steps:
            helps = ["write `50 steps`"]
            self.reporter.error(
                "PD110", "`after` says how many steps", after.span, "not a number of steps", helps=helps
            )
        field = "a mapping with an entry for each field", "write `FIELD: …`, each on its own line"
        drawing = "a drawing of `{}`", "write a word a cell, a row a line, below `|`"
        return TestDecl(
            name,
            self.scalar(entries, "given"),
            self.scalars(
                self.pairs(values.get("legend"), "a mapping from characters to elements"), "an element"
            ),
            int(steps[1]) if steps else 1,
            self.scalar(entries, "expect"),
            self.lines(values.get("always")),
            values.get("seed"),
            self.scalars(self.pairs(values.get("fields"), *field), *drawing),
            self.scalars(self.pairs(values.get("expect_fields"), *field), *drawing),
            tuple(self.often(values.get("often"))),
        )

    def scalars(
        self, pairs: tuple[tuple[Scalar, Node], ...], wanted: str, help_text: str = ""
    ) -> tuple[tuple[Scalar, Scalar], ...]:
        """The pairs whose value is a scalar; reports the others. `{}` in `wanted` stands for the key."""
        for key, value in pairs:
            if not isinstance(value, Scalar):
                self.shape(value, wanted.format(key.text), help_text)
        return tuple((key, value) for key, value in pairs if isinstance(value, Scalar))

    def often(self, node: Node | None) -> Iterator[tuple[Syntax, Syntax]]:
        """`before -> after: CHANCE`, in one mapping or a list of them."""
        parts = node.items if isinstance(node, Sequence) else (node,)
        for part in parts:
            for key, value in self.pairs(part, "a mapping from changes to chances", "write `egg -> hen: 2%`"):
                change, chance = self.line(key, "rule"), self.line(value)
                if change is None or chance is None:
                    continue
                if change.kind == "transform" and len(change.children) == 2:
                    yield change, chance
                    continue
                self.reporter.error(
                    "PD110", "`often` says what becomes of cells", key.span, "not of the form `A -> B`",
                    helps=["write what holds in a cell before and after: `egg -> hen: 2%`"],
                )  # fmt: skip


def _row_fault(row: list[str], width: int, kernel: str) -> tuple[str, str, str] | None:
    """The fault of a row of weights as a message, a label and a fix. `width` is the length of the first row."""
    count = len(row)
    if not row or not all(re.fullmatch(r"-?[0-9]{1,3}", weight) for weight in row):
        fix = 'write "1 0 1", numbers up to 999 with blanks between them'
        return "a kernel row that is not integers", "not a row of weights", fix
    if count > MAX_WEIGHTS:
        label = f"{count} weights: a kernel reaches {MAX_RADIUS} cells to each side"
        return "a kernel that is too wide", label, f"write at most {MAX_WEIGHTS}"
    if count % 2 == 0:
        fix = "write an odd number of weights, the cell's own in the middle"
        return f"kernel `{kernel}` has no middle", f"{count} weights are an even number", fix
    if count != width:
        label = f"{count} weights, the first row has {width}"
        return "the rows of a kernel are equally long", label, f"write {width} weights here too"
    return None
