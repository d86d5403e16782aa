"""Mistakes put into the shipped packs are noticed: most by `check`, the others by tests and invariants."""

from __future__ import annotations

from pathlib import Path
from statistics import median

import pytest

from tests.semantics.mutations import Caught, Mutation, mutations, try_mutation

ALL = mutations()
SECONDS = 30.0
CAUGHT: dict[str, Caught] = {}


def named(found: list[Mutation]) -> list:  # type: ignore[type-arg]
    return [pytest.param(one, id=f"{one.pack}: {one.mistake}") for one in found]


@pytest.mark.parametrize("mutation", named([one for one in ALL if one.check]))
def test_the_checker_notices(mutation: Mutation, tmp_path: Path) -> None:
    assert mutation.check in try_mutation(mutation, tmp_path).codes


@pytest.mark.slow
@pytest.mark.parametrize("mutation", named([one for one in ALL if one.test]))
def test_worlds_show(mutation: Mutation, tmp_path: Path) -> None:
    caught = try_mutation(mutation, tmp_path)
    CAUGHT[mutation.mistake] = caught
    assert not caught.codes
    assert any(item.startswith(mutation.test) for item in caught.items), caught.items


@pytest.mark.slow
def test_counterexamples_are_small() -> None:
    sizes = [size for caught in CAUGHT.values() for size in caught.sizes]
    if not sizes:
        pytest.skip("the tests before this one did not run here")
    rows, columns, steps = (median(numbers) for numbers in zip(*sizes, strict=True))
    assert rows <= 3
    assert columns <= 3
    assert steps <= 2


def test_there_are_enough_of_them() -> None:
    assert len(ALL) >= 30
    assert len({(one.pack, one.before, one.after) for one in ALL}) == len(ALL)
    assert len({one.pack for one in ALL}) >= 15
