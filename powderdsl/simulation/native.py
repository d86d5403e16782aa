"""Native code by the width of grids, compiled when it is worth it.

Each width has a library of its own, or shares one with others (`known_width`). A library is made when the first grid of
its width is stepped, so that nobody waits for code that is not needed. If the same model was compiled before, its code
comes from the cache and nothing is lowered. The cache's key depends on the model, on every source file that turns models
into C++, on the compiler, the processor and the width. Values of parameters are inputs of a step, so they take no part.

The backend `auto` starts on WebAssembly, or on torch where wasmtime has no wheel. Once the work done and asked for is
worth it, a thread compiles. The change comes between two steps, with the same worlds: long calls are cut into slices for
it. Short scripts never start a compiler.
"""

from __future__ import annotations

import hashlib
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import replace
from functools import cache
from math import prod
from pathlib import Path

import torch

from powderdsl.ir.ops import Program
from powderdsl.ir.segments import segments
from powderdsl.model.fingerprint import fingerprint
from powderdsl.model.types import Ruleset
from powderdsl.targets.array_kind import Array
from powderdsl.targets.cache import turn
from powderdsl.targets.cpp.build import (
    INSTALL,
    MISSING,
    NoCompiler,
    NoCompilerWarning,
    building,
    cache_key,
    current,
    find_compiler,
    flags_for,
)
from powderdsl.targets.cpp.program import NativeProgram, compile_program, recall, remember
from powderdsl.targets.cpp.source import known_width
from powderdsl.targets.job import Job, Runnable, shape_of, unavailable
from powderdsl.targets.mixed import mixed_program
from powderdsl.targets.torch.program import TorchProgram

Lowered = Callable[[], Program]
"""Returns a ruleset in IR; the first call does the work."""

SOURCES = ("compiler.py", "simulation/native.py", "model", "analysis", "ir", "schedule", "targets")

WORTH = 2.0
"""Native code is compiled once work on the first backend, done or expected in the current call, exceeds this many seconds.
Compiling takes longer, but runs in another thread, and its result is cached."""

SLICE = 0.25
"""Seconds on the first backend between two checks for native code."""


def start_key(ruleset: Ruleset, width: int | None = None) -> str:
    """The cache's key for the native code of a ruleset; without `width`, for the code compiled last.

    Raises NoCompiler if there is no compiler.
    """
    compiler = find_compiler()
    params = tuple(replace(param, default=0, about="") for param in ruleset.params)
    said = fingerprint(replace(ruleset, params=params))
    return cache_key(f"{said}{generator()} {width}", compiler, flags_for(compiler, current().level))


@cache
def generator() -> str:
    """A hash of the source files that generate C++."""
    here = Path(__file__).resolve().parents[1]
    found = hashlib.sha256()
    for name in SOURCES:
        files = sorted(p for p in (here / name).rglob("*") if p.suffix in (".py", ".hpp")) or [here / name]
        for path in files:
            found.update(path.read_bytes())
    return found.hexdigest()


def latest_width(ruleset: Ruleset, lowered: Lowered) -> int:
    """What the code compiled last is for, or 0. Without any, what cannot be lowered is reported here.

    Raises NoCompiler if there is no compiler.
    """
    code = recall(start_key(ruleset))
    if code is None:
        lowered()
    return 0 if code is None else code.width


def native_program(ruleset: Ruleset, lowered: Lowered, threads: int, width: int) -> Runnable:
    """A program, from the cache or compiled now; passes that do not fit bit planes run on cells.

    Raises:
        NoCompiler: there is no C++ compiler, or it failed.
    """
    key = start_key(ruleset, width)
    code = recall(key)
    if code is None:
        with turn(current().place(), key):
            code = recall(key)  # from another process, while this one waited
            if code is None:
                found = segments(lowered())
                if len(found) > 1 or found[0].planes is None:
                    return mixed_program(
                        found,
                        lambda numbers, planes: NativeProgram(
                            compile_program(numbers, planes, width), threads
                        ),
                        lambda numbers: TorchProgram(numbers, torch.device("cpu")),
                    )
                code = compile_program(found[0].program, found[0].planes, width)
                remember(key, code)
                remember(start_key(ruleset), code)
    return NativeProgram(code, threads)


def native_by_width(ruleset: Ruleset, lowered: Lowered, threads: int) -> ByWidth:
    """The backend `native`. Without a compiler, there is an error at once: CompileError (PD701)."""

    @_compiler_needed()
    def make(width: int) -> Runnable:
        return native_program(ruleset, lowered, threads, width)

    with _compiler_needed():
        latest_width(ruleset, lowered)
    return ByWidth(make)


@contextmanager
def _compiler_needed() -> Iterator[None]:
    try:
        yield
    except NoCompiler as error:
        raise unavailable("native", str(error), f"run on the backend `wasm`, or {INSTALL}") from None


def auto_by_width(
    ruleset: Ruleset,
    lowered: Lowered,
    threads: int,
    first: tuple[str, Callable[[], Runnable]],
    cells: Callable[[], Runnable],
) -> ByWidth:
    """The backend `auto`: an `AutoProgram` for every width."""
    try:
        latest = latest_width(ruleset, lowered)
    except NoCompiler:
        latest = 0
        lowered()

    def make(width: int) -> AutoProgram:
        def ready() -> Runnable | None:
            code = recall(start_key(ruleset, width))
            return None if code is None else NativeProgram(code, threads)

        return AutoProgram(*first, cells, ready, lambda: native_program(ruleset, lowered, threads, width))

    return ByWidth(make, latest)


class ByWidth:
    """A program for each known width of grids, and one for all others (`known_width`), made when the first such grid comes.

    It is built with the settings that are in effect now. What it tells is about the width stepped last.
    """

    def __init__(self, make: Callable[[int], Runnable], width: int | None = None):
        """`width`: the program for it is made at once."""
        self._make, self._how = make, current()
        self._programs: dict[int, Runnable] = {}
        self._latest = None if width is None else self.of(width)

    def of(self, width: int) -> Runnable:
        """The program for a known width; 0 for all others."""
        program = self._programs.get(width)
        if program is None:
            with building(self._how):
                program = self._programs.setdefault(width, self._make(width))
        return program

    @property
    def running(self) -> str:
        """What the next step runs on: ``wasm``, ``torch`` or ``native``."""
        return str(getattr(self._latest, "running", "native"))

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about which backend ran, and why."""
        return tuple(getattr(self._latest, "notes", ()))

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later."""
        self._latest = program = self.of(known_width(shape_of(job.state)[-1]))
        return program.run(job)


class AutoProgram:
    """Runs on a backend that starts at once until native code has been compiled.

    Args:
        name: that backend.
        first: gives its program, the same at each call.
        large: gives the program for worlds that it has no memory for, if there is no native code.
        ready: native code that was compiled before, or None; raises NoCompiler if none could be made.
        make: native code, compiled; raises NoCompiler.
    """

    def __init__(
        self,
        name: str,
        first: Callable[[], Runnable],
        large: Callable[[], Runnable],
        ready: Callable[[], Runnable | None],
        make: Callable[[], Runnable],
    ):
        self._name, self._first, self._large, self._make = name, first, large, make
        self._thread: threading.Thread | None = None
        self._began = 0.0
        self._took: float | None = None
        self._native: Runnable | None = None
        self._problem = ""
        self._beginning = threading.Lock()
        self._spent = 0.0
        self._pace: tuple[int, float] | None = None  # cells of a batch, seconds a step on the first backend
        self._steps = {"first": 0, "native": 0}
        try:
            self._native = ready()
        except NoCompiler as error:
            self._problem = str(error)

    @property
    def running(self) -> str:
        """What the next step runs on: ``wasm``, ``torch`` or ``native``."""
        return self._name if self._native is None else "native"

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about which backend ran, and why."""
        thread, steps, first = self._thread, self._steps, self._name
        seconds = time.perf_counter() - self._began if self._took is None else self._took
        if self._native is not None and thread is None:
            return ("native: it was compiled before",)
        if self._native is not None:
            ready = f"while native was made ready ({seconds:.0f} s), then native for {steps['native']}"
            return (f"{first} for {steps['first']} steps {ready}",)
        if self._problem:
            return f"{first}: {self._problem}", f"native code is faster: {INSTALL}"
        if thread is not None and thread.is_alive():
            return (f"{first} for {steps['first']} steps; native is being made ready ({seconds:.0f} s)",)
        return (f"{first}: native is compiled from {WORTH:g} s of work, or by --backend native",)

    def run(self, job: Job) -> Mapping[str, Array]:
        """The state `job.steps` later."""
        if job.timing is not None:
            return (self._native or self._first()).run(job)
        clock, part, done, cells = job.clock, job, 0, prod(shape_of(job.state))
        while True:
            native = self._native
            if native is not None:
                self._steps["native"] += part.steps
                return native.run(part)
            count = self._slice(cells, job.steps - done)
            began = time.perf_counter()
            try:
                state = self._first().run(part._replace(steps=count))
            except MemoryError:  # of WebAssembly: native code is waited for
                self._begin()
                if self._thread is not None:
                    self._thread.join()
                self._steps["native"] += part.steps
                return (self._native or self._large()).run(part)
            done += count
            later = clock._replace(since=clock.since + done)
            part = part._replace(state=state, clock=later, steps=job.steps - done)
            self._account(cells, count, job.steps - done, time.perf_counter() - began)
            if done == job.steps:
                return state

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
            # A fork has its parent's memory, but not its threads: there the thread is lost.
            lost = self._thread is not None and self._took is None and not self._thread.is_alive()
            if self._native is None and (self._thread is None or lost):
                self._began = time.perf_counter()
                context = copy_context()
                self._thread = threading.Thread(target=context.run, args=(self._compile,), daemon=True)
                self._thread.start()
        finally:
            self._beginning.release()

    def _compile(self) -> None:
        try:
            self._native = self._make()
        except NoCompiler as error:
            self._problem = str(error)
        except Exception as error:  # what runs continues; `--backend native` shows what is wrong
            self._problem = f"{type(error).__name__}: {error}"
        self._took = time.perf_counter() - self._began


@cache
def _tell_of_compilers(problem: str) -> None:
    """Warn once in a process if work that is worth compiling meets no compiler. Other problems stand in `notes`."""
    if problem.startswith(MISSING):
        warnings.warn(
            f"{problem}; native code is many times faster: {INSTALL}", NoCompilerWarning, stacklevel=2
        )
