"""Rules that one variable keeps apart: most pairs of a long list are, and need no search."""

from __future__ import annotations

from collections.abc import Sequence

from powderdsl.model.logic.satisfy import Facts, alone
from powderdsl.model.types import Expr, Offset

GLANCE = 3
"""What a comparison of two rules costs, in nodes."""


class Glances:
    """What conditions of a substep's rules ask of single variables: elements, fields and counts at places."""

    def __init__(self, masks: Sequence[Expr], facts: Facts, lets: dict[str, Expr]):
        self._facts = facts
        numbers: dict[tuple[str, object], int] = {}
        self._asked: dict[int, dict[tuple[int, int, int], frozenset[object]]] = {}
        for mask in masks:
            self._asked[id(mask)] = {
                (numbers.setdefault((what, name), len(numbers)), *at): values
                for (what, name, at), values in alone(facts, mask, lets).items()
            }

    def apart(self, first: Expr, second: Expr, at: Offset) -> bool:
        """Whether some variable cannot be as the first condition and, `at` away from it, the second ask for."""
        self._facts.budget.left -= GLANCE
        asked = self._asked[id(first)]
        for (number, row, column), values in self._asked[id(second)].items():
            known = asked.get((number, row + at[0], column + at[1]))
            if known is not None and known.isdisjoint(values):
                return True
        return False
