"""Hypothesis strategies for start worlds. Hypothesis shrinks the examples that fail."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from hypothesis import strategies as st

from powderdsl.compiler import load
from powderdsl.model.types import Ruleset
from powderdsl.testing.generators.cases import Choices, Start, random_start

T = TypeVar("T")


def worlds(
    rules: Ruleset | str, max_batch: int = 3, max_side: int = 65, shape: tuple[int, int, int] | None = None
) -> st.SearchStrategy[Start]:
    """Return a strategy for start worlds of a ruleset: any ids, fields and parameters it allows, in odd shapes.

    Args:
        rules: a checked model, or a name for `powderdsl.load`.
        max_batch: the maximum number of worlds.
        max_side: the maximum number of rows and of columns.
        shape: (worlds, rows, columns); drawn by default.
    """
    ruleset = load(rules) if isinstance(rules, str) else rules
    return chosen(lambda choices: random_start(ruleset, choices, shape, max_batch, max_side))


def chosen(make: Callable[[Choices], T]) -> st.SearchStrategy[T]:
    """Return a strategy for the values that `make` builds from choices; plain options come first, for shrinking."""

    @st.composite
    def strategy(draw: st.DrawFn) -> T:
        return make(Choices(lambda count: draw(st.integers(0, count - 1)) if count > 1 else 0))

    return strategy()
