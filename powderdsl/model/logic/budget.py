"""How much work questions about rules may take: counted in nodes, so that it is the same on every machine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

BUDGET = 500_000
"""Nodes evaluated in a group of questions: half a second. The largest shipped ruleset needs a twentieth of it."""

MAX_QUESTION = 100_000
"""Nodes evaluated for one question. A harder one stays undecided, and the others keep their share."""

QUESTION = 60
"""What a question costs besides its evaluations."""


class Exhausted(Exception):
    """The question takes too much work: the answer is that it could not be told."""


@dataclass
class Budget:
    """Work that is left for some questions, counted in nodes. It depends on what is asked, never on time or order."""

    left: int = BUDGET
    most: int = MAX_QUESTION
    """For one question."""

    def spend(self, nodes: int) -> None:
        self.left -= nodes
        if self.left < 0:
            raise Exhausted

    @property
    def is_exhausted(self) -> bool:
        return self.left < 0

    @contextmanager
    def question(self, most: int | None = None) -> Iterator[None]:
        """Spend at most this much within. What one question may not spend is left for the next."""
        reserve = max(self.left - (most or self.most), 0)
        self.left -= reserve
        try:
            yield
        finally:
            if reserve:
                self.left = max(self.left, 0) + reserve
