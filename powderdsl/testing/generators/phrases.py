"""Random phrases: one walk through the grammar, whose names are those that a ruleset and its loops declare."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from powderdsl.model.builtins import MAX_MAGNITUDE
from powderdsl.testing.generators.choices import Choices
from powderdsl.testing.generators.grammar import Production, Productions, named

LIMIT = MAX_MAGNITUDE // 2
"""Largest magnitude of an integer expression."""

LOOP_NAMES = {
    "side": ("loop side", "loop place"),
    "place": ("loop place",),
    "element": ("loop element", "element word"),
    "number": ("loop number",),
}
"""The kinds of phrases that a loop variable is, by what the loop is over."""


@dataclass(frozen=True)
class Phrase:
    """A text; of an integer, its largest magnitude too."""

    text: str
    reach: float = 0


Maker = Callable[["Phrases", int], "Phrase | None"]
"""Makes a phrase that no text describes, from the phrases that are known and the depth that is left."""


@dataclass(frozen=True)
class Phrases:
    """Draws phrases by the grammar and by makers of single kinds."""

    choices: Choices
    grammar: Mapping[str, Productions]
    makers: Mapping[str, Maker]
    loops: int = 0

    def bound(self, name: str, *kinds: str, reach: float = 0) -> Phrases:
        """The same with a name that is a phrase of some kinds."""
        more = {kind: (*self.grammar.get(kind, ()), named(name, reach)) for kind in kinds}
        return replace(self, grammar={**self.grammar, **more})

    def looping(self, name: str) -> tuple[str, Phrases]:
        """A loop, `name in DOMAIN`, and what is known inside."""
        over = self.text("loop", 0)
        inside = self.bound(name, *LOOP_NAMES[over], reach=2)
        return f"{name} in {self.text(f'loop over {over}', 0)}", replace(inside, loops=self.loops + 1)

    def text(self, kind: str, depth: int) -> str:
        """A phrase of a kind that can always be drawn."""
        phrase = self.draw(kind, depth)
        assert phrase is not None, kind
        return phrase.text

    def draw(self, kind: str, depth: int) -> Phrase | None:
        """A phrase of a kind that nests at most this deep; None if there is none."""
        if kind in self.makers:
            return self.makers[kind](self, depth)
        rows = [row for row in self.grammar.get(kind, ()) if depth > 0 or not row.nests]
        while rows:
            row = self.choices.weighted([(row.weight, row) for row in rows])
            phrase = self.filled(row, depth - row.nests)
            if phrase is not None and phrase.reach <= LIMIT:
                return phrase
            rows.remove(row)
        return None

    def filled(self, row: Production, depth: int) -> Phrase | None:
        """A production with its parts drawn; None if one of them cannot be."""
        (text, *literals), parts = row.pieces
        repeated: dict[str, str] = {}
        reaches: list[float] = []
        for (name, kind), literal in zip(parts, literals, strict=True):
            if kind in repeated:
                text += repeated[kind] + literal
                continue
            part = self._another(repeated) if kind == "another element" else self.draw(kind, depth)
            if part is None:
                return None
            if name:
                repeated[name] = part.text
            reaches.append(part.reach)
            text += part.text + literal
        return Phrase(text, row.reach(reaches))

    def _another(self, taken: Mapping[str, str]) -> Phrase | None:
        """An element that is none of those that the phrase repeats."""
        names = [row.text for row in self.grammar["known element"] if row.text not in taken.values()]
        return Phrase(self.choices.pick(names)) if names else None


def flag_of_a_loop(phrases: Phrases, depth: int) -> Phrase:
    """A condition for each value of a variable, inside `any` or `all`."""
    loop, inside = phrases.looping(f"w{phrases.loops}")
    return Phrase(f"{inside.text('flag', depth)} for {loop}")
