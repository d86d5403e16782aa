"""A level, ready to run: many of its worlds at once, painted, stepped, drawn and compared with goals, on tensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from powderdsl.compiler import load, lower
from powderdsl.diagnostics import suggest
from powderdsl.model.types import Ruleset
from powderdsl.ogbench.levels import Level
from powderdsl.simulation.draw import palette
from powderdsl.simulation.simulator import Simulator, World, compile
from powderdsl.targets.cpp.program import PackedState
from powderdsl.targets.torch.program import TorchProgram
from powderdsl.tasks.tensors.actions import Blocks

Numbers = NDArray[np.int64]


class _WithoutSnap(Simulator):
    """On torch, keeping every magnitude of float fields."""

    def __init__(self, ruleset: Ruleset, backend: str, device: str | torch.device, threads: int):
        super().__init__(ruleset, backend, device, threads)
        self._program = TorchProgram(lower(ruleset), self.device, snap=0.0)


class LevelProgram:
    """The worlds of a level on one backend and device.

    Args:
        level: from `find_level`.
        backend, device, threads: those of `powderdsl.compile`.
        as_ogbench: round as OGBench does, on the backend ``torch``: the level's `rounded` rules, draws of 32 bits, and
            no magnitude is too small to keep.
    """

    def __init__(
        self,
        level: Level,
        *,
        backend: str = "auto",
        device: str | torch.device = "cpu",
        threads: int = 1,
        as_ogbench: bool = False,
    ):
        self.level = level
        if as_ogbench:
            ruleset = load(level.rounded)
            ruleset = replace(ruleset, streams=tuple(replace(one, bits=32) for one in ruleset.streams))
            self.simulator: Simulator = _WithoutSnap(ruleset, "torch", device, threads)
        else:
            ruleset = load(level.rules)
            self.simulator = compile(ruleset, backend, str(device), threads)
        self.device = self.simulator.device
        self.streams = tuple(stream.name for stream in ruleset.streams)
        self.ids = np.array([_number(ruleset, name) for name in level.elements], dtype=np.int64)
        """The ids of what agents paint, in the order of actions."""
        fill, frame = _number(ruleset, level.fill), _number(ruleset, level.frame)
        start = torch.full((level.side, level.side), fill, dtype=torch.uint8, device=self.device)
        start[0], start[-1], start[:, 0], start[:, -1] = frame, frame, frame, frame
        self._start = start
        first = torch.arange(level.places, device=self.device) * level.grid
        edges = torch.stack([first, first + level.brush], 1).clamp(1, level.side - 1)
        self.blocks = Blocks(self.simulator, (level.side, level.side), (edges, edges))
        """The blocks of all places, without the frame."""
        self._covers = (edges[:, 1] > edges[:, 0]).cpu().numpy()
        self.paints = torch.from_numpy(palette(ruleset.elements)[self.ids]).to(self.device)
        """The colors of what agents paint: uint8 [n, 3]."""

    def start(self, seeds: Numbers, indices: Numbers) -> World:
        """New worlds. Their draws depend on seed and index, int64 [B] of at least 0 each."""
        ids = self._start.repeat(len(seeds), 1, 1)
        return self.simulator.world(ids, torch.from_numpy(seeds), index=torch.from_numpy(indices))

    def act(
        self, world: World, painted: Numbers, planes: NDArray[np.float64] | None = None, *, reuse: bool = True
    ) -> World:
        """One step of the rules, then a block painted in each world, except where the frame is.

        Args:
            painted: int64 [B, 3]: the index of the element, x and y.
            planes: [streams, B, H, W] in [0, 1): draws to use instead of our own, in the order of the rules' streams.
            reuse: the memory of `world` may be written to, and it must not be used afterwards.
        """
        draws: Mapping[str, Any] | None = None
        if planes is not None:
            draws = dict(zip(self.streams, planes, strict=True))
        stepped = self.simulator.step(world, random=draws, reuse=reuse)
        element, x, y = painted.T
        where: Any = self._covers[x] & self._covers[y]
        ids: Any = self.ids[element]
        packed = isinstance(stepped.state, PackedState)
        if not packed:
            ids, x, y, where = (torch.from_numpy(part).to(self.device) for part in (ids, x, y, where))
        values = self.blocks.fresh_cells(stepped.state, ids)
        reuse = reuse or packed  # a step makes a packed state of its own
        cells = self.blocks.cells(stepped.state, y, x)
        return stepped.with_state(self.blocks.filled(stepped.state, cells, where, values, reuse=reuse))

    def errors(self, ids: Tensor, goals: Tensor) -> Numbers:
        """Cells of goals, uint8 [B, H, W], whose element is neither there in `ids` nor beside it: int64 [B]."""
        matched = ids == goals
        for axis in (1, 2):
            for by in (1, -1):
                matched |= ids.roll(by, axis) == goals
        found: Numbers = (~matched).sum((1, 2)).cpu().numpy()
        return found


def _number(ruleset: Ruleset, name: str) -> int:
    found = ruleset.element(name)
    if found is None:
        helps = suggest(name, [one.name for one in ruleset.elements], "elements")
        raise ValueError("; ".join([f"no element {name!r} in {ruleset.name}", *helps]))
    return found.id
