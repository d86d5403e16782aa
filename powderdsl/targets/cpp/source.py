"""A program on bit planes → one C++ source file: the library, the tables and a function per pass."""

from __future__ import annotations

from collections.abc import Sequence
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
    asked = reduce(or_, map(asked_ids, schedules), 0)
    calls = "\n".join(f"  pass_{i}(c); TICK({i})" for i in range(len(program.passes)))
    resets = [
        (slot, layout.planes.get(slot.name), layout.reals.get(slot.name))
        for slot in program.slots
        if slot.resets
    ]
    reset_planes = [f"{{{plane}, {int(slot.default)}}}" for slot, plane, _ in resets if plane is not None]
    reset_reals = [
        f"{{{real}, {literal(float(slot.default))}}}" for slot, _, real in resets if real is not None
    ]
    step_table = [f"{{{a}, {b}}}" for a, b in layout.step_planes]
    fixed = [f"{{{k}, {a}, {b}}}" for k, a, b in layout.fixed]
    idents = [f"{ident}u" for _, ident, _ in program.streams]
    head = "\n".join([
        f"// {len(program.passes)} passes, generated; version {GENERATOR_VERSION}",
        f"#define WIDTH {width}",
        f"#define STREAMS {len(layout.streams)}",
        f"#define STEP_PLANES {len(layout.step_planes)}",
        f"#define PARAM_PLANES {len(layout.param_planes)}",
        f"#define PARAM_REALS {len(layout.param_reals)}",
        f"#define SLOTS {len(layout.planes)}",
        f"#define COINS {len(layout.coins)}",
        f"#define REALS {len(layout.reals)}",
        *(f"#define {name.upper()} {size}" for name, size in vars(layout).items() if isinstance(size, int)),
        f"#define SNAP {literal(SNAP)}",
        f"#define PASSES {len(program.passes)}",
    ])  # fmt: skip
    tables = "\n".join([
        "struct ResetPlane { int slot; bool value; };",
        "struct ResetReal { int slot; float value; };",
        "struct FixedPlane { int kind, a, b; };",
        "struct StepPlane { u64 a; int b; };",
        f"static const std::vector<ResetPlane> RESET_PLANES = {{{', '.join(reset_planes)}}};",
        f"static const std::vector<ResetReal> RESET_REALS = {{{', '.join(reset_reals)}}};",
        f"static const std::vector<FixedPlane> FIXED = {{{', '.join(fixed)}}};",
        f"static const std::vector<StepPlane> STEP_TABLE = {{{', '.join(step_table)}}};",
        f"static const std::vector<u32> STREAM_IDENT = {{{', '.join(idents)}}};",
    ])  # fmt: skip
    folder = files("powderdsl.targets.cpp")
    before, after = (
        "\n".join((folder / f"{part}.hpp").read_text(encoding="utf-8") for part in parts)
        for parts in (LIBRARY, DRIVER)
    )
    units = 2 if sum(map(len, passes)) >= UNIT_SIZE else 1
    body = _in_units(passes, units, len(after))
    known = "  if (c.present == ~0ull) look(c);\n" if asked else ""
    step = f"{look(layout, asked)}\nstatic void run_passes(Context& c) {{\n  START;\n{known}{calls}\n}}"
    last = f"{_only_in(0)}\n{tables}\n{step}\n{after}\n#endif\n"
    return NativeSource("\n".join([head, before, body, last]), layout, units)


def _only_in(unit: int) -> str:
    return f"#if !defined(UNIT) || UNIT == {unit}"


def _in_units(passes: Sequence[str], units: int, driver: int) -> str:
    """The passes, each in a unit, so that all units are about as long; the first has a driver of so many letters, too."""
    sizes = [driver, *[0] * (units - 1)]
    chosen: dict[int, int] = {}
    for number in sorted(range(len(passes)), key=lambda number: -len(passes[number])):
        chosen[number] = sizes.index(min(sizes))
        sizes[chosen[number]] += len(passes[number])
    declared = [f"void pass_{number}(Context& c);" for number in range(len(passes))]
    return "\n".join(declared + [f"{_only_in(chosen[i])}\n{text}\n#endif" for i, text in enumerate(passes)])


ELEMENT = "element:"


def look(layout: NativeLayout, asked: int) -> str:
    """The function that finds which of the ids in `asked` are present, from products of their low and high bits."""
    count = sum(name.startswith(ELEMENT) for name in layout.planes)
    ids = [code for code in range(1 << count) if asked >> code & 1]
    if not ids:
        return "static void look(Context&) {}"
    low = count // 2
    planes = [layout.planes[f"{ELEMENT}{bit}"] for bit in range(count)]

    def products(name: str, bits: range) -> list[str]:
        return [
            f"const V {name}{code} = "
            + (
                " & ".join(f"{'' if code >> i & 1 else '~'}b{bit}" for i, bit in enumerate(bits))
                or "~splat(0)"
            )
            + ";"
            for code in range(1 << len(bits))
        ]

    return "\n".join([
        "static void look(Context& c) {",
        *(f"const V* e{bit} = c.slot[{plane}]->data;" for bit, plane in enumerate(planes)),
        *(f"V id{code} = splat(0);" for code in ids),
        "for (size_t i = 0; i < c.g.cells(); i++) {",
        *(f"const V b{bit} = e{bit}[i];" for bit in range(count)),
        *products("low", range(low)),
        *products("high", range(low, count)),
        *(f"id{code} |= low{code & (1 << low) - 1} & high{code >> low};" for code in ids),
        "}",
        "c.present = " + " | ".join(f"(any(id{code}) ? 1ull << {code} : 0)" for code in ids) + ";",
        "}",
    ])  # fmt: skip
