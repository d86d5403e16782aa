"""Running a study on Ray: each point is a task. The study's folder, on storage that all nodes share, holds all state.

Ray repeats the task of a node that dies; a new driver repeats what is not done.
"""

from __future__ import annotations

import logging
import platform
import signal
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from powderdsl.diagnostics import CompileError
from powderdsl.experiments.studies.run import Outcome, Report, StudyRun, run_all
from powderdsl.experiments.studies.study import Point, Study
from powderdsl.system.interrupts import SIGNALS
from powderdsl.system.packages import require
from powderdsl.system.writing import failure

RETRIES = 20
"""How often Ray repeats the task of a node or process that died."""
AHEAD = 1000
"""Tasks that are submitted at a time."""


def resources(study: Study, point: Point, threads: int) -> dict[str, float]:
    """What Ray reserves for a point: a CPU core per thread, and a GPU if a step's `device` is a CUDA device."""
    devices = [point.filled(word) for step in study.steps for name, word in step.words if name == "device"]
    return {"num_cpus": threads, "num_gpus": int(any(name.startswith("cuda") for name in devices))}


def run_on_ray(
    run: StudyRun, points: Sequence[Point], address: str, jobs: int | None, report: Report
) -> list[Outcome]:
    """Run points to their end as Ray tasks. Signals end all of them; the same call resumes them.

    Args:
        address: of the cluster, as `ray.init` takes it. jobs: how many tasks there are at a time; None: as many as fit.

    Raises:
        CompileError: PD626 if the connection to the cluster cannot be made.
    """
    # Commands run elsewhere, in other working directories.
    study, folder = replace(run.study, folder=run.study.folder.resolve()), run.folder.resolve()
    with _connected(address) as ray:
        remote = ray.remote(max_retries=RETRIES, scheduling_strategy="SPREAD")(run_point)
        tasks: list[Any] = []

        def wait_for(point: Point) -> Outcome:
            options = {"name": f"{study.name} {point.name}", **resources(study, point, run.threads)}
            tasks.append(
                task := remote.options(**options).remote(study, folder, run.size, run.threads, point)
            )
            try:
                outcome: Outcome = ray.get(task)
                return outcome
            except Exception as error:  # Ray's messages end with the exception, after a traceback
                last = (str(error).strip().splitlines() or [""])[-1][:400]
                return Outcome(point, {}, f"{type(error).__name__}: {last}")

        def cancel_all() -> None:
            for task in tasks:
                with suppress(Exception):
                    ray.cancel(task)

        return run_all(wait_for, points, jobs or max(1, min(len(points), AHEAD)), report, cancel_all)


def run_point(study: Study, folder: Path, size: str, threads: int, point: Point) -> Outcome:
    """Run a point on a node of the cluster. If a process of a dead driver still works on it, wait for its end."""
    host, run = platform.node(), StudyRun(study, folder, size, threads)
    if not run.is_prepared():
        return Outcome(point, {}, f"{host} does not see {folder}: it must be on storage that all nodes share")
    try:
        (outcome,) = run.run([point], 1, patient=True)
    except CompileError as error:
        return Outcome(point, {}, f"{host}: {'; '.join(mistake.message for mistake in error.diagnostics)}")
    return outcome


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """The module `ray`, connected to a cluster. Raises CompileError (PD626)."""
    ray = _ray()
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:
        raise _no_cluster(address, error) from None
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():  # Ray's own abort the process
                signal.signal(number, handler)
    try:
        yield ray
    finally:
        ray.shutdown()


def check_cluster(address: str) -> None:
    """Raise CompileError if Ray is not installed (PD612) or nobody listens at an address (PD626).

    Ray itself would try to connect for minutes.
    """
    _ray()
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        if address != "auto":
            socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()
    except (OSError, OverflowError, ValueError) as error:
        raise _no_cluster(address, error) from None


def _ray() -> Any:
    helps = "pip install 'powderdsl[ray]'", "or split the study: `--shard 1/4` to `--shard 4/4`"
    return require("ray", "running a study on a cluster", *helps)


def _no_cluster(address: str, error: Exception) -> CompileError:
    notes, helps = (str(error)[:400],), ("start one with `ray start --head`, which prints its address",)
    return failure("PD626", f"no Ray cluster at `{address[:80]}`", notes=notes, helps=helps)
