"""What acts while episodes are recorded, by name. Any other function of observations can be given instead."""

from __future__ import annotations

from collections.abc import Callable

import torch

from powderdsl.envs.acting import Policy, random_policy
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.task import BLOW, NO_CHANGE, Task


def nothing_policy(program: TaskProgram) -> Policy:
    """The same action again and again, as `still_action` has it. Raises ValueError where there is none."""
    action = torch.tensor(still_action(program.task), device=program.simulator.device)
    return lambda observed, keys: action.expand(len(observed), 5)


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


SCRIPTED: dict[str, Callable[[TaskProgram], Policy]] = {
    "random": lambda program: random_policy(program.action_nvec),
    "nothing": nothing_policy,
}
