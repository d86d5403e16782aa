"""Running a study: each point is a chain of commands in processes of their own. Finished steps are not repeated."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from powderdsl.diagnostics import CompileError
from powderdsl.experiments.runs.folder import ABOUT, check_folder, held, new_folder, write_json
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

EVALUATION = "evaluation.json"
LOG_LINES = 6


@dataclass(frozen=True)
class Outcome:
    """A finished point: its measures by name, or the problem."""

    point: Point
    values: Mapping[str, float]
    problem: str | None = None


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

    def prepare(self) -> None:
        """Make the folder, or resume in it. Values, seeds and measures may have changed, but no step.

        Raises:
            CompileError: PD621 where the folder holds another study or other files; PD613 where it cannot be written.
        """
        # What its words mean follows from a step's command.
        steps = [asdict(step) for step in self.study.steps]
        decides: dict[str, Any] = {
            "study": self.study.name,
            "size": self.size,
            "varied": [axis.name for axis in self.study.axes],
            "steps": [{name: value for name, value in step.items() if name != "means"} for step in steps],
        }
        decides = json.loads(json.dumps(decides))  # as it will be read
        if self.folder.is_dir():
            check_folder(self.folder)
        kept = self.folder / "study.json"
        if kept.exists():
            found = read_json(kept)
            if not isinstance(found, dict) or any(found.get(key) != value for key, value in decides.items()):
                what = "another study, or this one as it was before its steps changed"
                helps = ("choose another folder with `--out`",)
                raise failure("PD621", f"{self.folder} holds {what}", helps=helps)
        else:
            new_folder(self.folder)
        write_json(kept, {**decides, "text": self.study.text})

    def run(
        self, points: Sequence[Point], jobs: int, told: Callable[[Outcome], None] | None = None
    ) -> list[Outcome]:
        """Run points to their end, `jobs` at a time. Signals end all processes; the same call resumes them.

        Raises:
            CompileError: PD622 if another process runs a study in this folder.
        """
        done: list[Outcome] = []
        with held(self.folder):
            pool = ThreadPoolExecutor(jobs)
            try:
                waiting: set[Future[Outcome]] = {pool.submit(self._point, point) for point in points}
                while waiting:
                    ended, waiting = wait(waiting, timeout=0.5, return_when=FIRST_COMPLETED)
                    for one in ended:
                        done.append(one.result())
                        if told is not None:
                            told(done[-1])
            except BaseException:
                self._end_all(pool)
                raise
            pool.shutdown()
        order = {point: number for number, point in enumerate(points)}
        return sorted(done, key=lambda outcome: order[outcome.point])

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

    def _point(self, point: Point) -> Outcome:
        kept = self.folder / "done" / f"{point.name}.json"
        place = self.folder / "runs" / point.name
        # Values by where they come from: measures may change later, and runs may be deleted.
        known = read_json(kept)
        try:
            if not isinstance(known, dict):
                place.mkdir(parents=True, exist_ok=True)
                kept.parent.mkdir(exist_ok=True)
                for step in self.study.steps:
                    problem = self._step(step, point, place)
                    if problem is not None:
                        return Outcome(point, {}, problem)
                known = {}
            values, found = {}, dict(known)
            for one in self.study.measures:
                key = "/".join((one.step, *one.keys))
                if key not in found:
                    found[key] = value_of(one, place / one.step, point, self.size)
                values[one.name] = found[key]
                if one.scale == "log" and not found[key] > 0:
                    raise ValueError(f"{key} is {found[key]}; the scale `log` needs numbers above 0")
            if found != known:
                write_json(kept, found)
        except (OSError, Canceled, ValueError) as error:
            return Outcome(point, {}, str(error) or "stopped")
        return Outcome(point, values)

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

    def _step(self, step: StudyStep, point: Point, place: Path) -> str | None:
        """Run a step. Returns the problem if it failed, else None."""
        if step.makes_run:
            self._wait_for_last_call(place / step.name)
        log = place / f"{step.name}.log"
        threads = str(self.threads)
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "PYTHONUNBUFFERED": "1", "NO_COLOR": "1"}
        environment[LIFELINE] = "1"
        words = [sys.executable, "-m", "powderdsl", *self.command(step, point, place)]
        with log.open("ab") as file:
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
            try:
                status = process.wait()
            finally:
                self._running.discard(process)
                assert process.stdin is not None
                process.stdin.close()
        if status == 0:
            return None
        last = log.read_text(encoding="utf-8", errors="replace").splitlines()[-LOG_LINES:]
        return "\n".join([f"{step.name} ended with {status}; {log} ends with:", *last])

    def _wait_for_last_call(self, run: Path) -> None:
        """Where a study was killed, what it had started may still be saving its last checkpoint."""
        end = time.monotonic() + 2 * GRACE
        while (run / ABOUT).exists() and time.monotonic() < end and not self._stopped.is_set():
            try:
                with held(run, patience=0.5):
                    return
            except CompileError:
                continue


def value_of(measure: Measure, run: Path, point: Point, size: str) -> float:
    """A measure out of a run's evaluation. Raises ValueError where it is not there."""
    found: Any = read_json(run / EVALUATION)
    for key in measure.keys:
        word = filled(key, point, size)
        if not isinstance(found, dict) or word not in found:
            there = ", ".join(sorted(map(str, found))[:12]) if isinstance(found, dict) else "nothing"
            raise ValueError(
                f"{run / EVALUATION} has no `{word}` for the measure `{measure.name}`: it has {there}"
            )
        found = found[word]
    if isinstance(found, bool) or not isinstance(found, (int, float)):
        raise ValueError(f"the measure `{measure.name}` is not a number in {run / EVALUATION}")
    return float(found)
