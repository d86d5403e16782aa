"""Actions on tensors: blocks of cells filled with an element, or blown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from powderdsl.backends.torch_native import PackedState
from powderdsl.model.state import Slot
from powderdsl.simulator import Simulator, World
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

    def __init__(self, sim: Simulator, agent: Agent, size: Size):
        self.agent, self.size, self.device = agent, size, sim.device
        self.choices = torch.tensor(agent.choices, device=self.device)
        self._places = [self._lines(axis) for axis in (0, 1)]
        self._blocks = [torch.stack([lines.amin(1), lines.amax(1) + 1], 1).int() for lines, _ in self._places]
        """First row (or column) of each bin's brush, and the one after its last: int32 [bins, 2]."""
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
            name: table
            for name, table in self._fresh.items()
            if table.ndim == 1 and bool((table != table[0]).any())
        }
        """Properties that cells may override: those of new cells hang on their element."""

    def _lines(self, axis: int) -> tuple[Tensor, Tensor]:
        """The rows (or columns) of the brush at each bin, int64 [bins, brush] within the grid, and whether they lie there.

        Those outside stand for the nearest one inside, which the brush covers as well.
        """
        side, bins, brush = self.size[axis], self.agent.bins[axis], self.agent.brush[axis]
        center = (2 * torch.arange(bins, device=self.device) + 1) * side // (2 * bins)
        lines = center[:, None] - brush // 2 + torch.arange(brush, device=self.device)
        return lines.clamp(0, side - 1), (lines >= 0) & (lines < side)

    def fresh_state(self, ids: Tensor) -> dict[str, Tensor]:
        """The state of new worlds of known ids, uint8 [B, H, W]: what `Simulator.world` makes, without its checks."""
        state = {"element": ids}
        for slot in self._slots:
            if slot.name != "element":
                by_id = self._differing.get(slot.name)
                state[slot.name] = self._usual(slot, len(ids)) if by_id is None else by_id[ids.int()]
        return state

    def _usual(self, slot: Slot, batch: int) -> Tensor:
        """A slot that is the same in all cells."""
        dtype = getattr(torch, slot.dtype)
        if slot.planes == 2:
            value = torch.tensor(slot.default, dtype=dtype, device=self.device)[:, None, None]
            return value.repeat(batch, 1, *self.size)
        default = (
            int(self._fresh[slot.name][0]) if slot.name in self._fresh and not slot.is_real else slot.default
        )
        return torch.full((batch, *self.size), default, dtype=dtype, device=self.device)

    def act(self, world: World, actions: Tensor, *, reuse: bool) -> Done:
        """The worlds after actions, int64 [B, 5], within their bounds. `reuse` writes into the world's own tensors."""
        choice = self.choices[actions[:, 2]]
        blown, placed = choice == BLOW, choice >= 0
        rows, columns = (self._places[axis][0][actions[:, 1 - axis]] for axis in (0, 1))
        cells = (rows[:, :, None] * self.size[1] + columns[:, None]).flatten(1)
        if reuse and isinstance(world.state, PackedState):
            return self._act_packed(world, world.state, actions, choice)
        state = dict(world.state)
        painted = torch.zeros_like(choice)
        if self.places_elements:
            inside = [self._places[axis][1][actions[:, 1 - axis]] for axis in (0, 1)]
            old = state["element"].flatten(1).gather(1, cells)
            new = choice.clamp(min=0).to(torch.uint8)[:, None]
            differs = (old != new) & (inside[0][:, :, None] & inside[1][:, None]).flatten(1)
            painted = (differs & placed[:, None]).sum(1)
            self._place(state, cells, choice, ~placed, reuse)
        if self.agent.speed_field is not None:
            self._blow(state, cells, actions, blown, reuse)
        return Done(replace(world, state=state), painted, placed.long(), blown.long())

    def _act_packed(self, world: World, state: PackedState, actions: Tensor, choice: Tensor) -> Done:
        """The same where worlds lie packed: blocks are filled there."""
        block = torch.cat([self._blocks[axis][actions[:, 1 - axis]] for axis in (0, 1)], 1)
        blown, placed = choice == BLOW, choice >= 0
        ids, painted = choice.clamp(min=0), torch.zeros_like(choice)
        if self.places_elements:
            where = torch.where(placed[:, None], block, 0)
            painted = state.count_others("element", where, ids)
            for name, table in self._fresh.items():
                state.fill(name, where, table[ids])
        if self.agent.speed_field is not None:
            where = torch.where(blown[:, None], block, 0)
            state.fill(self.agent.speed_field, where, self._speed(actions))
        return Done(world, painted, placed.long(), blown.long())

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
        self._write(state, name, cells, self._speed(actions), ~blown, reuse)

    def _speed(self, actions: Tensor) -> Tensor:
        """What each action blows with, as (rows, columns): float32 [B, 2]."""
        return self.agent.speed * (actions[:, [4, 3]] - 1).to(torch.float32)

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
        value = torch.as_tensor(given.get(param.name, float(param.default)), device=sim.device)
        found[param.name] = value.to(torch.float64).expand(batch)
    return found
