"""Experts of tasks: which move they play and where, plans that are searched, and what is wrong with bad ones."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import torch

from powderdsl.diagnostics import CompileError, Reporter, Severity, Source
from powderdsl.experiments.runs import Estimate
from powderdsl.rl.evaluation import evaluate
from powderdsl.system.settings import fingerprint
from powderdsl.tasks.episodes import Episodes, TaskProgram, compile_task
from powderdsl.tasks.file import read_task
from powderdsl.tasks.players import ExpertPlayer, best_plans
from powderdsl.tasks.shipped import load_task
from powderdsl.tasks.task import Task
from tests.tasks.test_episodes import task_of

YARD = """task: yard
rules: powderworld
size: [24, 32]
fill: empty
regions:
  pit: box rows 12:20 columns 4:20
generate:
  - scatter sand chance 20%
  - scatter stone chance 10%
agent: {may: [water, wall, blow, nothing], speed: 5, bins: [6, 8], brush: [6, 4], actions: 4}
reward: {each: count(water) / 10}
"""


def program_of(expert: str) -> TaskProgram:
    return compile_task(task_of(f"{YARD}expert:\n{expert}"), backend="torch")


def fullest(cells: np.ndarray, task: Task) -> tuple[int, int, int]:
    """Row and column of the first bin with most cells in its block, counted one by one; and how many cells there are."""
    best, place = -1, (0, 0)
    for row in range(task.agent.bins[0]):
        for column in range(task.agent.bins[1]):
            top = task.agent.first_line(0, row, task.size[0])
            left = task.agent.first_line(1, column, task.size[1])
            block = cells[
                max(top, 0) : max(top + task.agent.brush[0], 0),
                max(left, 0) : max(left + task.agent.brush[1], 0),
            ]
            if block.sum() > best:
                best, place = int(block.sum()), (row, column)
    return *place, int(cells.sum())


def test_a_move_acts_where_most_cells_are() -> None:
    """On the block that counting cell by cell finds, in each world and for each way to limit the cells."""
    expert = """
  - {choose: wall, at: most(sand in pit), within: "box rows 14:18 columns :", least: 9}
  - {choose: blow, toward: above.left, at: most(stone and below is sand)}
  - {choose: water, at: most(sand)}
"""
    program = program_of(expert)
    task, names = program.task, [one.name for one in program.task.ruleset.elements]
    episodes = program.start(torch.arange(40))
    actions = ExpertPlayer(program)(episodes)
    played = set()
    for i, ids in enumerate(episodes.world.state["element"].numpy()):
        sand, stone = ids == names.index("sand"), ids == names.index("stone")
        near = np.zeros_like(sand)
        near[14:18, 4:20] = True
        below = np.roll(sand, -1, 0)
        row, column, count = fullest(sand & near, task)
        wanted = [column, row, 0, 1, 1]
        if count < 9:
            row, column, count = fullest(stone & below, task)
            wanted = [column, row, 2, 0, 0]
            if not count:
                row, column, _ = fullest(sand, task)
                wanted = [column, row, 1, 1, 1]
        assert actions[i].tolist() == wanted
        played.add(wanted[2])
    assert played == {0, 2}


def test_moves_come_in_order_of_their_conditions() -> None:
    program = program_of("""
  - {choose: wall, at: [0, 0], if: taken == 0}
  - {choose: water, at: [23, 31], if: count(wall) > 0 and left > 2}
  - {choose: nothing}
""")
    episodes, player, seen = program.start(torch.arange(2)), ExpertPlayer(program), []
    for _ in range(4):
        actions = player(episodes)
        seen.append(actions.tolist())
        episodes, *_ = program.act(episodes, actions)
    assert seen == [
        [one, one] for one in ([0, 0, 0, 1, 1], [7, 5, 1, 1, 1], [0, 0, 3, 1, 1], [0, 0, 3, 1, 1])
    ]


def test_a_search_plays_the_best_of_its_plans() -> None:
    """What it promises is what playing gives, and more plans are never worse: the first ones are among them."""
    program = program_of("  search: 12\n")
    worlds = torch.arange(5)
    plans = {count: best_plans(program, worlds, count) for count in (1, 4, 12)}

    def played(choose: Callable[[Episodes, int], torch.Tensor]) -> torch.Tensor:
        episodes, total = program.start(worlds), torch.zeros(5, dtype=torch.float64)
        for step in range(program.task.agent.actions):
            episodes, reward, *_ = program.act(episodes, choose(episodes, step))
            total += reward.double()
        return total

    one, four, twelve = (played(lambda _, step, plan=plan: plan[:, step]) for plan in plans.values())
    player = ExpertPlayer(program)
    assert torch.equal(played(lambda episodes, _: player(episodes)), twelve)
    assert bool((twelve >= four).all())
    assert bool((twelve > one).any())
    assert torch.equal(best_plans(program, worlds[3:], 12), plans[12][3:])


def test_an_expert_changes_no_fingerprint() -> None:
    """Runs and datasets that were begun before a task had one continue."""
    task = load_task("sand-pushing")
    assert task.expert is not None
    assert fingerprint(task) == fingerprint(replace(task, expert=None))


@pytest.mark.parametrize(("name", "least"), [("sand-pushing", 6.0), ("path-building", 1.0)])
def test_shipped_experts_beat_doing_nothing(name: str, least: float) -> None:
    found = evaluate(load_task(name), splits=["test"], policies=["expert", "nothing"], episodes=32)
    expert, nothing = found.scores
    assert expert.above["nothing"].mean > least
    assert expert.normalized == Estimate(1.0, 0.0)
    assert nothing.normalized == Estimate(0.0, 0.0)


def test_scores_on_the_experts_scale() -> None:
    """Random actions lie between, with the interval of paired worlds; worlds without a difference are counted."""
    task = task_of(f"{YARD}expert:\n  - {{choose: water, at: most(sand)}}\n")
    found = evaluate(task, episodes=24, backend="torch")
    scores = {one.policy: one for one in found.scores}
    assert list(scores) == ["expert", "random", "nothing"]
    assert scores["random"].normalized is not None
    ratio, half = scores["random"].normalized
    assert 0 < ratio < 1
    assert half is not None
    assert 0 < half < 1
    assert found.as_json()["splits"]["train"]["random"]["normalized"] == {"mean": ratio, "interval": half}
    assert found.unchanged == {"train": 0}
    rich = replace(task, goal=replace(task.goal, each=None))
    assert evaluate(rich, episodes=4, backend="torch").unchanged == {"train": 4}
    assert evaluate(rich, episodes=4, backend="torch").scores[0].normalized is None


def test_test_worlds_that_are_training_worlds_are_told_apart() -> None:
    """A sixth of these test worlds are empty, as training worlds without lines and disks are."""
    found = evaluate(load_task("destroying"), episodes=64, policies=["nothing"], backend="wasm")
    assert list(found.seen) == ["test"]
    seen = found.seen["test"]
    assert 3 < seen.worlds < 25
    everywhere = next(one for one in found.scores if one.split == "test")
    empty = 62 * 62 / 1000
    whole = seen.worlds * empty + (64 - seen.worlds) * seen.without["nothing"].mean
    assert everywhere.mean == pytest.approx(whole / 64)
    assert found.as_json()["seen"]["test"]["worlds"] == seen.worlds


WRONG = {
    "  search: 0\n": ("PD402", "0"),
    "  search: 3\n  find: 3\n": ("PD108", "find"),
    "  []\n": ("PD107", "[]"),
    "  - {at: [1, 1]}\n": ("PD109", ""),
    "  - {choose: lava}\n": ("PD804", "lava"),
    "  - {choose: jam}\n": ("PD604", "jam"),
    "  - {choose: blow}\n": ("PD109", "blow"),
    "  - {choose: wall, toward: left}\n": ("PD804", "left"),
    "  - {choose: blow, toward: up}\n": ("PD804", "up"),
    "  - {choose: blow, toward: left.right}\n": ("PD804", "left.right"),
    "  - {choose: wall, at: count(sand)}\n": ("PD804", "count(sand)"),
    "  - {choose: wall, at: most(sand in hole)}\n": ("PD802", "hole"),
    "  - {choose: wall, at: most(sand), within: blob rows 1}\n": ("PD605", "blob"),
    "  - {choose: wall, at: most(sand), within: 'box rows 1:(2..3)'}\n": ("PD803", ""),
    "  - {choose: wall, at: [0, 0], least: 3}\n": ("PD804", ""),
    "  - {choose: wall, if: taken == 0}\n": ("PD804", ""),
    "  - {choose: wall, if: painted > 0}\n  - {choose: wall}\n": ("PD406", "painted > 0"),
    "  - {choose: wall, if: count(sand)}\n  - {choose: wall}\n": ("PD401", "count(sand)"),
}


@pytest.mark.parametrize("expert", WRONG)
def test_what_is_wrong_is_reported_at_its_place(expert: str) -> None:
    reporter = Reporter()
    with suppress(CompileError):
        read_task(Source("yard.yaml", f"{YARD}expert:\n{expert}"), reporter)
    errors = [one for one in reporter.diagnostics if one.severity is Severity.ERROR]
    code, place = WRONG[expert]
    assert [one.code for one in errors] == [code]
    span = errors[0].primary.span
    assert place in span.text
