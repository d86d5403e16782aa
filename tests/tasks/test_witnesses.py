"""Tasks of our own can be solved: by a short script, hardly by chance, and never by doing nothing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import powderdsl
from powderdsl.syntax.sources import shipped
from powderdsl.tasks.episodes import ACTION, TaskProgram, check_numbers
from powderdsl.tasks.players import ExpertPlayer
from powderdsl.tasks.shipped import load_task, shipped_tasks
from tests.tasks.witnesses import WITNESSES, Act, Seen
from tests.tiers import tiered

WORLDS = 8
PLAYERS = ("witness", "chance", "nothing")
ALIVE = {"herd-birds", "snakes-in-the-garden"}
"""Tasks about creatures that may go where they should by themselves, now and then."""
OF_THE_PAPER = {"sand-pushing", "destroying", "path-building", "world-model"}


@dataclass(frozen=True)
class Played:
    """How the worlds of one player ended: bool and float64 [WORLDS]."""

    solved: NDArray[np.bool_]
    returns: NDArray[np.float64]


@cache
def simulator(rules: str):  # type: ignore[no-untyped-def]
    return powderdsl.compile(rules, backend="wasm")


def play(name: str, split: str) -> dict[str, Played]:
    """The same `WORLDS` worlds, three times side by side in one batch: once for each of `PLAYERS`."""
    task = load_task(name)
    program = TaskProgram(task, split, simulator(*task.rules))
    agent = program.task.agent
    elements = program.simulator.elements
    words = [{-1: "blow", -2: "nothing"}.get(one) or elements[one] for one in agent.choices]
    episodes = program.start(torch.arange(WORLDS).repeat(3))
    random = np.random.default_rng(0)
    solved, over = np.zeros(3 * WORLDS, dtype=bool), np.zeros(3 * WORLDS, dtype=bool)
    returns = np.zeros(3 * WORLDS)

    def numbers(act: Act) -> list[int]:
        """An act as the five numbers of an action. What lies outside is done at the edge."""
        word, row, column, down, right = (*act, 0, 0)[:5]
        bins = (
            int(np.clip(place, 0, 63)) * n // 64 for place, n in zip((row, column), agent.bins, strict=True)
        )
        y, x = bins
        return [x, y, words.index(word), right + 1, down + 1]

    def scripted(turn: int) -> list[list[int]]:
        """What the witness does: moves of the task's own, or a script of ours."""
        if name not in WITNESSES:
            return ExpertPlayer(program)(episodes)[:WORLDS].tolist()
        ids = episodes.world.ids.numpy()
        regions = {key: value.expand(3 * WORLDS, -1, -1).numpy() for key, value in episodes.regions.items()}
        seen = (Seen(ids[i], {k: v[i] for k, v in regions.items()}, elements, turn) for i in range(WORLDS))
        return [numbers(WITNESSES[name](one)) for one in seen]

    for turn in range(agent.actions):
        actions = scripted(turn)
        actions += random.integers(program.action_nvec, size=(WORLDS, 5)).tolist()
        actions += [numbers(("nothing", 0, 0))] * WORLDS
        checked = check_numbers(actions, program.action_nvec, ACTION)
        episodes, reward, success, ended = program.act(episodes, checked, reuse=True)
        returns += np.where(over, 0, reward.numpy())
        solved |= success.numpy() & ~over
        over |= ended.numpy()
        if over.all():
            break
    parts = (slice(i * WORLDS, (i + 1) * WORLDS) for i in range(3))
    return {player: Played(solved[part], returns[part]) for player, part in zip(PLAYERS, parts, strict=True)}


TEXTS = {name: (shipped("tasks") / f"{name}.yaml").read_text("utf-8") for name in shipped_tasks()}
OF_UNIVERSES = {name for name, text in TEXTS.items() if "\nrulesets:" in text}
"""Tasks of generated rules: `test_universe_tasks` plays them."""
SECOND = [name for name, text in TEXTS.items() if "\nfamily:" in text and name not in OF_UNIVERSES]


@pytest.mark.parametrize("split", ["train", "test"])
@pytest.mark.parametrize("name", tiered([*WITNESSES, *SECOND], [*[*WITNESSES][:2], SECOND[0]]))
def test_a_witness_solves_it_and_chance_does_not(torch, name, split):
    played = play(name, split)
    witness, chance, nothing = (played[player] for player in PLAYERS)
    assert witness.solved.mean() >= 0.75
    assert chance.solved.mean() <= 0.25
    assert nothing.solved.mean() <= (0.25 if name in ALIVE else 0)
    assert witness.returns.mean() > max(chance.returns.mean(), nothing.returns.mean()) + 0.2


def test_every_task_of_our_own_has_a_witness():
    assert {*WITNESSES, *SECOND} == set(shipped_tasks()) - OF_THE_PAPER - OF_UNIVERSES
    assert len({load_task(name).family for name in SECOND}) == 5
