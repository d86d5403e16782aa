"""Processes that work through tasks. If one dies or hangs, its task is reported as lost, and the others continue."""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

Tell = Callable[[Any], None]
Work = Callable[[Any, Tell], Any]
"""What a process does with a task: returns a result, and may report how far it is. Must be importable by name."""


@dataclass(frozen=True)
class Done:
    """A task and its result."""

    task: Any
    result: Any


@dataclass(frozen=True)
class Lost:
    """A task whose process died or took too long (`reason` says which), and what it reported last (`told`)."""

    task: Any
    reason: str
    told: Any


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    task: Any = None
    busy: bool = False
    told: Any = None
    since: float = 0.0
    tasks: int = 0


def work_through(
    tasks: deque[Any], work: Work, jobs: int, limit: float = math.inf, recycle: int = 200
) -> Iterator[Done | Lost]:
    """Yield results in the order in which they come. Tasks that the caller appends meanwhile are done too.

    Args:
        work: runs in `jobs` fresh processes; one is replaced after `recycle` tasks, so that it cannot grow forever.
        limit: seconds that a task may take. Without a limit, outcomes do not depend on how busy the machine is;
            tasks must then end by themselves.
    """
    workers: list[_Worker] = []
    try:
        while tasks or any(worker.busy for worker in workers):
            workers = [worker for worker in workers if worker.process.is_alive() or worker.busy]
            while len(workers) < jobs and len(tasks) > sum(not worker.busy for worker in workers):
                workers.append(_start(work))
            for worker in workers:
                if tasks and not worker.busy:
                    _give(worker, tasks.popleft())
            ready = wait([worker.pipe for worker in workers], timeout=1.0)
            for worker in list(workers):
                outcome = _hear(worker) if worker.pipe in ready else None
                if outcome is None and worker.busy and time.monotonic() - worker.since > limit:
                    outcome = Lost(worker.task, f"took more than {limit:g} s", worker.told)
                if outcome is None:
                    continue
                worker.busy = False
                worker.tasks += 1
                if isinstance(outcome, Lost) or worker.tasks >= recycle:
                    _end(worker)
                    workers.remove(worker)
                yield outcome
    finally:
        for worker in workers:
            _end(worker)


def _start(work: Work) -> _Worker:
    context = get_context("spawn")  # a fork of a process with threads of torch's may hang
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, work), daemon=True)
    process.start()
    theirs.close()
    return _Worker(process, ours)


def _give(worker: _Worker, task: Any) -> None:
    worker.task, worker.busy, worker.told, worker.since = task, True, None, time.monotonic()
    with suppress(OSError):  # it is dead, which `_hear` reports
        worker.pipe.send(task)


def _hear(worker: _Worker) -> Done | Lost | None:
    """The outcome that a worker reports: a result or its end. None if it only reports how far it is."""
    try:
        kind, value = worker.pipe.recv()
    except (EOFError, OSError):
        worker.process.join(5)
        code = worker.process.exitcode
        how = signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"
        return Lost(worker.task, f"the process died: {how}", worker.told)
    if kind == "told":
        worker.told = value
        return None
    return Done(worker.task, value)


def _end(worker: _Worker) -> None:
    worker.process.terminate()
    worker.process.join(2)
    if worker.process.is_alive():
        worker.process.kill()
    worker.pipe.close()


def _serve(pipe: Connection, work: Work) -> None:
    """The loop of a worker process: tasks from the pipe, results into it, until its other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that started us
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            task = pipe.recv()
            pipe.send(("done", work(task, lambda value: pipe.send(("told", value)))))
        except (EOFError, OSError):
            return


def _end_with_parent() -> None:
    """End this process as soon as its parent has ended: nobody waits for the result."""
    parent = parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)
