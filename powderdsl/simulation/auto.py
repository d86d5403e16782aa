"""The backend `auto` on the CPU: it starts on WebAssembly and switches to native code. Both give the same worlds.

Native code that was compiled before is loaded when the program is made. Otherwise WebAssembly runs, or torch on machines
that wasmtime has no wheel for; once the work done and asked
for is worth it, a thread compiles in the background. The change comes between two steps: long calls are cut into slices
for it. Short scripts never start a compiler.
"""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Callable, Mapping
from contextvars import copy_context
from functools import cache
from math import prod

from torch import Tensor

from powderdsl.simulation.widths import ByWidth
from powderdsl.targets.cpp.compilers import INSTALL, MISSING, NoCompiler, NoCompilerWarning
from powderdsl.targets.job import Job, Runnable, shape_of

WORTH = 2.0
"""Native code is compiled once work on the first backend, done or expected in the current call, exceeds this many seconds.
Compiling takes longer, but runs in another thread, and its result is cached."""

SLICE = 0.25
"""Seconds on the first backend between two checks for native code."""


class Build:
    """Native code being compiled, in a thread that waits for the compiler and ends with the process."""

    def __init__(self, make: Callable[[], Runnable]):
        self._make = make
        self._began = time.perf_counter()
        self._took: float | None = None
        self.program: Runnable | None = None
        self.problem = ""
        self._thread = threading.Thread(target=copy_context().run, args=(self._run,), daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.program = self._make()
        except NoCompiler as error:
            self.problem = str(error)
        except Exception as error:  # what runs continues; `--backend native` shows what is wrong
            self.problem = f"{type(error).__name__}: {error}"
        self._took = time.perf_counter() - self._began

    def wait(self) -> None:
        """Return when the build has ended."""
        self._thread.join()

    @property
    def seconds(self) -> float:
        """How long the build took, or has taken so far."""
        return time.perf_counter() - self._began if self._took is None else self._took

    @property
    def lost(self) -> bool:
        """Whether the build's thread is gone: a fork has its parent's memory, but not its threads."""
        return self._took is None and not self._thread.is_alive()


class AutoProgram:
    """Runs on a backend that starts at once until native code has been compiled.

    Args:
        first: the name of that backend, and a function that gives its program, the same at each call.
        asked: gives the program for jobs with given draws or chosen passes.
        ready: native code that was compiled before, or None; raises NoCompiler if none could be made.
        make: native code, compiled; raises NoCompiler.
    """

    def __init__(
        self,
        first: tuple[str, Callable[[], Runnable]],
        asked: Callable[[], Runnable],
        ready: Callable[[], Runnable | None],
        make: Callable[[], Runnable],
    ):
        (self._name, self._first), self._asked, self._make = first, asked, make
        self._build: Build | None = None
        self._native: Runnable | None = None
        self._problem = ""
        self._beginning = threading.Lock()
        self._spent = 0.0
        self._pace: tuple[int, float] | None = None  # cells of a batch, seconds a step on the first backend
        self._steps = {"first": 0, "native": 0, "asked": 0}
        try:
            self._native = ready()
        except NoCompiler as error:
            self._problem = str(error)

    @property
    def running(self) -> str:
        """What the next step runs on: ``wasm``, ``torch`` or ``native``."""
        return self._name if self._arrived() is None else "native"

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about which backend ran, and why."""
        native, steps, build, first = self._arrived(), self._steps, self._build, self._name
        found = []
        if native is not None and build is None:
            found.append("native: it was compiled before")
        elif native is not None and build is not None:
            found.append(
                f"{first} for {steps['first']} steps while native was made ready ({build.seconds:.0f} s), "
                f"then native for {steps['native']}"
            )
        elif self._problem:
            found.append(f"{first}: {self._problem}")
            found.append(f"native code is faster: {INSTALL}")
        elif build is not None and not build.lost:
            found.append(
                f"{first} for {steps['first']} steps; native is being made ready ({build.seconds:.0f} s)"
            )
        else:
            found.append(f"{first}: native is compiled from {WORTH:g} s of work, or by --backend native")
        if steps["asked"]:
            found.append(f"torch for {steps['asked']} steps with given draws or chosen passes")
        return tuple(found)

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later."""
        if job.draws or job.passes is not None:
            self._steps["asked"] += job.steps
            return self._asked().run(job)
        if job.timing is not None:
            return (self._arrived() or self._first()).run(job)
        clock, part, done, cells = job.clock, job, 0, prod(shape_of(job.state))
        while True:
            native = self._arrived()
            if native is not None:
                self._steps["native"] += part.steps
                return native.run(part)
            count = self._slice(cells, job.steps - done)
            began = time.perf_counter()
            try:
                state = self._first().run(part._replace(steps=count))
            except MemoryError:
                return self._large(part)
            done += count
            later = clock._replace(since=clock.since + done)
            part = part._replace(state=state, clock=later, steps=job.steps - done)
            self._account(cells, count, job.steps - done, time.perf_counter() - began)
            if done == job.steps:
                return state

    def _large(self, job: Job) -> Mapping[str, Tensor]:
        """Worlds that do not fit into WebAssembly's memory: native code is waited for, without a compiler torch runs."""
        self._begin()
        if self._build is not None:
            self._build.wait()
        self._steps["native"] += job.steps
        return (self._arrived() or self._asked()).run(job)

    def _slice(self, cells: int, left: int) -> int:
        """The number of steps to run on the first backend before the next check: one until their speed is known."""
        if self._problem:
            return left
        if self._pace is None or self._pace[0] != cells:
            return min(left, 1)
        return min(left, max(1, int(SLICE / max(self._pace[1], 1e-9))))

    def _account(self, cells: int, count: int, left: int, seconds: float) -> None:
        """Count steps that ran on the first backend, and start to compile once that is worth it."""
        if count == 0:
            return
        self._steps["first"] += count
        self._spent += seconds
        # The first step makes what later ones reuse: its duration does not predict theirs.
        first = self._pace is None or self._pace[0] != cells
        self._pace = (cells, seconds / count)
        expected = 0.0 if first else left * self._pace[1]
        if self._spent + expected >= WORTH:
            self._begin()

    def _begin(self) -> None:
        """Start to compile, unless a build has started. Concurrent callers do not wait."""
        if self._problem:
            _tell_of_compilers(self._problem)
            return
        if not self._beginning.acquire(blocking=False):
            return
        try:
            if self._native is None and (self._build is None or self._build.lost):
                self._build = Build(self._make)
        finally:
            self._beginning.release()

    def _arrived(self) -> Runnable | None:
        """The native program, or None until it has been compiled."""
        build = self._build
        if self._native is None and build is not None:
            self._native, self._problem = build.program, build.problem or self._problem
        return self._native


@cache
def _tell_of_compilers(problem: str) -> None:
    """Warn once in a process if work that is worth compiling meets no compiler. Other problems stand in `notes`."""
    if problem.startswith(MISSING):
        warnings.warn(
            f"{problem}; native code is many times faster: {INSTALL}", NoCompilerWarning, stacklevel=2
        )


class AutoByWidth(ByWidth[AutoProgram]):
    """Chooses for each width of grids. What it tells is about the width stepped last.

    Args:
        width: what it tells about before the first step, see `known_width`.
    """

    def __init__(self, make: Callable[[int], AutoProgram], width: int):
        super().__init__(make)
        self._latest = self.of(width)

    @property
    def running(self) -> str:
        """What the next step runs on: ``wasm``, ``torch`` or ``native``."""
        return self._latest.running

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about which backend ran, and why."""
        return self._latest.notes

    def run(self, job: Job) -> Mapping[str, Tensor]:
        """The state `job.steps` later."""
        self._latest = self.for_job(job)
        return self._latest.run(job)
