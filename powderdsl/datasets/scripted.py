"""What acts while episodes are recorded: any function of observations, and two scripted ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from powderdsl.backends.torch_random import MASK, mix
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.task import BLOW, NO_CHANGE, Task


@dataclass(frozen=True)
class Moment:
    """Which actions are asked for: those of the episodes `episode`, int64 [B], after `taken` actions, int64 [B]."""

    seed: int
    episode: Tensor
    taken: Tensor

    def draws(self, count: int) -> Tensor:
        """Random whole numbers from 0 to 2³² − 1: int64 [B, count].

        Hashes of the dataset's seed, the episode and the action's number. A policy that draws by them acts the same
        however many episodes are played together.
        """
        keys = torch.zeros_like(self.episode)
        for part in (self.seed & MASK, self.seed >> 32, self.episode & MASK, self.episode >> 32, self.taken):
            keys = mix((keys + 0x9E3779B1 + part) & MASK)
        number = torch.arange(count, dtype=torch.int64, device=self.episode.device)
        return mix((keys[:, None] + mix(number + 1)) & MASK)


Policy = Callable[[Tensor, Moment], Any]
"""From observations, uint8 [B, C, H, W], and the moment to actions: whole numbers [B, 5]."""


def random_policy(program: TaskProgram) -> Policy:
    """Every action as likely as any other."""
    nvec = torch.tensor(program.action_nvec, device=program.simulator.device)
    return lambda observed, moment: (moment.draws(5) * nvec) >> 32


def nothing_policy(program: TaskProgram) -> Policy:
    """The same action again and again, as `still_action` has it. Raises ValueError where there is none."""
    action = torch.tensor(still_action(program.task), device=program.simulator.device)
    return lambda observed, moment: action.expand(len(observed), 5)


def still_action(task: Task) -> tuple[int, int, int, int, int]:
    """The action ``nothing``; where agents have no such one but can blow, still air into the first bin.

    Raises:
        ValueError: the task has neither.
    """
    choices = task.agent.choices
    choice = next((one for one in (NO_CHANGE, BLOW) if one in choices), None)
    if choice is None:
        raise ValueError(
            f"the policy `nothing`: the agent of {task.name} may neither `blow` nor do `nothing`"
        )
    return 0, 0, choices.index(choice), 1, 1


SCRIPTED: dict[str, Callable[[TaskProgram], Policy]] = {"random": random_policy, "nothing": nothing_policy}
