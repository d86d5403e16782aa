"""Shapes cover the cells that their definitions say, one at a time and in whole batches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from powderdsl.targets.tensor_kind import Tensors
from powderdsl.tasks.tensors.generator import cells_between, shape_rows
from powderdsl.worlds.raster import Shape, mask, root

PLACE = st.integers(-12, 90)
SIZES = st.sampled_from([(1, 1), (7, 9), (64, 64), (65, 30), (130, 12)])


def ranges() -> st.SearchStrategy[list[int | None]]:
    """A start and an end above it; perhaps open."""
    start = st.integers(0, 70)
    return st.tuples(start, st.integers(1, 70) | st.none()).map(
        lambda pair: [pair[0], None if pair[1] is None else pair[0] + pair[1]]
    )


NUMBERS: dict[str, st.SearchStrategy[Any]] = {
    "line": st.tuples(PLACE, PLACE, PLACE, PLACE, st.integers(1, 25)).map(list),
    "disk": st.tuples(PLACE, PLACE, st.integers(1, 40)).map(list),
    "square": st.tuples(PLACE, PLACE, st.integers(1, 40)).map(list),
    "box": st.tuples(ranges(), ranges()).map(lambda pair: pair[0] + pair[1]),
    "ramp": st.tuples(PLACE, PLACE, PLACE, PLACE).map(list),
    "arch": st.tuples(ranges(), ranges(), st.integers(1, 9)).map(lambda t: [*t[0], *t[1], t[2]]),
    "container": st.tuples(ranges(), ranges(), st.integers(1, 9)).map(lambda t: [*t[0], *t[1], t[2]]),
    "wave": st.tuples(PLACE, st.integers(0, 20), st.integers(2, 30), PLACE).map(list),
}


def between(one: Any, first: int, last: int) -> Any:
    return (one >= min(first, last)) & (one <= max(first, last))


def definition(kind: str, n: list[Any], size: tuple[int, int]) -> np.ndarray:
    """The cells of a shape, each by itself, bool [H, W]."""
    row, column = np.arange(size[0])[:, None], np.arange(size[1])
    if kind in ("box", "arch", "container"):
        top, bottom, left, end, *rest = (one if one is not None else size[i // 2] for i, one in enumerate(n))
        box = (row >= top) & (row < bottom) & (column >= left) & (column < end)
        if kind == "box":
            return box
        lid = row < top + rest[0] if kind == "arch" else row >= bottom - rest[0]
        return box & (lid | (column < left + rest[0]) | (column >= end - rest[0]))
    if kind == "disk":
        return (row - n[0]) ** 2 + (column - n[1]) ** 2 < n[2] ** 2
    if kind == "square":
        return (np.maximum(row - n[0], n[0] - row - 1) < n[2]) & (
            np.maximum(column - n[1], n[1] - column - 1) < n[2]
        )
    if kind == "wave":
        turn = (column + n[3]) % n[2]
        return row >= n[0] + n[1] * np.minimum(2 * turn, 2 * (n[2] - turn)) // n[2]
    top, left, bottom, end = n[:4]
    down, right = bottom - top, end - left
    if kind == "ramp":
        over = (row - top) * abs(right) >= (column - left) * down * (1 if right > 0 else -1)
        return (
            between(column, left, end)
            & (over if right else row >= min(top, bottom))
            & (row <= max(top, bottom))
        )
    within = between(row, top, bottom) if abs(down) > abs(right) else between(column, left, end)
    right = 1 if down == right == 0 else right
    excess = 4 * (np.abs((column - left) * down - (row - top) * right) - max(abs(down), abs(right)))
    return within & ((excess < 0) | (excess**2 < n[4] ** 2 * (down**2 + right**2)))


@pytest.mark.parametrize("kind", NUMBERS)
def test_batches_cover_the_same_cells(torch, kind):
    @settings(max_examples=60, deadline=None, derandomize=True)
    @given(batch=st.lists(NUMBERS[kind], min_size=1, max_size=6), size=SIZES)
    def compare(batch, size):
        opens = [batch[0][i] is None for i in range(len(batch[0]))]
        batch = [one for one in batch if [n is None for n in one] == opens]
        columns = [None if n[0] is None else torch.tensor(n) for n in zip(*batch, strict=True)]
        rows = shape_rows(Tensors(), kind, columns, size)
        found = cells_between(Tensors(), *rows, size).numpy()
        for one, numbers in zip(found, batch, strict=True):
            expected = definition(kind, numbers, size)
            assert np.array_equal(one, expected), (numbers, size)
            assert np.array_equal(mask(Shape(kind, tuple(numbers)), size), expected), (numbers, size)

    compare()


def test_whole_roots_are_exact(torch):
    n = torch.tensor([0, 1, 2, 3, 4, 2**26, 2**25 - 1, 67_108_863])
    assert torch.equal(root(torch, n * n), n)
    assert torch.equal(root(torch, (n * n - 1).clamp(min=0)), (n - 1).clamp(min=0))
