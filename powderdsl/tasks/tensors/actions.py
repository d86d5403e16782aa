"""Actions on tensors: filling blocks of cells with an element, or blowing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from powderdsl.simulation.simulator import Simulator, World
from powderdsl.targets.cpp.program import PackedState
from powderdsl.tasks.task import BLOW, Agent
from powderdsl.worlds.raster import Size

CLOCK = ("seed", "index", "step")
"""Tensors of `World` that determine draws."""

Numbers = Any
"""int64 [B]: tensors, or for packed worlds NumPy arrays, which have less overhead."""


def take_worlds(world: World, places: Tensor) -> World:
    """The worlds of numbers `places`, int64 [n], as `World.select` gives them, without unpacking them."""
    if not isinstance(world.state, PackedState):
        return world.select(places)
    clock = {name: getattr(world, name)[places] for name in ("seed", "index", "start")}
    return world.with_state(world.state.select(places), **clock)


def put_worlds(world: World, places: Tensor, part: World, *, reuse: bool) -> World:
    """The worlds with those of numbers `places`, int64 [n], replaced. `reuse` writes into the world's own tensors."""
    if len(places) == len(world):
        return part
    state: Mapping[str, Tensor]
    if isinstance(world.state, PackedState):
        state = world.state.put(places.cpu(), part.state, reuse=reuse)
    else:
        old, new = world.state, part.state
        state = {name: put_rows(old[name], places, new[name], reuse) for name in old}
    seed, index, step = (put_rows(getattr(world, name), places, getattr(part, name), reuse) for name in CLOCK)
    return World(world.sim, state, seed, index, step)


def put_rows(rows: Tensor, places: Tensor, part: Tensor, reuse: bool) -> Tensor:
    """The rows of a tensor with those of numbers `places` replaced, in place with `reuse`."""
    changed = rows if reuse else rows.clone()
    if rows.device.type != "cpu":
        return changed.index_copy_(0, places, part)
    changed.numpy()[places.numpy()] = part.numpy()  # 20 times as fast for bytes
    return changed


def cells_of(agent: Agent, size: Size, rows: Tensor, columns: Tensor) -> Tensor:
    """The cells that actions at bins, int64 [B], change: bool [B, H, W]."""
    covered = []
    for axis, (bins, side) in enumerate(zip((rows, columns), size, strict=True)):
        first, line = agent.first_line(axis, bins, side)[:, None], torch.arange(side)
        covered.append((first <= line) & (line < first + agent.brush[axis]))
    return covered[0][:, :, None] & covered[1][:, None, :]


class Blocks:
    """Blocks of cells in the worlds of one simulator and size.

    `edges`: of rows, then of columns: the first line of each bin's block and the one after its last, int64 [bins, 2].
    """

    def __init__(self, sim: Simulator, size: Size, edges: tuple[Tensor, Tensor]):
        self.size, self.edges = size, edges
        self._lines = []
        """Of rows, then of columns: all lines of each block, int64 [bins, n]; short blocks repeat their last."""
        for first, end in (axis.T[:, :, None] for axis in edges):
            width = torch.arange(int((end - first).max()), device=sim.device)
            self._lines.append(torch.minimum(first + width, end - 1))
        self.tables = {slot.name: sim.fresh_values(slot) for slot in sim.slots}
        """The values of a new cell, by id: [256] or, for vectors, [256, 2]."""
        self.fresh = {slot.name: self.tables[slot.name] for slot in sim.slots if slot.travels}
        """The same for values that travel with the element."""
        self._arrays = {name: table.cpu().numpy() for name, table in self.fresh.items()}
        self._edges = [axis.cpu().numpy() for axis in edges]

    def fresh_cells(self, state: Mapping[str, Tensor], ids: Numbers) -> dict[str, Any]:
        """Return the state of new cells of elements: arrays [B, …] for a packed state, tensors for others."""
        tables: Mapping[str, Any] = self._arrays if isinstance(state, PackedState) else self.fresh
        return {name: table[ids] for name, table in tables.items()}

    def cells(self, state: Mapping[str, Tensor], rows: Numbers, columns: Numbers) -> Any:
        """The blocks at bins of rows and columns, as `filled` takes them: boxes for a packed state, else numbers of cells."""
        if isinstance(state, PackedState):
            return np.concatenate([self._edges[0][rows], self._edges[1][columns]], 1)
        lines, across = self._lines[0][rows], self._lines[1][columns]
        return (lines[:, :, None] * self.size[1] + across[:, None]).flatten(1)

    def filled(
        self, state: Mapping[str, Tensor], cells: Any, where: Any, values: Mapping[str, Any], *, reuse: bool
    ) -> Mapping[str, Tensor]:
        """A state with blocks, which `cells` gave, filled in the worlds of `where`, bool [B].

        There is one value per world, [B] or [B, 2]. All are arrays for a packed state, and tensors for others. `reuse`
        overwrites the tensors of `state`.
        """
        if isinstance(state, PackedState):  # only the blocks are written, nothing is unpacked
            numbers = {
                name: torch.from_numpy(value if value.dtype == np.float32 else value.astype(np.int64))
                for name, value in values.items()
            }
            return state.fill(torch.from_numpy(cells * where[:, None]), numbers, reuse=reuse)
        state_after = dict(state)
        for name, value in values.items():
            slot = state[name] if reuse else state[name].clone()
            flat = slot.flatten(-2)
            index = cells if flat.ndim == 2 else cells[:, None].expand(-1, 2, -1)
            before = flat.gather(-1, index)
            filled = where.view(-1, *[1] * (before.ndim - 1))
            flat.scatter_(-1, index, torch.where(filled, value.to(slot.dtype)[..., None], before))
            state_after[name] = flat.view(slot.shape)
        return state_after


class Hands:
    """Applies an agent's actions to the worlds of one simulator and size."""

    def __init__(self, sim: Simulator, agent: Agent, size: Size, *, counts: bool):
        """`counts`: count the cells that actions change."""
        self.agent, self.size, self.device, self.counts = agent, size, sim.device, counts
        edges = []
        for axis, side in enumerate(size):
            first = agent.first_line(axis, torch.arange(agent.bins[axis], device=self.device), side)
            edges.append(torch.stack([first, first + agent.brush[axis]], 1).clamp(0, side))
        self.blocks = Blocks(sim, size, (edges[0], edges[1]))
        self.choices = torch.tensor(agent.choices, device=self.device)
        self._choices = self.choices.cpu().numpy()
        self.places_elements = any(choice >= 0 for choice in agent.choices)
        self._fresh = {
            name: (table, bool((table == table[:1]).all()))
            for name, table in self.blocks.tables.items()
            if name != "element"
        }
        """The values of new cells, and whether all elements share them, since looking up ids takes 20 times as long."""

    def fresh_state(self, ids: Tensor, *, shares: bool = False) -> dict[str, Tensor]:
        """The state of new worlds of ids, uint8 [B, H, W]. `shares`: store a value of all cells once, read-only."""
        index, state = ids.int(), {"element": ids}
        for name, (table, same) in self._fresh.items():
            cells = table[0].expand(*ids.shape, *table.shape[1:]) if same else table[index]
            cells = cells.movedim(-1, 1) if cells.ndim == 4 else cells
            if not shares:
                cells = cells.clone(memory_format=torch.contiguous_format) if same else cells.contiguous()
            state[name] = cells
        return state

    def act(self, world: World, actions: Tensor, *, reuse: bool) -> tuple[World, dict[str, Tensor]]:
        """The worlds after actions, int64 [B, 5], within bounds. `reuse` overwrites the world's own tensors.

        Beside them, int64 [B] each: the number of cells ``painted``, and 1 if an element was ``placed``, or cells were
        ``blown``.
        """
        state, packed = world.state, isinstance(world.state, PackedState)
        numbers: Any = actions.numpy() if packed else actions
        choice = (self._choices if packed else self.choices)[numbers[:, 2]]
        blown, placed = choice == BLOW, choice >= 0
        cells = self.blocks.cells(state, numbers[:, 1], numbers[:, 0])
        painted = torch.zeros(len(choice), dtype=torch.int64, device=self.device)
        if self.places_elements:
            before = state["element"].clone() if self.counts else None
            values = self.blocks.fresh_cells(state, choice.clip(0))
            state = self.blocks.filled(state, cells, placed, values, reuse=reuse)
            if before is not None:
                painted = (before != state["element"]).sum((1, 2))
        if self.agent.speed_field is not None:
            # Directions are −1, 0 and 1, so products in double precision are exact.
            speed = self.agent.speed * (numbers[:, [4, 3]] - 1)
            speed = speed.astype(np.float32) if packed else speed.float()
            values = {self.agent.speed_field: speed}
            own = reuse or (packed and state is not world.state)
            state = self.blocks.filled(state, cells, blown, values, reuse=own)
        done = {"placed": torch.as_tensor(placed).long(), "blown": torch.as_tensor(blown).long()}
        return world.with_state(state), {"painted": painted, **done}
