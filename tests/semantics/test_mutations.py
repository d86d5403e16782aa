"""Mistakes put into the shipped packs are noticed: most by `check`, the others by tests and invariants."""

from __future__ import annotations

from pathlib import Path

import pytest

import powderdsl
from tests.semantics.mutations import Mutation, mutations, try_mutation

ALL = mutations()
MAX_CELLS, MAX_STEPS = 9, 2
"""How large a world that shows a mistake may be."""


def named(rows: list[Mutation]) -> list:  # type: ignore[type-arg]
    """Parameters: all mistakes in `make test-all`, and those in one pack in `make test`."""
    return [
        pytest.param(
            row, id=f"{row.pack}: {row.mistake}", marks=[] if row.pack == "water" else pytest.mark.slow
        )
        for row in rows
    ]


@pytest.mark.parametrize("mutation", named([row for row in ALL if row.check]))
def test_the_checker_notices(mutation: Mutation, tmp_path: Path) -> None:
    caught = try_mutation(mutation, tmp_path)
    assert mutation.check.partition(":")[0] in caught.codes
    if caught.size is not None:
        rows, columns, steps = caught.size
        assert rows * columns <= MAX_CELLS
        assert steps <= MAX_STEPS


@pytest.mark.parametrize("mutation", named([row for row in ALL if row.test]))
def test_worlds_show(mutation: Mutation, tmp_path: Path) -> None:
    caught = try_mutation(mutation, tmp_path)
    assert caught.codes == ()
    assert any(name.startswith(mutation.test) for name in caught.tests)


def test_there_are_enough_of_them() -> None:
    assert len(ALL) >= 30
    assert len({(one.pack, one.before, one.after) for one in ALL}) == len(ALL)
    assert {one.pack for one in ALL} >= {*powderdsl.load("powderworld").packs}
    assert sum(bool(one.check) for one in ALL) > len(ALL) / 2
