"""The grammar of random rules keeps up with the language."""

from __future__ import annotations

from powderdsl.model.operations import FUNCTIONS
from tests.fuzz.grammar import EXPRESSIONS, WORDS


def test_random_rules_call_every_function() -> None:
    texts = [row.text for rows in (*EXPRESSIONS.values(), *WORDS.values()) for row in rows]
    assert all(any(text == name or f"{name}(" in text for text in texts) for name in FUNCTIONS)
