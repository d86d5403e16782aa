"""Running a study on Ray: each point is a task, wherever there is room for it. The study's folder holds all state.

Nodes share the storage of the folder. Ray repeats the task of a node that dies; a new driver repeats what was not done.
Claims keep two tasks from working on the same point, whatever Ray believes about the first.
"""

from __future__ import annotations

import logging
import os
import platform
import re
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from powderdsl.diagnostics import CompileError
from powderdsl.experiments.studies.claims import LEASE
from powderdsl.experiments.studies.run import ABOUT_STUDY, Outcome, StudyRun
from powderdsl.experiments.studies.study import Point, Study, filled
from powderdsl.system.interrupts import GRACE, SIGNALS
from powderdsl.system.reading import read_json
from powderdsl.system.writing import failure

RETRIES = 20
"""How often Ray repeats the task of a node or process that died."""
PATIENCE = LEASE + GRACE
"""Seconds that a task waits for a process that holds its point: one of a dead driver's saves its last checkpoint."""
QUIET = {
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_NUM_REDIS_GET_RETRIES": "2",
}
"""Environment of the driver, where the user has not set it: fewer warnings, and fewer attempts to connect."""
AHEAD = 1000
"""Tasks that are submitted at a time."""


def require_ray() -> None:
    """Raise CompileError (PD612) if Ray is not installed."""
    if find_spec("ray") is None:
        raise failure(
            "PD612",
            "running a study on a cluster needs Ray, which is not installed",
            helps=("pip install 'powderdsl[ray]'", "or split the study: `--shard 1/4` to `--shard 4/4`"),
        )


def resources(study: Study, point: Point, size: str, threads: int) -> dict[str, float]:
    """What Ray reserves for a point: a CPU core per thread, and a GPU if a step's `device` is a CUDA device."""
    words = [
        word for step in study.steps for name, words in step.options if name == "device" for word in words
    ]
    gpu = any(filled(word, point, size).strip().startswith("cuda") for word in words)
    return {"num_cpus": threads, "num_gpus": 1 if gpu else 0}


def run_on_ray(
    run: StudyRun,
    points: Sequence[Point],
    address: str,
    jobs: int | None,
    told: Callable[[Outcome], None],
    note: Callable[[str], None],
) -> list[Outcome]:
    """Run points to their end as Ray tasks. Signals end all of them; the same call resumes them.

    Args:
        address: of the cluster, as `ray.init` takes it. jobs: how many tasks there are at a time; None: as many as fit.
        note: shows a sentence to the user.

    Raises:
        CompileError: PD612 without Ray, PD626 if there is no such cluster, or the connection to it is lost.
    """
    require_ray()
    # Commands are run elsewhere, in other working directories.
    study = replace(run.study, folder=run.study.folder.resolve(), places={})
    folder = run.folder.resolve()
    done: dict[Point, Outcome] = {}
    with _connected(address) as ray:
        for lacking in _lacking(ray, [resources(study, point, run.size, run.threads) for point in points]):
            note(f"no node of the cluster has {lacking} yet: runs wait for one")
        task = ray.remote(max_retries=RETRIES, scheduling_strategy="SPREAD")(run_point)
        waiting = list(reversed(points))
        # Futures, because a signal that comes while Ray itself waits is no longer known when it returns.
        running: dict[Future[Outcome], tuple[Any, Point]] = {}
        try:
            while waiting or running:
                while waiting and len(running) < (jobs or AHEAD):
                    point = waiting.pop()
                    asked = resources(study, point, run.size, run.threads)
                    name = f"{study.name} {point.name}"
                    arguments = (study, str(folder), run.size, run.threads, point, _version())
                    started = task.options(name=name, **asked).remote(*arguments)
                    running[started.future()] = started, point
                for one in wait(running, return_when=FIRST_COMPLETED).done:
                    _, point = running.pop(one)
                    done[point] = _outcome(ray, one, point, address)
                    told(done[point])
        except BaseException:
            for started, _ in running.values():
                with suppress(Exception):
                    ray.cancel(started)
            wait(running, timeout=GRACE)
            raise
    return [done[point] for point in points]


def run_point(study: Study, folder: str, size: str, threads: int, point: Point, version: str) -> Outcome:
    """Run a point on a node of the cluster."""
    host = platform.node()
    if version != _version():
        return Outcome(point, {}, f"{host} has powderdsl {_version()}; {version} is needed")
    run = StudyRun(study, Path(folder), size, threads)
    found = read_json(Path(folder) / ABOUT_STUDY)
    if not isinstance(found, dict) or found.get("text") != study.text or not run.is_prepared():
        return Outcome(point, {}, f"{host} does not see {folder}: it must be on storage that all nodes share")
    try:
        (outcome,) = run.run([point], 1, patience=PATIENCE)
    except CompileError as error:
        return Outcome(point, {}, f"{host}: {'; '.join(one.message for one in error.diagnostics)}")
    return outcome


def _lacking(ray: Any, asked: Sequence[dict[str, float]]) -> list[str]:
    """What no node of a cluster has, however idle it is."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    found = {}
    for kind, key, thing in (("num_cpus", "CPU", "CPU cores"), ("num_gpus", "GPU", "GPU")):
        wanted = max((one[kind] for one in asked), default=0)
        if all(node.get(key, 0) < wanted for node in nodes):
            found[key] = f"{wanted:g} {thing}"
    return list(found.values())


def _outcome(ray: Any, task: Future[Outcome], point: Point, address: str) -> Outcome:
    try:
        return task.result()
    except ray.exceptions.LocalRayletDiedError as error:  # no task will ever end
        helps = ("start it again with `ray start`; the same command then resumes here",)
        raise _no_cluster(
            address, _words(error), helps, "lost the Ray node of this machine in the cluster"
        ) from None
    except ray.exceptions.RayTaskError as error:  # its text ends with the exception, after a traceback
        return Outcome(point, {}, str(error).strip().splitlines()[-1][:400])
    except Exception as error:  # whatever ended the task, the others continue
        return Outcome(point, {}, f"{type(error).__name__}: {_words(error)}")


def _words(error: Exception) -> str:
    return " ".join(str(error).split())[:400] or type(error).__name__


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """The module `ray`, connected to a cluster. Raises CompileError (PD626)."""
    check_address(address)
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    ray = import_module("ray")
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:
        raise _no_cluster(address, _words(error)) from None
    finally:
        if threading.current_thread() is threading.main_thread():
            for (
                number,
                handler,
            ) in handlers.items():  # it puts its own below Python's, which abort the process
                signal.signal(number, handler)
    try:
        yield ray
    finally:
        ray.shutdown()


def check_address(address: str) -> None:
    """Raise CompileError (PD626) if nobody listens at an address. Ray itself would try for minutes."""
    if address in ("auto", "local"):
        return
    match = re.fullmatch(r"(?:ray://)?\[?([^\s/\[\]]+)\]?:([0-9]{1,5})", address)
    if match is None:
        raise _no_cluster(address, "an address is `auto` or HOST:PORT")
    try:
        socket.create_connection((match[1], int(match[2])), timeout=10).close()
    except (OSError, OverflowError, UnicodeError) as error:
        raise _no_cluster(address, getattr(error, "strerror", None) or str(error)) from None


def _no_cluster(
    address: str,
    reason: str,
    helps: tuple[str, ...] = ("start one with `ray start --head`, which prints its address",),
    what: str = "no Ray cluster",
) -> CompileError:
    return failure("PD626", f"{what} at `{address[:80]}`", notes=(reason,), helps=helps)


def _version() -> str:
    found: str = sys.modules["powderdsl"].__version__  # our own package, so it has been imported
    return found
