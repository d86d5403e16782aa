"""A piece of the line language, and the small sets that random expressions choose from."""

from __future__ import annotations

from dataclasses import dataclass

from powderdsl.model.builtins import MAX_MAGNITUDE
from powderdsl.model.types import Kind

PLACES = (
    "below",
    "left",
    "above",
    "right",
    "below.right",
    "above.left",
    "at(0, 2)",
    "at(-2, 1)",
    "at(3, 0)",
    "at(-7, -15)",
)
SIDES = ("below", "left", "above", "right", "below.left", "above.right")
"""Places that are directions too."""

PLACE, SIDE, ONE, NUMBER = Kind("place"), Kind("side"), Kind("one"), Kind("number", 0, 2)
"""Kinds of loop variables: a neighbor, one of the eight next to a cell, an element's name, a number."""

LIMIT = MAX_MAGNITUDE // 2


@dataclass(frozen=True)
class Phrase:
    """Text that stands as an operand anywhere. Whole numbers have bounds; `fixed`: it may be folded to a number."""

    text: str
    lo: float = 0
    hi: float = 0
    fixed: bool = False
