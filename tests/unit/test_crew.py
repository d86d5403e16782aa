"""Processes that work through tasks: what one of them dies of is known, and the others continue."""

from __future__ import annotations

from collections import deque

from tests.fuzz.crew import Done, Lost, work_through
from tests.unit.crew_work import work


def test_every_task_is_done_by_several_processes() -> None:
    done = list(work_through(deque(range(12)), work, jobs=2, limit=60, recycle=5))
    assert {(one.task, one.result) for one in done if isinstance(one, Done)} == {
        (i, i * i) for i in range(12)
    }


def test_a_task_that_kills_its_process_costs_only_itself() -> None:
    outcomes = {one.task: one for one in work_through(deque([1, 13, 2, 17, 19, 3]), work, jobs=2, limit=20)}
    assert {task for task, one in outcomes.items() if isinstance(one, Done)} == {1, 2, 3}
    assert outcomes[13] == Lost(13, "the process died: SIGKILL", "at 13")
    assert outcomes[17] == Lost(17, "the process died: exit code 3", "at 17")
    assert outcomes[19] == Lost(19, "took more than 20 s", "at 19")


def test_tasks_may_be_added_meanwhile() -> None:
    tasks = deque([2])
    found = []
    for one in work_through(tasks, work, jobs=1, limit=60):
        assert isinstance(one, Done)
        found.append(one.result)
        if one.result < 1000:
            tasks.append(one.result)
    assert found == [4, 16, 256, 65536]
