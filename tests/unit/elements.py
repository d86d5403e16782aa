"""The elements of the paper's world as plain data, for tests that need elements and no rules."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Element:
    """As much of an element as drawing and reading worlds needs."""

    name: str
    pack: str
    id: int
    color: str
    glyph: str
    ramp: None = None

    @property
    def qualified(self) -> str:
        return f"{self.pack}.{self.name}"


_ROWS = (
    ("empty", "ECF0F1", "."),
    ("wall", "6C7A89", "#"),
    ("sand", "F3C23A", "s"),
    ("water", "4B77BE", "~"),
    ("gas", "875F9A", "g"),
    ("wood", "CA6924", "w"),
    ("ice", "89C4F4", "i"),
    ("fire", "F9680E", "f"),
    ("plant", "26C281", "p"),
    ("stone", "264348", "o"),
    ("lava", "9D2933", "l"),
    ("acid", "B0CF78", "a"),
    ("dust", "FFB3A7", "d"),
    ("cloner", "BF55EC", "%"),
)

ELEMENTS = tuple(
    Element(name=name, pack="core", id=number, color=f"#{color}", glyph=glyph)
    for number, (name, color, glyph) in enumerate(_ROWS)
)
ID = {element.name: element.id for element in ELEMENTS}


@dataclass(frozen=True)
class Rules:
    """As much of a ruleset as worlds need."""

    elements: tuple[Element, ...] = ELEMENTS
    properties: tuple[()] = ()
    fields: tuple[()] = ()
    order: tuple[()] = ()


RULES = Rules()
