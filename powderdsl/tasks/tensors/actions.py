"""Actions on tensors: blocks of cells filled with an element, or blown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from powderdsl.model.state import Slot
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.targets.cpp.program import PackedState
from powderdsl.tasks.task import BLOW, Agent
from powderdsl.worlds.raster import Size


@dataclass(frozen=True)
class Done:
    """What actions did: the worlds after them, and int64 [B] each: cells painted, 1 if placed, 1 if blown."""

    world: World
    painted: Tensor
    placed: Tensor
    blown: Tensor


class Hands:
    """An agent's hands on the worlds of one simulator and size."""

    def __init__(self, sim: Simulator, agent: Agent, size: Size, *, counts: bool):
        """`counts`: whether the cells that actions change are counted."""
        self.agent, self.size, self.device, self.counts = agent, size, sim.device, counts
        self.choices = torch.tensor(agent.choices, device=self.device)
        self._edges = [self._ends(axis) for axis in (0, 1)]
        self._places = [self._lines(axis) for axis in (0, 1)]
        self.places_elements = any(choice >= 0 for choice in agent.choices)
        known = torch.tensor([[element.id for element in sim.ruleset.elements]], device=self.device)
        fresh = sim.world(known[None]).state
        self._fresh: dict[str, Tensor] = {}
        """What a new cell holds, by id: [256] or, of vectors, [256, 2]."""
        for slot in sim.slots:
            if slot.travels:
                value = (
                    fresh[slot.name][0, :, 0].transpose(0, -1) if slot.planes == 2 else fresh[slot.name][0, 0]
                )
                table = value[:1].repeat(256, *[1] * (value.ndim - 1))
                table[known[0]] = value
                self._fresh[slot.name] = table
        self._slots = sim.slots
        self._differing = {
            name: table for name, table in self._fresh.items() if bool((table != table[0]).any())
        }
        """What new cells have by their element: properties that cells may override, fields with defaults by element."""

    def _lines(self, axis: int) -> tuple[Tensor, Tensor]:
        """The rows (or columns) of the brush at each bin, int64 [bins, brush] within the grid, and whether they lie there.

        Those outside stand for the nearest one inside, which the brush covers as well.
        """
        side, bins, brush = self.size[axis], self.agent.bins[axis], self.agent.brush[axis]
        center = (2 * torch.arange(bins, device=self.device) + 1) * side // (2 * bins)
        lines = center[:, None] - brush // 2 + torch.arange(brush, device=self.device)
        return lines.clamp(0, side - 1), (lines >= 0) & (lines < side)

    def _ends(self, axis: int) -> Tensor:
        """The first row (or column) of the brush at each bin within the grid, and the one after the last: int64 [bins, 2]."""
        side, bins, brush = self.size[axis], self.agent.bins[axis], self.agent.brush[axis]
        first = (2 * torch.arange(bins, device=self.device) + 1) * side // (2 * bins) - brush // 2
        return torch.stack([first, first + brush], 1).clamp(0, side)

    def fresh_state(self, ids: Tensor) -> dict[str, Tensor]:
        """The state of new worlds of known ids, uint8 [B, H, W]: what `Simulator.world` makes, without its checks."""
        state = {"element": ids}
        for slot in self._slots:
            if slot.name != "element":
                by_id = self._differing.get(slot.name)
                if by_id is None:
                    state[slot.name] = self._usual(slot, len(ids))
                else:
                    new = by_id[ids.int()]
                    state[slot.name] = new.movedim(-1, 1).contiguous() if slot.planes == 2 else new
        return state

    def _usual(self, slot: Slot, batch: int) -> Tensor:
        """A slot that is the same in all cells."""
        dtype = getattr(torch, slot.dtype)
        default: Any = self._fresh[slot.name][0].tolist() if slot.name in self._fresh else slot.default
        if slot.planes == 2:
            value = torch.tensor(default, dtype=dtype, device=self.device)[:, None, None]
            return value.repeat(batch, 1, *self.size)
        return torch.full((batch, *self.size), default, dtype=dtype, device=self.device)

    def act(self, world: World, actions: Tensor, *, reuse: bool) -> Done:
        """The worlds after actions, int64 [B, 5], within their bounds. `reuse` writes into the world's own tensors."""
        choice = self.choices[actions[:, 2]]
        blown, placed = choice == BLOW, choice >= 0
        if isinstance(world.state, PackedState):
            return self._packed(world, world.state, actions, choice, reuse)
        rows, columns = (self._places[axis][0][actions[:, 1 - axis]] for axis in (0, 1))
        cells = (rows[:, :, None] * self.size[1] + columns[:, None]).flatten(1)
        state = dict(world.state)
        painted = torch.zeros_like(choice)
        if self.places_elements and self.counts:
            inside = [self._places[axis][1][actions[:, 1 - axis]] for axis in (0, 1)]
            old = state["element"].flatten(1).gather(1, cells)
            new = choice.clamp(min=0).to(torch.uint8)[:, None]
            differs = (old != new) & (inside[0][:, :, None] & inside[1][:, None]).flatten(1)
            painted = (differs & placed[:, None]).sum(1)
        if self.places_elements:
            self._place(state, cells, choice, ~placed, reuse)
        if self.agent.speed_field is not None:
            self._blow(state, cells, actions, blown, reuse)
        return Done(replace(world, state=state), painted, placed.long(), blown.long())

    def _packed(self, world: World, state: PackedState, actions: Tensor, choice: Tensor, reuse: bool) -> Done:
        """The same on packed worlds: only the blocks are written, and nothing is unpacked unless cells are counted."""
        blown, placed = choice == BLOW, choice >= 0
        edges = [self._edges[axis][actions[:, 1 - axis]] for axis in (0, 1)]
        boxes = torch.cat(edges, 1)
        painted = torch.zeros_like(choice)
        before = state["element"] if self.places_elements and self.counts else None
        if self.places_elements:
            ids = choice.clamp(min=0)
            values = {name: table[ids] for name, table in self._fresh.items()}
            values = {name: one if one.is_floating_point() else one.long() for name, one in values.items()}
            state = state.fill(torch.where(placed[:, None], boxes, 0), values, reuse=reuse)
        if self.agent.speed_field is not None:
            speed = self.agent.speed * (actions[:, [4, 3]] - 1).float()
            reuse = reuse or state is not world.state
            state = state.fill(
                torch.where(blown[:, None], boxes, 0), {self.agent.speed_field: speed}, reuse=reuse
            )
        if before is not None:
            painted = (before != state["element"]).sum((1, 2))
        return Done(replace(world, state=state), painted, placed.long(), blown.long())

    def _place(
        self, state: dict[str, Tensor], cells: Tensor, choice: Tensor, unchanged: Tensor, reuse: bool
    ) -> None:
        """Fresh cells of the chosen elements in everything that travels with elements."""
        ids = choice.clamp(min=0)
        for name, table in self._fresh.items():
            self._write(state, name, cells, table[ids], unchanged, reuse)

    def _blow(
        self, state: dict[str, Tensor], cells: Tensor, actions: Tensor, blown: Tensor, reuse: bool
    ) -> None:
        name = str(self.agent.speed_field)
        speed = self.agent.speed * (actions[:, [4, 3]] - 1).to(state[name].dtype)
        self._write(state, name, cells, speed, ~blown, reuse)

    def _write(
        self,
        state: dict[str, Tensor],
        name: str,
        cells: Tensor,
        value: Tensor,
        unchanged: Tensor,
        reuse: bool,
    ) -> None:
        """One value a world, [B] or [B, 2], in some of its cells [B, n]; worlds of `unchanged` keep theirs."""
        slot = state[name] if reuse else state[name].clone()
        if slot.ndim == 4:
            flat, index = slot.flatten(2), cells[:, None].expand(-1, 2, -1)
        else:
            flat, index = slot.flatten(1), cells
        kept = flat.gather(-1, index)
        new = torch.where(unchanged.view(-1, *[1] * (kept.ndim - 1)), kept, value[..., None])
        flat.scatter_(-1, index, new)
        state[name] = flat.view(slot.shape)


def params_of(sim: Simulator, given: Mapping[str, Tensor], batch: int) -> dict[str, Tensor]:
    """All parameters as float64 [B], for measures that ask for them."""
    found = {}
    for param in sim.ruleset.params:
        value = given.get(param.name, float(param.default))
        found[param.name] = torch.as_tensor(value, dtype=torch.float64, device=sim.device).expand(batch)
    return found
