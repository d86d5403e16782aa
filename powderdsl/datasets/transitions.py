"""Recorded transitions by number, for `torch.utils.data.DataLoader`, and their split into training and held-out worlds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import index as integer
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from powderdsl.datasets.dataset import MEANING, Batch, Dataset
from powderdsl.datasets.manifest import check_count
from powderdsl.system.random import MASK, base_keys, mix

Array = NDArray[Any]

UNITS = ("world", "episode")
"""What `split` keeps together."""


@dataclass(frozen=True)
class _Episodes:
    """Some episodes of several datasets, int64 [n] each: the dataset's place, their numbers in it, worlds, actions."""

    source: Array
    number: Array
    world: Array
    length: Array

    def of(self, rows: Array) -> _Episodes:
        """Those that a mask, bool [n], keeps."""
        return _Episodes(self.source[rows], self.number[rows], self.world[rows], self.length[rows])


class Transitions(torch.utils.data.Dataset[Batch]):
    """All transitions of one or several datasets, by number: dataset by dataset, episode by episode, in order.

    ``rows[i]`` is transition i, a `Batch` without the dimension B; ``rows[[3, 5]]`` and ``rows[2:9]`` are a `Batch`.
    Nothing is read before it is asked for, and workers of a `DataLoader` open the folders themselves.

    Args:
        data: a dataset, or several whose observations and actions mean the same.
        length: sequences of that many transitions in a row of one episode, [L, …], instead of single ones.

    Raises:
        CompileError: PD630: a shard is damaged; PD631: the datasets do not fit together. ValueError: there is no dataset,
            or no episode of that length.
    """

    def __init__(self, data: Dataset | Sequence[Dataset], *, length: int | None = None):
        self.datasets = (data,) if isinstance(data, Dataset) else tuple(data)
        if not self.datasets:
            raise ValueError("Transitions needs at least one dataset")
        for one in self.datasets[1:]:
            one.require_equal(self.datasets[0].recipe, MEANING, self.datasets[0].folder)
        if length is not None:
            check_count("length", length, max(one.recipe.actions for one in self.datasets))
        self.length = length
        parts = [one.lengths_and_worlds() for one in self.datasets]
        self._keep(
            _Episodes(
                np.repeat(np.arange(len(parts)), [len(one) for one, _ in parts]),
                np.concatenate([np.arange(len(one)) for one, _ in parts]),
                np.concatenate([world for _, world in parts]),
                np.concatenate([one for one, _ in parts]),
            )
        )
        if not len(self):
            raise ValueError(f"no episode has {length} actions; the longest has {self.episodes.length.max()}")

    def _keep(self, episodes: _Episodes) -> None:
        self.episodes = episodes
        self._ends = np.cumsum(np.maximum(0, episodes.length - (self.length or 1) + 1))

    @property
    def worlds(self) -> Tensor:
        """The worlds that occur, ascending: int64 [n]."""
        return torch.from_numpy(np.unique(self.episodes.world))

    def __len__(self) -> int:
        """The number of transitions, or of sequences."""
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, numbers: Any) -> Batch:
        """One transition, or a `Batch` of those of a slice, a list or an array. Raises IndexError, TypeError."""
        if isinstance(numbers, slice):
            return self._batch(np.arange(len(self))[numbers])
        if isinstance(numbers, Sequence | np.ndarray | Tensor) and np.ndim(numbers):
            return self._batch(_integers(numbers))
        return Batch(*(value[0] for value in self._batch(np.array([integer(numbers)], np.int64))))

    def __getitems__(self, numbers: Sequence[int]) -> list[Batch]:
        """Several transitions, read together. `DataLoader` calls it for each minibatch."""
        found = self._batch(_integers(numbers))
        return [Batch(*row) for row in zip(*(value.unbind() for value in found), strict=True)]

    def _batch(self, numbers: Array) -> Batch:
        count = len(self)
        wrong = numbers[(numbers < -count) | (numbers >= count)]
        if len(wrong):
            raise IndexError(f"no transition {wrong[0]}: there are {count}")
        numbers = np.where(numbers < 0, numbers + count, numbers)
        place = np.searchsorted(self._ends, numbers, side="right")
        first = numbers - np.concatenate([[0], self._ends])[place]
        source, episode = self.episodes.source[place], self.episodes.number[place]
        out: list[Array] = []
        for one in np.unique(source).tolist() or [0]:
            rows = np.flatnonzero(source == one)
            found = self.datasets[one].gather(episode[rows], first[rows], self.length or 1)
            out = out or [np.empty((len(numbers), *value.shape[1:]), value.dtype) for value in found]
            for whole, part in zip(out, found, strict=True):
                whole[rows] = part
        return Batch(*(torch.from_numpy(value if self.length else value[:, 0]) for value in out))


def _integers(numbers: Any) -> Array:
    """A sequence of integers as an array, int64 [n]. Raises TypeError for other values, masks among them."""
    found = np.asarray(numbers)
    if found.ndim != 1 or (len(found) and found.dtype.kind not in "iu"):
        raise TypeError(f"transitions are numbered by integers, found {found.dtype} {list(found.shape)}")
    return found.astype(np.int64)


def split(
    rows: Transitions, fractions: Sequence[float], *, by: str = "world", seed: int = 0
) -> tuple[Transitions, ...]:
    """Parts of transitions such that no world, or no episode, has transitions in two of them.

    A hash of `seed` and of the world (and of the episode's number, by episode) decides the part. So it is the same in
    every process, in other recordings of the world, and after episodes are added; and the sizes of parts come near the
    fractions rather than equal them.

    Args:
        fractions: of the worlds or episodes, one for each part: positive, 1 in all.
        by: ``world``, or ``episode`` where held-out episodes may play worlds of the training set.

    Raises:
        ValueError: a wrong argument, or a part would be empty.
    """
    if by not in UNITS:
        raise ValueError(f"by is one of {', '.join(UNITS)}; found {by!r}")
    check_count("seed", seed, (1 << 62) - 1, least=0)
    if not fractions or not all(one > 0 for one in fractions) or not math.isclose(sum(fractions), 1):
        raise ValueError(f"fractions must be positive and sum to 1, found {list(fractions)}")
    episodes = rows.episodes
    numbers = torch.from_numpy(np.zeros_like(episodes.number) if by == "world" else episodes.number + 1)
    chance = _uniform(seed, torch.from_numpy(episodes.world), numbers)
    part = np.searchsorted(np.cumsum(fractions)[:-1], chance, side="right")
    return tuple(_part(rows, number, part == number, by) for number in range(len(fractions)))


def _part(rows: Transitions, number: int, kept: Array, by: str) -> Transitions:
    part = Transitions.__new__(Transitions)
    part.datasets, part.length = rows.datasets, rows.length
    part._keep(rows.episodes.of(kept))
    if not len(part):
        count = len(rows.worlds) if by == "world" else len(kept)
        raise ValueError(f"part {number} would be empty: {count} {by}s are too few, or take another seed")
    return part


def _uniform(seed: int, world: Tensor, number: Tensor) -> Array:
    """Numbers in [0, 1), hashes of the seed, a world and a number: float64 [n]."""
    keys = base_keys(world, torch.full_like(world, seed & MASK))[0]
    key = mix((mix((keys + (seed >> 32)) & MASK) + number) & MASK)
    return np.asarray(key.double() / float(1 << 32))
