"""What a ruleset asks of the sizes of its worlds."""

from __future__ import annotations

from powderdsl.model.types import Ruleset


def fits(ruleset: Ruleset, size: tuple[int, ...]) -> bool:
    """Whether worlds of this many rows and columns may follow these rules."""
    return all(side % ruleset.side_multiple == 0 for side in size[-2:])


def check_sides(ruleset: Ruleset, size: tuple[int, int]) -> None:
    """Raises ValueError for a size that does not fit."""
    if not fits(ruleset, size):
        raise ValueError(size_problem(ruleset, size))


def size_problem(ruleset: Ruleset, size: tuple[int, ...]) -> str:
    """What is wrong with a size that does not fit."""
    asked = f"a multiple of {ruleset.side_multiple}"
    return (
        f"a world of {size[-2]}×{size[-1]} cells: with {ruleset.name}, rows and columns must be {asked} each"
    )


def fitting(ruleset: Ruleset, side: int) -> int:
    """The smallest side, not smaller than this one, that fits."""
    return -(-side // ruleset.side_multiple) * ruleset.side_multiple
