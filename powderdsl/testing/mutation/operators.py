"""Mutants: a rule file with one realistic mistake, made by replacing characters of its text.

For each kind of syntax and each key, the mistake is what a hurried author writes instead.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Sequence as Sequence_
from dataclasses import dataclass, field, replace
from itertools import takewhile

from powderdsl.diagnostics import Reporter, Source, Span
from powderdsl.model.builtins import DIRECTION_SETS, KERNEL_SHAPES, KERNELS
from powderdsl.model.declarations import PackDecl, TypedDecl
from powderdsl.syntax import yaml_tree
from powderdsl.syntax.parse import Syntax, parse_scalar
from powderdsl.syntax.yaml_tree import Node, Scalar, Sequence, parse_yaml

Container = yaml_tree.Mapping | Sequence
Path = tuple[tuple[Container, int], ...]
"""From the file's root to an entry: each container, and which of its entries leads on."""


@dataclass(frozen=True)
class Change:
    """A mistake: the kind of it (docs/testing.md has a table), and characters `start` to `end` (exclusive) that become `text`."""

    operator: str
    start: int
    end: int
    text: str


@dataclass(frozen=True)
class Mutant:
    """One file of a composition with one mistake. `source` is the file as it was."""

    source: Source
    pack: str
    change: Change

    @property
    def operator(self) -> str:
        return self.change.operator

    @property
    def text(self) -> str:
        text = self.source.text
        return text[: self.change.start] + self.change.text + text[self.change.end :]

    @property
    def place(self) -> str:
        """`file:line:column` of what is replaced."""
        start, text = self.change.start, self.source.text
        while start < min(self.change.end, len(text) - 1) and text[start].isspace():
            start += 1  # what is cut out may begin with the blanks before it
        return Span(self.source, start, start).place

    @property
    def diff(self) -> str:
        """The lines that differ, before and after, each on one line; `(nothing)` where there are none."""
        old, new = self.source.text.splitlines(), self.text.splitlines()
        before, after = (" ".join(" ".join(lines).split()) for lines in split_common_ends(old, new)[1:])
        return f"{before or '(nothing)'}  ⇒  {after or '(nothing)'}"

    @property
    def key(self) -> str:
        """The mutant's identity from run to run: place, kind and the new text."""
        return f"{self.place} {self.operator} {self.diff}"


def split_common_ends(old: list[str], new: list[str]) -> tuple[list[str], list[str], list[str]]:
    """Split two lists into their common beginning and the parts of each before their common end."""
    head = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(old, new, strict=False)))
    ends = zip(reversed(old[head:]), reversed(new[head:]), strict=False)
    tail = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], ends))
    return old[:head], old[head : len(old) - tail], new[head : len(new) - tail]


def replace_text(operator: str, span: Span, text: str) -> Change:
    """Another text at a place; words that stay the same at its ends are left alone."""
    old, new = (re.findall(r"[\w.%]+|\s+|[^\w\s.%]+", words) for words in (span.text, text))
    head, before, after = ("".join(words) for words in split_common_ends(old, new))
    start = span.start + len(head)
    return Change(operator, start, start + len(before), after)


def exchange_texts(operator: str, first: Span, second: Span) -> Change:
    """Two texts in each other's place."""
    between = first.source.text[first.end : second.start]
    return replace_text(operator, first.to(second), f"{second.text}{between}{first.text}")


# Cutting entries out of located YAML, and putting some in: the rest of the file is unchanged


def removed(operator: str, path: Path) -> Change:
    """The entry at the end of a path cut out; the whole container where it was the only one."""
    container, number = path[-1]
    spans = entry_spans(container)
    if len(spans) == 1 and len(path) > 1:
        return removed(operator, path[:-1])
    text = container.span.source.text
    start, end = spans[number].start, spans[number].end
    if text[container.span.start] in "[{":
        return without(operator, spans, number)
    line = text.rfind("\n", 0, start) + 1
    if isinstance(container, yaml_tree.Mapping) and text[line:start].strip():
        # The first key of a list's item stands beside the dash, which stays.
        return Change(operator, start, spans[number + 1].start if number + 1 < len(spans) else end, "")
    stop = text.find("\n", end)
    return Change(operator, line, len(text) if stop < 0 else stop + 1, "")


def without(operator: str, items: list[Span], number: int) -> Change:
    """An item of a list cut out with the comma beside it."""
    if number + 1 < len(items):
        return Change(operator, items[number].start, items[number + 1].start, "")
    return Change(operator, items[number - 1].end, items[number].end, "")


def inserted(operator: str, path: Path, entry: str) -> Change:
    """A new entry after one of a mapping's, written as the mapping is: with a comma, or on its own line."""
    node, number = path[-1]
    assert isinstance(node, yaml_tree.Mapping)
    end = entry_spans(node)[number].end
    source = node.span.source
    column = source.position(node.entries[0][0].span.start)[1]
    before = ", " if source.text[node.span.start] == "{" else "\n" + " " * (column - 1)
    return Change(operator, end, end, before + entry)


def entry_spans(container: Container) -> list[Span]:
    """Return the span of each entry, from key to value."""
    if isinstance(container, Sequence):
        return [_whole(item) for item in container.items]
    return [key.span.to(_whole(value)) for key, value in container.entries]


def _whole(node: Node) -> Span:
    """A node with all of its text: a block scalar's own span is its sign alone."""
    span = node.span
    if isinstance(node, Scalar) and node.style == "block":
        content = node.content
        text = content.source.text[span.start : content.end].rstrip()
        return Span(span.source, span.start, span.start + len(text))
    return span


# Names that a hurried author might write instead


@dataclass(frozen=True)
class NamesByKind:
    """Names by kind, in the order of the files. `own` are those of the mutated pack; `local` are its `let` values."""

    kinds: dict[str, str]
    own: frozenset[str]
    ranges: dict[str, tuple[int, int]]
    """Bounds of properties that are integers."""
    flags: frozenset[str]
    """Properties that are flags."""
    local: dict[str, str] = field(default_factory=dict)
    """`let` values of the pass at hand, with their text."""

    def kind(self, name: str) -> str:
        """The kind of a name without what it holds, or nothing: `property:int` is a `property`."""
        return self.kinds.get(name, "").partition(":")[0]

    def others(self, name: str) -> list[str]:
        """The next and the last name of the same kind: those of the same pack first, then others."""
        if name not in self.kinds:
            return []
        same = [other for other, kind in self.kinds.items() if kind == self.kinds[name]]
        place = same.index(name)
        ring = same[place + 1 :] + same[:place]
        if name in self.own:
            ring.sort(key=lambda other: other not in self.own)
        return [*dict.fromkeys([*ring[:1], *ring[-1:]])]

    def with_lets(self, lets: dict[str, str]) -> NamesByKind:
        kinds = {**self.kinds, **dict.fromkeys(lets, "let")}
        return replace(self, kinds=kinds, own=self.own | frozenset(lets), local=lets)


def names_of(packs: Sequence_[PackDecl], pack: PackDecl) -> NamesByKind:
    """The names that rules of a pack can say."""
    kinds: dict[str, str] = dict.fromkeys(KERNELS, "kernel")
    own: set[str] = set()
    types: dict[str, str] = {}
    for other in packs:
        names = {
            decl.name.text: kind
            for kind in ("tag", "set", "element", "stream", "kernel")
            for decl in getattr(other, f"{kind}s")
        }
        names |= _typed(other.properties, "property") | _typed(other.fields, "field")
        if other is pack:
            names |= _typed(other.params, "parameter")
            own |= set(names)
        kinds |= names
        types |= {decl.name.text: decl.type.span.text.strip() for decl in other.properties if decl.type}
    bounds = {name: re.fullmatch(r"(-?\d+)\s*\.\.\s*(-?\d+)", text) for name, text in types.items()}
    ranges = {name: (int(match[1]), int(match[2])) for name, match in bounds.items() if match}
    flags = frozenset(name for name, text in types.items() if text == "flag")
    return NamesByKind(kinds, frozenset(own), ranges, flags)


def _typed(decls: Iterable[TypedDecl], kind: str) -> dict[str, str]:
    """Declared names with their kind and what they hold: a number never stands for a flag by mistake."""
    kinds = {}
    for decl in decls:
        declared = decl.type or decl.default
        text = declared.span.text.strip() if declared else ""
        is_range = re.match(r"-?\d+\s*\.\.", text)
        content = "int" if is_range else "chance" if "%" in text else text.partition("(")[0]
        kinds[decl.name.text] = f"{kind}:{content}"
    return kinds


def table(text: str) -> dict[str, tuple[str, ...]]:
    """The kind of mistake for each word, and what is written instead: `KIND: WORD → OTHER | OTHER; …`."""
    lines = (line.split(": ", 1) for line in text.strip().splitlines())
    rows = ((kind, *entry.split(" → ")) for kind, entries in lines for entry in entries.split("; "))
    return {word: (kind, *others.split(" | ")) for kind, word, others in rows}


SIMILAR = table("""
neighbor: above → below | left; below → above | right; left → right | below; right → left | above; here → above | right
coordinate: row → column; column → row; step → row
comparison: < → <= | >; <= → < | >=; > → >= | <; >= → > | <=; == → != | >=; != → == | <
write: := → += | -=; += → -= | :=; -= → += | :=
connective: and → or; or → and; any( → all(; all( → any(
arithmetic: min( → max(; max( → min(; abs( → (
constant: yes → no; no → yes
""")
"""What stands for words and signs of the language. For a neighbor: the opposite, and one around the corner."""

SIMILAR |= {name: ("side", *(other for other in DIRECTION_SETS if other != name)) for name in DIRECTION_SETS}
SIMILAR |= {
    f"{shape}(": ("kernel", *(f"{other}(" for other in KERNEL_SHAPES if other != shape))
    for shape in KERNEL_SHAPES
}

WORD = re.compile(r"->|[<>=!:+-]=|[<>]|[a-z]\w*\(|\d+(?:\.\d+)?(?:e-?\d+)?%?|[A-Za-z_]\w*")
"""A sign, the name of a function, a number, a name."""

TEMPLATES = table("""
connective: and_ → {0} | {1}; or_ → {0} | {1}
negation: not_ → {0}
comparison: is_ → {0} is not {1}; is_not → {0} is {1}; in_ → {0} not in {1}; not_in → {0} in {1}
kernel: in_kernel → {0}
set: any_but → {0}
arithmetic: add → {0} - {1}; sub → {0} + {1}; mul → {0} / {1}; div → {0} * {1}; quotient → {0} * {1}
arithmetic: choose → {2} if {1} else {0}; clamp → ({0})
neighbor: opposite → {0}; clockwise → {0}; counterclockwise → {0}
constant: neg → {0}
""")
"""What stands for kinds of syntax and calls: `{0}` is the first operand."""

Changes = Iterator[Change]


def mutants_of(pack: PackDecl, packs: Sequence_[PackDecl]) -> list[Mutant]:
    """All mutants of a pack's file, each text once, in the order of the file.

    `packs`: all packs of the composition in which it is mutated.
    """
    root = parse_yaml(pack.source, Reporter())
    mutants: dict[str, Mutant] = {}
    for section in entries_of(root, (), names_of(packs, pack)) if root is not None else ():
        for change in changes_in(section, section.key.text):
            mutant = Mutant(pack.source, pack.name.text, change)
            if mutant.text != pack.source.text:
                mutants.setdefault(mutant.text, mutant)
    return sorted(mutants.values(), key=lambda mutant: mutant.change.start)


# Lines


def word_changes(line: Span, names: NamesByKind) -> Changes:
    """Each word, sign and number of a line in place of which another one stands."""
    for match in WORD.finditer(line.text):
        word = match[0]
        if word[0].isdigit():
            operator, others = (
                ("chance", near_chances(word)) if word[-1] == "%" else ("constant", near_numbers(word))
            )
        elif word in SIMILAR:
            operator, *others = SIMILAR[word]
        else:
            operator, others = names.kind(word), names.others(word)
            if word in names.local and line.text[: match.start()][-1:] != ".":
                others = [*others, f"({names.local[word]})"]
        start = line.start + match.start()
        for other in others:
            yield Change(operator, start, start + len(word), other)


def near_numbers(text: str) -> list[str]:
    """Integers one off; of a large one twice as large and half. Of a decimal half, and twice as far from 1 or from 0."""
    if text.isdigit():
        number = int(text)
        others = [number + 1, number - 1, *((number * 2, number // 2) if number >= 10 else ())]
        return [str(other) for other in others if other >= 0]
    decimal = float(text)
    digits = (f"{other:.6g}" for other in (decimal / 2, (1 + decimal) / 2 if decimal < 1 else decimal * 2))
    return [text if re.search(r"[.e]", text) else f"{text}.0" for text in digits]


def near_chances(text: str) -> list[str]:
    """A percentage ten times as large or small, and half as large again; nothing above 100 %."""
    number = float(text.rstrip("%"))
    others = (min(number * 10, 100.0), number / 10, min(number * 1.5, 100.0)) if number else (10.0,)
    return [f"{other:.10g}%" for other in others]


def near_bounds(text: str) -> list[str]:
    """Other bounds for a declared kind: one off, or half of a large one."""
    return near_numbers(text)[:2] if int(text) <= 20 else [str(int(text) // 2)]


def near_weights(text: str) -> list[str]:
    """The weights tried for a weight: none where there was one, or twice as much; one where there was none."""
    return ["0", str(2 * int(text))] if int(text) else ["1"]


def numbers(operator: str, span: Span, pattern: str, others: Callable[[str], list[str]]) -> Changes:
    """Other values for each number in a text."""
    for match in re.finditer(pattern, span.text):
        for other in others(match[0]):
            yield Change(operator, span.start + match.start(), span.start + match.end(), other)


def syntax_changes(node: Syntax, names: NamesByKind) -> Changes:
    """Mistakes in the parts of a line, besides other words."""
    kind = node.text if node.kind == "call" else node.kind
    if kind == "in_" and names.kind(node.children[1].text) == "kernel":
        kind = "in_kernel"
    operator, *templates = TEMPLATES.get(kind, ("",))
    for template in templates:
        if template == "{1}" and node.children[0].kind == node.kind:
            continue  # the same as a part's second operand
        yield replace_text(operator, node.span, template.format(*(part.text for part in extents(node))))
    if node.kind in MISTAKES:
        yield from MISTAKES[node.kind](node, names)
    for child in node.children:
        yield from syntax_changes(child, names)


def extents(node: Syntax) -> list[Span]:
    """Return the spans of operands with the parentheses around them, which their own spans leave out."""
    text = node.span.source.text
    first, last = node.span.start, node.span.end
    if node.kind in ("call", "tuple"):
        first, last = text.index("(", first) + 1, last - 1
    spans = []
    for child in node.children:
        start, end = child.span.start, child.span.end
        while True:
            before, after = text[first:start].rstrip(), text[end:last].lstrip()
            if before[-1:] != "(" or after[:1] != ")":
                break
            start, end = first + len(before) - 1, last - len(after) + 1
        spans.append(Span(node.span.source, start, end))
    return spans


def is_neighbor(word: str) -> bool:
    return SIMILAR.get(word, ("",))[0] == "neighbor"


def _attribute(node: Syntax, names: NamesByKind) -> Changes:
    """The neighbor alone, or the value here."""
    before = node.children[0].span.text
    if is_neighbor(node.text) or not (node.text in SIMILAR or names.kind(node.text)):
        yield replace_text("neighbor", node.span, before)
    if node.text not in SIMILAR or (is_neighbor(node.text) and is_neighbor(before)):
        yield replace_text("neighbor", node.span, node.text)


def _call(node: Syntax, names: NamesByKind) -> Changes:
    """Another neighborhood to count in."""
    counted = extents(node)[-1]
    has_kernel = any(
        child.kind == "in_" and names.kind(child.children[1].text) == "kernel" for child in node.children
    )
    if node.text in ("count", "sum") and not has_kernel:
        text = counted.text if re.fullmatch(r"[\w.?]+|\(.*\)", counted.text) else f"({counted.text})"
        for kernel in ("ring", "cross"):
            yield replace_text("kernel", counted, f"{text} in {kernel}")


def _tuple(node: Syntax, names: NamesByKind) -> Changes:
    """A missing member."""
    for number in range(len(node.children)):
        operator = "side" if is_neighbor(node.children[0].text) else "set"
        yield without(operator, extents(node), number)


def _binding(node: Syntax, names: NamesByKind) -> Changes:
    """A loop in another order."""
    domain = node.children[1]
    if domain.kind == "tuple":
        yield exchange_texts("order", extents(domain)[0], extents(domain)[-1])


def _rule(node: Syntax, names: NamesByKind) -> Changes:
    """A rule without its condition or its chance, or the other way round."""
    sides = node.children[:2]
    if node.kind == "transform" and {side.kind for side in sides} <= {"name", "optional_name"}:
        yield exchange_texts("element", sides[0].span, sides[1].span)
    for clause in node.children:
        if clause.kind in ("condition", "where", "chance"):
            yield replace_text("guard", clause.span, "")
        if clause.kind in ("condition", "where"):
            yield from _negations(clause.children[0])


def _negations(node: Syntax) -> Changes:
    """A `not` before a part of a condition that is none already."""
    if node.kind in ("and_", "or_"):
        for child in node.children:
            yield from _negations(child)
    elif node.kind in ("name", "optional_name", "attribute", "any_of", "all_of"):
        yield Change("negation", node.span.start, node.span.start, "not ")


def _effects(node: Syntax, names: NamesByKind) -> Changes:
    if len(node.children) == 1:
        yield replace_text("effect", node.span, "")
        return
    for number in range(len(node.children)):
        yield without("effect", [child.span for child in node.children], number)


MISTAKES: dict[str, Callable[[Syntax, NamesByKind], Changes]] = {
    "call": _call,
    "attribute": _attribute,
    "tuple": _tuple,
    "binding": _binding,
    **dict.fromkeys(("transform", "swap", "move", "assign"), _rule),
    "then": _effects,
}
"""The mistakes in each kind of syntax besides its templates. Mistakes in its parts come on top."""


# Entries of the file


@dataclass(frozen=True)
class Entry:
    """An entry of the file: its key, its value and the way to it, and the names that its lines can say."""

    key: Scalar
    node: Node
    path: Path
    names: NamesByKind

    @property
    def siblings(self) -> dict[str, tuple[Scalar, Node]]:
        """The entries of the mapping to which it belongs, by key."""
        container = self.path[-1][0]
        assert isinstance(container, yaml_tree.Mapping)
        return {key.text: (key, node) for key, node in container.entries}

    def entries(self) -> Iterator[Entry]:
        return entries_of(self.node, self.path, self.names)

    def items(self) -> list[Entry]:
        """The items of a list; the entry itself for anything else."""
        if not isinstance(self.node, Sequence):
            return [self]
        return [
            replace(self, node=item, path=(*self.path, (self.node, number)))
            for number, item in enumerate(self.node.items)
        ]

    def line(self, start: str = "expression") -> Changes:
        if isinstance(self.node, Scalar) and self.node.text:
            tree = parse_scalar(self.node, start, Reporter())
            if tree is not None:
                yield from word_changes(tree.span, self.names)
                yield from syntax_changes(tree, self.names)

    def lost(self, operator: str) -> Change:
        """The file without it."""
        return removed(operator, self.path)

    def instead(self, operator: str, text: str) -> Change:
        """Another value for its scalar."""
        assert isinstance(self.node, Scalar)
        return replace_text(operator, self.node.content, text)

    def added(self, operator: str, line: str) -> Change:
        """One more entry at the end of its mapping."""
        assert isinstance(self.node, yaml_tree.Mapping)
        return inserted(operator, (*self.path, (self.node, len(self.node.entries) - 1)), line)


EntryMistake = Callable[[Entry], Iterable[Change]]


def entries_of(node: Node, path: Path, names: NamesByKind) -> Iterator[Entry]:
    """The entries of a mapping, or of the mappings in a list."""
    if isinstance(node, yaml_tree.Mapping):
        for number, (key, value) in enumerate(node.entries):
            yield Entry(key, value, (*path, (node, number)), names)
    elif isinstance(node, Sequence):
        for number, item in enumerate(node.items):
            yield from entries_of(item, (*path, (node, number)), names)


def changes_in(parent: Entry, place: str) -> Changes:
    """All mistakes below an entry, by the rows of PLACES; `place` is its own row."""
    for entry in parent.entries():
        if place == "passes":
            entry = replace(entry, names=entry.names.with_lets(lets_in(entry)))
        is_action = place == "passes.*" and entry.key.text.startswith(("do", "then", "for ", "repeat "))
        row = f"{place}.{entry.key.text}"
        row = "passes.*.do" if is_action else row if row in PLACES else f"{place}.*"
        for mistake in PLACES.get(row, ()):
            yield from mistake(entry)
        yield from changes_in(entry, place if is_action else row)


def lets_in(parent: Entry) -> dict[str, str]:
    """The `let` values of a pass and its blocks, with their text on one line."""
    lets = {}
    for entry in parent.entries():
        if parent.key.text == "let" and isinstance(entry.node, Scalar):
            lets[entry.key.text] = " ".join(entry.node.content.text.split())
        lets |= lets_in(entry)
    return lets


def lost(operator: str) -> EntryMistake:
    return lambda entry: [entry.lost(operator)]


def option(operator: str, *words: str) -> EntryMistake:
    """Another word for a key that takes one of a few."""
    return lambda entry: [entry.instead(operator, other) for other in words if other != entry.node.span.text]


def _bounds(entry: Entry) -> Changes:
    if isinstance(entry.node, Scalar):
        yield from numbers("field", entry.node.content, r"(?<!\d\.)(?<!\w)\d+(?!\d|\.\d)", near_bounds)


def _value(entry: Entry) -> Changes:
    """A property's value: one or two off, the other flag, another chance, or not said."""
    if not isinstance(entry.node, Scalar) or not entry.node.text:
        return
    if re.fullmatch(r"-?\d+", entry.node.text):
        keys = [node.entries[n][0].word for node, n in entry.path if isinstance(node, yaml_tree.Mapping)]
        low, high = next(
            (entry.names.ranges[key] for key in keys if key in entry.names.ranges), (-(10**6), 10**6)
        )
        number = int(entry.node.text)
        for other in (number - 1, number + 1, number - 2, number + 2):
            if low <= other <= high:
                yield entry.instead("property", str(other))
    else:
        yield from entry.line()
    yield entry.lost("property")


def _at(entry: Entry) -> Changes:
    yield from option("field", "place", "element")(entry)
    if "resets" not in entry.siblings:
        yield inserted("field", entry.path, "resets: step")


def _kernel(entry: Entry) -> Changes:
    """Other weights, other edges."""
    parts = {part.key.text: part for part in entry.entries()}
    for row in parts.get("rows", entry).items():
        if isinstance(row.node, Scalar):
            yield from numbers("kernel", row.node.content, r"-?\d+", near_weights)
    if parts and "edges" not in parts:
        yield entry.added("kernel", "edges: wrap")
    elif entry.node.span.text[:1] == "[":
        yield replace_text("kernel", entry.node.span, f"{{rows: {entry.node.span.text}, edges: wrap}}")


def _element(entry: Entry) -> Changes:
    """A flag more, a tag where there is none."""
    if not isinstance(entry.node, yaml_tree.Mapping):
        return
    words = {part.key.word for part in entry.entries()}
    for flag in sorted(entry.names.flags - words):
        yield entry.added("property", f"{flag}: yes")
    tag = next((name for name, kind in entry.names.kinds.items() if kind == "tag"), None)
    if "tags" not in words and tag is not None:
        yield entry.added("tag", f"tags: {tag}?")


def _tags(entry: Entry) -> Changes:
    """A word of a list of tags gone, another one, one more."""
    node = entry.node
    words = [(item, item.node) for item in entry.items() if isinstance(item.node, Scalar)]
    listed = [word.word for _, word in words]
    for number, (item, word) in enumerate(words):
        if entry.names.kind(word.word) != "tag":
            continue
        yield item.lost("tag")
        other = next((name for name in entry.names.others(word.word) if name not in listed), None)
        if other is not None:
            yield item.instead("tag", f"{other}?")
            if isinstance(node, Scalar):
                yield replace_text("tag", node.span, f"[{node.text}, {other}?]")
            elif number == 0 and node.span.text[0] == "[":
                yield replace_text("tag", node.span, f"[{other}?, {node.span.text[1:]}")


def _order(entry: Entry) -> Changes:
    for item in entry.items():
        yield item.lost("order")
    other = "before" if entry.key.text == "after" else "after"
    if other not in entry.siblings:
        yield replace_text("order", entry.key.span, other)


def _action(entry: Entry) -> Changes:
    """Yield the changes of a block's `do` or `then`: a rule, a list of rules, or blocks."""
    key, items = entry.key, entry.items()
    if key.text == "then":
        yield entry.lost("rule")
    elif key.text != "do":
        yield from replace(entry, node=key).line("header")
    rules = lines_of(entry.node)
    if "then" not in entry.siblings and len(entry.path) == 3:
        yield removed("rule", entry.path[:-1])
    elif "then" in entry.siblings and key.text != "then":
        then, node = entry.siblings["then"]
        yield replace_text("rule", key.span.to(then.span), "do")
        if key.text == "do" and rules and lines_of(node):  # one substep where there were two
            indent = "\n" + " " * (key.span.column - 1) + "  - "
            lines = [" ".join(rule.span.text.split()) for rule in (*rules, *lines_of(node))]
            yield replace_text("order", key.span.to(node.span), indent.join(["do:", *lines]))
    for item in items:
        if len(items) > 1:
            yield item.lost("rule")
        yield from item.line("rule")
    if len(items) == 1 or not rules or any(rule.style == "block" for rule in rules):
        return
    spans = [rule.span for rule in rules]
    for first, second in itertools.pairwise(spans):  # neighbors exchanged
        yield exchange_texts("order", first, second)
    if entry.node.span.text[:1] != "[":  # one after the other instead of at once
        source, end = spans[0].source, spans[-1].end
        text = ""
        for first, second in itertools.pairwise([*spans, Span(source, end, end)]):
            text += f"do: {' '.join(first.text.split())}{source.text[first.end : second.start]}"
        yield replace_text("order", spans[0].to(spans[-1]), text)


PLACES: dict[str, tuple[EntryMistake, ...]] = {
    "properties.*": (_bounds,),
    "properties.*.about": (),
    "properties.*.type": (_bounds,),
    "properties.*.*": (_value,),
    **dict.fromkeys(("fields.*.about", "fields.*.tint", "passes.*.let", "passes.*.scratch"), ()),
    "fields.*.type": (_bounds,),
    "fields.*.at": (_at,),
    "fields.*.resets": (lost("field"),),
    "fields.*.*": (Entry.line, lost("field")),
    "params.*": (Entry.line,),
    "params.*.default": (Entry.line,),
    "kernels.*": (_kernel,),
    "kernels.*.shape": (Entry.line,),
    "kernels.*.edges": (option("kernel", "wrap", "nothing"),),
    "sets.*": (Entry.line,),
    "elements.*": (_element,),
    "also.*": (_tags,),
    **{f"{section}.*.{key}": () for section in ("elements", "also") for key in ("id", "color", "color_by", "glyph", "about")},
    **{f"{section}.*.tags": (_tags,) for section in ("elements", "also")},
    **{f"{section}.*.override": (option("override", "no", "yes"),) for section in ("elements", "also")},
    **{f"{section}.*.*": (_value,) for section in ("elements", "also")},
    "passes.*.after": (_order,),
    "passes.*.before": (_order,),
    "passes.*.scratch.*": (_bounds,),
    "passes.*.let.*": (Entry.line,),
    "passes.*.symmetry": (option("side", "mirror", "rotations", "all"), lost("side")),
    "passes.*.conflicts": (option("conflicts", "drop_both", "first_wins", "overwrite"), lost("conflicts")),
    "passes.*.do": (_action,),
}  # fmt: skip
"""The mistakes in each entry of the file: `*` is any key. All actions of passes and blocks stand at `passes.*.do`."""


def lines_of(node: Node) -> list[Scalar]:
    """The rules of a body: itself or the items of a list; none where there are blocks."""
    items = node.items
    scalars = [item for item in items if isinstance(item, Scalar)]
    return scalars if len(scalars) == len(items) else []
