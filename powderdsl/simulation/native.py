"""Native code by the width of grids, compiled when it pays off.

Each width has its own library, or shares one with others (`known_width`). A library is built when the first grid of its
width is stepped, so that unneeded code takes no time. If the same model was compiled before, its code comes from the
cache and nothing is lowered. The cache's key depends on the model, on the code of this package, on the compiler, the
processor and the width. Values of parameters are inputs of a step, so the key excludes them.

The backend `auto` starts on WebAssembly, or on torch if wasmtime has no wheel. Once enough work is done or requested, a
thread compiles. The backend changes between two steps, with the same worlds: long calls are split into slices. Short
scripts never start a compiler.
"""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Callable, Mapping
from contextvars import copy_context
from dataclasses import replace
from functools import cache, cached_property, partial
from math import prod

import torch

from powderdsl.diagnostics import CompileError
from powderdsl.ir.bits import Segment
from powderdsl.model.types import Ruleset
from powderdsl.system.cache import code_hash
from powderdsl.system.settings import fingerprint
from powderdsl.targets.array_kind import Array
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
    turn,
)
from powderdsl.targets.cpp.program import NativeProgram, compile_program, recall, remember
from powderdsl.targets.cpp.source import known_width
from powderdsl.targets.job import Job, Runnable, mixed_program, shape_of, unavailable
from powderdsl.targets.torch.program import TorchProgram

WORTH = 2.0
"""Native code is compiled once work on the first backend, done or expected in the current call, exceeds this many seconds.
Compiling takes longer, but runs in another thread, and its result is cached."""

SLICE = 0.25
"""Seconds on the first backend between two checks for native code."""


class ByWidth:
    """Native code for each width of grids (`known_width`), made for the first grid of that width.

    Code is built with the current settings. `latest` is the program of the last width stepped.

    Args:
        segments: returns the ruleset on planes; the first call does the work.
        first: for `auto`, the backend that starts instantly, and a function that returns its program.
        cells: returns the program that runs everything on cells.

    Raises:
        CompileError: PD701 if there is no compiler, unless another backend starts.
    """

    def __init__(
        self,
        ruleset: Ruleset,
        segments: Callable[[], tuple[Segment, ...]],
        threads: int,
        first: tuple[str, Callable[[], Runnable]] | None,
        cells: Callable[[], Runnable],
    ):
        self._ruleset, self._segments, self._threads, self._how = ruleset, segments, threads, current()
        self._first, self._cells = first, cells
        self._programs: dict[int, Runnable] = {}
        self.latest: Runnable | None = None
        try:
            code = recall(self._key())
        except NoCompiler as error:
            if first is None:
                raise _refusal(error) from None
            code = None
        if code is None:
            segments()  # reports rules that cannot be lowered
        if first is not None:
            self.latest = self.of(0 if code is None else code.width)

    def of(self, width: int) -> Runnable:
        if width in self._programs:
            return self._programs[width]
        recall, compile = partial(self._recall, width), partial(self._compile, width)
        with building(self._how):
            try:
                if self._first is not None:
                    program: Runnable = AutoProgram(*self._first, self._cells, recall, compile)
                else:
                    program = recall() or compile()
            except NoCompiler as error:
                raise _refusal(error) from None
            return self._programs.setdefault(width, program)

    @cached_property
    def _model(self) -> str:
        params = tuple(replace(param, default=0, about="") for param in self._ruleset.params)
        return fingerprint(replace(self._ruleset, params=params))

    def _key(self, width: int | None = None) -> str:
        """The cache's key for native code; without `width`, for the code compiled last. Raises NoCompiler."""
        compiler = find_compiler()
        return cache_key(
            f"{self._model}{code_hash()} {width}", compiler, flags_for(compiler, current().level)
        )

    def _recall(self, width: int) -> Runnable | None:
        """Cached native code, or None. Raises NoCompiler."""
        code = recall(self._key(width))
        return None if code is None else NativeProgram(code, self._threads)

    def _compile(self, width: int) -> Runnable:
        """Native code, compiled here or meanwhile by another process. Raises NoCompiler.

        Passes that do not fit bit planes run on cells.
        """
        with turn(current().place(), self._key(width)):
            if (program := self._recall(width)) is not None:
                return program
            program = mixed_program(
                self._segments(),
                lambda program, planes: NativeProgram(compile_program(program, planes, width), self._threads),
                lambda cells: TorchProgram(cells, torch.device("cpu")),
            )
            if isinstance(program, NativeProgram):
                remember(self._key(width), program.code)
                remember(self._key(), program.code)
        return program

    def native(self, width: int) -> NativeProgram | None:
        """Return the native code for grids of a width that runs all passes, if it has been compiled."""
        program: Runnable | None = self.of(known_width(width))
        if isinstance(program, AutoProgram):
            program = program.native
        return program if isinstance(program, NativeProgram) else None

    def run(self, job: Job) -> Mapping[str, Array]:
        self.latest = program = self.of(known_width(shape_of(job.state)[-1]))
        return program.run(job)


def _refusal(error: NoCompiler) -> CompileError:
    return unavailable("native", str(error), f"run on the backend `wasm`, or {INSTALL}")


class AutoProgram:
    """Runs on a backend that starts instantly until native code has been compiled.

    Args:
        name: the backend that starts.
        first: returns its program, the same on each call.
        large: without native code, returns the program for worlds that do not fit into its memory.
        recall: returns cached native code, or None; raises NoCompiler.
        make: compiles native code; raises NoCompiler.
    """

    def __init__(
        self,
        name: str,
        first: Callable[[], Runnable],
        large: Callable[[], Runnable],
        recall: Callable[[], Runnable | None],
        make: Callable[[], Runnable],
    ):
        self._name, self._first, self._large, self._make = name, first, large, make
        self.native: Runnable | None = None
        """Native code, once it has been compiled."""
        self._problem = ""
        self._thread: threading.Thread | None = None
        self._starting = threading.Lock()
        self._spent = 0.0
        self._pace: tuple[int, float] | None = None  # cells of a batch, seconds per step on the first backend
        self._steps = {"first": 0, "native": 0}
        try:
            self.native = recall()
        except NoCompiler as error:
            self._problem = str(error)

    @property
    def running(self) -> str:
        """The backend of the next step: ``wasm``, ``torch`` or ``native``."""
        return self._name if self.native is None else "native"

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that name the backends that ran, and the reasons."""
        thread, first = self._thread, f"{self._name} for {self._steps['first']} steps"
        if self.native is not None and thread is None:
            return ("native: it was compiled before",)
        if self.native is not None:
            return (f"{first} while native was made ready, then native for {self._steps['native']}",)
        if self._problem:
            return f"{self._name}: {self._problem}", f"native code is faster: {INSTALL}"
        if thread is not None and thread.is_alive():
            return (f"{first}; native is being made ready",)
        return (f"{self._name}: native is compiled from {WORTH:g} s of work, or by --backend native",)

    def run(self, job: Job) -> Mapping[str, Array]:
        if job.timing is not None:
            return (self.native or self._first()).run(job)
        cells = prod(shape_of(job.state))
        while self.native is None:
            count, clock = self._slice(cells, job.steps), job.clock
            began = time.perf_counter()
            try:
                state = self._first().run(job._replace(steps=count))
            except MemoryError:  # WebAssembly is too small: wait for native code
                self._begin()
                if self._thread is not None:
                    self._thread.join()
                break
            left = job.steps - count
            self._account(cells, count, left, time.perf_counter() - began)
            if not left:
                return state
            job = job._replace(state=state, clock=clock._replace(since=clock.since + count), steps=left)
        self._steps["native"] += job.steps
        return (self.native or self._large()).run(job)

    def _slice(self, cells: int, left: int) -> int:
        """The number of steps to run on the first backend before the next check: 1 until their speed is known."""
        if self._problem:
            return left
        if self._pace is None or self._pace[0] != cells:
            return min(left, 1)
        return min(left, max(1, int(SLICE / max(self._pace[1], 1e-9))))

    def _account(self, cells: int, count: int, left: int, seconds: float) -> None:
        """Count steps that ran on the first backend, and start to compile once it pays off."""
        if count == 0:
            return
        self._steps["first"] += count
        self._spent += seconds
        # The first step allocates memory that later steps reuse, so its duration does not predict theirs.
        first = self._pace is None or self._pace[0] != cells
        self._pace = (cells, seconds / count)
        expected = 0.0 if first else left * self._pace[1]
        if self._spent + expected >= WORTH:
            self._begin()

    def _begin(self) -> None:
        """Start to compile, unless a build has started."""
        if self._problem:
            _warn_of_compilers(self._problem)
            return
        with self._starting:
            # A forked child has its parent's memory, but not its threads: there, the thread has ended without a result.
            finished = self.native is not None or bool(self._problem)
            if not finished and (self._thread is None or not self._thread.is_alive()):
                context = copy_context()
                self._thread = threading.Thread(target=context.run, args=(self._compile,), daemon=True)
                self._thread.start()

    def _compile(self) -> None:
        try:
            self.native = self._make()
        except NoCompiler as error:
            self._problem = str(error)
        except Exception as error:  # the first backend continues; `--backend native` shows the error
            self._problem = f"{type(error).__name__}: {error}"


@cache
def _warn_of_compilers(problem: str) -> None:
    """Warn once per process if compiling would pay off but there is no compiler. Other problems appear in `notes`."""
    if problem.startswith(MISSING):
        message = f"{problem}; native code is many times faster: {INSTALL}"
        warnings.warn(message, NoCompilerWarning, stacklevel=2)
