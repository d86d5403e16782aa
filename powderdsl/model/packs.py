"""Located YAML -> declarations of one pack or ruleset file. Shapes and literals are checked here, names are not."""

from __future__ import annotations

import re

from powderdsl.diagnostics import Label, Reporter, Source, Span
from powderdsl.model.builtins import MAX_SIDE_MULTIPLE
from powderdsl.model.declarations import (
    AlsoDecl,
    Block,
    ElementDecl,
    KernelDecl,
    PackDecl,
    PassDecl,
    RulesetDecl,
    StreamDecl,
    TestDecl,
    TypedDecl,
)
from powderdsl.model.kernel_rows import kernel_rows
from powderdsl.model.ramp_keys import color_of, read_ramp
from powderdsl.model.schema import KEYS, Reader, first_line
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.parse import parse_scalar
from powderdsl.syntax.yaml_tree import Mapping, Node, Scalar, Sequence, parse_yaml


def read_file(source: Source, reporter: Reporter) -> PackDecl | RulesetDecl | None:
    """Parse and shape-check a rule file. Reports everything it can; None where nothing can be made of it."""
    tree = parse_yaml(source, reporter)
    if tree is None:
        if not reporter.has_errors:
            reporter.error(
                "PD107", f"{source.name} is empty", None, helps=["a pack starts with `pack: NAME`"]
            )
        return None
    if not isinstance(tree, Mapping):
        Reader(reporter).shape(tree, "a pack: a mapping that starts with `pack: NAME`")
        return None
    reader = _PackReader(reporter, source)
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

    def line(self, node: Node, start: str = "expression") -> Syntax | None:
        if not isinstance(node, Scalar):
            self.shape(node, "one line")
            return None
        return parse_scalar(node, start, self.reporter)

    def ruleset(self, tree: Mapping) -> RulesetDecl | None:
        entries = self.mapping(tree, "ruleset", "a ruleset")
        name = self.scalar(entries, "ruleset")
        if name is None or not self.name(name, "a ruleset"):
            return None
        renamed = []
        for key, value in self._pairs(entries.get("rename", (None, None))[1], "names: `pack.word: name`"):
            if not isinstance(value, Scalar):
                self.shape(value, "a name")
            elif self.name(value, "a name"):
                renamed.append((key, value))
        params = []
        node = entries.get("params", (None, None))[1]
        if isinstance(node, Mapping):
            params = [(key, line) for key, value in node.entries if (line := self.line(value))]
        extends = self.scalar(entries, "extends")
        without = self.words(entries.get("without", (None, None))[1])
        if extends is None and "extends" not in entries:
            self.needs_no_base(tree, entries, without)
        return RulesetDecl(
            name,
            self.source,
            self.text(entries, "about"),
            self.words(entries.get("packs", (None, None))[1]),
            self.number(entries, "slots", 1, 256),
            self.words(entries.get("matrix", (None, None))[1]),
            tuple(params),
            self.statements(entries.get("invariants", (None, None))[1]),
            tuple(renamed),
            extends=extends,
            without=without,
        )

    def needs_no_base(
        self, tree: Mapping, entries: dict[str, tuple[Scalar, Node]], without: tuple[Scalar, ...]
    ) -> None:
        """Report what is missing in a ruleset that extends none, or has no sense there."""
        if "packs" not in entries:
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
        entries = self.mapping(tree, "pack", "a pack")
        name = self.scalar(entries, "pack")
        if name is None or not self.name(name, "a pack"):
            return None

        def value(key: str) -> Node | None:
            return entries.get(key, (None, None))[1]

        return PackDecl(
            name=name,
            source=self.source,
            about=self.text(entries, "about"),
            needs=self.words(value("needs")),
            conflicts=self.words(value("conflicts")),
            tags=tuple(
                (key, node.text if isinstance(node, Scalar) else "")
                for key, node in self.named(value("tags"), "a tag")
            ),
            properties=tuple(
                self.property(key, node) for key, node in self.named(value("properties"), "a property")
            ),
            fields=tuple(self.field(key, node) for key, node in self.named(value("fields"), "a field")),
            streams=self.streams(value("streams")),
            params=tuple(self.param(key, node) for key, node in self.named(value("params"), "a parameter")),
            kernels=tuple(
                k for key, node in self.named(value("kernels"), "a kernel") if (k := self.kernel(key, node))
            ),
            sets=tuple(
                (key, line) for key, node in self.named(value("sets"), "a set") if (line := self.line(node))
            ),
            elements=tuple(
                self.element(key, node) for key, node in self.named(value("elements"), "an element")
            ),
            also=tuple(self.also(key, node) for key, node in self._pairs(value("also"), "elements to tags")),
            passes=tuple(self.pass_(key, node) for key, node in self.named(value("passes"), "a pass")),
            tests=tuple(t for node in self._items(value("tests")) if (t := self.test(node))),
            invariants=self.statements(value("invariants")),
            side_multiple=self.number(entries, "side_multiple", 1, MAX_SIDE_MULTIPLE) or 1,
        )

    def statements(self, node: Node | None) -> tuple[Syntax, ...]:
        """Invariants: a line, or a list of lines."""
        items = () if node is None else node.items if isinstance(node, Sequence) else (node,)
        return tuple(line for item in items if (line := self.line(item, "invariant")))

    def _pairs(self, node: Node | None, what: str) -> tuple[tuple[Scalar, Node], ...]:
        if node is None:
            return ()
        if not isinstance(node, Mapping):
            self.shape(node, f"a mapping from {what}")
            return ()
        return node.entries

    def _items(self, node: Node | None) -> tuple[Node, ...]:
        if node is None:
            return ()
        if not isinstance(node, Sequence):
            self.shape(node, "a list")
            return ()
        return node.items

    def property(self, key: Scalar, node: Node) -> TypedDecl:
        if isinstance(node, Scalar):
            return TypedDecl(key, self.line(node), None)
        entries = self.mapping(node, "property", f"the property `{key.text}`")
        values = self.open_values(entries, "property")
        return TypedDecl(
            key,
            self.entry_line(entries, "type"),
            self.entry_line(entries, "default"),
            values=values,
            about=self.text(entries, "about"),
        )

    def open_values(
        self, entries: dict[str, tuple[Scalar, Node]], context: str
    ) -> tuple[tuple[Scalar, Syntax], ...]:
        """Entries beyond the table's keys: property values, or values for elements."""
        found = []
        for name, (key, node) in entries.items():
            if name not in KEYS[context] and (line := self.line(node)):
                found.append((key, line))
        return tuple(found)

    def entry_line(self, entries: dict[str, tuple[Scalar, Node]], key: str) -> Syntax | None:
        node = entries.get(key, (None, None))[1]
        return self.line(node) if isinstance(node, Scalar) else None

    def field(self, key: Scalar, node: Node) -> TypedDecl:
        entries = self.mapping(node, "field", f"the field `{key.text}`")
        at = self.choice(entries, "at", ("element", "place")) or "place"
        resets = self.choice(entries, "resets", ("step",)) is not None
        return TypedDecl(
            key,
            self.entry_line(entries, "type"),
            self.entry_line(entries, "default"),
            at,
            self.entry_line(entries, "of"),
            resets,
            values=self.open_values(entries, "field"),
            about=self.text(entries, "about"),
        )

    def param(self, key: Scalar, node: Node) -> TypedDecl:
        if isinstance(node, Scalar):
            return TypedDecl(key, None, self.line(node))
        entries = self.mapping(node, "param", f"the parameter `{key.text}`")
        return TypedDecl(
            key,
            self.entry_line(entries, "type"),
            self.entry_line(entries, "default"),
            about=self.text(entries, "about"),
        )

    def streams(self, node: Node | None) -> tuple[StreamDecl, ...]:
        if isinstance(node, Mapping):
            found = []
            for key, value in self.named(node, "a stream"):
                entries = self.mapping(value, "stream", f"the stream `{key.text}`")
                bits = self.number(entries, "bits", 16, 32) or 16
                if bits not in (16, 32):
                    self.reporter.error(
                        "PD110", "`bits` must be 16 or 32", entries["bits"][1].span, "neither of them"
                    )
                    bits = 16
                found.append(StreamDecl(key, bits))
            return tuple(found)
        return tuple(StreamDecl(word, 16) for word in self.words(node) if self.name(word, "a stream"))

    def kernel(self, key: Scalar, node: Node) -> KernelDecl | None:
        """Rows of weights, a shape with its radius, or a mapping with one of them and `edges`."""
        if isinstance(node, Scalar) and not node.text[:1].isdigit():
            shape = self.line(node)
            return KernelDecl(key, (), False, shape) if shape else None
        if isinstance(node, Mapping):
            entries = self.mapping(node, "kernel", f"the kernel `{key.text}`")
            wrap = self.choice(entries, "edges", ("nothing", "wrap")) == "wrap"
            if "shape" in entries and "rows" not in entries:
                shape = self.entry_line(entries, "shape")
                return KernelDecl(key, (), wrap, shape) if shape else None
            if len({"shape", "rows"} & entries.keys()) != 1:
                both = "rows" in entries
                self.reporter.error(
                    "PD109", f"the kernel `{key.text}` has {'rows and a shape' if both else 'no rows'}",
                    entries["shape"][0].span if both else key.span, "one of them" if both else "`rows` is missing",
                    helps=["`rows`: rows of integer weights; or `shape`: a shape and its radius, such as `disc(3)`"],
                )  # fmt: skip
                return None
            rows = kernel_rows(self, key, entries["rows"][1])
        else:
            wrap, rows = False, kernel_rows(self, key, node)
        return KernelDecl(key, rows, wrap) if rows else None

    def element(self, key: Scalar, node: Node) -> ElementDecl:
        entries = self.mapping(node, "element", f"the element `{key.text}`")
        glyph = self.scalar(entries, "glyph")
        if glyph is not None and not (
            len(glyph.text) == 1 and "!" <= glyph.text <= "~" and glyph.text != "?"
        ):
            self.reporter.error(
                "PD110",
                f"`{glyph.text}` is not a glyph",
                glyph.span,
                "expected one printable ASCII character, not `?`",
                helps=['quote it: glyph: "#"'],
            )
            glyph = None
        return ElementDecl(
            key,
            self.number(entries, "id", 0, 255),
            self.scalar(entries, "id"),
            color_of(self, entries, "color") or "#000000",
            glyph.text if glyph else "",
            self.text(entries, "about"),
            self.words(entries.get("tags", (None, None))[1]),
            self.open_values(entries, "element"),
            self.choice(entries, "override", ("yes", "no", "true", "false")) in ("yes", "true"),
            ramp=read_ramp(self, entries, f"`{key.text}`"),
        )

    def also(self, key: Scalar, node: Node) -> AlsoDecl:
        if isinstance(node, (Sequence, Scalar)):
            return AlsoDecl(key, self.words(node), ())
        entries = self.mapping(node, "also", f"`{key.text}`")
        tags, values = self.words(entries.get("tags", (None, None))[1]), self.open_values(entries, "also")
        return AlsoDecl(key, tags, values, read_ramp(self, entries, f"`{key.text}`"))

    def pass_(self, key: Scalar, node: Node) -> PassDecl:
        entries = self.mapping(node, "pass", f"the pass `{key.text}`")
        scratch = []
        for name, value in self.named(entries.get("scratch", (None, None))[1], "a scratch field"):
            scratch.append(TypedDecl(name, self.line(value), None))
        return PassDecl(
            key,
            self.text(entries, "about"),
            self.words(entries.get("after", (None, None))[1]),
            self.words(entries.get("before", (None, None))[1]),
            tuple(scratch),
            self.block(entries, node),
        )

    def block(self, entries: dict[str, tuple[Scalar, Node]], node: Node) -> Block:
        lets = []
        for name, value in self.named(entries.get("let", (None, None))[1], "a value"):
            if line := self.line(value):
                lets.append((name, line))
        actions = [
            (key, value)
            for key, value in entries.values()
            if key.text == "do" or key.text.startswith(("for ", "repeat "))
        ]
        if len(actions) > 1:
            self.reporter.error(
                "PD107",
                "a block with two actions",
                actions[1][0].span,
                "the second one",
                secondary=[Label(actions[0][0].span, "the first one")],
                helps=["put what comes next under `then:`"],
            )
        header = None
        rules: tuple[Syntax, ...] = ()
        blocks: tuple[Block, ...] = ()
        if actions:
            key, body = actions[0]
            if key.text != "do":
                header = parse_scalar(key, "header", self.reporter)
            rules, blocks = self.body(body)
        elif "then" not in entries and isinstance(node, Mapping) and len(entries) == len(node.entries):
            self.reporter.error(
                "PD109",
                "a block that does nothing",
                first_line(node),
                "it lacks `do:`, `for …:` or `repeat …:`",
                helps=["put the rules under `do:`"],
            )
        then: tuple[Block, ...] = ()
        if "then" in entries:
            then_rules, then_blocks = self.body(entries["then"][1])
            then = (Block((), None, then_rules, (), None, None, ()),) if then_rules else then_blocks
        return Block(
            tuple(lets),
            header,
            rules,
            blocks,
            self.choice(entries, "symmetry", ("mirror", "rotations", "all")),
            self.choice(entries, "conflicts", ("drop_both", "first_wins")),
            then,
        )

    def body(self, node: Node) -> tuple[tuple[Syntax, ...], tuple[Block, ...]]:
        """A rule or a list of rules (one substep), or a block or a list of blocks (one after the other)."""
        items = node.items if isinstance(node, Sequence) else (node,)
        if not items or (isinstance(node, Scalar) and not node.text):
            self.reporter.error(
                "PD109", "a place for rules without any", node.span, "nothing here", helps=["write rules, or leave the key out"]
            )  # fmt: skip
            return (), ()
        kinds = {isinstance(item, Mapping) for item in items}
        if len(kinds) > 1:
            first = next(item for item in items if isinstance(item, Mapping) != isinstance(items[0], Mapping))
            self.reporter.error(
                "PD204",
                "rules and blocks in one list",
                first_line(first),
                "not of the kind of the first item",
                notes=["a list of rules is one substep; a list of blocks happens one after the other"],
                helps=[
                    "put each group of rules under a `- do:` of its own; quote a rule that has `: ` in it"
                ],
            )
            return (), ()
        if True in kinds:
            return (), tuple(self.block(self.mapping(item, "block", "a block"), item) for item in items)
        return tuple(rule for item in items if (rule := self.line(item, "rule"))), ()

    def test(self, node: Node) -> TestDecl | None:
        if not isinstance(node, Mapping) or len(node.entries) != 1:
            self.shape(node, "a test: `- what it shows:` with its keys indented below")
            return None
        name, body = node.entries[0]
        entries = self.mapping(body, "test", f"the test `{name.text}`")
        legend = []
        legend_node = entries.get("legend", (None, None))[1]
        if isinstance(legend_node, Mapping):
            legend = [(key, value) for key, value in legend_node.entries if isinstance(value, Scalar)]
        after = self.scalar(entries, "after")
        steps = 1
        if after is not None:
            match = re.fullmatch(r"([0-9]{1,5}) steps?", after.text.strip())
            if match:
                steps = int(match[1])
            else:
                self.reporter.error(
                    "PD110",
                    "`after` says how many steps",
                    after.span,
                    "not a number of steps",
                    helps=["write `50 steps`"],
                )
        always = entries.get("always", (None, None))[1]
        lines = (
            ()
            if always is None
            else tuple(
                line
                for item in (always.items if isinstance(always, Sequence) else (always,))
                if (line := self.line(item))
            )
        )
        return TestDecl(
            name.text,
            name,
            self.scalar(entries, "given"),
            tuple(legend),
            steps,
            self.scalar(entries, "expect"),
            lines,
            self.number(entries, "seed", 0, 2**31 - 1),
            self.drawn(entries, "fields"),
            self.drawn(entries, "expect_fields"),
            self.often(entries.get("often", (None, None))[1]),
        )

    def often(self, node: Node | None) -> tuple[tuple[Syntax, Syntax], ...]:
        """`before -> after: CHANCE`, in one mapping or a list of them."""
        if node is None:
            return ()
        parts = node.items if isinstance(node, Sequence) else (node,)
        found = []
        for part in parts:
            if not isinstance(part, Mapping):
                self.shape(part, "a mapping from changes to chances", "write `egg -> hen: 2%`")
                continue
            for key, value in part.entries:
                change, chance = self.line(key, "rule"), self.line(value)
                if change is None or chance is None:
                    continue
                if change.kind == "transform" and len(change.children) == 2:
                    found.append((change, chance))
                    continue
                self.reporter.error(
                    "PD110", "`often` says what becomes of cells", key.span, "not of the form `A -> B`",
                    helps=["write what holds in a cell before and after: `egg -> hen: 2%`"],
                )  # fmt: skip
        return tuple(found)

    def drawn(self, entries: dict[str, tuple[Scalar, Node]], key: str) -> tuple[tuple[Scalar, Scalar], ...]:
        """Drawings by a field's name."""
        node = entries.get(key, (None, None))[1]
        if node is None:
            return ()
        if not isinstance(node, Mapping):
            self.shape(
                node, "a mapping with an entry for each field", "write `FIELD: …`, each on a line of its own"
            )
            return ()
        found = []
        for name, value in node.entries:
            if isinstance(value, Scalar):
                found.append((name, value))
            else:
                self.shape(
                    value, f"a drawing of `{name.text}`", "write a word a cell, a row a line, below `|`"
                )
        return tuple(found)
