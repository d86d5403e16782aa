"""Actions on tensors: blocks of cells filled with an element, or blown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from powderdsl.model.state import Slot
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.targets.cpp.program import PackedState
from powderdsl.tasks.task import BLOW, Agent
from powderdsl.worlds.raster import Size

Array = np.ndarray[Any, np.dtype[Any]]


class Hands:
    """An agent's hands on the worlds of one simulator and size."""

    def __init__(self, sim: Simulator, agent: Agent, size: Size, *, counts: bool):
        """`counts`: whether the cells that actions change are counted."""
        self.agent, self.size, self.device, self.counts = agent, size, sim.device, counts
        self.choices = torch.tensor(agent.choices, device=self.device)
        self.edges: tuple[Tensor, Tensor]
        """Of rows, then of columns: the first line of each bin's block and the one after its last, int64 [bins, 2]."""
        self.edges, self._lines = zip(*(self._brush(axis) for axis in (0, 1)), strict=True)
        self.places_elements = any(choice >= 0 for choice in agent.choices)
        known = torch.tensor([[element.id for element in sim.ruleset.elements]], device=self.device)
        state = sim.world(known[None]).state
        self._slots = sim.slots
        self._fresh: dict[str, Tensor] = {}
        """What a new cell holds, by id: [256] or, of vectors, [256, 2]."""
        for slot in sim.slots:
            if slot.travels:
                fresh = state[slot.name][0]
                value = fresh[:, 0].T if slot.planes == 2 else fresh[0]
                table = value[:1].repeat(256, *[1] * (value.ndim - 1))
                table[known[0]] = value
                self._fresh[slot.name] = table
        # For packed worlds.
        self._tables = {name: table.cpu().numpy() for name, table in self._fresh.items()}
        self._choices, *self._edges = (one.cpu().numpy() for one in (self.choices, *self.edges))
        self._by_element = [name for name, table in self._fresh.items() if (table != table[0]).any()]

    def _brush(self, axis: int) -> tuple[Tensor, Tensor]:
        """The rows (or columns) of the brush at each bin within the grid.

        Returns:
            the first, and the one after the last, int64 [bins, 2]; all of them, int64 [bins, brush], where those
            outside stand for the nearest one inside, which the brush covers as well.
        """
        side, brush = self.size[axis], self.agent.brush[axis]
        first = self.agent.first_line(axis, torch.arange(self.agent.bins[axis], device=self.device), side)
        lines = first[:, None] + torch.arange(brush, device=self.device)
        return torch.stack([first, first + brush], 1).clamp(0, side), lines.clamp(0, side - 1)

    def fresh_state(self, ids: Tensor) -> dict[str, Tensor]:
        """The state of new worlds of known ids, uint8 [B, H, W]: what `Simulator.world` makes, without its checks."""
        others = [slot for slot in self._slots if slot.name != "element"]
        return {"element": ids, **{slot.name: self._fresh_slot(slot, ids) for slot in others}}

    def _fresh_slot(self, slot: Slot, ids: Tensor) -> Tensor:
        if slot.name in self._by_element:
            new = self._fresh[slot.name][ids.int()]
            return new.movedim(-1, 1).contiguous() if slot.planes == 2 else new
        default = self._fresh[slot.name][0] if slot.name in self._fresh else slot.default
        value = torch.as_tensor(default, dtype=getattr(torch, slot.dtype), device=self.device)
        everywhere = value[..., None, None].expand(len(ids), *value.shape, *self.size)
        return everywhere.clone(memory_format=torch.contiguous_format)

    def act(self, world: World, actions: Tensor, *, reuse: bool) -> tuple[World, dict[str, Tensor]]:
        """The worlds after actions, int64 [B, 5], within their bounds. `reuse` writes into the world's own tensors.

        Returns:
            the worlds; int64 [B] each: the number of cells ``painted``, and 1 if an element was ``placed``, or cells
            were ``blown``.
        """
        if isinstance(world.state, PackedState) and not self.counts:
            return self._act_packed(world, world.state, actions, reuse)
        choice = self.choices[actions[:, 2]]
        blown, placed = choice == BLOW, choice >= 0
        state, painted = world.state, torch.zeros_like(choice)
        if self.places_elements:
            ids = choice.clamp(min=0)
            before = state["element"].clone() if self.counts else None
            values = {name: table[ids] for name, table in self._fresh.items()}
            state = self._filled(world, state, actions, placed, values, reuse)
            if before is not None:
                painted = (before != state["element"]).sum((1, 2))
        if self.agent.speed_field is not None:
            speed = self.agent.speed * (actions[:, [4, 3]] - 1).float()
            state = self._filled(world, state, actions, blown, {self.agent.speed_field: speed}, reuse)
        done = {"painted": painted, "placed": placed.long(), "blown": blown.long()}
        return world.with_state(state), done

    def _act_packed(
        self, world: World, state: PackedState, actions: Tensor, reuse: bool
    ) -> tuple[World, dict[str, Tensor]]:
        """The same in native memory. NumPy starts an operation on a few numbers in a fraction of torch's time."""
        numbers = actions.numpy()
        choice = self._choices[numbers[:, 2]]
        blown, placed = choice == BLOW, choice >= 0
        boxes = np.concatenate([edges[numbers[:, 1 - axis]] for axis, edges in enumerate(self._edges)], 1)
        if self.places_elements:
            ids = choice.clip(0)
            values = {name: table[ids] for name, table in self._tables.items()}
            state = _filled_packed(state, boxes, placed, values, reuse)
        if self.agent.speed_field is not None:
            speed = (np.float32(self.agent.speed) * (numbers[:, [4, 3]] - 1)).astype(np.float32)
            reuse = reuse or state is not world.state
            state = _filled_packed(state, boxes, blown, {self.agent.speed_field: speed}, reuse)
        done = {"painted": np.zeros(len(choice)), "placed": placed, "blown": blown}
        numbered = {name: torch.from_numpy(value.astype(np.int64)) for name, value in done.items()}
        return world.with_state(state), numbered

    def _filled(
        self,
        world: World,
        state: Mapping[str, Tensor],
        actions: Tensor,
        where: Tensor,
        values: Mapping[str, Tensor],
        reuse: bool,
    ) -> Mapping[str, Tensor]:
        """A state of `world`'s with the block of each action filled: a value a world, [B] or [B, 2], in those of `where`."""
        if isinstance(state, PackedState):  # only the blocks are written, nothing is unpacked
            boxes = torch.cat([edges[actions[:, 1 - axis]] for axis, edges in enumerate(self.edges)], 1)
            arrays = {name: value.numpy() for name, value in values.items()}
            return _filled_packed(
                state, boxes.numpy(), where.numpy(), arrays, reuse or state is not world.state
            )
        rows, columns = (lines[actions[:, 1 - axis]] for axis, lines in enumerate(self._lines))
        cells = (rows[:, :, None] * self.size[1] + columns[:, None]).flatten(1)
        found = dict(state)
        for name, value in values.items():
            slot = state[name] if reuse else state[name].clone()
            flat = slot.flatten(-2)
            index = cells if flat.ndim == 2 else cells[:, None].expand(-1, 2, -1)
            kept = flat.gather(-1, index)
            filled = where.view(-1, *[1] * (kept.ndim - 1))
            flat.scatter_(-1, index, torch.where(filled, value.to(slot.dtype)[..., None], kept))
            found[name] = flat.view(slot.shape)
        return found


def _filled_packed(
    state: PackedState, boxes: Array, where: Array, values: Mapping[str, Array], reuse: bool
) -> PackedState:
    """A state with boxes int64 [B, 4] filled where `where`, bool [B], is set: only they are written, nothing is unpacked."""
    numbers = {
        name: torch.from_numpy(one if one.dtype == np.float32 else one.astype(np.int64))
        for name, one in values.items()
    }
    return state.fill(torch.from_numpy(boxes * where[:, None]), numbers, reuse=reuse)
