"""Running a study: each point is a chain of commands in separate processes. Finished steps are not repeated.

On Ray, each point is a task: Ray repeats the task of a node that dies, and a new driver repeats what is not done. All
state is in the study's folder, on storage shared by all nodes.
"""

from __future__ import annotations

import logging
import os
import platform
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from powderdsl.diagnostics import CompileError, Reporter, Source
from powderdsl.experiments.runs import ABOUT, check_folder, lock_folder, new_folder, not_a_run, write_json
from powderdsl.experiments.studies.study import SIZES, Commands, Measure, Point, Study, StudyStep, read_study
from powderdsl.system.interrupts import GRACE, LIFELINE, SIGNALS
from powderdsl.system.packages import require
from powderdsl.system.reading import read_json
from powderdsl.system.writing import failure

EVALUATION, ABOUT_STUDY = "evaluation.json", "study.json"


@dataclass(frozen=True)
class Outcome:
    """A finished point: its measures by name, or the problem. `held`: another process is working on it."""

    point: Point
    values: Mapping[str, float]
    problem: str | None = None
    held: bool = False


Report = Callable[[Outcome], None]


class StudyRun:
    """A study that runs in a folder.

    The folder has the study (``study.json``), the runs of each point (``runs/POINT``) and the evaluations of finished
    points (``done/POINT.json``). A process that works on a point locks ``runs/POINT/.lock``.

    `size`: one of `SIZES`. `threads`: of each process.
    """

    def __init__(self, study: Study, folder: Path, size: str, threads: int = 1):
        self.study, self.folder, self.size, self.threads = study, folder, size, threads
        self._running: set[subprocess.Popen[bytes]] = set()

    def prepare(self) -> None:
        """Create the folder, or resume in it. Values, seeds and measures may have changed, but steps may not.

        Raises CompileError: PD621 if the folder contains another study or other files, PD613 if it cannot be written.
        """
        path = self.folder / ABOUT_STUDY
        if self.folder.is_dir():
            check_folder(self.folder)
        try:
            if not path.exists():
                new_folder(self.folder)
        except CompileError:
            if not path.exists():  # otherwise, another process has just begun the same study
                raise
        with lock_folder(self.folder, GRACE):
            if path.exists() and not self.is_prepared():
                what = "another study, or this one as it was before its steps changed"
                helps = ("choose another folder with `--out`",)
                raise failure("PD621", f"{self.folder} holds {what}", helps=helps)
            write_json(path, {**self.study.identity(self.size), "text": self.study.source.text})

    def is_prepared(self) -> bool:
        """Return True if the folder holds this study."""
        about = read_json(self.folder / ABOUT_STUDY)
        return isinstance(about, dict) and about == about | self.study.identity(self.size)

    def run(
        self,
        points: Sequence[Point],
        jobs: int,
        report: Report = lambda outcome: None,
        *,
        patient: bool = False,
    ) -> list[Outcome]:
        """Run points, `jobs` at a time. Signals end all processes; the same call resumes them.

        `report` is called with each outcome. `patient`: wait for points that other processes are working on.
        """
        read, write = os.pipe()
        # Processes end when their stdin is closed: by us, or because we are killed.
        with os.fdopen(read) as self._stdin, os.fdopen(write, "w") as self._lifeline:
            return run_all(lambda point: self._point(point, patient), points, jobs, report, self._end_all)

    def finished(self, point: Point) -> Outcome | None:
        """The outcome of a point whose steps are done; None if they are not."""
        path = self.folder / "done" / f"{point.name}.json"
        evaluations = read_json(path)
        if not isinstance(evaluations, dict):
            return None
        try:
            return Outcome(
                point, {item.name.text: _value(item, evaluations, point) for item in self.study.measures}
            )
        except ValueError as error:
            return Outcome(point, {}, f"{path}: {error}")

    def _point(self, point: Point, patient: bool) -> Outcome:
        place = self.folder / "runs" / point.name
        try:
            place.mkdir(parents=True, exist_ok=True)
            with FileLock(place / ".lock").acquire(timeout=-1 if patient else 0):
                if self.finished(point) is None:
                    for step in self.study.steps:
                        self._step(step, point, place)
                    runs = [step.name for step in self.study.steps if step.makes_run]
                    evaluations = {name: read_json(place / name / EVALUATION) for name in runs}
                    (self.folder / "done").mkdir(exist_ok=True)
                    write_json(self.folder / "done" / f"{point.name}.json", evaluations)
                outcome = self.finished(point)
                assert outcome is not None
                return outcome
        except Timeout:
            return Outcome(point, {}, "another process works on it", held=True)
        except (OSError, ValueError) as error:
            return Outcome(point, {}, str(error))

    def _step(self, step: StudyStep, point: Point, place: Path) -> None:
        """Run a step. Raises ValueError if it fails."""
        log = place / f"{step.name}.log"
        words = [sys.executable, "-m", "powderdsl", *self.study.command(step, point, place)]
        own = {"OMP_NUM_THREADS": str(self.threads), "PYTHONUNBUFFERED": "1", "NO_COLOR": "1", LIFELINE: "1"}
        if (place / step.name / ABOUT).exists():
            # The process of a study that was killed may still be saving its last checkpoint.
            with suppress(CompileError), lock_folder(place / step.name, GRACE):
                pass
        with log.open("ab") as file:
            process = subprocess.Popen(
                words,
                stdin=self._stdin,
                stdout=file,
                stderr=file,
                env=os.environ | own,
                start_new_session=True,  # Ctrl-C is sent to us alone
            )
            self._running.add(process)
            status = process.wait()
            self._running.discard(process)
        if status != 0:
            last = log.read_text(encoding="utf-8", errors="replace").splitlines()[-6:]
            raise ValueError("\n".join([f"{step.name} ended with {status}; {log} ends with:", *last]))

    def _end_all(self) -> None:
        """End all processes and wait for their last checkpoints. A second signal does not wait."""
        self._lifeline.close()
        try:
            end = time.monotonic() + GRACE
            while self._running and time.monotonic() < end:
                time.sleep(0.05)
        finally:
            for process in [*self._running]:
                process.kill()


def run_all(
    run_point: Callable[[Point], Outcome],
    points: Sequence[Point],
    jobs: int,
    report: Report,
    end_all: Callable[[], None],
) -> list[Outcome]:
    """The outcomes of points, each computed in a thread, `jobs` at a time.

    `end_all` is called after a signal or an error; it makes `run_point` return early in all threads.
    """
    with ThreadPoolExecutor(jobs) as pool:
        futures = [pool.submit(run_point, point) for point in points]
        running = {*futures}
        try:
            while running:
                # What Ray interrupts is not interrupted in a wait without a timeout.
                done, running = wait(running, timeout=0.5, return_when=FIRST_COMPLETED)
                for future in done:
                    report(future.result())
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            end_all()
            raise
    return [future.result() for future in futures]


def _value(measure: Measure, evaluations: Any, point: Point) -> float:
    """A measure in the evaluations of a point's runs. Raises ValueError if it is missing or cannot be used."""
    value, keys = evaluations, [measure.of.text, *point.filled(measure.keys).split("/")]
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    if type(value) not in (int, float) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"the measure `{measure.name.text}` is not a finite number: {'/'.join(keys)}")
    if measure.scale == "log" and not value > 0:
        raise ValueError(
            f"the measure `{measure.name.text}` is {value}; the scale `log` needs numbers above 0"
        )
    return float(value)


# Results of one study that lie in several folders


def read_folders(folders: Sequence[Path], commands: Commands) -> list[StudyRun]:
    """The studies whose results lie in some folders. No other file is read, and none is written.

    Raises CompileError: PD620 if a folder has no results, PD621 if they are not results of one study, PD112 if it has
    links that lead out of it, and all that is wrong with the study's text.
    """
    first, *others = runs = [_read(folder, commands) for folder in folders]
    for run in others:
        if (run.size, run.study.source.text) != (first.size, first.study.source.text):
            raise failure(
                "PD621",
                f"{run.folder} and {first.folder} hold results of different studies",
                notes=(f"`{run.study.name}` ({run.size}), `{first.study.name}` ({first.size})",),
                helps=("if the file has changed in between, run the study in both folders again",),
            )
    return runs


def collected(runs: Sequence[StudyRun], point: Point) -> Outcome:
    """The outcome of a point, from the folders that have it; the problem where none has it.

    Raises CompileError (PD627) if folders have different results.
    """
    outcomes = {run.folder: outcome for run in runs if (outcome := run.finished(point)) is not None}
    good = {folder: outcome for folder, outcome in outcomes.items() if outcome.problem is None}
    if not good:
        return next(iter(outcomes.values()), Outcome(point, {}, "not done in any of these folders"))
    (folder, first), *others = good.items()
    for other, outcome in others:
        if outcome != first:
            raise failure(
                "PD627",
                f"{folder} and {other} have different results of {point.name}",
                notes=(f"{folder}: {dict(first.values)}", f"{other}: {dict(outcome.values)}"),
                helps=(f"remove done/{point.name}.json from one of them, or leave that folder out",),
            )
    return first


def _read(folder: Path, commands: Commands) -> StudyRun:
    path = folder / ABOUT_STUDY
    if not path.exists():
        why = f"it has no {ABOUT_STUDY}" if folder.is_dir() else "there is no such folder"
        raise not_a_run(folder, why, ("give folders of results, those that `powderdsl study --out` named",))
    check_folder(folder)
    match read_json(path):
        case {"text": str(text), "size": str(size)} if size in SIZES:
            run = StudyRun(read_study(Source(str(path), text), Reporter(), commands), folder, size)
            if run.is_prepared():
                return run
    raise not_a_run(folder, f"its {ABOUT_STUDY} is damaged")


# Ray


def resources(study: Study, point: Point, threads: int) -> dict[str, float]:
    """The resources that Ray reserves for a point: a CPU core per thread, and a GPU if a step's `device` is a CUDA device."""
    devices = [point.filled(word) for step in study.steps for name, word in step.words if name == "device"]
    return {"num_cpus": threads, "num_gpus": int(any(name.startswith("cuda") for name in devices))}


def run_on_ray(
    run: StudyRun, points: Sequence[Point], address: str, jobs: int | None, report: Report
) -> list[Outcome]:
    """Run points to their end as Ray tasks. Signals end all of them; the same call resumes them.

    `jobs`: how many tasks there are at a time; None: as many as fit. Raises CompileError (PD626) if the connection to the
    cluster at `address`, which is what `ray.init` takes, cannot be made.
    """
    # Commands run elsewhere, in other working directories.
    study, folder = replace(run.study, folder=run.study.folder.resolve()), run.folder.resolve()
    with _connected(address) as ray:
        remote = ray.remote(max_retries=20, scheduling_strategy="SPREAD")(run_point)
        tasks: list[Any] = []

        def wait_for(point: Point) -> Outcome:
            options = {"name": f"{study.name} {point.name}", **resources(study, point, run.threads)}
            task = remote.options(**options).remote(study, folder, run.size, run.threads, point)
            tasks.append(task)
            try:
                return ray.get(task)
            except Exception as error:  # Ray's messages end with the exception, after a traceback
                last = (str(error).strip().splitlines() or [""])[-1][:400]
                return Outcome(point, {}, f"{type(error).__name__}: {last}")

        def cancel_all() -> None:
            for task in tasks:
                with suppress(Exception):
                    ray.cancel(task)

        return run_all(wait_for, points, jobs or max(1, min(len(points), 1000)), report, cancel_all)


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
