"""A task's expert on tensors: scripted moves, or the best of many random plans by simulation."""

from __future__ import annotations

import torch
from torch import Tensor

from powderdsl.system.random import action_keys, uniforms
from powderdsl.tasks.episodes import Episodes, TaskProgram
from powderdsl.tasks.goals import measures_in, parts_of
from powderdsl.tasks.mixed import MixedEpisodes
from powderdsl.tasks.task import ExpertMove
from powderdsl.tasks.tensors.measures import Meter, ScalarInputs, scalar_value
from powderdsl.worlds.raster import mask

SIMULATED = 1024
"""Number of episodes that a search simulates at once."""

PLANS = 0x506C616E
"""The seed of random plans."""


class ExpertPlayer:
    """Plays the expert of a program's task. A search runs when a world first appears; its plan is cached.

    Raises ValueError for a task without an expert.
    """

    def __init__(self, program: TaskProgram):
        expert = program.task.expert
        if expert is None:
            raise ValueError(f"the task {program.task.name} has no expert")
        self.program, self.expert = program, expert
        self._under: dict[int, ExpertPlayer] = {}
        scalars = [part for move in expert.moves if move.condition for part in parts_of(move.condition)]
        most = [move.most for move in expert.moves if move.most is not None]
        self.measures = tuple(dict.fromkeys([*most, *measures_in(scalars)]))
        self._numbers = {measure: number for number, measure in enumerate(self.measures)}
        ruleset, device = program.simulator.ruleset, program.simulator.device
        self._meter = Meter(ruleset, self.measures, program.task.size, {}, device)
        self._plans: dict[int, Tensor] = {}
        """Of a search: int64 [actions, 5] by world."""

    def under(self, ruleset: int) -> ExpertPlayer:
        """The player for each ruleset by number, if worlds run under different ones."""
        if not self.program.is_mixed:
            return self
        if ruleset not in self._under:
            self._under[ruleset] = ExpertPlayer(self.program.under(ruleset))
        return self._under[ruleset]

    def __call__(self, episodes: Episodes | MixedEpisodes) -> Tensor:
        """The actions of some episodes, int64 [B, 5]."""
        if isinstance(episodes, MixedEpisodes):
            return episodes.joined(lambda program, part: self.under(program.ruleset or 0)(part))
        if self.expert.search:
            seeds, last = episodes.seed.tolist(), self.program.task.agent.actions - 1
            new = [seed for seed in dict.fromkeys(seeds) if seed not in self._plans]
            if new:
                worlds = torch.tensor(new, device=episodes.seed.device)
                self._plans |= zip(new, best_plans(self.program, worlds, self.expert.search), strict=True)
            steps = zip(seeds, episodes.acted.tolist(), strict=True)
            return torch.stack([self._plans[seed][min(step, last)] for seed, step in steps])
        places = episodes.regions, episodes.targets
        now = self._meter.take(episodes.world, *places, episodes.params, self._meter.masks(*places))
        left = self.program.task.agent.actions - episodes.acted
        inputs = ScalarInputs(self._numbers, now, now, now, {"taken": episodes.acted, "left": left})
        actions = torch.zeros(len(episodes), 5, dtype=torch.int64, device=now.device)
        waiting = torch.ones(len(episodes), dtype=torch.bool, device=now.device)
        for number, move in enumerate(self.expert.moves):
            applies = waiting.clone()
            if move.condition is not None:
                applies &= scalar_value(move.condition, inputs) != 0
            if not bool(applies.any()):
                continue
            targets, cells = self._action(move, episodes)
            if number + 1 < len(self.expert.moves):
                applies &= cells >= move.least
            actions[applies] = targets[applies]
            waiting &= ~applies
        return actions

    def _action(self, move: ExpertMove, episodes: Episodes) -> tuple[Tensor, Tensor]:
        """The action of a move in every episode, int64 [B, 5], and the number of cells counted, int64 [B]."""
        task = self.program.task
        count = torch.full_like(episodes.acted, task.size[0] * task.size[1])
        if move.most is not None:
            cells = self._meter.cells(self._numbers[move.most], episodes.world, episodes.regions)
            if move.within is not None:
                cells = cells & torch.from_numpy(mask(move.within, task.size)).to(cells.device)
            count = cells.sum((1, 2))
            row, column = self._fullest(cells)
        else:
            assert move.cell is not None
            row, column = (
                torch.full_like(episodes.acted, place * bins // side)
                for place, bins, side in zip(move.cell, task.agent.bins, task.size, strict=True)
            )
        rows, columns = move.toward
        other = [torch.full_like(episodes.acted, value) for value in (move.choice, columns + 1, rows + 1)]
        return torch.stack([column, row, *other], 1), count

    def _fullest(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """The first bin, int64 [B] each, whose block has most of some cells, bool [B, H, W]."""
        sums = torch.nn.functional.pad(cells.long().cumsum(1).cumsum(2), (1, 0, 1, 0))
        (top, bottom), (left, right) = (edges.T for edges in self.program.hands.blocks.edges)
        count = sums[:, bottom][:, :, right] - sums[:, top][:, :, right]
        count += sums[:, top][:, :, left] - sums[:, bottom][:, :, left]
        best = count.flatten(1).argmax(1)
        columns = self.program.task.agent.bins[1]
        return best // columns, best % columns


def best_plans(program: TaskProgram, worlds: Tensor, count: int) -> Tensor:
    """The best of `count` random plans in each of some worlds, int64 [n]: int64 [n, actions, 5].

    Every plan is simulated from the start of the world. The plan with the highest return wins, the first one if several
    are equal. Plans are hashes of the world and the plan's number.
    """
    agent, device = program.task.agent, worlds.device
    nvec = torch.tensor(program.action_nvec, device=device)
    best = torch.zeros(len(worlds), agent.actions, 5, dtype=torch.int64, device=device)
    returns = torch.full((len(worlds),), -torch.inf, dtype=torch.float64, device=device)
    together = max(1, SIMULATED // max(1, len(worlds)))
    for first in range(0, count, together):
        numbers = torch.arange(first, min(first + together, count), device=device)
        seeds = worlds.repeat(len(numbers))  # plan by plan
        places = numbers.repeat_interleave(len(worlds)) * agent.actions
        keys = (action_keys(PLANS, seeds, places + step) for step in range(agent.actions))
        plans = torch.stack([(uniforms(key, 5) * nvec).long() for key in keys], 1)
        plan_returns = _returns(program, seeds, plans).view(len(numbers), len(worlds))
        top = plan_returns.argmax(0)
        better = plan_returns.gather(0, top[None])[0]
        plans = plans.view(len(numbers), len(worlds), agent.actions, 5)
        chosen = plans[top, torch.arange(len(worlds), device=device)]
        wins = better > returns
        best[wins], returns[wins] = chosen[wins], better[wins]
    return best


def _returns(program: TaskProgram, seeds: Tensor, plans: Tensor) -> Tensor:
    """The return of a plan in each of some worlds, float64 [n]."""
    episodes = program.start(seeds)
    total = torch.zeros(len(seeds), dtype=torch.float64, device=seeds.device)
    going = torch.ones(len(seeds), dtype=torch.bool, device=seeds.device)
    for step in range(plans.shape[1]):
        episodes, reward, _, over = program.act(episodes, plans[:, step], reuse=True)
        total += torch.where(going, reward.double(), 0.0)
        going &= ~over
    return total
