"""Random divisions of whole numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from powderdsl.testing.generators.phrase import Phrase

if TYPE_CHECKING:
    from powderdsl.testing.generators.phrases import Phrases


def modulo(phrases: Phrases, depth: int) -> Phrase:
    choices = phrases.choices
    modulus = choices.pick([2, 3, 1, 4, 7, 64])
    step, column = ("step", "column") if phrases.manner.borders else ("step", "step")
    inner = (
        choices.pick(["row", "column", "step", "(row + step)", "(column - row)"])
        if phrases.manner.borders
        else "step"
    )
    if choices.maybe(50):
        value = phrases.whole(depth - 1)
        if not value.fixed:
            inner = (
                value.text
                if choices.maybe(60)
                else f"({value.text} {choices.pick('+-')} {choices.pick([step, column])})"
            )
    return Phrase(f"({inner} mod {modulus})", 0, modulus - 1)


def quotient(phrases: Phrases, depth: int) -> Phrase | None:
    """A whole division, by constants of both signs or by what may be 0."""
    choices = phrases.choices
    if phrases.manner.borders and choices.maybe(15):
        inner = choices.pick(["row", "(column + step)", "(row - 1)"])
        return Phrase(f"({inner} div {choices.pick([1, 2, 3, 5])} mod {choices.pick([2, 3])})", 0, 2)
    value = phrases.whole(depth - 1)
    if value.fixed:
        return None
    if choices.maybe(60):
        by = choices.pick([2, 3, -2, 8, 1, -1, 7, -5, 64, 100, -64])
        ends = [value.lo // by, value.hi // by]
        return Phrase(f"({value.text} div {by})", min(ends), max(ends))
    divisor = phrases.whole(depth - 1)
    if divisor.fixed:
        return None
    reach = max(abs(value.lo), abs(value.hi))
    return Phrase(f"({value.text} div {divisor.text})", -reach, reach)
