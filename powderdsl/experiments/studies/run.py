"""Running a study: each point is a chain of commands in processes of their own. Finished steps are not repeated."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from powderdsl.diagnostics import CompileError
from powderdsl.experiments.runs.folder import ABOUT, check_folder, held, new_folder, write_json
from powderdsl.experiments.studies.claims import Claim, Claims, Held, Lost, lock_if_free
from powderdsl.experiments.studies.study import (
    FLAG,
    TEXT,
    Measure,
    Point,
    Study,
    StudyStep,
    confined,
    filled,
    maker,
)
from powderdsl.system.interrupts import GRACE, LIFELINE
from powderdsl.system.reading import read_json
from powderdsl.system.writing import failure

EVALUATION, ABOUT_STUDY = "evaluation.json", "study.json"
LOG_LINES = 6
RETRY = 1.0
"""Seconds between two attempts at points that other processes hold."""


@dataclass(frozen=True)
class Outcome:
    """A finished point: its measures by name, or the problem. `held`: the problem is that another process works on it."""

    point: Point
    values: Mapping[str, float]
    problem: str | None = None
    held: bool = False


class Canceled(Exception):
    """The study was stopped."""


class StudyRun:
    """A study that is being run in a folder.

    Args:
        size: one of `SIZES`. threads: of each process.
    """

    def __init__(self, study: Study, folder: Path, size: str, threads: int = 1):
        self.study, self.folder, self.size, self.threads = study, folder, size, threads
        self._stopped = threading.Event()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._starting = threading.Lock()
        """Held while a process is started or all are ended, so that none escapes."""
        self._claims = Claims()
        self._undecided: set[Point] = set()
        """Points that other processes hold, which may be dead."""

    def prepare(self) -> None:
        """Make the folder, or resume in it. Values, seeds and measures may have changed, but no step.

        Raises:
            CompileError: PD621 where the folder holds another study or other files; PD613 where it cannot be written.
        """
        kept = self.folder / ABOUT_STUDY
        if not kept.exists():
            if self.folder.is_dir():
                check_folder(self.folder)
            try:
                new_folder(self.folder)
            except CompileError:
                if not kept.exists():  # else somebody has just begun the same study
                    raise
        with held(self.folder, GRACE):
            if kept.exists() and not self.is_prepared():
                what = "another study, or this one as it was before its steps changed"
                helps = ("choose another folder with `--out`",)
                raise failure("PD621", f"{self.folder} holds {what}", helps=helps)
            write_json(kept, {**decides(self.study, self.size), "text": self.study.text})

    def is_prepared(self) -> bool:
        """Whether the folder holds this study."""
        found = read_json(self.folder / ABOUT_STUDY)
        wanted = decides(self.study, self.size)
        return isinstance(found, dict) and all(found.get(key) == value for key, value in wanted.items())

    def run(
        self,
        points: Sequence[Point],
        jobs: int,
        told: Callable[[Outcome], None] | None = None,
        patience: float = 0.0,
    ) -> list[Outcome]:
        """Run points to their end, `jobs` at a time. Signals end all processes; the same call resumes them.

        Args:
            patience: seconds to wait for points that other processes hold, once all others have ended. Where it is not
                known whether such a process lives, the wait is as long as that takes.
        """
        done: dict[Point, Outcome] = {}
        waiting, end = list(points), 0.0
        pool = ThreadPoolExecutor(jobs)
        try:
            while True:
                for one in self._attempts(pool, waiting):
                    done[one.point] = one
                    if told is not None and not one.held:
                        told(one)
                waiting = [point for point in waiting if done[point].held]
                end = end or time.monotonic() + patience
                if not self._undecided.intersection(waiting) and (not waiting or time.monotonic() >= end):
                    break
                time.sleep(RETRY)
        except BaseException:
            self._end_all(pool)
            raise
        pool.shutdown()
        if told is not None:
            for point in waiting:
                told(done[point])
        return [done[point] for point in points]

    def _attempts(self, pool: ThreadPoolExecutor, points: Sequence[Point]) -> Iterator[Outcome]:
        """The outcome of each point, in the order in which they end."""
        waiting: set[Future[Outcome]] = {pool.submit(self._point, point) for point in points}
        while waiting:
            ended, waiting = wait(waiting, timeout=0.5, return_when=FIRST_COMPLETED)
            yield from (one.result() for one in ended)

    def _end_all(self, pool: ThreadPoolExecutor) -> None:
        """End all processes and wait for them to save. A second signal does not wait."""
        self._signal(signal.SIGTERM)
        try:
            end = time.monotonic() + GRACE
            pool.shutdown(wait=False, cancel_futures=True)
            while self._running and time.monotonic() < end:
                time.sleep(0.05)
        finally:
            self._signal(getattr(signal, "SIGKILL", signal.SIGTERM))
            pool.shutdown()

    def _signal(self, number: int) -> None:
        with self._starting:
            self._stopped.set()
            for process in list(self._running):
                with suppress(OSError):
                    process.send_signal(number)

    def finished(self, point: Point) -> Outcome | None:
        """The outcome of a point whose steps are done here; None if they are not."""
        try:
            known = self._known(point)
            return None if known is None else Outcome(point, self._values(point, known))
        except ValueError as error:
            return Outcome(point, {}, str(error))

    def _point(self, point: Point) -> Outcome:
        place = self.folder / "runs" / point.name
        self._undecided.discard(point)
        try:
            known = self._known(point)
            if known is not None and all(_key(one) in known for one in self.study.measures):
                return Outcome(point, self._values(point, known))
            place.mkdir(parents=True, exist_ok=True)
            claim, elsewhere = self._claims.take(place)
            with claim:
                known = self._known(point)  # somebody may have finished it in between
                if known is None:
                    if elsewhere:
                        self._forget_locks(place)
                    for step in self.study.steps:
                        problem = self._step(step, point, place, claim)
                        if problem is not None:
                            return Outcome(point, {}, problem)
                    known = {}
                values = self._values(point, known)
                claim.check()
                self._keep(point, known)
                return Outcome(point, values)
        except Held as error:
            if not error.sure:
                self._undecided.add(point)
            return Outcome(point, {}, f"held by {error}", held=True)
        except Lost as error:
            self._undecided.add(point)
            return Outcome(point, {}, f"lost: {error}", held=True)
        except (OSError, Canceled, ValueError) as error:
            return Outcome(point, {}, str(error) or "stopped")

    def _known(self, point: Point) -> dict[str, float] | None:
        """The values of a finished point, by where they come from: measures may change, and runs may be deleted.

        Raises:
            ValueError: they are not numbers.
        """
        path = self.folder / "done" / f"{point.name}.json"
        known = read_json(path)
        if not isinstance(known, dict):
            return None
        if not all(is_number(value) for value in known.values()):
            raise ValueError(f"{path} has values that are not numbers")
        return known

    def _values(self, point: Point, known: dict[str, float]) -> dict[str, float]:
        """The measures of a finished point. Those that are not in `known` are read from its runs, and added there.

        Raises:
            ValueError: one is not there, or cannot be used.
        """
        values = {}
        for one in self.study.measures:
            key = _key(one)
            if key not in known:
                place = self.folder / "runs" / point.name
                known[key] = value_of(one, place / one.step, point, self.size)
            values[one.name] = known[key]
            if one.scale == "log" and not known[key] > 0:
                raise ValueError(f"{key} is {known[key]}; the scale `log` needs numbers above 0")
        return values

    def _keep(self, point: Point, known: Mapping[str, float]) -> None:
        """Record that a point is done: from here on it is not run again."""
        place, done = self.folder / "runs" / point.name, self.folder / "done"
        done.mkdir(exist_ok=True)
        # Written where nobody else writes, and moved in one step.
        os.replace(write_json(place / "done.json", known), done / f"{point.name}.json")

    def _forget_locks(self, place: Path) -> None:
        """Remove the locks of a machine that is dead: a file server may keep them until it is started again."""
        for step in self.study.steps:
            with suppress(OSError):
                (place / step.name / ".lock").unlink()

    def command(self, step: StudyStep, point: Point, place: Path) -> list[str]:
        """The words of a step's command for a point whose runs lie in `place`."""
        words = list(step.command)
        if step.on is not None:
            steps = {one.name: one for one in self.study.steps}
            words.append(
                str(place / maker(steps, step.on).name)
                if step.on_step
                else self._word(step, "on", step.on, point)
            )
        for name, values in step.options:
            for value in values:
                word = self._word(step, name, value, point)
                if step.means.get(name) != FLAG:
                    words += [f"--{name}", word]
                elif word == "yes":
                    words.append(f"--{name}")
        return [*words, "--run", str(place / step.name)] if step.makes_run else words

    def _word(self, step: StudyStep, name: str, text: str, point: Point) -> str:
        """A word of a command. Raises CompileError (PD112) if it names a path elsewhere."""
        word, place = filled(text, point, self.size), self.folder / "runs" / point.name
        try:
            return confined(step.means.get(name, TEXT), word, self.study.folder, place)
        except ValueError as error:
            notes = (f"in the step `{step.name}`: {error}",)
            raise failure("PD112", f"the path `{word}` leaves the study's folder", notes=notes) from None

    def _step(self, step: StudyStep, point: Point, place: Path, claim: Claim) -> str | None:
        """Run a step. Returns the problem if it failed, else None."""
        log = place / f"{step.name}.log"
        threads = str(self.threads)
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "PYTHONUNBUFFERED": "1", "NO_COLOR": "1"}
        environment[LIFELINE] = "1"
        words = [sys.executable, "-m", "powderdsl", *self.command(step, point, place)]
        with log.open("ab") as file:
            self._wait_for_last_call(file.fileno(), place / step.name)
            with self._starting:
                if self._stopped.is_set():
                    raise Canceled("stopped")
                process = subprocess.Popen(
                    words,
                    stdin=subprocess.PIPE,  # nothing is written: it closes when we are killed, which ends them
                    stdout=file,
                    stderr=file,
                    env=environment,
                    start_new_session=True,  # Ctrl-C reaches us alone: we pass it on once
                )
                self._running.add(process)
            claim.stop_if_lost(process.kill)
            try:
                status = process.wait()
            finally:
                self._running.discard(process)
                assert process.stdin is not None
                process.stdin.close()
        claim.check()
        if status == 0:
            return None
        last = log.read_text(encoding="utf-8", errors="replace").splitlines()[-LOG_LINES:]
        return "\n".join([f"{step.name} ended with {status}; {log} ends with:", *last])

    def _wait_for_last_call(self, log: int, run: Path) -> None:
        """Where a study was killed, what it had started may still be saving its last checkpoint."""
        end = time.monotonic() + 2 * GRACE
        # It has inherited the log with its lock. Where there are no such locks, a run that has begun has one of its own.
        while not lock_if_free(log) and time.monotonic() < end and not self._stopped.is_set():
            time.sleep(0.1)
        while (run / ABOUT).exists() and time.monotonic() < end and not self._stopped.is_set():
            try:
                with held(run, patience=0.5):
                    return
            except CompileError:
                continue


def decides(study: Study, size: str) -> dict[str, Any]:
    """What makes results those of one study, as JSON has it."""
    # What its words mean follows from a step's command.
    steps = [asdict(step) for step in study.steps]
    found = {
        "study": study.name,
        "size": size,
        "varied": [axis.name for axis in study.axes],
        "steps": [{name: value for name, value in step.items() if name != "means"} for step in steps],
    }
    plain: dict[str, Any] = json.loads(json.dumps(found))
    return plain


def is_number(value: Any) -> bool:
    """Whether a value of a JSON file is a finite number."""
    largest = sys.float_info.max
    return isinstance(value, int | float) and not isinstance(value, bool) and -largest <= value <= largest


def _key(measure: Measure) -> str:
    """Where a measure's value comes from."""
    return "/".join((measure.step, *measure.keys))


def value_of(measure: Measure, run: Path, point: Point, size: str) -> float:
    """A measure out of a run's evaluation. Raises ValueError where it is not there, or not a number."""
    found: Any = read_json(run / EVALUATION)
    for key in measure.keys:
        word = filled(key, point, size)
        if not isinstance(found, dict) or word not in found:
            there = ", ".join(sorted(map(str, found))[:12]) if isinstance(found, dict) else "nothing"
            raise ValueError(
                f"{run / EVALUATION} has no `{word}` for the measure `{measure.name}`: it has {there}"
            )
        found = found[word]
    if not is_number(found):
        raise ValueError(f"the measure `{measure.name}` is not a finite number in {run / EVALUATION}")
    return float(found)
