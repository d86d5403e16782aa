"""Tasks under generated rules: who knows the laws does better than chance, in universes that training never shows."""

from __future__ import annotations

import pytest

from powderdsl.tasks.shipped import load_task
from tests.tasks.test_witnesses import OF_UNIVERSES, TEXTS
from tests.tiers import tiered

pytestmark = pytest.mark.usefixtures("torch")

SUITE = sorted(name for name in OF_UNIVERSES if "\nfamily:" in TEXTS[name])
FIND_OUT = ["aim-with-the-wind", "find-the-solvent", "float-or-sink"]
"""Tasks in which the best action depends on a law that differs by universe, so that chance gets less than half."""

EPISODES = {name: 12 if name in FIND_OUT else 64 for name in SUITE}
"""Experts of the other tasks are closer to chance."""


@pytest.mark.parametrize("name", tiered(SUITE, FIND_OUT))
def test_the_expert_does_better_than_chance_in_new_universes(name: str) -> None:
    from powderdsl.rl.evaluation import evaluate

    task = load_task(name)
    how = {"splits": ["test"], "policies": ["expert", "random", "nothing"], "episodes": EPISODES[name]}
    scores = {score.policy: score for score in evaluate(task, backend="wasm", **how).scores}
    assert scores["expert"].normalized.mean == 1
    for other in ("random", "nothing"):
        above = scores["expert"].above[other]
        assert above.mean > above.interval
    if name in FIND_OUT:
        assert scores["random"].normalized.mean < 0.6


def test_the_suite_has_six_tasks_of_four_families() -> None:
    tasks = [load_task(name) for name in SUITE]
    assert len(tasks) == 6
    assert {task.family for task in tasks} == {"find-out", "build", "destroy", "push"}
    for task in tasks:
        train, test = (set(task.split(name).rulesets) for name in ("train", "test"))
        assert len(train) == 256
        assert len(test) == 16
        assert not train & test
