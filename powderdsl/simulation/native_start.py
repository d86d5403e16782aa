"""From a checked model to native code: cached code if the same model has been compiled before, else by lowering it.

Each width of grids has a library of its own, or shares one with others (`known_width`). A library is compiled when the
first grid of its width is stepped, so that nobody waits for code that is not needed.

The cache's key depends on the model, on every source file that turns models into C++, on the compiler, the processor
and the width. Values of parameters are inputs of a step, so they take no part.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import torch

from powderdsl.ir.ops import Program
from powderdsl.ir.segments import segments
from powderdsl.model.fingerprint import fingerprint
from powderdsl.model.types import Ruleset
from powderdsl.targets.cache import turn
from powderdsl.targets.cpp.build import cache_key, current
from powderdsl.targets.cpp.code import NativeCode, compile_program, recall, remember
from powderdsl.targets.cpp.compilers import find_compiler, flags_for
from powderdsl.targets.cpp.program import NativeProgram
from powderdsl.targets.job import Runnable
from powderdsl.targets.torch.mixed import mixed_program

Lowered = Callable[[], Program]
"""Returns a ruleset in IR; the first call does the work."""

SOURCES = ("compiler.py", "simulation/native_start.py", "model", "analysis", "ir", "schedule", "targets")


def start_key(ruleset: Ruleset, width: int | None = None) -> str:
    """The cache's key for the native code of a ruleset; without `width`, for the code compiled last.

    Raises NoCompiler if there is no compiler.
    """
    compiler = find_compiler()
    params = tuple(replace(param, default=0, about="") for param in ruleset.params)
    said = fingerprint(replace(ruleset, params=params))
    return cache_key(f"{said}{generator()} {width}", compiler, flags_for(compiler, current().level))


@lru_cache(maxsize=1)
def generator() -> str:
    """A hash of the source files that generate C++."""
    here = Path(__file__).resolve().parents[1]
    found = hashlib.sha256()
    for name in SOURCES:
        files = sorted(p for p in (here / name).rglob("*") if p.suffix in (".py", ".hpp")) or [here / name]
        for path in files:
            found.update(path.read_bytes())
    return found.hexdigest()


def latest_width(ruleset: Ruleset) -> int | None:
    """What the code compiled last is for; None if there is none. Raises NoCompiler if there is no compiler."""
    code = recall(start_key(ruleset))
    return None if code is None else code.width


def ready_program(ruleset: Ruleset, lowered: Lowered, threads: int, width: int) -> Runnable | None:
    """A program that was compiled before, or None. Raises NoCompiler if there is no compiler."""
    code = recall(start_key(ruleset, width))
    return None if code is None else _recalled(code, lowered, threads, width)


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
                        torch.device("cpu"),
                        lambda cells, planes: _compiled(cells, planes, threads, width),
                    )
                code = compile_program(found[0].program, found[0].planes, width)
                remember(key, code)
                remember(start_key(ruleset), code)
    return _recalled(code, lowered, threads, width)


def _recalled(code: NativeCode, lowered: Lowered, threads: int, width: int) -> Runnable:
    """The program of code for a whole ruleset, which is only lowered if its passes are timed."""

    def with_clocks() -> NativeCode:
        (segment,) = segments(lowered())
        assert segment.planes is not None
        return compile_program(segment.program, segment.planes, width, clocks=True)

    return NativeProgram(code, threads, with_clocks)


def _compiled(cells: Program, planes: Program, threads: int, width: int) -> Runnable:
    code = compile_program(cells, planes, width)
    return NativeProgram(code, threads, lambda: compile_program(cells, planes, width, clocks=True))
