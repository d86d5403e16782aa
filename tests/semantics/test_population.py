"""How many cells of each element the eight designed worlds hold over 64 steps, against the published engine.

Recorded steps (test_recordings.py) say what one step does with given random numbers. Here both sides use
numbers of their own, so only distributions can be compared: `population.npz` holds the counts of 16 runs of
the engine in each designed world, and the ruleset makes 16 runs of its own on the torch backend.

In each world a run is a vector: the count of every element at steps 1, 2, 4, 8, 16, 32 and 64. If ruleset and
engine have the same dynamics, it is chance which 16 of the 32 runs are the engine's. So labels are dealt at random
99,999 times, in each world on its own: the test fails if fewer than 5 of 100,000 deals give as large a statistic as
the true labels do. The statistic is the largest standardized difference of means |z| over all worlds, steps and
elements; about 81 of the 784 counts vary, and the bound comes out near |z| = 4.2. Seeds are fixed, so the outcome is
too.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import powderdsl

DATA = Path(__file__).parents[1] / "data"
STEPS = (1, 2, 4, 8, 16, 32, 64)
RUNS = 16
ALL_WORLDS = tuple(range(8))
DEALS = 99_999
FALSE_ALARM = 5e-5
SEED = 2022

Counts = npt.NDArray[np.int64]  # [step, world, run, element]


@cache
def recorded() -> tuple[npt.NDArray[np.uint8], Counts]:
    """The ids [8, 64, 64] of the designed worlds, and the engine's counts at STEPS."""
    with np.load(DATA / "population.npz", allow_pickle=False) as archive:
        return archive["start_ids"], archive["counts"][list(STEPS)].astype(np.int64)


@cache
def simulated(worlds: tuple[int, ...], changed: tuple[tuple[str, float], ...] = ()) -> Counts:
    """The ruleset's counts at STEPS in these designed worlds, with the parameters `changed`."""
    rules = powderdsl.load("powderworld", params=dict(changed))
    simulator = powderdsl.compile(rules, backend="wasm")
    start = recorded()[0][list(worlds)]
    world = simulator.world(np.repeat(start, RUNS, axis=0), seed=SEED)
    counts, done = [], 0
    for step in STEPS:
        world = simulator.step(world, steps=step - done)
        done = step
        counts.append(count(world.ids, len(simulator.elements)).reshape(len(worlds), RUNS, -1))
    return np.stack(counts)


def count(ids: Any, elements: int) -> Counts:
    """How many cells of each element [B, elements] worlds [B, H, W] hold."""
    flat = np.asarray(ids).reshape(len(ids), -1)
    return np.stack([np.bincount(world, minlength=elements) for world in flat])


def chance(first: Counts, second: Counts) -> float:
    """How likely labels dealt at random give as large a difference as the true ones (at least 1e-5)."""
    runs = first.shape[2]
    random = np.random.default_rng(0)
    groups = np.tile(np.repeat(np.array([1, -1], np.float32), runs), (1 + DEALS, 1))
    largest = np.zeros(1 + DEALS)
    for world in range(first.shape[1]):
        groups[1:] = random.permuted(groups[1:], axis=1)  # the first row holds the true labels
        both = np.concatenate([first[:, world], second[:, world]], axis=1)  # [step, run, element]
        vectors = both.transpose(1, 0, 2).reshape(2 * runs, -1).astype(float)
        vectors = vectors[:, vectors.std(axis=0) > 0]
        vectors = ((vectors - vectors.mean(axis=0)) / vectors.std(axis=0)).astype(np.float32)
        z = np.abs(groups @ vectors) / np.sqrt(2 * runs)
        largest = np.maximum(largest, z.max(axis=1, initial=0))
    return float(np.mean(largest >= largest[0] - 1e-4 * largest[0]))


def test_counts_spread_as_the_engines() -> None:
    assert chance(recorded()[1], simulated(ALL_WORLDS)) >= FALSE_ALARM


@pytest.mark.parametrize(
    ("worlds", "parameter", "value"),
    [
        ((2,), "water.melt", 0.04),  # for 2 %
        ((3, 6), "fire.spread", 0.45),  # for 30 %
        ((4,), "acid.bite", 0.30),  # for 20 %
    ],
)
def test_a_changed_chance_is_found(worlds: tuple[int, ...], parameter: str, value: float) -> None:
    """One parameter changed, in the designed worlds that show it most, is told from the engine."""
    counts = simulated(ALL_WORLDS).copy()
    counts[:, list(worlds)] = simulated(worlds, ((parameter, value),))
    assert chance(recorded()[1], counts) < FALSE_ALARM
