"""Random declarations of a rule file: elements, tags, sets, properties, fields, streams, parameters, kernels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from powderdsl.model.builtins import KERNEL_SHAPES, KERNELS, shaped_kernel
from powderdsl.model.types import CHANCE, DIRECTION, ELEMENT, FLAG, Kind, integer
from powderdsl.testing.generators.choices import Choices
from powderdsl.testing.generators.phrases import Phrases
from powderdsl.testing.generators.trees import Tree

RANGES = (
    (0, 1), (0, 3), (-2, 2), (0, 7), (-1, 1), (0, 0), (-5, -2), (3, 9), (-128, 127), (0, 127), (-129, 5), (0, 128),
    (0, 255), (0, 256), (-32768, 32767), (0, 65535), (-100000, 100000),
)  # fmt: skip
"""Ranges of integers: small ones that saturate, and the borders of storage types and of the checker's search."""

REALS = ("0", "0.5", "1", "-1", "0.1", "-0.75", "9")
"""Floats as they are written in declarations, if the range allows."""


@dataclass(frozen=True)
class Manner:
    """Features of a random ruleset. Tests of single properties leave out what would break the property."""

    draws: bool = True
    """Streams of random numbers, and chances."""
    borders: bool = True
    """Anything that knows where the grid ends: `row`, `column`, `inside`, kernels that do not wrap."""
    symmetry: bool = True
    overwrites: bool = True
    """Blocks whose moves may overwrite each other, so that cells get lost or doubled."""
    forms: tuple[str, ...] = ("transform", "swap", "move", "assign", "push")


@dataclass
class Vocabulary:
    """Draws declarations. Their names become phrases; those of values are kept with their kinds."""

    choices: Choices
    manner: Manner
    phrases: Phrases
    elements: list[str] = field(default_factory=list)
    ids: list[int] = field(default_factory=list)
    properties: dict[str, Kind] = field(default_factory=dict)
    fields: dict[str, Kind] = field(default_factory=dict)
    params: dict[str, Kind] = field(default_factory=dict)

    def sections(self) -> dict[str, Tree]:
        """The declarations as sections of a rule file; those without entries are left out."""
        choices = self.choices
        last = -1
        for i in range(choices.weighted([(2, 1), (4, 2), (3, 3), (3, 4), (1, 6), (1, 9)])):
            self.elements.append(f"e{i}")
            last += choices.weighted([(12, 1), (2, 2), (1, 5)])
            self.ids.append(last)
            self._bind(f"e{i}", "known element", "element word")
        if choices.maybe(3):
            self.ids[-1] = 255
        tags = [f"t{i}" for i in range(choices.integer(0, 2))]
        for tag in tags:
            self._bind(tag, "set name")
        sections: dict[str, Tree] = {
            "params": {f"q{i}": self._param(f"q{i}") for i in self._numbers(3, 3, 2, 0, 1)},
            "properties": {f"p{i}": self._property(f"p{i}") for i in self._numbers(1, 2, 3, 2, 0, 1)},
            "fields": {f"f{i}": self._field(f"f{i}") for i in self._numbers(1, 2, 3, 3, 2, 0, 0, 1)},
            "streams": self._streams(),
            "kernels": {f"k{i}": self._kernel(f"k{i}") for i in self._numbers(1, 2, 1)},
            "tags": dict.fromkeys(tags, "a tag"),
            "elements": {
                name: self._element(identity, tags)
                for name, identity in zip(self.elements, self.ids, strict=True)
            },
            "sets": {f"s{i}": self._set(f"s{i}") for i in self._numbers(3, 2, 1)},
        }
        if self.manner.borders:  # kernels that every rule file knows do not wrap
            wide = shaped_kernel(choices.pick([*KERNEL_SHAPES]), choices.pick([1, 2, 3, 5]))
            for kernel in (*KERNELS.values(), wide):
                self._bind(f" in {kernel.name}", "kernel", reach=len(kernel.weights))
        return {name: tree for name, tree in sections.items() if tree}

    def _numbers(self, *weights: int) -> range:
        """Numbers of some declarations: how many there are is as likely as its weight, from 0 on."""
        return range(self.choices.weighted([(weight, count) for count, weight in enumerate(weights)]))

    def _bind(self, name: str, *kinds: str, reach: float = 0) -> None:
        self.phrases = self.phrases.bound(name, *kinds, reach=reach)

    def _param(self, name: str) -> Tree:
        choices = self.choices
        kind = choices.pick([CHANCE, integer(0, 7), FLAG, integer(-300, 300), Kind("real", -10, 10)])
        self.params[name] = kind
        self._bind(name, f"{kind.name} param", reach=kind.reach)
        value = self._literal(kind)
        is_inferred = kind == FLAG or value.endswith("%")
        return value if is_inferred and choices.maybe(50) else {"type": str(kind), "default": value}

    def _property(self, name: str) -> Tree:
        choices = self.choices
        kind = choices.weighted([(4, integer(0, 7)), (3, FLAG), (2, CHANCE), (2, some_range(choices))])
        self.properties[name] = kind
        self._bind(name, f"{kind.name} property", f"{kind.name} name", reach=kind.reach)
        return str(kind) if choices.maybe(30) else {"type": str(kind), "default": self._literal(kind)}

    def _field(self, name: str) -> Tree:
        choices = self.choices
        bound = choices.pick([100, 1, 1000, 2])
        floats = [(3, Kind("real", choices.pick([-bound, 0]), bound)), (3, Kind("vec2", -bound, bound))]
        kind = choices.weighted([(4, some_range(choices)), (3, FLAG), (2, ELEMENT), (2, DIRECTION), *floats])
        self.fields[name] = kind
        self._bind(name, f"{kind.name} field", f"{kind.name} name", reach=kind.reach)
        entry: dict[str, Tree] = {"type": str(kind), "at": choices.pick(["element", "place"])}
        if kind == ELEMENT or choices.maybe(40):
            entry["default"] = self._literal(kind)
        holders = self.elements
        if entry["at"] == "element" and choices.maybe(40):
            element = choices.pick(self.elements)
            is_holder = choices.maybe(75)
            entry["of"] = element if is_holder else f"any but {element}"
            holders = [name for name in self.elements if (name == element) == is_holder]
        if choices.maybe(20):
            entry["resets"] = "step"
        elif entry["at"] == "element" and choices.maybe(40):
            entry |= {name: self._literal(kind) for name in choices.some(holders, 0, 3)}
        return entry

    def _streams(self) -> Tree:
        names = [f"r{i}" for i in self._numbers(1, 3, 2)] if self.manner.draws else []
        for name in names:
            self._bind(name, "stream name")
        return (
            [*names]
            if self.choices.maybe(30)
            else {name: {"bits": self.choices.pick(["16", "32"])} for name in names}
        )

    def _kernel(self, name: str) -> Tree:
        choices = self.choices
        wraps = choices.maybe(40) or not self.manner.borders
        if choices.maybe(25):
            kernel = shaped_kernel(choices.pick([*KERNEL_SHAPES]), choices.pick([1, 2, 4]))
            self._bind(f" in {name}", "kernel", reach=len(kernel.weights))
            return {"shape": kernel.name, "edges": "wrap"} if wraps else kernel.name
        height, width = choices.pick([(3, 3), (1, 3), (3, 1), (1, 1), (5, 5), (1, 5), (5, 3)])
        weights = choices.pick([(0, 1), (0, 1, -1, 2, 3, -2)])
        rows = [[choices.pick(weights) for _ in range(width)] for _ in range(height)]
        self._bind(f" in {name}", "kernel", reach=sum(abs(weight) for row in rows for weight in row))
        text: list[Tree] = [" ".join(map(str, row)) for row in rows]
        return {"rows": text, "edges": "wrap"} if wraps else text

    def _element(self, identity: int, tags: Sequence[str]) -> Tree:
        choices = self.choices
        entry: dict[str, Tree] = {"id": str(identity), "color": f"#{identity:02X}80{255 - identity:02X}"}
        if carried := choices.some(tags, 0, 2):
            entry["tags"] = [*carried]
        for name, kind in self.properties.items():
            if choices.maybe(60):
                params = [param for param, other in self.params.items() if other == kind]
                entry[name] = choices.pick(params) if params and choices.maybe(30) else self._literal(kind)
        return entry

    def _set(self, name: str) -> Tree:
        text = self.phrases.text("declared set", 0)
        self._bind(name, "set name")
        return text

    def _literal(self, kind: Kind) -> str:
        """A literal of a kind, extremes included."""
        choices = self.choices
        if kind.name == "int":
            lo, hi = int(kind.lo), int(kind.hi)
            return str(choices.pick([min(max(0, lo), hi), lo, hi, choices.integer(lo, hi)]))
        if kind.name == "real":
            return choices.pick([text for text in REALS if kind.lo <= float(text) <= kind.hi])
        return self.phrases.text(f"{kind.name} literal", 0)


def some_range(choices: Choices) -> Kind:
    """A range of integers."""
    return integer(*choices.pick(RANGES))
