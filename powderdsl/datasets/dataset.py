"""Reading recorded episodes: one at a time, or endless random minibatches of transitions and sequences."""

from __future__ import annotations

from collections import OrderedDict
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from powderdsl.datasets.manifest import (
    Manifest,
    Recipe,
    check_count,
    damaged,
    differences,
    many_damaged,
    read_manifest,
    recipe_of,
)
from powderdsl.datasets.shards import DTYPES, Shard, knows_ids, open_shard, read_episodes, row_shape
from powderdsl.diagnostics import CompileError, Diagnostic
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.system.random import MASK, base_keys, mix
from powderdsl.system.writing import failure

Array = NDArray[Any]

MAX_OPEN = 4096
"""Shards that are mapped at once, at most."""
MEANING = ("observation", "channels", "shape", "palette", "action_nvec", "choices")
"""Fields of a recipe that define what the numbers of observations and actions mean."""


class Batch(NamedTuple):
    """Transitions, or sequences of them: tensors [B, …], or [B, L, …].

    `observation` and `next_observation` are uint8, `action` int16, `reward` float32, the others bool. The next
    observation of an episode's last transition is the one that the episode ended with.
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    next_observation: Tensor
    terminated: Tensor
    truncated: Tensor
    success: Tensor


class Episode(NamedTuple):
    """One episode of T actions: `observation` is uint8 [T + 1, C, H, W], the others [T, …] as in `Batch`."""

    number: int
    world: int
    observation: Tensor
    action: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    success: Tensor


class Dataset:
    """The episodes of a folder. Made by `Dataset.open`.

    Shards are looked at when they are first needed: their size, their SHA-256, their arrays. Those that are not
    compressed stay on disk, and the system keeps in memory what it has room for.
    """

    def __init__(self, folder: Path, manifest: Manifest, memory: int):
        self.folder, self.manifest, self.memory = folder, manifest, memory
        self.recipe: Recipe = manifest.recipe
        self._ends = np.cumsum([row.transitions for row in manifest.shards], dtype=np.int64)
        self._shards: OrderedDict[int, Shard] = OrderedDict()

    @classmethod
    def open(cls, folder: str | Path, *, memory: int = 1 << 30) -> Dataset:
        """The dataset of a folder.

        Args:
            memory: bytes that unpacked shards may take, where the dataset is compressed. One shard is always kept.

        Raises:
            CompileError: PD630: there is none, it is damaged, or not all of it has been recorded.
        """
        place = Path(folder)
        manifest = read_manifest(place)
        missing = manifest.recipe.shards - len(manifest.shards)
        if missing:
            reason = f"{missing} of {manifest.recipe.shards} shards are missing"
            raise damaged(f"{place} is not complete", reason, "the command that began it completes it")
        problems = []
        for row in manifest.shards:
            try:
                size = (place / row.file).stat().st_size
            except OSError as error:
                problems.append(f"{row.file}: {error.strerror}")
            else:
                if size != row.bytes:
                    problems.append(f"{row.file}: {size:,} bytes instead of {row.bytes:,}")
        if problems:
            raise many_damaged(place, problems)
        return cls(place, manifest, memory)

    def __reduce__(self) -> tuple[Any, ...]:
        # For workers, without what is mapped.
        return partial(Dataset.open, memory=self.memory), (str(self.folder),)

    def __len__(self) -> int:
        """The number of episodes."""
        return self.recipe.episodes

    @property
    def steps(self) -> int:
        """The number of transitions."""
        return self.manifest.transitions

    def require(self, env: TensorEnv, *, same_rules: bool = False) -> None:
        """Refuse an environment in which these observations and actions mean something else.

        Args:
            same_rules: also refuse other rules, parameters, or another task.

        Raises:
            CompileError: PD631, naming each difference.
        """
        names = (*MEANING, "params", "ruleset_fingerprint", "task_fingerprint") if same_rules else MEANING
        self.require_equal(recipe_of(env), names, env.task.name)

    def require_equal(self, other: Recipe, names: tuple[str, ...], whose: object) -> None:
        """Raise CompileError (PD631) where some values of the recipe differ from those of another."""
        found = [one for one in differences(self.recipe, other) if one.split(":")[0].split(".")[0] in names]
        if found:
            raise failure("PD631", f"{self.folder} does not fit {whose}", notes=tuple(found[:20]))

    def check(self) -> None:
        """Read every byte of every shard.

        Raises:
            CompileError: PD630, one for each shard that is damaged.
        """
        found: list[Diagnostic] = []
        for number, row in enumerate(self.manifest.shards):
            self._shards.pop(number, None)
            try:
                shard = self._shard(number)
                if not knows_ids(self.recipe, shard.arrays["observation"]):
                    raise damaged(
                        f"the shard {self.folder / row.file} is damaged", "it has ids that its palette lacks"
                    )
            except CompileError as error:
                found.extend(error.diagnostics)
        if found:
            raise CompileError(found)

    def episode(self, number: int) -> Episode:
        """One episode. Raises IndexError."""
        if not 0 <= number < len(self):
            raise IndexError(f"no episode {number}: there are {len(self)}")
        shard = self._shard(number // self.recipe.shard)
        place = number % self.recipe.shard
        first, length = int(shard.starts[place]), int(shard.arrays["length"][place])
        rows = np.arange(first, first + length)
        values = {name: _tensor(shard.arrays[name][rows]) for name in Batch._fields if name in shard.arrays}
        values["observation"] = _tensor(
            shard.arrays["observation"][np.arange(first + place, first + place + length + 1)]
        )
        return Episode(number, int(shard.arrays["world"][place]), **values)

    def transitions(
        self, batch: int, *, seed: int = 0, device: str | torch.device = "cpu", start: int = 0
    ) -> Batches:
        """Endless minibatches of `batch` transitions, all equally likely, drawn with replacement.

        Minibatch n depends on `seed` and n alone. `start` is the first one's number, to continue where one stopped.
        """
        _check_draw(batch, seed, start)
        return Batches(self, None, self._ends, batch, seed, device, start)

    def sequences(
        self, length: int, batch: int, *, seed: int = 0, device: str | torch.device = "cpu", start: int = 0
    ) -> Batches:
        """Endless minibatches [B, L, …] of `length` transitions in a row of one episode, all equally likely.

        Raises:
            ValueError: no episode is that long.
        """
        check_count("length", length, self.recipe.actions)
        _check_draw(batch, seed, start)
        windows = [np.maximum(0, one - length + 1).sum() for one in self._lengths]
        ends = np.cumsum(windows, dtype=np.int64)
        if not ends[-1]:
            longest = max(int(one.max()) for one in self._lengths)
            raise ValueError(f"no episode has {length} actions; the longest has {longest}")
        return Batches(self, length, ends, batch, seed, device, start)

    # Drawing

    def located(self, windows: Array, ends: Array, length: int) -> tuple[Array, Array]:
        """The episode and the first action of windows of `length` transitions; `ends` count them up to each shard."""
        episode, within = np.empty_like(windows), np.empty_like(windows)
        number = np.searchsorted(ends, windows, side="right")
        for one in np.unique(number).tolist():
            rows = np.flatnonzero(number == one)
            window = windows[rows] - (ends[one - 1] if one else 0)
            count = np.maximum(0, self._shard(one).arrays["length"].astype(np.int64) - length + 1)
            place = np.searchsorted(np.cumsum(count), window, side="right")
            episode[rows] = one * self.recipe.shard + place
            within[rows] = window - (np.cumsum(count) - count)[place]
        return episode, within

    def gather(self, episode: Array, first: Array, length: int) -> list[Array]:
        """The arrays of `Batch`, [n, length, …], of `length` transitions from action `first` of each episode, int64 [n]."""
        stored = {name: name.removeprefix("next_") for name in Batch._fields}
        out = {
            name: np.empty((len(episode), length, *row_shape(self.recipe, of)), DTYPES[of])
            for name, of in stored.items()
        }
        number, place = episode // self.recipe.shard, episode % self.recipe.shard
        for one in np.unique(number).tolist():
            rows = np.flatnonzero(number == one)
            shard = self._shard(one)
            at = (shard.starts[place[rows]] + first[rows])[:, None] + np.arange(length)
            shown = at + place[rows][:, None]  # each episode before has one observation more than actions
            for name, of in stored.items():
                taken = shown + (name != of) if of == "observation" else at
                out[name][rows] = shard.arrays[of][taken]
        return list(out.values())

    def lengths_and_worlds(self) -> tuple[Array, Array]:
        """The number of actions and the world of every episode: int64 [episodes] each. Reads little of each shard."""
        parts = [read_episodes(self.folder, self.recipe, row) for row in self.manifest.shards]
        length, world = (np.concatenate(one).astype(np.int64) for one in zip(*parts, strict=True))
        return length, world

    @cached_property
    def _lengths(self) -> list[Array]:
        """The lengths of the episodes of each shard."""
        return [
            np.array(self._shard(number).arrays["length"], np.int64) for number in range(self.recipe.shards)
        ]

    def _shard(self, number: int) -> Shard:
        """A shard, which stays open while there is room."""
        if number not in self._shards:
            row = self.manifest.shards[number]
            self._shards[number] = open_shard(self.folder, self.recipe, row)
            while len(self._shards) > 1 and (
                len(self._shards) > MAX_OPEN or sum(one.loaded for one in self._shards.values()) > self.memory
            ):
                self._shards.popitem(last=False)
        self._shards.move_to_end(number)
        return self._shards[number]


class Batches(IterableDataset[Batch]):
    """An endless iterator over minibatches: see `Dataset.transitions` and `Dataset.sequences`.

    It is also a dataset for `torch.utils.data.DataLoader` with ``batch_size=None``. Worker w of W reads every W-th
    minibatch from the w-th, so the loader yields the same minibatches in the same order with any number of workers.
    """

    def __init__(
        self,
        data: Dataset,
        length: int | None,
        ends: Array,
        batch: int,
        seed: int,
        device: str | torch.device,
        number: int,
    ):
        self.data, self.length, self.batch, self.seed, self.device = data, length, batch, seed, device
        self.number = number
        """Of the next minibatch; in a worker, of the first one that its workers read next."""
        self._ends = ends

    def __iter__(self) -> Batches:
        return self

    def __next__(self) -> Batch:
        worker = get_worker_info()
        number = self.number + (worker.id if worker else 0)
        self.number += worker.num_workers if worker else 1
        windows = drawn(self.seed, number, self.batch, int(self._ends[-1]))
        length = self.length or 1
        found = self.data.gather(*self.data.located(windows, self._ends, length), length)
        tensors = (torch.from_numpy(value if self.length else value[:, 0]) for value in found)
        return Batch(*(tensor.to(self.device) for tensor in tensors))


def drawn(seed: int, number: int, count: int, below: int) -> Array:
    """Integers 0 … below − 1, hashes of `seed` and `number`: int64 [count]."""
    keys = base_keys(torch.tensor([seed]), torch.tensor([number]))
    key = mix((keys[:, 0] + (number >> 32)) & MASK)
    halves = mix((key[:, None] + mix(torch.arange(1, count + 1))) & MASK)
    return np.asarray((((halves[0] << 31) | (halves[1] >> 1)) % below).numpy())


def _check_draw(batch: int, seed: int, start: int) -> None:
    check_count("batch", batch, 1 << 24)
    check_count("seed", seed, (1 << 62) - 1, least=0)
    check_count("start", start, (1 << 62) - 1, least=0)


def _tensor(rows: Array) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(rows))
