"""What is random in an episode, apart from the rules' own draws: hashes, or NumPy's old generators in OGBench's order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from powderdsl.system.random import MASK, base_keys, mix, name_number

Numbers = NDArray[np.int64]

RANDOMNESS = ("counter", "ogbench")
"""``counter``: hashes of the seed, the episode, the step and what is drawn. ``ogbench``: a generator for each environment."""

FIRST_TASK, FIRST_ELEMENT, FIRST_X, FIRST_Y, REPLACED = (
    "ogbench task",
    "ogbench element",
    "ogbench x",
    "ogbench y",
    "ogbench invalid",
)
"""What is drawn."""


class Draws(Protocol):
    """The random numbers of a batch of environments. `which`, int64 [n], are environments."""

    fixes_goals: bool
    """Whether a goal depends on the seed and its task alone."""

    def integers(self, which: Numbers, what: str, episode: Numbers, time: Numbers, count: int) -> Numbers:
        """A number in 0..count − 1 for each: int64 [n]. `episode` and `time` are int64 [n]."""
        ...

    def planes(self, which: Numbers) -> NDArray[np.float64] | None:
        """Draws for one step of their worlds, [streams, n, H, W] in [0, 1); None: the simulator's own."""
        ...


def keyed(parts: Sequence[Any], what: str, count: int) -> NDArray[np.float64]:
    """Numbers in [0, 1), float64 [n, count], hashed from integers [n] of at least 0 and what they are for.

    The first of `parts` is a seed of up to 62 bits, the others have 32.
    """
    seed, *rest = (np.asarray(part, dtype=np.int64) for part in parts)
    keys = base_keys(seed, rest[0], np)
    for part in (*rest[1:], np.int64(name_number(what))):
        keys = mix((keys + part) & MASK)
    numbers = np.arange(count, dtype=np.int64) * 0x9E3779B1 & MASK
    with np.errstate(over="ignore"):
        drawn = mix((mix(keys[0] ^ mix(keys[1]))[:, None] + numbers) & MASK)
    return np.asarray(drawn / float(1 << 32), dtype=np.float64)


class CounterDraws:
    """Hashes of the seed of an environment, the number of its episode and the environment step in it.

    Args:
        seeds: int64 [B].
    """

    fixes_goals = True

    def __init__(self, seeds: Numbers):
        self._seeds = seeds

    def integers(self, which: Numbers, what: str, episode: Numbers, time: Numbers, count: int) -> Numbers:
        drawn = keyed((self._seeds[which], episode, time), what, 1)[:, 0]
        return (drawn * count).astype(np.int64)

    def planes(self, which: Numbers) -> None:
        return None


class LegacyDraws:
    """OGBench's order of draws: `numpy.random.RandomState` of its own for each environment, instead of the global one."""

    fixes_goals = False

    def __init__(self, seeds: Numbers, streams: int, side: int):
        self._states = [np.random.RandomState(int(seed) & MASK) for seed in seeds]
        self._streams, self._side = streams, side

    def seed(self, which: Numbers, seeds: Numbers) -> None:
        """Start the generators of environments again, from their seeds, int64 [n]."""
        for one, seed in zip(which, seeds, strict=True):
            self._states[one] = np.random.RandomState(int(seed) & MASK)

    def integers(self, which: Numbers, what: str, episode: Numbers, time: Numbers, count: int) -> Numbers:
        return np.array([self._states[one].randint(count) for one in which], dtype=np.int64)

    def planes(self, which: Numbers) -> NDArray[np.float64]:
        shape = (self._streams, self._side, self._side)
        drawn = np.stack([self._states[one].rand(*shape) for one in which], 1)
        # In single precision, as the engine has them; what rounds to 1 stays below.
        single = drawn.astype(np.float32).astype(np.float64)
        return np.minimum(single, np.nextafter(1.0, 0.0))
