"""Recorded episodes in shards, read one at a time, as transitions by number, or as endless random minibatches.

A shard contains whole episodes as flat arrays in one .npz file, which is written atomically. An episode of T actions
has T rows of `action`, `reward`, `terminated`, `truncated`, `success`, and T + 1 of `observation`; episodes follow one
another. So row t of an episode's observations precedes its action t, and row t + 1 follows it, even at the end.
Uncompressed arrays are memory-mapped.
"""

from __future__ import annotations

import copy
import hashlib
import math
import os
import zipfile
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property, partial
from operator import index as integer
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
    ShardRow,
    damaged,
    read_manifest,
    recipe_of,
    reporting_damage,
    shard_file,
)
from powderdsl.diagnostics import CompileError, Diagnostic
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.experiments.runs import differences
from powderdsl.system.archives import BadArchive, Parts, open_archive, write_archive
from powderdsl.system.random import MASK, base_keys, mix
from powderdsl.system.reading import open_regular
from powderdsl.system.settings import check_choice, check_count
from powderdsl.system.writing import failure, replacing

Array = NDArray[Any]

MEANING = ("observation", "channels", "shape", "palette", "action_nvec", "choices")
"""Fields of a recipe that define what the numbers of observations and actions mean."""
UNITS = ("world", "episode")
"""The unit that `split` keeps together."""

DTYPES = {
    "observation": "|u1",
    "action": "<i2",
    "reward": "<f4",
    "terminated": "|b1",
    "truncated": "|b1",
    "success": "|b1",
    "length": "<i4",
    "world": "<i8",
}
LEVEL = 1
"""Compression level of deflate. Higher levels take three to five times as long to save a quarter."""


def row_shape(recipe: Recipe, name: str) -> tuple[int, ...]:
    return {"observation": recipe.shape, "action": (5,)}.get(name, ())


def shapes(recipe: Recipe, number: int, transitions: int) -> dict[str, tuple[int, ...]]:
    episodes = len(recipe.episodes_of(number))
    rows = {"observation": transitions + episodes, "length": episodes, "world": episodes}
    return {name: (rows.get(name, transitions), *row_shape(recipe, name)) for name in DTYPES}


def write_shard(
    folder: Path, number: int, parts: Mapping[str, Sequence[Array]], *, compress: bool
) -> ShardRow:
    """Write a shard from arrays in parts, which are concatenated. Equal arrays make equal files.

    Raises CompileError (PD613) if the file cannot be written.
    """
    path = folder / shard_file(number)
    arrays: dict[str, Array | Parts | str] = {}
    for name, dtype in DTYPES.items():
        rows = [np.asarray(part, dtype) for part in parts[name]]
        arrays[name] = Parts(dtype, (sum(map(len, rows)), *rows[0].shape[1:]), rows)
    with replacing(path) as temporary:
        with temporary.open("w+b") as file:
            write_archive(file, arrays, LEVEL if compress else 0)
            file.flush()
            file.seek(0)
            os.fsync(file.fileno())
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        size = temporary.stat().st_size
    return ShardRow(number, digest, size, sum(map(len, parts["action"])))


@dataclass(frozen=True)
class Shard:
    """The read-only arrays of a shard, with the types of `DTYPES` and `shapes`."""

    arrays: dict[str, Array]
    loaded: int
    """Bytes of these arrays in memory, not mapped."""

    @cached_property
    def starts(self) -> Array:
        """The first transition of each episode: int64 [episodes]. Its first observation is `starts` + its index."""
        length = self.arrays["length"].astype(np.int64)
        return np.cumsum(length) - length


def is_whole(folder: Path, row: ShardRow) -> bool:
    """True if a shard's file exists and has the size and digest of the manifest."""
    try:
        with open_regular(folder / row.file) as file:
            if os.fstat(file.fileno()).st_size != row.bytes:
                return False
            return hashlib.file_digest(file, "sha256").hexdigest() == row.sha256
    except OSError:
        return False


def open_shard(folder: Path, recipe: Recipe, row: ShardRow) -> Shard:
    """Read a shard after checking every byte of it.

    Raises CompileError (PD630) with the shard and the fault.
    """
    path = folder / row.file
    with _damage(path):
        if not is_whole(folder, row):
            raise BadArchive("its size or its SHA-256 differs from the manifest's")
        shard = _read(path, shapes(recipe, row.number, row.transitions))
        check_episodes(shard.arrays, recipe)
    return shard


def _damage(path: Path) -> AbstractContextManager[None]:
    return reporting_damage(f"the shard {path} is damaged", "run the command that recorded it again")


def _read(path: Path, expected: dict[str, tuple[int, ...]], only: tuple[str, ...] = tuple(DTYPES)) -> Shard:
    """Some arrays of an archive. Raises an error unless it has exactly the expected ones."""
    arrays: dict[str, Array] = {}
    loaded = 0
    whole = np.memmap(path, np.uint8, "r")
    with open_archive(path) as archive:
        if archive.headers.keys() != expected.keys():
            raise BadArchive(f"it must contain exactly {', '.join(expected)}")
        for name in only:
            header, shape, dtype = archive.headers[name], expected[name], np.dtype(DTYPES[name])
            if (header.shape, header.dtype) != (shape, dtype.name):
                is_there = f"{header.dtype} {list(header.shape)}"
                raise BadArchive(f"`{name}` is {is_there}, not {dtype} {list(shape)}")
            if header.entry.compress_type == zipfile.ZIP_STORED:
                # A member's bytes follow its local header, whose name and extra field vary in length.
                at = header.entry.header_offset + 30
                sizes = np.frombuffer(whole[at - 4 : at].tobytes(), "<u2").tolist()
                start = at + sum(sizes) + header.start
                arrays[name] = np.ndarray(shape, dtype, buffer=whole, offset=start)
            else:
                arrays[name] = archive.read(name)
                loaded += header.size
    return Shard(arrays, loaded)


def _check_lengths(length: Array, recipe: Recipe, transitions: int) -> None:
    if length.min() < 1 or length.max() > recipe.actions or length.sum() != transitions:
        raise BadArchive("the lengths of its episodes do not fit")


def knows_ids(recipe: Recipe, observation: Array) -> bool:
    """True if the palette contains all ids of observations, uint8 [n, C, H, W]."""
    known = np.zeros(256, bool)
    known[[int(number) for number in recipe.palette]] = True
    where = recipe.channels.index("element") if "element" in recipe.channels else 0
    rows = observation[:, where]
    return all(bool(known[rows[at : at + 256]].all()) for at in range(0, len(rows), 256))


def check_episodes(arrays: Mapping[str, Array], recipe: Recipe) -> None:
    """Check that episodes have the recorded lengths, and that actions are in range. Raises BadArchive."""
    length, action = arrays["length"].astype(np.int64), arrays["action"]
    _check_lengths(length, recipe, len(action))
    ended = arrays["terminated"].astype(np.int64) + arrays["truncated"]
    last = np.zeros_like(ended)
    last[np.cumsum(length) - 1] = 1
    if not np.array_equal(ended, last):
        raise BadArchive("episodes do not have the recorded lengths")
    if (action < 0).any() or (action >= np.array(recipe.action_nvec)).any():
        raise BadArchive("it has actions out of range")
    if (arrays["world"] < 0).any():
        raise BadArchive("it has worlds out of range")


class Batch(NamedTuple):
    """Transitions, or sequences of them: tensors [B, …], or [B, L, …].

    `observation` and `next_observation` are uint8, `action` int16, `reward` float32, the others bool. The next
    observation of an episode's last transition is its final observation.
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
    """The episodes recorded in a folder, opened by `Dataset.open`.

    The size, SHA-256 and arrays of a shard are checked on first use. Uncompressed shards are memory-mapped.
    """

    def __init__(self, folder: Path, manifest: Manifest, memory: int):
        self.folder, self.manifest, self.memory = folder, manifest, memory
        self.recipe: Recipe = manifest.recipe
        self._shards: OrderedDict[int, Shard] = OrderedDict()

    @classmethod
    def open(cls, folder: str | Path, *, memory: int = 1 << 30) -> Dataset:
        """Open the dataset of a folder.

        Args:
            folder: the folder written by `record`.
            memory: maximum bytes of unpacked shards of a compressed dataset. One shard is always kept.

        Raises:
            CompileError: PD630 if there is no dataset, or it is damaged or incomplete.
        """
        place = Path(folder)
        manifest = read_manifest(place)
        missing = manifest.recipe.shards - len(manifest.shards)
        if missing:
            reason = f"{missing} of {manifest.recipe.shards} shards are missing"
            raise damaged(
                f"{place} is not complete", reason, "run the command that began it again to complete it"
            )
        return cls(place, manifest, memory)

    def __reduce__(self) -> tuple[Any, ...]:
        # For workers, without mapped arrays.
        return partial(Dataset.open, memory=self.memory), (str(self.folder),)

    def __len__(self) -> int:
        """The number of episodes."""
        return self.recipe.episodes

    @property
    def steps(self) -> int:
        """The number of transitions."""
        return sum(row.transitions for row in self.manifest.shards)

    def require(self, env: TensorEnv, *, same_rules: bool = False) -> None:
        """Reject an environment in which these observations and actions have another meaning.

        Args:
            same_rules: also reject other rules, parameters, or another task.

        Raises:
            CompileError: PD631, naming each difference.
        """
        names = (*MEANING, "params", "ruleset_fingerprint", "task_fingerprint") if same_rules else MEANING
        self.require_equal(recipe_of(env), names, env.task.name)

    def require_equal(self, other: Recipe, names: tuple[str, ...], whose: object) -> None:
        """Raise CompileError (PD631) if some values of the recipe differ from those of another."""
        own, others = ({name: getattr(recipe, name) for name in names} for recipe in (self.recipe, other))
        notes = differences(own, others)
        if notes:
            raise failure("PD631", f"{self.folder} does not fit {whose}", notes=notes)

    def check(self) -> None:
        """Read every byte of every shard. Raises CompileError (PD630) with all damaged shards."""
        errors: list[Diagnostic] = []
        for number, row in enumerate(self.manifest.shards):
            self._shards.pop(number, None)
            try:
                shard = self._shard(number)
                if not knows_ids(self.recipe, shard.arrays["observation"]):
                    raise damaged(
                        f"the shard {self.folder / row.file} is damaged", "it has ids that its palette lacks"
                    )
            except CompileError as error:
                errors.extend(error.diagnostics)
        if errors:
            raise CompileError(errors)

    def episode(self, number: int) -> Episode:
        """Read one episode, from 0. Raises IndexError; CompileError (PD630) if its shard is damaged."""
        if not 0 <= number < len(self):
            raise IndexError(f"no episode {number}: there are {len(self)}")
        shard, place = self._shard(number // self.recipe.shard), number % self.recipe.shard
        length = int(shard.arrays["length"][place])
        rows = self.gather(np.array([number]), np.array([0]), length)
        values = {name: torch.from_numpy(part[0]) for name, part in zip(Batch._fields, rows, strict=True)}
        last = values.pop("next_observation")[-1:]
        values["observation"] = torch.cat([values["observation"], last])
        return Episode(number, int(shard.arrays["world"][place]), **values)

    def transitions(self, batch: int, **how: Any) -> Batches:
        """Yield endless minibatches of `batch` transitions, drawn uniformly with replacement.

        Args:
            how: `seed`, `start` (the number of the first minibatch) and `device`, as in `Batches`.
        """
        return Batches(Transitions(self), batch, **how)

    def sequences(self, length: int, batch: int, **how: Any) -> Batches:
        """Yield endless minibatches [B, L, …] of `length` successive transitions of an episode, drawn uniformly.

        Args:
            how: as in `transitions`.

        Raises:
            ValueError: no episode is that long.
        """
        return Batches(Transitions(self, length=length), batch, **how)

    # Reading

    def gather(self, episode: Array, first: Array, length: int) -> list[Array]:
        """Read `length` transitions from action `first` of each episode, int64 [n]: the arrays of a `Batch`, [n, length, …]."""
        stored = {name: name.removeprefix("next_") for name in Batch._fields}
        out = {
            name: np.empty((len(episode), length, *row_shape(self.recipe, of)), DTYPES[of])
            for name, of in stored.items()
        }
        number, place = episode // self.recipe.shard, episode % self.recipe.shard
        for shard_number in np.unique(number).tolist():
            rows = np.flatnonzero(number == shard_number)
            shard = self._shard(shard_number)
            at = (shard.starts[place[rows]] + first[rows])[:, None] + np.arange(length)
            shown = at + place[rows][:, None]  # each earlier episode has one observation more than actions
            for name, of in stored.items():
                index = shown + (name != of) if of == "observation" else at
                out[name][rows] = shard.arrays[of][index]
        return list(out.values())

    def lengths_and_worlds(self) -> tuple[Array, Array]:
        """The number of actions and the world of every episode: int64 [episodes] each.

        Other parts of shards are neither read nor checked. Raises as `open_shard`.
        """
        lengths, worlds = [], []
        for row in self.manifest.shards:
            path, expected = self.folder / row.file, shapes(self.recipe, row.number, row.transitions)
            with _damage(path):
                arrays = _read(path, expected, only=("length", "world")).arrays
                lengths.append(arrays["length"].astype(np.int64))
                worlds.append(arrays["world"])
                _check_lengths(lengths[-1], self.recipe, row.transitions)
        return np.concatenate(lengths), np.concatenate(worlds).astype(np.int64)

    def _shard(self, number: int) -> Shard:
        """A shard, which is kept open while memory allows."""
        if number not in self._shards:
            row = self.manifest.shards[number]
            self._shards[number] = open_shard(self.folder, self.recipe, row)
            while (
                len(self._shards) > 1 and sum(shard.loaded for shard in self._shards.values()) > self.memory
            ):
                self._shards.popitem(last=False)
        self._shards.move_to_end(number)
        return self._shards[number]


class _Episodes(NamedTuple):
    """Some episodes of several datasets, int64 [n] each: the dataset's index, their numbers in it, worlds, actions."""

    source: Array
    number: Array
    world: Array
    length: Array


class Transitions(torch.utils.data.Dataset[Batch]):
    """All transitions of one or several datasets, numbered in the order of datasets and episodes.

    ``rows[i]`` is transition i, a `Batch` without the dimension B; ``rows[[3, 5]]`` and ``rows[2:9]`` are a `Batch`;
    ``len(rows)`` counts them. Rows are read when they are indexed, and workers of a `DataLoader` open the folders
    themselves.

    Args:
        data: a dataset, or several with the same meaning of observations and actions.
        length: read sequences of this many successive transitions of an episode, [L, …], instead of single ones.

    Raises:
        CompileError: PD630 if a shard is damaged; PD631 if the datasets do not fit together.
        ValueError: there is no dataset, or no episode is long enough.
    """

    def __init__(self, data: Dataset | Sequence[Dataset], *, length: int | None = None):
        self.datasets = (data,) if isinstance(data, Dataset) else tuple(data)
        if not self.datasets:
            raise ValueError("Transitions needs at least one dataset")
        first, *others = self.datasets
        for other in others:
            other.require_equal(first.recipe, MEANING, first.folder)
        if length is not None:
            check_count("length", length, max(dataset.recipe.actions for dataset in self.datasets))
        self.length = length
        parts = []
        for number, dataset in enumerate(self.datasets):
            lengths, worlds = dataset.lengths_and_worlds()
            parts.append((np.full(len(lengths), number), np.arange(len(lengths)), worlds, lengths))
        self._select(_Episodes(*map(np.concatenate, zip(*parts, strict=True))))
        if not len(self):
            raise ValueError(f"no episode has {length} actions; the longest has {self.episodes.length.max()}")

    def _select(self, episodes: _Episodes) -> None:
        self.episodes = episodes
        self._ends = np.cumsum(np.maximum(0, episodes.length - (self.length or 1) + 1))

    @property
    def worlds(self) -> Tensor:
        """The distinct worlds, ascending: int64 [n]."""
        return torch.from_numpy(np.unique(self.episodes.world))

    def __len__(self) -> int:
        """The number of transitions, or of sequences."""
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, numbers: Any) -> Batch:
        """One transition, or a `Batch` for a slice, a list or an array. Raises IndexError, TypeError."""
        if isinstance(numbers, slice):
            return self._batch(np.arange(len(self))[numbers])
        if isinstance(numbers, Sequence | np.ndarray | Tensor) and np.ndim(numbers):
            return self._batch(_integers(numbers))
        return Batch(*(value[0] for value in self._batch(np.array([integer(numbers)], np.int64))))

    def __getitems__(self, numbers: Sequence[int]) -> list[Batch]:
        """Read several transitions together. `DataLoader` calls it for each minibatch."""
        batch = self._batch(_integers(numbers))
        return [Batch(*row) for row in zip(*(value.unbind() for value in batch), strict=True)]

    def _batch(self, numbers: Array) -> Batch:
        count = len(self)
        wrong = numbers[(numbers < -count) | (numbers >= count)]
        if len(wrong):
            raise IndexError(f"no transition {wrong[0]}: there are {count}")
        numbers = np.where(numbers < 0, numbers + count, numbers)
        place = np.searchsorted(self._ends, numbers, side="right")
        first = numbers - np.concatenate([[0], self._ends])[place]
        source, episode = self.episodes.source[place], self.episodes.number[place]
        places = [np.flatnonzero(source == number) for number in range(len(self.datasets))]
        parts = [
            data.gather(episode[rows], first[rows], self.length or 1)
            for data, rows in zip(self.datasets, places, strict=True)
        ]
        out = parts[0]
        if len(parts) > 1:
            order = np.argsort(np.concatenate(places))
            out = [np.concatenate(columns)[order] for columns in zip(*parts, strict=True)]
        return Batch(*(torch.from_numpy(value if self.length else value[:, 0]) for value in out))


class Batches(IterableDataset[Batch]):
    """An endless iterator over minibatches: see `Dataset.transitions` and `Dataset.sequences`.

    It is also a dataset for `torch.utils.data.DataLoader` with ``batch_size=None``. Worker w of W reads every W-th
    minibatch from the w-th, so the order of minibatches does not depend on the number of workers.

    Args:
        rows: the transitions to draw from.
        batch: transitions in a minibatch.
        seed: minibatch n depends only on the seed and n.
        device: the torch device of the minibatches.
        start: number of the first minibatch, to resume an iterator.
    """

    def __init__(
        self,
        rows: Transitions,
        batch: int,
        *,
        seed: int = 0,
        device: str | torch.device = "cpu",
        start: int = 0,
    ):
        check_count("batch", batch, 1 << 24)
        check_count("seed", seed, (1 << 62) - 1, least=0)
        check_count("start", start, (1 << 62) - 1, least=0)
        self.rows, self.batch, self.seed, self.device = rows, batch, seed, device
        self.number = start
        """The number of the next minibatch; in a worker, of the first one that the workers read next."""

    def __iter__(self) -> Batches:
        return self

    def __next__(self) -> Batch:
        worker = get_worker_info()
        number = self.number + (worker.id if worker else 0)
        self.number += worker.num_workers if worker else 1
        batch = self.rows[drawn(self.seed, number, self.batch, len(self.rows))]
        return Batch(*(tensor.to(self.device) for tensor in batch))


def drawn(seed: int, number: int, count: int, below: int) -> Array:
    """Integers 0 … below − 1, hashes of `seed` and `number`: int64 [count]."""
    keys = base_keys(torch.tensor([seed]), torch.tensor([number]))
    key = mix((keys[:, 0] + (number >> 32)) & MASK)
    halves = mix((key[:, None] + mix(torch.arange(1, count + 1))) & MASK)
    return np.asarray((((halves[0] << 31) | (halves[1] >> 1)) % below).numpy())


def _integers(numbers: Any) -> Array:
    """A sequence of integers as an array, int64 [n]. Raises TypeError for other values, including masks."""
    array = np.asarray(numbers)
    if array.ndim != 1 or (len(array) and array.dtype.kind not in "iu"):
        raise TypeError(f"transitions are numbered by integers, found {array.dtype} {list(array.shape)}")
    return array.astype(np.int64)


def split(
    rows: Transitions, fractions: Sequence[float], *, by: str = "world", seed: int = 0
) -> tuple[Transitions, ...]:
    """Split transitions into parts, so that no world (or episode) has transitions in two parts.

    The part is chosen by a hash of `seed` and the world (and, by episode, the episode's number). So it is the same in
    every process, in other recordings of the world, and after episodes are added. The sizes of parts are only
    approximately the fractions.

    Args:
        rows: the transitions.
        fractions: the share of the worlds or episodes in each part: positive, with the sum 1.
        by: ``world``, or ``episode`` if held-out episodes may play worlds of the training set.
        seed: of the hash.

    Returns:
        The parts, in the order of `fractions`.

    Raises:
        ValueError: a wrong argument, or a part would be empty.
    """
    check_choice("by", by, UNITS)
    check_count("seed", seed, (1 << 62) - 1, least=0)
    if not fractions or min(fractions) <= 0 or not math.isclose(sum(fractions), 1):
        raise ValueError(f"fractions must be positive and sum to 1, found {list(fractions)}")
    episodes = rows.episodes
    numbers = torch.from_numpy(np.zeros_like(episodes.number) if by == "world" else episodes.number + 1)
    worlds = torch.from_numpy(episodes.world)
    keys = base_keys(worlds, torch.full_like(worlds, seed & MASK))[0]
    key = mix((mix((keys + (seed >> 32)) & MASK) + numbers) & MASK)
    chance = np.asarray(key.double() / float(1 << 32))
    part = np.searchsorted(np.cumsum(fractions)[:-1], chance, side="right")
    parts = []
    for number in range(len(fractions)):
        selected = copy.copy(rows)
        selected._select(_Episodes(*(column[part == number] for column in episodes)))
        if not len(selected):
            count = len(rows.worlds) if by == "world" else len(episodes.number)
            raise ValueError(f"part {number} would be empty: use more than {count} {by}s or another seed")
        parts.append(selected)
    return tuple(parts)


# The flat layouts of D4RL and OGBench for offline learners, which load everything into memory

LAYOUTS = ("d4rl", "ogbench")


def flat(dataset: Dataset, layout: str = "d4rl") -> dict[str, NDArray[Any]]:
    """All episodes, concatenated.

    Args:
        layout: ``d4rl``: N rows of `observations`, `actions`, `rewards`, `next_observations`, `terminals` and
            `timeouts`. ``ogbench``: the layout of its dataset files, as read by its `load_dataset`: each episode has
            one more row, its last observation with an action of zeros, and `terminals` is 1 only there. `masks`, which
            it does not read, is 0 where an episode terminated, and `rewards` is 0 in the last row.

    Raises:
        ValueError: an unknown layout.
    """
    check_choice("layout", layout, LAYOUTS)
    parts = [_episode(dataset, number, layout) for number in range(len(dataset))]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _episode(dataset: Dataset, number: int, layout: str) -> dict[str, NDArray[Any]]:
    episode = dataset.episode(number)
    shown, reward = episode.observation.numpy(), episode.reward.numpy()
    action = episode.action.numpy().astype(np.int32)
    terminated, truncated = episode.terminated.numpy(), episode.truncated.numpy()
    if layout == "d4rl":
        return {
            "observations": shown[:-1],
            "actions": action,
            "rewards": reward,
            "next_observations": shown[1:],
            "terminals": terminated,
            "timeouts": truncated,
        }
    return {
        "observations": shown,
        "actions": np.concatenate([action, np.zeros((1, 5), np.int32)]),
        "rewards": np.append(reward, np.float32(0)),
        "terminals": np.append(np.zeros(len(action), np.float32), np.float32(1)),
        "masks": np.append(~terminated, not terminated[-1]).astype(np.float32),
    }
