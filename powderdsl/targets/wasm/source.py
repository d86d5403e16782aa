"""A program on bit planes → a module for grids of one width."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from operator import or_

from powderdsl.ir.ops import PassGraph, Program
from powderdsl.ir.text import structure
from powderdsl.schedule.presence import tested_ids
from powderdsl.schedule.stages import CPU, plan
from powderdsl.schedule.types import Schedule
from powderdsl.system.memo import Memo, collection_paused
from powderdsl.targets.layout import layout_of
from powderdsl.targets.wasm.binary import Module
from powderdsl.targets.wasm.driver import Driver
from powderdsl.targets.wasm.library import PAGE, Library, Memory, extent_of
from powderdsl.targets.wasm.passes import pass_function
from powderdsl.targets.wasm.standalone import Face, Standalone

PAGES = 1 << 15
"""The most pages of 64 KiB that a module's memory has: 2 GiB, so that no sum of two sizes passes 32 bits."""


@collection_paused()
def wasm_module(
    program: Program, width: int, *, face: Face | None = None, memo: Memo | None = None
) -> Module:
    """The module of a program on planes, for grids of this width.

    Args:
        face: the module is a world by itself (`standalone`), and exports only what that has.
        memo: where schedules of passes that have not changed are found.
    """
    schedules = [_schedule(pass_, memo) for pass_ in program.passes]
    memory = Memory(width, extent_of(schedules), layout_of(program))
    module = Module(memory.top // PAGE + 1, PAGES)
    library = Library(memory, module)
    passes = [pass_function(schedule, library) for schedule in schedules]
    asked = reduce(or_, map(tested_ids, schedules), 0)
    calls = Driver(library, program, passes, asked).add(export=face is None)
    if face is not None:
        Standalone(library, face, calls).add()
    return module


def _schedule(pass_: PassGraph, memo: Memo | None) -> Schedule:
    if memo is None:
        return plan(pass_, CPU)
    key = structure(pass_, places=False)
    kept = memo.of(("schedule", pass_.name), key, lambda: plan(pass_, CPU))
    return replace(kept, graph=kept.graph.copy())  # emitting code adds nodes to it
