"""Tasks in the page: the same returns as here, from the same actions."""

from __future__ import annotations

import json
import runpy
import shutil
from pathlib import Path

import pytest
import torch

from powderdsl.compiler import load
from powderdsl.simulation.standalone import standalone_module
from powderdsl.tasks.episodes import compile_task
from powderdsl.tasks.shipped import load_task
from powderdsl.web.playable import WORLDS, played_split, task_data
from powderdsl.web.site import PAGE
from tests.tiers import tiered
from tests.wheels import succeed

HERE = Path(__file__).parent
PLAYABLE = runpy.run_path(str(HERE.parents[1] / "docs" / "task_scores.py"))["playable"]()
SCORES = json.loads((PAGE / "scores.json").read_text(encoding="utf-8"))


def played(name: str, seed: int) -> tuple[list[list[list[int]]], list[list[float]]]:
    """Random actions in two worlds of a task, as links have them, and their returns, successes and counts."""
    program = compile_task(name, split=played_split(load_task(name)).name)
    draws = torch.Generator().manual_seed(seed)
    nvec = torch.tensor(program.action_nvec)
    actions: list[list[list[int]]] = []
    results: list[list[float]] = []
    for world in range(2):
        own, taken, total = program.under(world), [], 0.0
        episodes, over = own.start(torch.tensor([world])), torch.zeros(1, dtype=torch.bool)
        while not over:
            action = (torch.rand(1, 5, generator=draws) * nvec).long()
            episodes, reward, success, over = own.act(episodes, action)
            x, y, choice, vx, vy = action[0].tolist()
            taken.append([x, y, choice, 3 * vy + vx])
            total += float(reward)
        actions.append(taken)
        results.append([total, bool(success), len(taken)])
    return actions, results


def test_the_scores_are_of_all_playable_tasks() -> None:
    assert list(SCORES) == list(PLAYABLE)
    assert all(len(row) == WORLDS for rows in SCORES.values() for row in rows.values())


@pytest.mark.parametrize("name", ["herd-gas", "stone-tower"])
def test_the_scores_are_what_doing_nothing_returns(name: str) -> None:
    program = compile_task(name)
    episodes, total = program.start(torch.arange(WORLDS)), torch.zeros(WORLDS, dtype=torch.float64)
    for _ in range(program.task.agent.actions):
        episodes, reward, _, _ = program.act(episodes, None)
        total += reward.double()
    assert total.tolist() == pytest.approx(SCORES[name]["nothing"], abs=1e-5)


@pytest.mark.parametrize(
    "names",
    tiered(
        [("herd-gas", "stone-tower", "blow-up-the-heap", "aim-with-the-wind"), PLAYABLE],
        [("herd-gas", "stone-tower", "blow-up-the-heap", "aim-with-the-wind")],
    ),
)
def test_the_page_judges_as_tasks_do(names: tuple[str, ...], tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("the page is tested with Node.js")
    actions, expected = {}, {}
    for number, name in enumerate(names):
        data = task_data(name)
        (tmp_path / f"{name}.json").write_text(json.dumps(data), encoding="utf-8")
        for start in data["starts"][:2]:
            rules, size = start["rules"], (start["world"]["rows"], start["world"]["columns"])
            module = tmp_path / f"{rules}-{size[0]}x{size[1]}.wasm"
            if not module.exists():
                ruleset = load(rules.replace("universe_", "universe:"))
                module.write_bytes(standalone_module(ruleset, size))
        actions[name], expected[name] = played(name, number)
    (tmp_path / "actions.json").write_text(json.dumps(actions), encoding="utf-8")
    found = json.loads(succeed(node, HERE / "judge.mjs", PAGE / "judge.js", tmp_path, cwd=tmp_path))
    assert found == expected
