"""Decisions behind random rulesets and worlds: from a seed, or from Hypothesis, which can shrink them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from random import Random
from typing import TypeVar

T = TypeVar("T")


class Choices:
    """Decisions, all made of one: `below(n)`, an integer of 0..n-1. Plain options stand first, at 0."""

    def __init__(self, below: Callable[[int], int]):
        self.below = below

    @classmethod
    def seeded(cls, seed: int) -> Choices:
        """The same decisions for the same seed, on every machine."""
        return cls(Random(seed).randrange)

    def pick(self, options: Sequence[T]) -> T:
        return options[self.below(len(options))]

    def integer(self, lo: int, hi: int) -> int:
        """An integer of lo..hi."""
        return lo + self.below(hi - lo + 1)

    def maybe(self, percent: int) -> bool:
        """True in `percent` cases of a hundred; False is the plain option."""
        return self.below(100) >= 100 - percent

    def some(self, options: Sequence[T], least: int, most: int) -> list[T]:
        """From `least` to `most` different options, in their order."""
        most = min(most, len(options))
        wanted = self.integer(min(least, most), most)
        picked: list[T] = []
        for i, option in enumerate(options):
            left = len(options) - i
            if self.below(left) < wanted - len(picked):
                picked.append(option)
        return picked

    def weighted(self, rows: Sequence[tuple[int, T]]) -> T:
        """One of the options, each as likely as its weight says."""
        number = self.below(sum(weight for weight, _ in rows))
        for weight, option in rows:
            if number < weight:
                return option
            number -= weight
        raise AssertionError("weights must not be negative")
