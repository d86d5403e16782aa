"""A program on bit planes → one C++ source file: the library, the tables and a function per pass."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import reduce
from importlib.resources import files
from operator import or_
from typing import NamedTuple

from powderdsl.ir.ops import SNAP, Program
from powderdsl.schedule.presence import asked_ids
from powderdsl.schedule.stages import CPU, plan
from powderdsl.system.memo import collection_paused
from powderdsl.targets.cpp.text import pass_text
from powderdsl.targets.layout import NativeLayout, literal, native_layout

GENERATOR_VERSION = 11
"""Part of every cache key; increase it when generated code changes meaning."""

LIBRARY = ("vectors", "runtime", "planes", "movements", "fields")
"""Headers that come before the generated passes, in this order."""
DRIVER = ("driver", "views")
"""Headers that come after them."""

UNIT_SIZE = 40_000
"""Letters of generated passes from which compiling two units side by side is faster."""

ELEMENT = "element:"
ONLY_IN = "#if !defined(UNIT) || UNIT == "


class NativeSource(NamedTuple):
    """A source file, its layout, and the number of units: with UNIT defined as its number, a unit's part is compiled."""

    text: str
    layout: NativeLayout
    units: int


def known_width(width: int) -> int:
    """The width that a library for grids of this width is compiled for; 0 if it takes any width.

    Rows of whole words have a library for each width: words have 64 columns, or 32 if that is the width. All other
    widths share one.
    """
    return width if width == 32 or width % 64 == 0 else 0


@collection_paused()
def native_source(program: Program, width: int = 0) -> NativeSource:
    """The source file of a program.

    Args:
        width: see `known_width`.
    """
    layout = native_layout(program)
    schedules = [plan(pass_, CPU) for pass_ in program.passes]
    passes = [pass_text(schedule, i, layout) for i, schedule in enumerate(schedules)]
    sizes = {
        "WIDTH": width,
        "STREAMS": len(layout.streams),
        "STEP_PLANES": len(layout.step_planes),
        "PARAM_PLANES": len(layout.param_planes),
        "PARAM_REALS": len(layout.param_reals),
        "SLOTS": len(layout.planes),
        "COINS": len(layout.coins),
        "REALS": len(layout.reals),
        **{name.upper(): size for name, size in vars(layout).items() if isinstance(size, int)},
        "SNAP": literal(SNAP),
        "PASSES": len(passes),
    }
    folder = files("powderdsl.targets.cpp")
    before, after = (
        "\n".join((folder / f"{part}.hpp").read_text(encoding="utf-8") for part in parts)
        for parts in (LIBRARY, DRIVER)
    )
    units = 2 if sum(map(len, passes)) >= UNIT_SIZE else 1
    asked = reduce(or_, map(asked_ids, schedules), 0)
    lines = [
        f"// {len(passes)} passes, generated; version {GENERATOR_VERSION}",
        *(f"#define {name} {size}" for name, size in sizes.items()),
        before,
        *_in_units(passes, units, len(after)),
        f"{ONLY_IN}0",
        *_tables(program, layout),
        *_look(layout, asked),
        "static void run_passes(Context& c) {\n  START;",
        *(["  if (c.present == ~0ull) look(c);"] if asked else []),
        *(f"  pass_{i}(c); TICK({i})" for i in range(len(passes))),
        "}",
        after,
        "#endif\n",
    ]
    return NativeSource("\n".join(lines), layout, units)


def _tables(program: Program, layout: NativeLayout) -> Iterator[str]:
    """The types of tables, and tables of slots that a step resets, of planes and of streams."""
    yield "struct ResetPlane { int slot; bool value; };"
    yield "struct ResetReal { int slot; float value; };"
    yield "struct FixedPlane { int kind, a, b; };"
    yield "struct StepPlane { u64 a; int b; };"
    planes, reals = [], []
    for slot in program.slots:
        if slot.resets and slot.name in layout.planes:
            planes.append((layout.planes[slot.name], int(slot.default)))
        elif slot.resets:
            reals.append((layout.reals[slot.name], literal(float(slot.default))))
    tables: dict[tuple[str, str], Iterable[tuple[object, ...]]] = {
        ("ResetPlane", "RESET_PLANES"): planes,
        ("ResetReal", "RESET_REALS"): reals,
        ("FixedPlane", "FIXED"): layout.fixed,
        ("StepPlane", "STEP_TABLE"): layout.step_planes,
    }
    for (type, name), rows in tables.items():
        items = ", ".join(["{" + ", ".join(map(str, row)) + "}" for row in rows])
        yield f"static const std::vector<{type}> {name} = {{{items}}};"
    idents = ", ".join(f"{ident}u" for _, ident, _ in program.streams)
    yield f"static const std::vector<u32> STREAM_IDENT = {{{idents}}};"


def _in_units(passes: Sequence[str], units: int, driver: int) -> Iterator[str]:
    """The passes, each in a unit, so that all units are about as long; the first has a driver of so many letters, too."""
    sizes = [driver, *[0] * (units - 1)]
    chosen: dict[int, int] = {}
    for number in sorted(range(len(passes)), key=lambda number: -len(passes[number])):
        chosen[number] = sizes.index(min(sizes))
        sizes[chosen[number]] += len(passes[number])
    yield from (f"void pass_{number}(Context& c);" for number in range(len(passes)))
    for number, text in enumerate(passes):
        yield f"{ONLY_IN}{chosen[number]}\n{text}\n#endif"


def _look(layout: NativeLayout, asked: int) -> Iterator[str]:
    """The function that finds which of the ids in `asked` are present, from products of their low and high bits."""
    planes = [plane for name, plane in layout.planes.items() if name.startswith(ELEMENT)]
    ids = [code for code in range(1 << len(planes)) if asked >> code & 1]
    if not ids:
        yield "static void look(Context&) {}"
        return
    low = len(planes) // 2
    before, stores, present = [], [], []
    for code in ids:
        before.append(f"V id{code} = splat(0);")
        stores.append(f"id{code} |= low{code & (1 << low) - 1} & high{code >> low};")
        present.append(f"(any(id{code}) ? 1ull << {code} : 0)")
    yield "static void look(Context& c) {"
    yield from (f"const V* e{bit} = c.slot[{plane}]->data;" for bit, plane in enumerate(planes))
    yield from (*before, "for (size_t i = 0; i < c.g.cells(); i++) {")
    yield from (f"const V b{bit} = e{bit}[i];" for bit in range(len(planes)))
    for name, bits in (("low", range(low)), ("high", range(low, len(planes)))):
        for code in range(1 << len(bits)):
            factors = [f"{'' if code >> i & 1 else '~'}b{bit}" for i, bit in enumerate(bits)]
            yield f"const V {name}{code} = {' & '.join(factors) or '~splat(0)'};"
    yield from (*stores, "}", f"c.present = {' | '.join(present)};", "}")
