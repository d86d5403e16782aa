"""Processes that work through tasks. If one dies or hangs, its task is reported as lost, and the others continue."""

from __future__ import annotations

import signal
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import active_children, get_context
from typing import Any

from powderdsl.system.interrupts import delay_signal
from powderdsl.testing.mutation.judging import _begin_process

Work = Callable[[Any], Any]
"""What a process does with a task. Must be importable by name."""


@dataclass(frozen=True)
class Done:
    """A task and its result."""

    task: Any
    result: Any


@dataclass(frozen=True)
class Lost:
    """A task whose process died or took too long, and the reason as text."""

    task: Any
    reason: str


def work_through(
    tasks: deque[Any], work: Work, jobs: int, limit: int, recycle: int = 200
) -> Iterator[Done | Lost]:
    """Yield results in the order in which they come. Tasks that the caller appends meanwhile are done too.

    Args:
        work: runs in `jobs` fresh processes; one is replaced after `recycle` tasks, so that it cannot grow forever.
        limit: seconds that a task may take.
    """
    # A pool of one process each: a process that dies takes its pool with it, and no other task.
    idle: list[ProcessPoolExecutor] = []
    busy: dict[Future[Any], tuple[Any, ProcessPoolExecutor]] = {}
    try:
        while tasks or busy:
            while tasks and len(busy) < jobs:
                pool = idle.pop() if idle else _one_process(recycle)
                task = tasks.popleft()
                with delay_signal():  # a process whose start is cut short ends with a traceback
                    busy[pool.submit(_within, limit, work, task)] = task, pool
            for future in wait(busy, return_when=FIRST_COMPLETED).done:
                task, pool = busy.pop(future)
                try:
                    outcome: Done | Lost = Done(task, future.result())
                    idle.append(pool)
                except BrokenProcessPool:
                    outcome = Lost(task, f"the process died, or took more than {limit} s")
                yield outcome
    finally:
        for process in active_children():
            process.kill()
        for pool in (*idle, *(pool for _, pool in busy.values())):
            pool.shutdown(cancel_futures=True)


def _one_process(recycle: int) -> ProcessPoolExecutor:
    # A fork of a process with threads of torch's may hang.
    return ProcessPoolExecutor(1, get_context("spawn"), _begin_process, max_tasks_per_child=recycle)


def _within(limit: int, work: Work, task: Any) -> Any:
    """Do a task; the process dies if it takes too long."""
    signal.alarm(limit)
    try:
        return work(task)
    finally:
        signal.alarm(0)
