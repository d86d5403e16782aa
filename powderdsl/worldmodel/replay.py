"""The replay buffer: pairs as uint8, the oldest replaced as training continues.

What it holds in an iteration, and which pairs a batch has, are functions of the configuration, the run's seed and the
iteration. So a checkpoint needs no copy of it: `Replay.advance_to` makes it again, cell by cell the same.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import torch
from torch import Tensor

from powderdsl.system.random import MASK, base_keys, mix
from powderdsl.worldmodel.config import DataConfig
from powderdsl.worldmodel.worlds import Pairs, Worlds, pairs_of

TOGETHER = 1 << 20
"""The most cells that are simulated together when the buffer is filled."""

_BATCH, _FIRST = 0x57A7, 0x0FF5
"""The numbers of the hashes that choose batches and the first world."""


class Replay:
    """A buffer of pairs: `starts` and `ends`, uint8 [size, H, W], as the iteration `iteration` needs them.

    Args:
        seed: the run's. It decides which world comes first, and which pairs a batch has.
        store: ``memory`` (of `device`), ``disk``, or ``auto``: disk where the buffer would take more than half of memory.
        folder: where its files lie, unless it is that of temporary files.
    """

    def __init__(
        self,
        worlds: Worlds,
        config: DataConfig,
        *,
        seed: int = 0,
        device: str | torch.device = "cpu",
        store: str = "auto",
        folder: Path | None = None,
    ):
        self.worlds, self.config, self.device = worlds, config, torch.device(device)
        self.all_fit = config.states * config.pairs <= config.capacity
        self.size = config.states * config.pairs if self.all_fit else config.capacity
        keys = base_keys(torch.tensor([seed, seed]), torch.tensor([_BATCH, _FIRST]))
        self._key = int(mix(keys[0] ^ keys[1])[0])
        first = int((keys[0, 1] << 32 | keys[1, 1]) & (2**63 - 1))
        self._first = 0 if self.all_fit else first % config.states
        shape = (self.size, *worlds.size)
        if store == "auto":
            store = "disk" if 2 * math.prod(shape) > memory_of(self.device) // 2 else "memory"
        if store == "memory":
            self.starts, self.ends = torch.zeros(2, *shape, dtype=torch.uint8, device=self.device)
        else:
            with TemporaryFile(dir=folder) as file:  # what is mapped outlives the file
                pairs = np.memmap(file, dtype=np.uint8, mode="w+", shape=(2, *shape))
            self.starts, self.ends = torch.from_numpy(pairs)
        self.iteration = -1
        self._live: Any = None

    def advance_to(self, iteration: int) -> None:
        """Make the buffer's contents before an iteration, counted from 0."""
        config = self.config
        back = -(-self.size // config.refresh)  # what older iterations brought has been overwritten
        begin = max(0, iteration - back) // config.pairs * config.pairs
        if self.all_fit or begin == 0:
            self._fill()
        self.iteration, self._live = begin, None
        while self.iteration < iteration:
            self.advance()

    def advance(self) -> None:
        """Go to the next iteration: `refresh` worlds continue by some steps, and their pairs replace the oldest."""
        if not self.all_fit:
            config, many = self.config, self.config.refresh
            turn, moment = divmod(self.iteration, config.pairs)
            if moment == 0 or self._live is None:
                filled = -(-self.size // config.pairs)
                self._live = self.worlds.start(self._seeds(filled + turn * many, many))
            start = self._live.ids
            self._live = self.worlds.later(self._live, config.steps)
            place = self.size + self.iteration * many + torch.arange(many)
            self._write(place % self.size, (start, self._live.ids))
        self.iteration += 1

    def batch(self, iteration: int, count: int) -> Pairs:
        """The pairs of an iteration's batch, drawn uniformly: uint8 [count, H, W] each, on the buffer's device."""
        key = mix(torch.tensor((self._key + iteration * 0x9E3779B1) & MASK))
        drawn = mix((mix((key + torch.arange(count) * 0x85EBCA6B) & MASK) + (iteration >> 16)) & MASK)
        chosen = ((drawn * self.size) >> 32).to(self.starts.device)
        return self.starts[chosen].to(self.device), self.ends[chosen].to(self.device)

    def _fill(self) -> None:
        """The first pairs: world by world, in the order of time."""
        pairs = self.config.pairs
        height, width = self.worlds.size
        together = max(1, TOGETHER // (height * width))
        many = -(-self.size // pairs)
        for first in range(0, many, together):
            count = min(together, many - first)
            rollout = pairs_of(self.worlds, self._seeds(first, count), self.config.steps, pairs)
            for moment, pair in enumerate(rollout):
                place = (first + torch.arange(count)) * pairs + moment
                inside = place < self.size
                self._write(place[inside], (pair[0][inside], pair[1][inside]))

    def _seeds(self, first: int, count: int) -> Tensor:
        """The seeds of worlds by their number in the run: all states come equally often."""
        return (self._first + first + torch.arange(count)) % self.config.states

    def _write(self, place: Tensor, pair: Pairs) -> None:
        place = place.to(self.starts.device)
        for room, ids in zip((self.starts, self.ends), pair, strict=True):
            # If one iteration brings more pairs than fit, the newest stay.
            newest = slice(max(0, len(place) - self.size), None)
            room[place[newest]] = ids[newest].to(room.device)


def memory_of(device: torch.device) -> int:
    """The memory of a device in bytes."""
    if device.type == "cuda":
        return int(torch.cuda.get_device_properties(device).total_memory)
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return 8 << 30
