"""A program on bit planes → one C++ source file: the library, the tables and a function per pass."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.resources import files
from typing import NamedTuple

from powderdsl.ir.ops import SNAP, Program
from powderdsl.schedule.presence import tested_ids
from powderdsl.schedule.stages import CPU, plan
from powderdsl.system.cache import collection_paused
from powderdsl.targets.cpp.text import pass_text
from powderdsl.targets.layout import NativeLayout, braced, literal, native_layout

GENERATOR_VERSION = 13
"""Part of every cache key; increase it when the meaning of generated code changes."""

LIBRARY = ("vectors", "runtime", "planes", "movements", "fields")
"""Headers before the generated passes, in this order."""
DRIVER = ("driver", "views", "episodes", "levels")
"""Headers after the generated passes."""

UNIT_SIZE = 40_000
"""Minimum number of letters of generated passes for which compiling two units side by side is faster."""

ELEMENT = "element:"
ONLY_IN = "#if !defined(UNIT) || UNIT == "


class NativeSource(NamedTuple):
    """A source file, its layout, and the number of units: with UNIT defined as a number, only that unit is compiled."""

    text: str
    layout: NativeLayout
    units: int


def known_width(width: int) -> int:
    """The width for which a library for grids of this width is compiled; 0 if it takes any width.

    Rows of whole words have a library for each width: words have 64 columns, or all columns of 8, 16 or 32. All other
    widths share one library.
    """
    return width if width in (8, 16, 32) or width % 64 == 0 else 0


@collection_paused()
def native_source(program: Program, width: int = 0) -> NativeSource:
    """The source file of a program. `width`: see `known_width`."""
    layout, tested = native_layout(program), 0
    passes, calls = [], []
    for number, pass_ in enumerate(program.passes):
        schedule = plan(program, pass_, CPU)
        tested |= tested_ids(schedule)
        passes.append(pass_text(schedule, number, layout))
        calls.append(f"  pass_{number}(c); TICK({number})")
    sizes: dict[str, object] = {
        "WIDTH": width,
        "STREAMS": len(layout.streams),
        "STEP_PLANES": len(layout.step_planes),
        "PARAM_PLANES": len(layout.param_planes),
        "PARAM_REALS": len(layout.param_reals),
        "SLOTS": len(layout.planes),
        "COINS": len(layout.coins),
        "REALS": len(layout.reals),
    }
    sizes |= {name.upper(): size for name, size in vars(layout).items() if isinstance(size, int)}
    sizes |= {"SNAP": literal(SNAP), "PASSES": len(passes)}
    before, after = "\n".join(map(_header, LIBRARY)), "\n".join(map(_header, DRIVER))
    units = 2 if sum(map(len, passes)) >= UNIT_SIZE else 1
    lines = [
        f"// {len(passes)} passes, generated; version {GENERATOR_VERSION}",
        *map("#define {} {}".format, sizes, sizes.values()),
        before,
        *_assign_units(passes, units, len(after)),
        f"{ONLY_IN}0",
        *_tables(program, layout, tested),
        "static void run_passes(Context& c) {\n  START;",
        *calls,
        "}",
        after,
        "#endif\n",
    ]
    return NativeSource("\n".join(lines), layout, units)


def _header(name: str) -> str:
    return (files("powderdsl.targets.cpp") / f"{name}.hpp").read_text(encoding="utf-8")


def _tables(program: Program, layout: NativeLayout, tested: int) -> Iterator[str]:
    """Tables of the slots that a step resets, of planes and of streams; the ids whose presence passes test."""
    planes, reals, elements = [], [], []
    for slot in program.slots:
        if slot.name.startswith(ELEMENT):
            elements.append(layout.planes[slot.name])
        if slot.resets and slot.name in layout.planes:
            planes.append((layout.planes[slot.name], int(slot.default)))
        elif slot.resets:
            reals.append((layout.reals[slot.name], literal(float(slot.default))))
    idents = [f"{ident}u" for _, ident, _ in program.streams]
    yield f"static const std::vector<ResetPlane> RESET_PLANES = {braced(map(braced, planes))};"
    yield f"static const std::vector<ResetReal> RESET_REALS = {braced(map(braced, reals))};"
    yield f"static const std::vector<FixedPlane> FIXED = {braced(map(braced, layout.fixed))};"
    yield f"static const std::vector<StepPlane> STEP_TABLE = {braced(map(braced, layout.step_planes))};"
    yield f"static const std::vector<u32> STREAM_IDENT = {braced(idents)};"
    yield f"constexpr int ELEMENTS = {len(elements)}, ELEMENT[] = {braced([*elements, 0])};"
    yield f"constexpr u64 ASKED = {tested:#x}ull;"


def _assign_units(passes: Sequence[str], units: int, driver: int) -> Iterator[str]:
    """The passes, divided into units of about the same length; the first unit also has a driver of `driver` letters."""
    sizes = [driver, *[0] * (units - 1)]
    chosen: dict[str, int] = {}
    for text in sorted(passes, key=len, reverse=True):
        chosen[text] = sizes.index(min(sizes))
        sizes[chosen[text]] += len(text)
    for number in range(len(passes)):
        yield f"void pass_{number}(Context& c);"
    for text in passes:
        yield f"{ONLY_IN}{chosen[text]}\n{text}\n#endif"
