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

Numbers = NDArray[np.int64]

CLOCK = ("seed", "index", "step")
"""Tensors of `World` that draws depend on."""


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
        known = torch.tensor([[[one.id for one in ruleset.elements]]], device=self.device)
        fresh = self.simulator.world(known).state
        self._fresh: dict[str, Tensor] = {}
        """What a new cell of each known element holds: [256] or, of vectors, [256, 2]."""
        for slot in self.simulator.slots:
            if slot.travels:
                value = fresh[slot.name][0, :, 0].T if slot.planes == 2 else fresh[slot.name][0, 0]
                table = value[:1].repeat(256, *[1] * (value.ndim - 1))
                table[known[0, 0]] = value
                self._fresh[slot.name] = table
        self.paints = torch.from_numpy(palette(ruleset.elements)[self.ids]).to(self.device)
        """The colors of what agents paint: uint8 [n, 3]."""

    def start(self, seeds: Numbers, indices: Numbers) -> World:
        """New worlds. Their draws depend on seed and index, int64 [B] of at least 0 each."""
        ids = self._start.expand(len(seeds), -1, -1)
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
        level = self.level
        ids = torch.from_numpy(self.ids[painted[:, 0]]).to(self.device)
        first = np.maximum(level.grid * painted[:, 1:], 1)
        last = np.minimum(level.grid * painted[:, 1:] + level.brush, level.side - 1)
        boxes = np.stack([first[:, 1], last[:, 1], first[:, 0], last[:, 0]], 1)
        values = {name: table[ids] for name, table in self._fresh.items()}
        return stepped.with_state(self._filled(stepped.state, torch.from_numpy(boxes), values))

    def _filled(
        self, state: Mapping[str, Tensor], boxes: Tensor, values: Mapping[str, Tensor]
    ) -> Mapping[str, Tensor]:
        """A state with boxes, int64 [B, 4], filled. `state` is nobody else's."""
        if isinstance(state, PackedState):
            wanted = {
                name: value if value.dtype == torch.float32 else value.long()
                for name, value in values.items()
            }
            return state.fill(boxes, wanted, reuse=True)
        lines = torch.arange(self.level.side, device=self.device)
        top, bottom, left, right = boxes.to(self.device)[:, :, None].unbind(1)
        rows, columns = (lines >= top) & (lines < bottom), (lines >= left) & (lines < right)
        cells = rows[:, :, None] & columns[:, None]
        found = dict(state)
        for name, value in values.items():
            where = cells if value.ndim == 1 else cells[:, None]
            found[name] = torch.where(where, value[..., None, None], state[name])
        return found

    def put(self, world: World, places: Tensor, part: World) -> World:
        """The worlds with those of numbers `places`, int64 [n], replaced. `world` must not be used afterwards."""
        if len(places) == len(world):
            return part
        state = world.state
        if isinstance(state, PackedState):
            new: Mapping[str, Tensor] = state.put(places.cpu(), part.state, reuse=True)
        else:
            new = {name: value.index_copy(0, places, part.state[name]) for name, value in state.items()}
        clock = (getattr(world, one).index_copy(0, places, getattr(part, one)) for one in CLOCK)
        return World(self.simulator, new, *clock)

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
