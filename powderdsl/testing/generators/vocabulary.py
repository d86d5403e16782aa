"""Random declarations of a rule file: elements, tags, sets, properties, fields, streams, parameters, kernels."""

from __future__ import annotations

from dataclasses import dataclass, field

from powderdsl.model.builtins import KERNEL_SHAPES, KERNELS, shaped_kernel
from powderdsl.model.types import CHANCE, DIRECTION, ELEMENT, FLAG, Kind, integer
from powderdsl.testing.generators.choices import Choices
from powderdsl.testing.generators.trees import Tree

RANGES = (
    (0, 1), (0, 3), (-2, 2), (0, 7), (-1, 1), (0, 0), (-5, -2), (3, 9), (-128, 127), (0, 127), (-129, 5), (0, 128),
    (0, 255), (0, 256), (-32768, 32767), (0, 65535), (-100000, 100000),
)  # fmt: skip
"""Ranges of integers: small ones that saturate, and the borders of storage types and of the checker's search."""

CHANCES = ("50%", "0%", "100%", "20%", "0.001%", "99.99%", "0.1", "33.3%", "0.0000152587890625")
"""The last one is 1/65536, one step of a draw of 16 bits."""


@dataclass
class Words:
    """The names that a random ruleset declares; expressions and rules use them."""

    elements: list[str] = field(default_factory=list)
    ids: list[int] = field(default_factory=list)
    groups: list[str] = field(default_factory=list)
    """Tags and named sets."""
    properties: dict[str, Kind] = field(default_factory=dict)
    fields: dict[str, Kind] = field(default_factory=dict)
    params: dict[str, Kind] = field(default_factory=dict)
    streams: dict[str, int] = field(default_factory=dict)
    kernels: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """Their weights."""

    def of_kind(self, kind: str) -> list[str]:
        """Fields and properties of a kind."""
        return [
            name for table in (self.fields, self.properties) for name, k in table.items() if k.name == kind
        ]


@dataclass(frozen=True)
class Manner:
    """Features of a random ruleset. Tests of single properties leave out what would break the property."""

    draws: bool = True
    """Streams of random numbers, and chances."""
    borders: bool = True
    """Anything that knows where the grid ends: `row`, `column`, `inside`, kernels that do not wrap."""
    reals: bool = True
    symmetry: bool = True
    overwrites: bool = True
    """Blocks whose moves may overwrite each other, so that cells get lost or doubled."""
    forms: tuple[str, ...] = ("transform", "swap", "move", "assign", "push")


def declare(choices: Choices, manner: Manner) -> tuple[Words, dict[str, Tree]]:
    """Random declarations: the words, and the sections of the file."""
    words = Words()
    if manner.borders:
        words.kernels |= {name: tuple(w for _, _, w in kernel.weights) for name, kernel in KERNELS.items()}
    sections: dict[str, Tree] = {}
    count = choices.weighted([(4, 2), (2, 1), (3, 3), (3, 4), (1, 6), (1, 9)])
    words.elements = [f"e{i}" for i in range(count)]
    words.ids = _ids(choices, count)
    tags = [f"t{i}" for i in range(choices.integer(0, 2))]
    sections["params"] = _params(choices, words, manner)
    sections["properties"] = _properties(choices, words)
    sections["fields"] = _fields(choices, words, manner)
    sections["streams"] = _streams(choices, words, manner)
    sections["kernels"] = _kernels(choices, words, manner)
    sections["tags"] = dict.fromkeys(tags, "a tag")
    sections["elements"] = {
        name: _element(choices, words, identity, tags)
        for name, identity in zip(words.elements, words.ids, strict=True)
    }
    words.groups += tags
    sections["sets"] = _sets(choices, words)
    return words, {name: tree for name, tree in sections.items() if tree}


def _ids(choices: Choices, count: int) -> list[int]:
    """Ids from 0 without gaps, or with some; now and then up to the largest one."""
    ids, last = [], -1
    for _ in range(count):
        last += choices.weighted([(12, 1), (2, 2), (1, 5)])
        ids.append(last)
    if choices.maybe(3):
        ids[-1] = 255
    return ids


def _params(choices: Choices, words: Words, manner: Manner) -> dict[str, Tree]:
    section: dict[str, Tree] = {}
    for i in range(choices.weighted([(3, 0), (3, 1), (2, 2), (1, 4)])):
        name = f"q{i}"
        kind = choices.pick(
            [
                CHANCE,
                integer(0, 7),
                FLAG,
                integer(-300, 300),
                *([Kind("real", -10, 10)] if manner.reals else []),
            ]
        )
        words.params[name] = kind
        value = _constant(choices, kind)
        inferred = kind == FLAG or value.endswith("%")
        section[name] = value if inferred and choices.maybe(50) else {"type": str(kind), "default": value}
    return section


def _properties(choices: Choices, words: Words) -> dict[str, Tree]:
    section: dict[str, Tree] = {}
    for i in range(choices.weighted([(3, 2), (2, 1), (2, 3), (1, 0), (1, 5)])):
        name = f"p{i}"
        kind = choices.weighted([(4, integer(0, 7)), (3, FLAG), (2, CHANCE), (2, some_range(choices))])
        words.properties[name] = kind
        if choices.maybe(30):
            section[name] = str(kind)
        else:
            section[name] = {"type": str(kind), "default": _constant(choices, kind)}
    return section


def _fields(choices: Choices, words: Words, manner: Manner) -> dict[str, Tree]:
    section: dict[str, Tree] = {}
    for i in range(choices.weighted([(3, 2), (2, 1), (3, 3), (2, 4), (1, 0), (1, 7)])):
        name = f"f{i}"
        real, vector = (
            Kind(k, -b, b)
            for k, b in (("real", choices.pick([100, 1, 1000])), ("vec2", choices.pick([100, 2])))
        )
        if choices.maybe(10):
            real = Kind("real", 0, 1)
        floats = [(3, real), (3, vector)] if manner.reals else []
        kind = choices.weighted([(4, some_range(choices)), (3, FLAG), (2, ELEMENT), (2, DIRECTION), *floats])
        words.fields[name] = kind
        entry: dict[str, Tree] = {"type": str(kind), "at": choices.pick(["element", "place"])}
        if kind == ELEMENT or choices.maybe(30 if kind.name == "vec2" else 40):
            entry["default"] = _default(choices, words, kind)
        holders = words.elements
        if entry["at"] == "element" and choices.maybe(40):
            one = choices.pick(words.elements)
            inside = choices.maybe(75)
            entry["of"] = one if inside else f"any but {one}"
            holders = [name for name in words.elements if (name == one) == inside]
        if choices.maybe(20):
            entry["resets"] = "step"
        elif entry["at"] == "element" and choices.maybe(40):
            some = choices.some(holders, 0, 3)
            entry |= {name: _default(choices, words, kind) for name in some}
        section[name] = entry
    return section


def _default(choices: Choices, words: Words, kind: Kind) -> str:
    """A field's value in fresh cells."""
    if kind == ELEMENT:
        return choices.pick(words.elements)
    if kind.name == "vec2":
        return f"vector({choices.pick(['0', '1', '-0.5'])}, {choices.pick(['0', '-2', '0.25'])})"
    return _constant(choices, kind)


def _streams(choices: Choices, words: Words, manner: Manner) -> Tree:
    count = choices.weighted([(3, 1), (2, 2), (1, 0)]) if manner.draws else 0
    for i in range(count):
        words.streams[f"r{i}"] = 32 if choices.maybe(30) else 16
    if all(bits == 16 for bits in words.streams.values()) and choices.maybe(50):
        return list(words.streams)
    return {name: {"bits": str(bits)} for name, bits in words.streams.items()}


def _kernels(choices: Choices, words: Words, manner: Manner) -> dict[str, Tree]:
    section: dict[str, Tree] = {}
    if manner.borders and choices.maybe(30):
        shape, radius = choices.pick([*KERNEL_SHAPES]), choices.pick([1, 2, 3, 5])
        kernel = shaped_kernel(shape, radius)
        words.kernels[kernel.name] = (1,) * len(kernel.weights)
    for i in range(choices.weighted([(2, 1), (2, 0 if manner.borders else 1), (1, 2)])):
        name = f"k{i}"
        if choices.maybe(25):
            shape, radius = choices.pick([*KERNEL_SHAPES]), choices.pick([1, 2, 4])
            kernel = shaped_kernel(shape, radius)
            words.kernels[name] = (1,) * len(kernel.weights)
            wraps = choices.maybe(40) or not manner.borders
            section[name] = {"shape": kernel.name, "edges": "wrap"} if wraps else kernel.name
            continue
        height, width = choices.pick([(3, 3), (1, 3), (3, 1), (1, 1), (5, 5), (1, 5), (5, 3)])
        dull = choices.maybe(50)
        weight = (0, 1) if dull else (0, 1, -1, 2, 3, -2)
        rows = [[choices.pick(weight) for _ in range(width)] for _ in range(height)]
        words.kernels[name] = tuple(w for row in rows for w in row if w)
        text: list[Tree] = [" ".join(map(str, row)) for row in rows]
        section[name] = {"rows": text, "edges": "wrap"} if choices.maybe(40) or not manner.borders else text
    return section


def _element(choices: Choices, words: Words, identity: int, tags: list[str]) -> Tree:
    entry: dict[str, Tree] = {"id": str(identity), "color": f"#{identity:02X}80{255 - identity:02X}"}
    if carried := choices.some(tags, 0, 2):
        entry["tags"] = [*carried]
    for name, kind in words.properties.items():
        if choices.maybe(60):
            alike = [
                param
                for param, k in words.params.items()
                if k.name == kind.name and kind.lo <= k.lo and k.hi <= kind.hi
            ]
            entry[name] = choices.pick(alike) if alike and choices.maybe(30) else _constant(choices, kind)
    return entry


def _sets(choices: Choices, words: Words) -> dict[str, Tree]:
    section: dict[str, Tree] = {}
    for i in range(choices.weighted([(3, 0), (2, 1), (1, 2)])):
        known = [*words.elements, *words.groups]
        first, second = choices.pick(known), choices.pick(known)
        section[f"s{i}"] = choices.pick(
            [
                f"({first}, {second})",
                f"any but {first}",
                f"{first} or {second}",
                f"any but ({first}, {second})",
                f"{first} and {second}",
                "any",
            ]
        )
        words.groups.append(f"s{i}")
    return section


def some_range(choices: Choices) -> Kind:
    """A range of integers."""
    return integer(*choices.pick(RANGES))


def _constant(choices: Choices, kind: Kind) -> str:
    """A literal of a kind, extremes included."""
    match kind.name:
        case "flag":
            return choices.pick(["no", "yes"])
        case "chance":
            return choices.pick(CHANCES)
        case "int":
            lo, hi = int(kind.lo), int(kind.hi)
            return str(choices.pick([min(max(0, lo), hi), lo, hi, choices.integer(lo, hi)]))
        case "real":
            options = [
                text
                for text in ("0", "0.5", "1", "-1", "0.1", "-0.75", "9")
                if kind.lo <= float(text) <= kind.hi
            ]
            return choices.pick(options)
    return choices.pick(["right", "above", "left", "below.left"])
