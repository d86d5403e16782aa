"""Classic cellular automata written in the rule language, against a few lines of NumPy that say the same.

The packs (rules/life.yaml and so on) have tests of known patterns; here are random worlds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import powderdsl


def around(cells: np.ndarray) -> np.ndarray:
    """How many of the eight neighbors hold, on a torus: bool [..., H, W] -> int [..., H, W]."""
    shifts = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
    return sum(np.roll(cells, shift, (-2, -1)).astype(int) for shift in shifts)  # type: ignore[return-value]


def life(ids: np.ndarray) -> np.ndarray:
    neighbors = around(ids == 1)
    return ((neighbors == 3) | ((ids == 1) & (neighbors == 2))).astype(int)


def wireworld(ids: np.ndarray) -> np.ndarray:
    wire, head, tail = 1, 2, 3
    lit = np.isin(around(ids == head), (1, 2))
    return np.select([ids == head, ids == tail, (ids == wire) & lit], [tail, wire, head], ids)


def brians_brain(ids: np.ndarray) -> np.ndarray:
    return np.select([ids == 1, ids == 2], [2, 0], (around(ids == 1) == 2).astype(int))


def cyclic(ids: np.ndarray) -> np.ndarray:
    eater = (ids + 1) % 6
    sides = [np.roll(ids, shift, (1, 2)) for shift in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    return np.where(np.any([side == eater for side in sides], axis=0), eater, ids)


@pytest.mark.parametrize("rule", [life, wireworld, brians_brain, cyclic])
@pytest.mark.parametrize("shape", [(2, 18, 31), (1, 50, 3)])
def test_random_worlds_follow_a_direct_formula(
    rule: Callable[[np.ndarray], np.ndarray], shape: tuple[int, ...]
) -> None:
    sim = powderdsl.compile(rule.__name__, backend="wasm")
    ids = np.random.default_rng(1).choice(len(sim.elements), shape)
    if rule is wireworld:  # nothing conducts across the edges
        ids = np.pad(ids, ((0, 0), (1, 1), (1, 1)))
    world = sim.world(ids)
    for _ in range(10):
        ids, world = rule(ids), sim.step(world)
        assert np.array_equal(world.ids.numpy(), ids)
