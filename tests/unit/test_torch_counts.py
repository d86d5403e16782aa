"""Counts of torch tensors, in integers as narrow as the weights allow, against sums of rolled worlds in wide ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from powderdsl.model.reference import neighborhood
from powderdsl.model.types import Kernel
from powderdsl.simulation.draw import to_numpy
from tests.semantics.texts import simulator

FLOATS = """\
pack: floats
elements: {air: {id: 0, color: '#000000'}, dust: {id: 1, color: '#111111'}}
fields:
  heat: {type: real(0..9), at: place}
  wind: {type: vec2(-9..9), at: place}
passes: {p: {do: air -> dust}}
"""


@pytest.mark.parametrize("wraps", [True, False])
@pytest.mark.parametrize("largest", [1, 3, 270, 100_000])
@pytest.mark.parametrize("shape", [(1, 64, 64), (3, 9, 70), (1, 5, 4), (3, 1, 33), (3, 2, 1)])
def test_sums_of_slices(shape: tuple[int, int, int], largest: int, wraps: bool, torch: Any) -> None:
    """Random weights of both signs, in worlds larger and smaller than the kernel; all cells hold in the last world."""
    from powderdsl.targets.torch.program import Kernels

    random = np.random.default_rng(largest)
    for tall, across in ((0, 0), (1, 1), (0, 3), (5, 2), (5, 5), (15, 15)):
        weights = random.integers(-largest // 3, largest + 1, (2 * tall + 1, 2 * across + 1))
        weights[random.random(len(weights)) < 0.3] = weights[0]  # rows with the same pattern
        offsets = [(dy - tall, dx - across, int(w)) for (dy, dx), w in np.ndenumerate(weights) if w]
        kernel = Kernel("kernel", tuple(offsets), wraps)
        flags = random.random(shape) < 0.5
        flags[-1] = True
        none = torch.zeros(0, dtype=torch.int64)
        kernels = Kernels(shape, torch.device("cpu"), {}, {}, {}, none, none, none)
        found = kernels.count(torch.from_numpy(flags), kernel.weights, wraps)
        assert found.dtype == torch.int32
        assert np.array_equal(to_numpy(found), neighborhood(flags.astype(np.int64), kernel))


def test_new_worlds_share_no_memory_with_old_ones(torch: Any) -> None:
    """Not even the planes that no pass has written: callers may write into them."""
    cells = simulator(FLOATS, backend="torch-cells")
    first = cells.world(torch.zeros((1, 3, 4), dtype=torch.uint8))
    second = cells.step(first)
    before = {name: plane.clone() for name, plane in first.state.items()}
    for plane in second.state.values():
        assert plane.is_contiguous()
        plane.add_(1)
    assert all(torch.equal(plane, before[name]) for name, plane in first.state.items())
