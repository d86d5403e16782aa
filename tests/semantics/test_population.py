"""How many cells of each element the eight designed worlds hold over 64 steps, against the published engine.

Recorded steps (test_recordings.py) say what one step does with given random numbers. Here both sides use
numbers of their own, so only distributions can be compared: `population.npz` holds the counts of 16 runs of
the engine in each designed world, and the ruleset makes 16 runs of its own on the torch backend.

The test. In each world a run is a vector: the count of every element at steps 1, 2, 4, 8, 16, 32 and 64. If
ruleset and engine have the same dynamics, the 32 runs of a world are exchangeable: which 16 of them are the
engine's is a label that could as well have been dealt at random. So we deal it 99,999 times, in each world on
its own, and ask how often chance alone gives a statistic as large as the true labels do. Two statistics:

* the largest standardized difference of means |z| over all worlds, steps and elements. It sees one count that
  is off. The scale of z is the standard deviation of all 32 runs, so it needs no floor: a count that never
  varies is left out, and |z| cannot pass 5.7 however little a count varies (16 runs all below the other 16);
* the energy distance between the two groups of runs (twice the mean distance between groups, less that within
  each), summed over worlds. It sees many small differences, and differences of spread and correlation: runs
  that share their random numbers, for one.

The bound. The test fails when either has a chance below 5e-5 under dealt labels: a false alarm in at most one
of 10,000 choices of the seed, the two together, whatever the distributions (no normality is assumed, and the
many dependent counts need no further correction). About 81 of the 784 counts vary, and the bound comes out
near |z| = 4.2. Seeds are fixed, so the outcome is too.

That the test can fail is shown below: chances of the ruleset changed by a quarter, by half or to double are
found, and so are runs that share their random numbers.
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
FALSE_ALARM = 5e-5  # of each of the two statistics
SEED = 2022

pytestmark = pytest.mark.slow  # 8,192 world-steps on a CPU

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


def deal(groups: npt.NDArray[np.float32], random: np.random.Generator) -> npt.NDArray[np.float32]:
    """Shuffle each row but the first, which holds the true labels."""
    return np.concatenate([groups[:1], random.permuted(groups[1:], axis=1)])


def chances(first: Counts, second: Counts) -> dict[str, float]:
    """For each statistic, how likely labels dealt at random give as much as the true ones (at least 1e-5)."""
    assert first.shape == second.shape
    runs = first.shape[2]
    random = np.random.default_rng(0)
    label = np.repeat(np.array([1, -1], np.float32), runs)
    groups = np.tile(label, (1 + DEALS, 1))
    largest = np.zeros(1 + DEALS)
    energy = np.zeros(1 + DEALS)
    for world in range(first.shape[1]):
        groups = deal(groups, random)
        both = np.concatenate([first[:, world], second[:, world]], axis=1)  # [step, run, element]
        vectors = both.transpose(1, 0, 2).reshape(2 * runs, -1).astype(float)
        vectors = vectors[:, vectors.std(axis=0) > 0]
        if vectors.size == 0:
            continue
        vectors = ((vectors - vectors.mean(axis=0)) / vectors.std(axis=0)).astype(np.float32)
        z = groups @ vectors / np.sqrt(2 * runs)
        largest = np.maximum(largest, np.abs(z).max(axis=1))
        distances = np.sqrt(((vectors[:, None] - vectors) ** 2).sum(axis=-1))
        energy -= ((groups @ distances) * groups).sum(axis=1) / runs**2
    return {"largest z": as_large(largest), "energy distance": as_large(energy)}


def as_large(statistic: npt.NDArray[np.float64]) -> float:
    """The share of values that are no smaller than the first, itself included; rounding breaks no tie."""
    return float(np.mean(statistic >= statistic[0] - 1e-4 * abs(statistic[0])))


def alike(first: Counts, second: Counts) -> bool:
    """Whether the test takes two sets of runs for runs of the same dynamics."""
    return min(chances(first, second).values()) >= FALSE_ALARM


def test_counts_spread_as_the_engines() -> None:
    found = chances(recorded()[1], simulated(ALL_WORLDS))
    assert min(found.values()) >= FALSE_ALARM, found


@pytest.mark.parametrize(
    ("worlds", "parameter", "value"),
    [
        ((2,), "water.melt", 0.04),  # for 2 %
        ((2,), "water.freeze", 0.10),  # for 5 %
        ((2,), "plant.growth", 0.075),  # for 5 %
        ((3, 6), "fire.spread", 0.45),  # for 30 %
        ((3,), "fire.dies", 0.50),  # for 40 %
        ((4,), "acid.bite", 0.30),  # for 20 %
    ],
)
def test_a_changed_chance_is_found(worlds: tuple[int, ...], parameter: str, value: float) -> None:
    """One parameter changed, in the designed worlds that show it most, is told from the engine."""
    counts = simulated(ALL_WORLDS).copy()
    counts[:, list(worlds)] = simulated(worlds, ((parameter, value),))
    assert not alike(recorded()[1], counts)


def test_runs_that_share_their_draws_are_found() -> None:
    """Sixteen copies of one run have the right mean, but no spread."""
    shared = np.repeat(simulated(ALL_WORLDS)[:, :, :1], RUNS, axis=2)
    assert not alike(recorded()[1], shared)
