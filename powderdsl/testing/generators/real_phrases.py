"""Random expressions that are float32 numbers and vectors."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from powderdsl.testing.generators.phrase import Phrase

if TYPE_CHECKING:
    from powderdsl.testing.generators.phrases import Phrases


def real(phrases: Phrases, depth: int) -> Phrase:
    leaves = [
        (3, partial(_decimal, phrases)),
        (4, partial(_real_name, phrases)),
        (1, partial(_real_param, phrases)),
    ]
    trees = [
        (4, partial(_real_arithmetic, phrases)), (2, partial(_divide, phrases)), (2, partial(_real_unary, phrases)), (2, partial(_real_extreme, phrases)), (2, partial(_part, phrases)),
        (1, partial(_length, phrases)), (1, partial(_real_sum, phrases)), (1, partial(_choose_real, phrases)), (1, partial(_scaled_draw, phrases)),
    ]  # fmt: skip
    return phrases._one(leaves + (trees if depth > 0 else []), depth)


def _decimal(phrases: Phrases, depth: int) -> Phrase:
    return Phrase(
        phrases.choices.pick(
            ["0.5", "0.1", "1.5", "-0.25", "0.95", "3.3", "-7.125", "0.0001", "1e-7", "1000.5"]
        ),
        fixed=True,
    )


def _real_name(phrases: Phrases, depth: int) -> Phrase | None:
    name = phrases._named("real")
    return None if name is None else Phrase(name)


def _real_param(phrases: Phrases, depth: int) -> Phrase | None:
    name = phrases._param("real")
    return None if name is None else Phrase(name)


def _real_arithmetic(phrases: Phrases, depth: int) -> Phrase | None:
    a, b = (
        real(phrases, depth - 1),
        phrases.choices.weighted([(3, phrases.real), (1, phrases.whole)])(depth - 1),
    )
    if a.fixed and b.fixed:
        return None
    first, second = (a, b) if phrases.choices.maybe(70) else (b, a)
    return Phrase(f"({first.text} {phrases.choices.pick('+-*')} {second.text})")


def _vary(phrases: Phrases, phrase: Phrase) -> str:
    """A real that is no constant: constants would have to be whole here."""
    return f"(0.5 * length(vector({phrase.text}, {phrase.text})))" if phrase.fixed else phrase.text


def _divide(phrases: Phrases, depth: int) -> Phrase | None:
    a, b = (phrases.choices.weighted([(2, phrases.real), (1, phrases.whole)])(depth - 1) for _ in range(2))
    if a.fixed and b.fixed:
        return None
    divisor = phrases.choices.pick(["2", "3", "18", "0.3"]) if b.fixed else b.text
    return Phrase(f"({a.text} / {divisor})", fixed=a.fixed and b.fixed)


def _real_unary(phrases: Phrases, depth: int) -> Phrase:
    value = real(phrases, depth - 1)
    return Phrase(phrases.choices.pick([f"abs({value.text})", f"(-{value.text})"]), fixed=value.fixed)


def _real_extreme(phrases: Phrases, depth: int) -> Phrase:
    a, b = (
        real(phrases, depth - 1),
        phrases.choices.weighted([(2, phrases.real), (1, phrases.whole)])(depth - 1),
    )
    return Phrase(f"{phrases.choices.pick(['min', 'max'])}({a.text}, {b.text})", fixed=a.fixed and b.fixed)


def _part(phrases: Phrases, depth: int) -> Phrase | None:
    if not phrases.words.of_kind("vec2") and phrases.choices.maybe(50):
        return None
    return Phrase(f"{vector(phrases, depth - 1).text}.{phrases.choices.pick(['row', 'column'])}")


def _length(phrases: Phrases, depth: int) -> Phrase:
    return Phrase(f"length({vector(phrases, depth - 1).text})")


def _real_sum(phrases: Phrases, depth: int) -> Phrase:
    kernel = phrases.kernel()
    return Phrase(f"sum({real(phrases, depth - 1).text}{f' in {kernel}' if kernel else ''})")


def _choose_real(phrases: Phrases, depth: int) -> Phrase:
    a, b = (
        real(phrases, depth - 1),
        phrases.choices.weighted([(3, phrases.real), (1, phrases.whole)])(depth - 1),
    )
    return Phrase(
        f"({a.text} if {phrases.flag(depth - 1, bare=True).text} else {b.text})", fixed=a.fixed or b.fixed
    )


def _scaled_draw(phrases: Phrases, depth: int) -> Phrase | None:
    if not phrases.words.streams:
        return None
    if phrases.choices.maybe(30):
        return Phrase(
            f"({phrases.draw(depth - 1).text} {phrases.choices.pick('+-')} {_vary(phrases, real(phrases, depth - 1))})"
        )
    return Phrase(
        f"({phrases.draw(depth - 1).text} {phrases.choices.pick('*/')} {phrases.choices.pick(['0.7', '2.5', '0.001'])})"
    )


def vector(phrases: Phrases, depth: int) -> Phrase:
    leaves = [(6, partial(_vector_name, phrases)), (2, partial(_pair, phrases))]
    trees = [
        (3, partial(_vector_sum, phrases)),
        (3, partial(_scaled, phrases)),
        (1, partial(_opposed, phrases)),
        (2, partial(_spread, phrases)),
        (1, partial(_choose_vector, phrases)),
    ]
    return phrases._one(leaves + (trees if depth > 0 else []), depth)


def _vector_name(phrases: Phrases, depth: int) -> Phrase | None:
    name = phrases._named("vec2")
    return None if name is None else Phrase(name)


def _pair(phrases: Phrases, depth: int) -> Phrase:
    parts = [
        phrases.choices.weighted([(2, phrases.real), (2, phrases.whole), (1, phrases.flag)])(depth - 1).text
        for _ in range(2)
    ]
    return Phrase(f"vector({parts[0]}, {parts[1]})")


def _vector_sum(phrases: Phrases, depth: int) -> Phrase:
    return Phrase(
        f"({vector(phrases, depth - 1).text} {phrases.choices.pick('+-')} {vector(phrases, depth - 1).text})"
    )


def _scaled(phrases: Phrases, depth: int) -> Phrase:
    arrow, factor = (
        vector(phrases, depth - 1),
        phrases.choices.weighted([(2, phrases.real), (1, phrases.whole)])(depth - 1),
    )
    text = phrases.choices.pick(["2", "0.5", "3"]) if factor.fixed else factor.text
    return Phrase(
        phrases.choices.pick(
            [f"({arrow.text} * {text})", f"({text} * {arrow.text})", f"({arrow.text} / {text})"]
        )
    )


def _opposed(phrases: Phrases, depth: int) -> Phrase:
    return Phrase(f"(-{vector(phrases, depth - 1).text})")


def _spread(phrases: Phrases, depth: int) -> Phrase:
    kernel = phrases.kernel()
    return Phrase(f"sum({vector(phrases, depth - 1).text}{f' in {kernel}' if kernel else ''})")


def _choose_vector(phrases: Phrases, depth: int) -> Phrase:
    return Phrase(
        f"({vector(phrases, depth - 1).text} if {phrases.flag(depth - 1, bare=True).text} else {vector(phrases, depth - 1).text})"
    )
