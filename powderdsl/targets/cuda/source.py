"""A program on bit planes → CUDA C++ for one size of grid: one kernel that runs many steps on the chip."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files

from powderdsl.ir.ops import SNAP, Program
from powderdsl.schedule.lifetimes import Pending, Pool, assign_buffers, insert_barriers
from powderdsl.schedule.stages import CUDA, plan
from powderdsl.system.cache import collection_paused
from powderdsl.targets.cuda.text import pass_text
from powderdsl.targets.layout import Layout, layout_of, literal

GENERATOR_VERSION = 2
"""Part of every cache key; increase it when the meaning of generated code changes."""

WARP = 32
MAX_THREADS = 1024
SMALL = 64
"""The number of words up to which several worlds share a block; one small world would leave most threads idle."""

HELD = 4
"""The number of rounds of a loop over words up to which a thread keeps its results in registers before storing."""

RESERVED = 1024
"""Bytes of shared memory that the system reserves in each block."""

REGISTERS, ENOUGH = 65_536, 128
"""Registers of a multiprocessor, and the number that a thread should have."""


@dataclass(frozen=True)
class KernelSource:
    """A translation unit and the numbers needed to launch it."""

    name: str
    """The name of the rules."""
    text: str
    layout: Layout
    group: int
    """Worlds per block."""
    threads: int
    shared: int
    """Bytes of shared memory per block."""
    scratch: int
    """Bytes of global memory per block, for buffers that did not fit into shared memory."""


@collection_paused()
def cuda_source(program: Program, height: int, width: int, shared_limit: int) -> KernelSource:
    """The kernel of a program on planes for one size of grid.

    `shared_limit`: bytes of shared memory that a block may have. If they do not suffice, fields go to global memory
    first, then planes.
    """
    layout = layout_of(program)
    row_words = -(-width // WARP)
    words = height * row_words
    group = max(1, SMALL // words)
    threads = min(MAX_THREADS, -(-group * words // WARP) * WARP * (2 if layout.reals else 1))
    own = {"flag": len(layout.planes), "real": len(layout.reals)}
    pool, pending = Pool(own, dict(own)), Pending()
    homes = layout.planes | layout.reals
    in_place = -(-group * words // threads) <= HELD
    passes = []
    for number, pass_ in enumerate(program.passes):
        schedule = assign_buffers(plan(program, pass_, CUDA), homes, pool, in_place=in_place)
        body = pass_text(insert_barriers(schedule, pending), layout)
        passes.append(f"DEVICE void pass_{number}(const Block& c) {{\n(void)c;\n{body}\n}}")
    numbers = len(layout.step_planes) + len(layout.param_planes) + len(layout.param_reals)
    uniform = 4 * group * (2 + 2 * len(layout.streams) + numbers)
    planes = 4 * group * words * pool.size["flag"]
    fields = 4 * group * (height * width + words) * pool.size["real"]
    planes_fit = uniform + planes <= shared_limit
    fields_fit = planes_fit and uniform + planes + fields <= shared_limit
    scratch = planes * (not planes_fit) + fields * (not fields_fit)
    shared = uniform + planes + fields - scratch
    # As many blocks as the chip's memory can contain, but not more than its registers allow.
    blocks = max(1, min(shared_limit // (shared + RESERVED), REGISTERS // (threads * ENOUGH)))
    head = {
        "HEIGHT": height, "WIDTH": width, "ROW_WORDS": row_words, "GROUP": group,
        "PLANES_ON_CHIP": int(planes_fit), "FIELDS_ON_CHIP": int(fields_fit),
        "PLANES": pool.size["flag"], "FIELDS": pool.size["real"], "SLOTS": len(layout.planes), "REALS": len(layout.reals),
        "STREAMS": len(layout.streams), "STEP_PLANES": len(layout.step_planes),
        "PARAM_PLANES": len(layout.param_planes), "PARAM_REALS": len(layout.param_reals), "SNAP": literal(SNAP),
    }  # fmt: skip
    folder = files("powderdsl.targets.cuda")
    text = "\n".join([
        f"// {len(program.passes)} passes for grids of {height} x {width}, generated; version {GENERATOR_VERSION}",
        *(f"#define {name} {value}" for name, value in head.items()),
        f"#if !defined(EMULATED)\n#define THREADS {threads}\n#define BLOCKS {blocks}\n#endif",
        (folder / "runtime.cuh").read_text(encoding="utf-8"),
        *_tables(program, layout, width, row_words),
        "\n\n".join(passes),
        _resets(program, layout),
        "DEVICE void run_passes(const Block& c) {",
        *(f"pass_{number}(c);" for number in range(len(passes))),
        "}",
        (folder / "driver.cuh").read_text(encoding="utf-8"),
    ])  # fmt: skip
    return KernelSource(program.name, text, layout, group, threads, shared, scratch)


def _tables(program: Program, layout: Layout, width: int, row_words: int) -> list[str]:
    """Constants by stream, step and column."""
    idents = ", ".join(f"{ident}u" for _, ident, _ in program.streams) or "0"
    moduli = ", ".join(f"{modulus}ull" for modulus, _ in layout.step_planes) or "1"
    bits = ", ".join(str(bit) for _, bit in layout.step_planes) or "0"
    lines = [
        f"TABLE u32 STREAM_IDENT[] = {{{idents}}};",
        f"TABLE u64 STEP_MODULUS[] = {{{moduli}}};",
        f"TABLE int STEP_BIT[] = {{{bits}}};",
    ]
    for (kind, modulus, bit), number in layout.fixed.items():
        if kind == 1:
            words = [0] * row_words
            for x in range(width):
                words[x // WARP] |= (x % modulus >> bit & 1) << x % WARP
            lines.append(f"TABLE u32 COLUMNS_{number}[] = {{{', '.join(f'{word:#x}u' for word in words)}}};")
    return lines


def _resets(program: Program, layout: Layout) -> str:
    """Statements that reset slots at the start of a step."""
    planes, reals = [], []
    for slot in program.slots:
        if slot.resets and slot.name in layout.planes:
            planes.append(f"P({layout.planes[slot.name]})[i] = {'valid' if slot.default else '0'};")
        elif slot.resets:
            number, value = layout.reals[slot.name], float(slot.default)
            need, live = (f"N({number})[i] != 0", "0") if value == 0 else ("true", "valid")
            cells = f"LANES {{ CELL; if (inside) F({number})[cell] = {literal(value)}; }} ONCE N({number})[i] = {live};"
            reals.append(f"FOR_BUSY_WORDS(i, [&](int i) {{ return {need}; }}) {{ PLACE(i); {cells} }}")
    loop = f"FOR_WORDS(k, i) {{ PLACE(i); {' '.join(planes)} }}" if planes else ""
    return "\n".join(["DEVICE void reset_slots(const Block& c) {", "(void)c;", loop, *reals, "}"])
