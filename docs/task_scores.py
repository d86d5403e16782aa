"""Returns that the playground compares with the player's: `python docs/task_scores.py` writes `web/page/scores.json`.

Of each task that can be played there, in each of its worlds: what its expert (if there is one), random actions and doing
nothing return. Random is a mean over PLAYS episodes.
"""

from __future__ import annotations

import json
from collections.abc import Callable

import torch
from torch import Tensor

from powderdsl.tasks.episodes import Episodes, TaskProgram, compile_task
from powderdsl.tasks.goals import measures_in, scalars_of
from powderdsl.tasks.players import ExpertPlayer
from powderdsl.tasks.shipped import load_task, shipped_tasks
from powderdsl.tasks.task import Task
from powderdsl.web.playable import WORLDS, played_split
from powderdsl.web.site import PAGE

PLAYS = 16

KNOWN = {"element", "member", "let", "and", "or", "not", "const"}
"""Operations on cells that depend only on their element."""

Player = Callable[[Episodes], Tensor | None]


def playable() -> tuple[str, ...]:
    """The shipped tasks with a goal that depends on counts of elements, under rules that the page has or makes."""
    return tuple(name for name in shipped_tasks() if is_playable(load_task(name)))


def is_playable(task: Task) -> bool:
    split, values = played_split(task), [measure.value for measure in measures_in(scalars_of(task.goal))]
    alike = not split.params and all(len(rules) == 1 for rules in (task.rules, *split.rulesets))
    known = all(value is not None and {part.op for part in value.walk()} <= KNOWN for value in values)
    return alike and known and (task.goal.each is not None or task.goal.final is not None)


def returns(program: TaskProgram, worlds: Tensor, player: Player) -> Tensor:
    """The return of a player in each of some worlds, float64 [n]."""
    episodes = program.start(worlds)
    total = torch.zeros(len(worlds), dtype=torch.float64)
    going = torch.ones(len(worlds), dtype=torch.bool)
    while bool(going.any()):
        episodes, reward, _, over = program.act(episodes, player(episodes))
        total += torch.where(going, reward.double(), 0.0)
        going &= ~over
    return total


def scores(name: str) -> dict[str, list[float]]:
    """The returns of a task in its worlds, by player."""
    program = compile_task(name, split=played_split(load_task(name)).name)
    parts = [_scores(one, places) for places, one in program.apart(torch.arange(WORLDS))]
    return {player: [value for part in parts for value in part[player]] for player in parts[0]}


def _scores(program: TaskProgram, worlds: Tensor) -> dict[str, list[float]]:
    """The same, of worlds under the same rules."""
    draws = torch.Generator().manual_seed(0)
    nvec = torch.tensor(program.action_nvec)

    def chance(episodes: Episodes) -> Tensor:
        return (torch.rand(len(episodes), 5, generator=draws) * nvec).long()

    expert = {"expert": returns(program, worlds, ExpertPlayer(program))} if program.task.expert else {}
    played = {
        **expert,
        "random": returns(program, worlds.repeat(PLAYS), chance).view(PLAYS, -1).mean(0),
        "nothing": returns(program, worlds, lambda _: None),
    }
    return {player: [round(value, 5) for value in found.tolist()] for player, found in played.items()}


if __name__ == "__main__":
    lines = [f"{json.dumps(name)}: {json.dumps(scores(name))}" for name in playable()]
    (PAGE / "scores.json").write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
