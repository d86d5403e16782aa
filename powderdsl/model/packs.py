"""Located YAML -> declarations of one pack or ruleset file. Checks shapes and literals, not names."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from powderdsl.diagnostics import Label, Reporter, Source, Span
from powderdsl.model.builtins import MAX_RADIUS
from powderdsl.model.declarations import (
    Block,
    Definition,
    KernelDecl,
    PackDecl,
    PassDecl,
    RulesetDecl,
    StreamDecl,
    TestDecl,
)
from powderdsl.model.schema import E, R, Reader, first_line, keys_of, read_tree
from powderdsl.syntax.parse import Syntax
from powderdsl.syntax.yaml_tree import Mapping, Node, Scalar, Sequence

SIDES = range(1, 2 * MAX_RADIUS + 2, 2)
"""Numbers of rows and columns of kernels: the cell's own weight is in the middle."""

WEIGHT = re.compile("-?[0-9]{1,3}")


def read_file(source: Source, reporter: Reporter) -> PackDecl | RulesetDecl | None:
    """Parse and shape-check a rule file. Reports everything it can; None if the file is unusable."""
    tree = read_tree(source, reporter, "a pack starts with `pack: NAME`")
    if tree is None:
        return None
    reader = _PackReader(reporter)
    if not isinstance(tree, Mapping):
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
            helps=["name it as a world, not among the rules" if drawn else "a pack starts with `pack: NAME`"],
        )  # fmt: skip
        return None
    return reader.file(PackDecl, tree)


class _PackReader(Reader):
    """Reads the records of rule files. Its methods check what the declarations of keys cannot."""

    owner = ""
    """The pack or ruleset whose file this is."""

    def file(self, kind: type[R], tree: Mapping) -> R | None:
        name = tree.get(kind.NOUN.removeprefix("a "))
        self.owner = name.text if isinstance(name, Scalar) else ""
        record = self.record(kind, tree, kind.NOUN, source=tree.span.source)
        return record if record is not None and self.name(record.name, kind.NOUN) else None  # type: ignore[attr-defined]  # files have names

    def ruleset(self, tree: Mapping) -> RulesetDecl | None:
        """Read a ruleset, and report what it lacks; None if its name cannot be read."""
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
                "PD304", f"`{first.text}` is left out of nothing", first.span, "this ruleset extends none",
                helps=["remove `without`, or say which ruleset this one `extends`"],
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
        if node is None or isinstance(node, Mapping):
            yield from self.entries(StreamDecl, node)
            return
        for word in self.words(node):
            if self.name(word, StreamDecl.NOUN):
                yield StreamDecl(name=word, pack=self.owner)

    def kernel(self, key: Scalar, node: Node) -> KernelDecl | None:
        """Rows of weights, a shape with its radius, or a mapping with one of them and `edges`."""
        if not isinstance(node, Mapping):
            is_shape = isinstance(node, Scalar) and not node.text[:1].isdigit()
            node = Mapping(((replace(key, text="shape" if is_shape else "rows"), node),), node.span)
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
        """Rows of weights with a cell in the middle; none after reporting what they lack."""
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
                helps=[f"write rows of integers, equally many in each: an odd number of both, at most {SIDES[-1]}"],
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
                helps=["put what comes next under `then:`"],
            )  # fmt: skip
        if actions:
            key, body = actions[0]
            values["header"] = self.line(key, "header") if key.text != "do" else None
            values["rules"], values["blocks"] = self.body(body)
        elif "then" not in entries and isinstance(node, Mapping) and len(entries) == len(node.entries):
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
            helps = ["write rules, or leave the key out"]
            self.reporter.error(
                "PD109", "a place for rules without any", node.span, "nothing here", helps=helps
            )
            return (), ()
        is_block = isinstance(items[0], Mapping)
        other = next((item for item in items if isinstance(item, Mapping) != is_block), None)
        if other is not None:
            self.reporter.error(
                "PD204", "rules and blocks in one list", first_line(other), "not of the kind of the first item",
                notes=["a list of rules is one substep; a list of blocks happens one after the other"],
                helps=["put each group of rules under a `- do:` of its own; quote a rule that has `: ` in it"],
            )  # fmt: skip
            return (), ()
        if is_block:
            return (), tuple(self.block(Block, item, Block.NOUN) for item in items)
        return self.lines(node, "rule"), ()

    # Tests

    def tests(self, node: Node | None) -> Iterator[TestDecl]:
        if isinstance(node, Sequence):
            for item in node.items:
                if isinstance(item, Mapping) and len(item.entries) == 1:
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
                    "PD110", "`often` says what becomes of cells", key.span, "not of the form `A -> B`",
                    helps=["write what holds in a cell before and after: `egg -> hen: 2%`"],
                )  # fmt: skip
