"""Forms of actions, their mapping to the five numbers that tasks take, and policies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Discrete, MultiDiscrete
from torch import Tensor

from powderdsl.system.random import uniforms
from powderdsl.system.settings import check_choice
from powderdsl.tasks.episodes import ACTION, check_numbers, integer_tensor
from powderdsl.tasks.task import BLOW, NO_CHANGE, Agent

KINDS = ("multidiscrete", "discrete", "full")

MAX_ACTIONS = 1 << 20
"""Maximum number of actions of the discrete form."""

UNREAD = (0, 0, 0, 1, 1)
"""The values of unused numbers; vx and vy are those of a blow without effect."""


@dataclass(frozen=True, eq=False)
class ActionForm:
    """A form of the actions of one agent, created by `action_form`. Its tensors are on one device.

    ``full``: the five numbers x, y, choice, vx, vy. ``multidiscrete``: those of them that one of the agent's choices
    uses and that can have several values; only the choice if there are none. ``discrete``: one number, each value of
    which has a different effect (see `table`).
    """

    kind: str
    space: Discrete[Any] | MultiDiscrete
    """Of one action."""
    names: tuple[str, ...]
    """The name of each number of an action."""
    nvec: tuple[int, ...]
    """The number of values of each number of an action."""
    mask: Tensor
    """bool [sum of `nvec`]: the allowed values of the first number, then of the next, …. Only `full` has disallowed
    values: an unused number has a single allowed value."""
    full_nvec: tuple[int, ...]
    """The number of values of each of the five numbers."""
    columns: Tensor
    """int64 [k]: which of the five numbers an action contains, unless it is ``discrete``."""
    table: Tensor
    """The five numbers of each value of a ``discrete`` action, int64 [n, 5]; of other forms UNREAD, [1, 5].

    Values are ordered by operation, then by y, then by x: ``value = (operation · rows + y) · columns + x``. Operations
    are the agent's choices in order, with one blow for each (vy, vx), vx varying fastest. Doing nothing has no location
    and is the last value.
    """
    weights: Tensor
    """int64 [choices, 5]: a ``discrete`` action is ``weights[choice] · (x, y, 1, vx, vy)``."""

    def decode(self, actions: Any) -> Tensor:
        """The five numbers of actions: int64 [B, 5], from integers [B] (``discrete``) or [B, k].

        Raises TypeError if they are not integers, ValueError for a wrong shape, or a number out of range, with its
        index.
        """
        if self.kind == "discrete":
            values = integer_tensor("actions", actions)
            if values.ndim != 1:
                raise ValueError(f"actions must have the shape [episodes], found {list(values.shape)}")
            actions = values[:, None]
        numbers = check_numbers(actions, self.nvec, self.names).to(self.table.device)
        if self.kind == "discrete":
            return self.table[numbers[:, 0]]
        if len(self.columns) == len(ACTION):
            return numbers
        return self.table.expand(len(numbers), -1).clone().index_copy_(1, self.columns, numbers)

    def encode(self, numbers: Any) -> Tensor:
        """The actions in this form, int64 [B] or [B, k], that are equivalent to five numbers each, [B, 5].

        Raises as `decode`.
        """
        full = check_numbers(numbers, self.full_nvec, ACTION).to(self.table.device)
        if self.kind != "discrete":
            return full[:, self.columns]
        terms = full.clone()
        terms[:, 2] = 1
        return (self.weights[full[:, 2]] * terms).sum(1)


def action_form(kind: str, agent: Agent, device: torch.device) -> ActionForm:
    """The form of a kind (one of KINDS) for an agent.

    Raises ValueError for an unknown kind, or more than MAX_ACTIONS discrete actions.
    """
    check_choice("actions", kind, KINDS)
    rows, columns = agent.bins
    full_nvec = agent.action_nvec
    acts, blows = agent.choices != (NO_CHANGE,), BLOW in agent.choices
    read = (columns > 1 and acts, rows > 1 and acts, len(agent.choices) > 1, blows, blows)
    table, weights = torch.tensor([UNREAD]), torch.zeros(len(agent.choices), 5, dtype=torch.int64)
    if kind == "discrete":
        table, weights = _discrete(agent)
        chosen: tuple[int, ...] = ()
        names: tuple[str, ...] = ("action",)
        nvec: tuple[int, ...] = (len(table),)
        space: Discrete[Any] | MultiDiscrete = Discrete(len(table))
    else:
        chosen = tuple(place for place in range(5) if read[place] or kind == "full") or (2,)
        names, nvec = tuple(ACTION[place] for place in chosen), tuple(full_nvec[place] for place in chosen)
        space = MultiDiscrete(np.array(nvec))
    mask = torch.ones(sum(nvec), dtype=torch.bool)
    if kind == "full":
        for part, value, is_read in zip(mask.split(nvec), UNREAD, read, strict=True):
            if not is_read:
                part[:] = torch.arange(len(part)) == value
    tensors = [part.to(device) for part in (mask, torch.tensor(chosen, dtype=torch.int64), table, weights)]
    return ActionForm(kind, space, names, nvec, tensors[0], full_nvec, *tensors[1:])


def _discrete(agent: Agent) -> tuple[Tensor, Tensor]:
    rows, columns = agent.bins
    places = rows * columns
    motions = [(vx, vy) for vy in range(3) for vx in range(3)]
    done = [
        (number, *motion)
        for number, choice in enumerate(agent.choices)
        if choice != NO_CHANGE
        for motion in (motions if choice == BLOW else [UNREAD[3:]])
    ]
    idle = NO_CHANGE in agent.choices
    count = len(done) * places + idle
    if count > MAX_ACTIONS:
        raise ValueError(f"this task has {count:,} actions: a discrete space takes {MAX_ACTIONS:,} at most")
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    where = torch.stack([x.flatten(), y.flatten()], 1).repeat(len(done), 1)
    what = torch.tensor(done, dtype=torch.int64).view(-1, 3).repeat_interleave(places, 0)
    table, weights = torch.cat([where, what], 1), []
    for number, choice in enumerate(agent.choices):
        first = next((place for place, pair in enumerate(done) if pair[0] == number), 0) * places
        motion = (places, 3 * places) if choice == BLOW else (0, 0)
        weights.append((0, 0, count - 1, 0, 0) if choice == NO_CHANGE else (1, columns, first, *motion))
    if idle:
        nothing = (*UNREAD[:2], agent.choices.index(NO_CHANGE), *UNREAD[3:])
        table = torch.cat([table, torch.tensor([nothing])])
    return table, torch.tensor(weights)


# Policies: random numbers are hashes, so that no batch changes them

Policy = Callable[[Tensor, Tensor], Tensor]
"""From observations [B, …] and keys, int64 [B], to actions int64 [B, 5]. Random numbers depend on the keys."""


class FrameStack:
    """The last observations of episodes, stacked along their channels, oldest first; zeros before an episode began."""

    def __init__(self, frames: int):
        self.frames = frames
        self._kept: Tensor | None = None

    def push(self, observed: Tensor) -> Tensor:
        """The stack [B, frames · C, …] after observations [B, C, …]."""
        if self.frames == 1:
            return observed
        channels = observed.shape[1]
        if self._kept is None:
            self._kept = observed.new_zeros(len(observed), self.frames * channels, *observed.shape[2:])
        self._kept = torch.cat([self._kept[:, channels:], observed], 1)
        return self._kept


def random_policy(nvec: tuple[int, ...]) -> Policy:
    """Uniformly random actions."""

    def act(observed: Tensor, keys: Tensor) -> Tensor:
        counts = torch.tensor(nvec, device=keys.device)
        return (uniforms(keys, len(nvec)) * counts).long()

    return act
