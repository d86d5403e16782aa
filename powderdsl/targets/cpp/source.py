"""A program on bit planes → C++: a function per pass and the tables; and the driver, which programs share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from typing import NamedTuple

from powderdsl.ir.ops import SNAP, Program
from powderdsl.schedule.presence import tested_ids
from powderdsl.schedule.stages import CPU, plan
from powderdsl.system.cache import collection_paused
from powderdsl.targets.cpp.text import pass_text
from powderdsl.targets.layout import NativeLayout, braced, literal, native_layout

GENERATOR_VERSION = 14
"""Part of every cache key; increase it when the meaning of generated code changes."""

LIBRARY = ("vectors", "runtime", "planes")
"""Headers that passes and driver build on, in this order."""
DRIVER = ("memory", "draws", "movements", "driver", "views", "episodes", "levels")
"""Headers of the driver."""

UNIT_SIZE = 40_000
"""Minimum number of letters of generated passes for which compiling two units side by side is faster."""

ELEMENT = "element:"
ONLY_IN = "#if !defined(UNIT) || UNIT == "


class NativeSource(NamedTuple):
    """Generated passes and the driver as C++, and the layout.

    Passes have `units`: with UNIT defined as a number, only that unit is compiled.
    """

    passes: str
    driver: str
    layout: NativeLayout
    units: int

    @property
    def whole(self) -> str:
        """All in one source file."""
        return "\n".join(["#define DRIVER", self.passes, *map(_header, DRIVER)])


def known_width(width: int) -> int:
    """The width for which a library for grids of this width is compiled; 0 if it takes any width.

    Rows of whole words have a library for each width: words have 64 columns, or all columns of 8, 16 or 32. All other
    widths share one library.
    """
    return width if width in (8, 16, 32) or width % 64 == 0 else 0


@collection_paused()
def native_source(program: Program, width: int = 0) -> NativeSource:
    """The sources of a program. `width`: see `known_width`."""
    layout, tested = native_layout(program), 0
    passes, calls = [], []
    for number, pass_ in enumerate(program.passes):
        schedule = plan(program, pass_, CPU)
        tested |= tested_ids(schedule)
        passes.append(pass_text(schedule, number, layout))
        calls.append(f"  pass_{number}(c); TICK({number})")
    shape = {"WIDTH": width, "HALO": layout.halo, "REACH": layout.reach}
    sizes = {"TURNED": layout.turned, "MARKED": layout.marked, "SNAP": literal(SNAP)}
    units = 2 if sum(map(len, passes)) >= UNIT_SIZE else 1
    lines = [
        f"// {len(passes)} passes, generated; version {GENERATOR_VERSION}",
        *_definitions(shape | sizes),
        *map(_header, (*LIBRARY, "fields")),
        *_assign_units(passes, units),
        f"{ONLY_IN}0",
        "static void run_passes(Context& c) {\n  START;",
        *calls,
        "}",
        _table(program, layout, tested),
        _header("program"),
        "#endif\n",
    ]
    driver = ["#define DRIVER", *_definitions(shape), *map(_header, (*LIBRARY, *DRIVER))]
    return NativeSource("\n".join(lines), "\n".join(driver), layout, units)


def _definitions(sizes: Mapping[str, object]) -> Iterator[str]:
    yield from map("#define {} {}".format, sizes, sizes.values())


def _header(name: str) -> str:
    return (files("powderdsl.targets.cpp") / f"{name}.hpp").read_text(encoding="utf-8")


def _table(program: Program, layout: NativeLayout, tested: int) -> str:
    """The definition of PROGRAM (runtime.hpp). `tested`: the ids whose presence passes test."""
    planes, reals, elements = [], [], []
    for slot in program.slots:
        if slot.name.startswith(ELEMENT):
            elements.append(layout.planes[slot.name])
        if slot.resets and slot.name in layout.planes:
            planes.append(braced((layout.planes[slot.name], int(slot.default))))
        elif slot.resets:
            reals.append(braced((layout.reals[slot.name], literal(float(slot.default)))))
    numbers = [len(layout.planes), len(layout.reals), len(layout.param_planes), len(layout.param_reals)]
    numbers += [layout.around_rows, layout.beyond_rows, len(layout.coins)]
    numbers += [layout.moving, layout.turned, layout.waiting, layout.marks]
    fixed, steps = map(braced, layout.fixed), map(braced, layout.step_planes)
    idents = [f"{ident}u" for _, ident, _ in program.streams]
    tables = map(braced, (planes, reals, fixed, steps, idents, elements))
    return f"static Program PROGRAM{braced((*numbers, *tables, f'{tested:#x}ull', 'run_passes'))};"


def _assign_units(passes: Sequence[str], units: int) -> Iterator[str]:
    """The passes, divided into units of about the same length."""
    sizes = [0] * units
    chosen: dict[str, int] = {}
    for text in sorted(passes, key=len, reverse=True):
        chosen[text] = sizes.index(min(sizes))
        sizes[chosen[text]] += len(text)
    for number in range(len(passes)):
        yield f"void pass_{number}(Context& c);"
    for text in passes:
        yield f"{ONLY_IN}{chosen[text]}\n{text}\n#endif"
