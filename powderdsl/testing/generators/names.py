"""Names for random expressions: neighbors, elements, fields, parameters, kernels, and what loops and `let` bind."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from powderdsl.model.types import Kind
from powderdsl.testing.generators.choices import Choices
from powderdsl.testing.generators.vocabulary import Manner, Words

PLACES = ("below", "left", "above", "right", "below.right", "above.left", "at(0, 2)", "at(-2, 1)", "at(3, 0)", "at(-7, -15)")  # fmt: skip
SIDES = ("below", "left", "above", "right", "below.left", "above.right")
"""Places that are directions too."""

PLACE, SIDE, ONE, NUMBER = Kind("place"), Kind("side"), Kind("one"), Kind("number", 0, 2)
"""Kinds of loop variables: a neighbor, one of the eight next to a cell, an element's name, a number."""


@dataclass(frozen=True)
class Names:
    """Chooses among words and local names."""

    choices: Choices
    words: Words
    manner: Manner
    locals: dict[str, Kind]
    scratch: dict[str, Kind]
    """Fields of the pass; they are locals of their own kind too."""

    def bind(self, **names: Kind) -> Self:
        """The same with more local names."""
        return replace(self, locals={**self.locals, **names})

    def pick(self, *options: str) -> str:
        return self.choices.pick(options)

    def place(self) -> str:
        """A neighbor."""
        loops = self.sides()
        if loops and self.choices.maybe(60):
            side = self.choices.pick(loops)
            return self.choices.weighted(
                [(6, side), (1, f"opposite({side})"), (1, f"below.{side}"), (1, f"{side}.left")]
            )
        return self.pick(*PLACES)

    def local(self, *kinds: str) -> list[str]:
        """Local names of some kinds."""
        return [name for name, kind in self.locals.items() if kind.name in kinds]

    def sides(self) -> list[str]:
        """Loop variables that are neighbors."""
        return self.local("place", "side")

    def lets(self, kind: str) -> list[str]:
        """Values of a kind that were fixed earlier."""
        return [name for name in self.local(kind) if name not in self.scratch]

    def _seen(self, name: str) -> str:
        """A value, here or at a neighbor."""
        if not self.choices.maybe(35):
            return name
        return f"{self.place()}.{name}" + ("?" if self.choices.maybe(10) else "")

    def _named(self, kind: str) -> str | None:
        """A field, property, let or scratch field of a kind, here or at a neighbor."""
        names = [*self.words.of_kind(kind), *self.local(kind)]
        return self._seen(self.choices.pick(names)) if names else None

    def _param(self, kind: str) -> str | None:
        names = [name for name, k in self.words.params.items() if k.name == kind]
        return self.choices.pick(names) if names else None

    def group(self) -> str:
        """A set of elements."""
        names = [*self.words.elements, *self.words.groups, *self.local("one")]
        one, other = self.pick(*names), self.pick(*names)
        return self.choices.weighted(
            [
                (8, one),
                (2, f"(any but {one})"),
                (2, f"({one}, {other})"),
                (1, f"({one} or {other})"),
                (1, "any"),
                (1, f"({one}, missing?)"),
            ]
        )

    def _kernel(self) -> tuple[str, tuple[int, ...]]:
        """` in KERNEL`, or nothing for the default one; and its weights."""
        kernels = self.words.kernels
        name = self.choices.pick([None, *kernels] if self.manner.borders else [*kernels])
        return f" in {name}" if name else "", kernels[name or "box"]

    def domain(self) -> tuple[Kind, str]:
        """A domain for a loop: the kind of its variable, and the text."""
        elements = self.words.elements
        groups = [*self.words.groups, f"({self.pick(*elements)}, {self.pick(*elements)})"]
        sides = self.pick("(left, right)", "sides", "diagonals", "(below, above.left)", "octants")
        numbers = self.pick("0..2", "0..1")
        return self.choices.weighted(
            [
                (4, (SIDE, sides)),
                (3, (NUMBER, numbers)),
                (2, (ONE, self.pick(*groups))),
                (1, (PLACE, "(at(0, 2), at(-3, 1))")),
            ]
        )
