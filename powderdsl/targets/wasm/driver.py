"""What JavaScript and Python call: batches of worlds, cells in and out, steps.

All functions take and give i32 unless said otherwise. `rows` are those of a world; the columns are those of the module.

    allocate(worlds, rows) → batch      all worlds of an instance have the same number of rows
    release(batch)
    copy(batch) → batch                 shares what is not changed later
    scratch(bytes) → address            memory for the host, until it asks for more
    inputs(batch) → address             i64 [3, worlds]: seed, index, step; then bits of parameters, bytes [bits, worlds];
                                        then, from a multiple of 16 bytes on, their values, f32 [values, worlds]
    run(batch, steps)                   and adds the steps to those of the inputs
    load(batch, plane, planes, bytes, address)          cells [worlds, rows, columns], integers of 1, 2 or 4 bytes
    store(batch, plane, planes, signed, bytes, address)
    load_real(batch, field, address, apart)             cells, f32; `apart`: bytes from one world to the next
    store_real(batch, field, address, apart)
    fill(batch, world, plane, planes, top, bottom, left, right, value)  a box of cells; bottom and right lie outside
    fill_real(batch, world, field, top, bottom, left, right, value)     the value is f32
"""

from __future__ import annotations

from collections.abc import Sequence

from powderdsl.ir.ops import Program
from powderdsl.targets.machine.batches import Batches
from powderdsl.targets.machine.functions import Callee
from powderdsl.targets.machine.grids import Grid
from powderdsl.targets.machine.library import Library
from powderdsl.targets.machine.steps import Steps
from powderdsl.targets.wasm.transfer import Transfer


def add_driver(
    library: Library,
    program: Program,
    passes: Sequence[Callee],
    asked: int,
    *,
    apart: bool = False,
    export: bool = True,
) -> dict[str, Callee]:
    """Add the functions that a host calls, and give them by name.

    Args:
        program: on bit planes.
        asked: the ids whose presence passes ask for.
        apart: export passes too, by their numbers, and what comes before and after them.
        export: whether hosts see these functions.
    """
    module, batches, cells = library.module, Batches(library), Transfer(library)
    allocate = module.add(batches.allocate(Grid(library).setup()), "allocate", export=export)
    added = {"allocate": allocate}
    for function, name in (
        (batches.copy(allocate), "copy"),
        (batches.release(), "release"),
        (batches.scratch(), "scratch"),
        (batches.inputs(), "inputs"),
        (Steps(library, program, passes, asked).run(apart=apart), "run"),
        (cells.load(), "load"),
        (cells.store(), "store"),
        (cells.load_real(), "load_real"),
        (cells.store_real(), "store_real"),
        (cells.fill(), "fill"),
        (cells.fill_real(), "fill_real"),
    ):
        added[name] = module.add(function, name, export=export)
    return added
