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

from powderdsl.ir.ops import REAL, Program
from powderdsl.system.random import START_0, START_1
from powderdsl.targets.wasm.batches import GROUPS, WORLDS, Batches
from powderdsl.targets.wasm.binary import Callee, Function, Local, Value, const, load, op
from powderdsl.targets.wasm.grids import Grid
from powderdsl.targets.wasm.library import ZERO, Library, counted, either, integers, word
from powderdsl.targets.wasm.memory import HEADER, LANES, SOME
from powderdsl.targets.wasm.transfer import Transfer


def add_driver(
    library: Library,
    program: Program,
    passes: Sequence[Callee],
    asked: int,
    *,
    export: bool = True,
) -> dict[str, Callee]:
    """Add the functions that a host calls, and give them by name.

    Args:
        program: on bit planes.
        asked: the ids whose presence passes ask for.
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
        (Steps(library, program, passes, asked).run(export=export), "run"),
        (cells.load(), "load"),
        (cells.store(), "store"),
        (cells.load_real(), "load_real"),
        (cells.store_real(), "store_real"),
        (cells.fill(), "fill"),
        (cells.fill_real(), "fill_real"),
    ):
        added[name] = module.add(function, name, export=export)
    return added


class Steps(Batches):
    """Makes the function that runs steps."""

    def __init__(self, library: Library, program: Program, passes: Sequence[Callee], asked: int):
        super().__init__(library)
        self.program, self.passes, self.asked = program, passes, asked

    def run(self, *, export: bool) -> Function:
        """Runs a batch. `export`: hosts see what it calls, so that they can measure the time of passes."""
        f, module = self.library.function("i32 i32"), self.library.module
        batch, steps = f.param(0), f.param(1)
        enter = module.add(self._enter(), "enter", export=export)
        begin = module.add(self._begin(), "begin", export=export)
        leave = module.add(self._leave(), "leave", export=export)
        if export:
            count = self.library.function("i32", "i32")
            count.give(word(count.param(0), GROUPS))
            module.add(count, "groups", export=True)
            for number, one in enumerate(self.passes):
                module.export(one, str(number))
        with f.block() as nothing:
            f.jump(nothing, op("i32.eqz", steps))
            with f.each(ZERO, word(batch, GROUPS)) as group:
                f.do(enter(batch, group))
                with f.each(ZERO, steps) as step:
                    f.do(begin(batch, group, step))
                    for one in self.passes:
                        f.do(one())
                f.do(leave())
        with f.each(ZERO, word(batch, WORLDS), some=False) as world:
            at = f.let(self.clock(batch, 2, world))
            f.store("i64.store", at, load("i64.load", at) + counted(steps))
        return f

    def _enter(self) -> Function:
        """A group becomes the one that runs: batch, number of the group."""
        f, library, memory = self.library.function("i32 i32"), self.library, self.memory
        batch, number = f.param(0), f.param(1)
        f.set(library.group, self.groups(batch) + number * memory.group)
        f.set(library.present, load("i64.load", library.group.value, memory.present))
        self._parameters(f, batch, number)
        return f

    def _leave(self) -> Function:
        f, library = self.library.function(), self.library
        f.store("i64.store", library.group.value, library.present.value, self.memory.present)
        return f

    def world_of(self, f: Function, batch: Value, number: Value, lane: int) -> Local:
        """The world of a lane; unused lanes are the last world once more."""
        strips, last = self.library.strips.value, word(batch, WORLDS) - 1
        pair = f.let((number << 1) + lane)
        return f.let(either(strips, number, either(pair < last, pair, last)))

    def _parameters(self, f: Function, batch: Value, number: Value) -> None:
        """The parameters of a group's worlds, and what their keys have in common at all steps."""
        layout, memory, library = self.layout, self.memory, self.library
        for lane in range(LANES):
            with f.scope():
                worlds, world = f.let(word(batch, WORLDS)), self.world_of(f, batch, number, lane)
                bits, values = f.let(self.bits(batch) + world), f.let(self.values(batch) + (world << 2))
                for i in range(len(layout.param_planes)):
                    flags = op("i64.sub", const("i64", 0), counted(load("i32.load8_u", bits)))
                    f.store("i64.store", ZERO, flags, memory.at("params", i) + 8 * lane)
                    f.set(bits, bits + worlds)
                for i in range(len(layout.param_reals)):
                    f.store("i32.store", ZERO, word(values), memory.at("reals", i, 8) + 4 * lane)
                    f.set(values, values + (worlds << 2))
                seed, index = (f.let(load("i64.load", self.clock(batch, i, world))) for i in range(2))
                parts = [op("i32.wrap_i64", part) for part in (seed, seed >> 32, index)]
                for i, start in enumerate((START_0, START_1)):
                    key = const("i32", start)
                    for part in parts:
                        key = library.mix(key + part)
                    self._twice(f, key, memory.at("worlds", i) + 8 * lane)

    def _twice(self, f: Function, number: Value, at: int) -> None:
        """A number for both hashes of a lane's word."""
        f.store("i64.store", ZERO, counted(number) * (1 << 32 | 1), at)

    def _begin(self) -> Function:
        """What comes before the passes of a step: batch, number of the group, steps that are done."""
        f, library, memory = self.library.function("i32 i32 i32"), self.library, self.memory
        batch, number, done = (f.param(i) for i in range(3))
        for lane in range(LANES):
            with f.scope():
                start = load("i64.load", self.clock(batch, 2, self.world_of(f, batch, number, lane)))
                step = f.let(start + counted(done))
                self._twice(f, op("i32.wrap_i64", step), memory.at("clock") + 8 * lane)
                for (modulus, bit), i in self.layout.step_planes.items():
                    flag = (op("i64.rem_u", step, const("i64", modulus)) >> bit) & 1
                    flags = op("i64.sub", const("i64", 0), flag)
                    f.store("i64.store", ZERO, flags, memory.at("steps", i) + 8 * lane)
        clock = load("v128.load", ZERO, memory.at("clock"))
        worlds = [load("v128.load", ZERO, memory.at("worlds", i)) for i in range(2)]
        bases = [library.mixed(f, op("i32x4.add", world, clock)) for world in worlds]
        apart = f.let(load("v128.load", ZERO, memory.at("apart")))
        for name, ident, _ in self.program.streams:
            with f.scope():
                first, second = (library.mixed(f, op("i32x4.add", base, integers(ident))) for base in bases)
                keys = memory.at("keys", self.layout.streams[name], 32)
                f.store("v128.store", ZERO, op("i32x4.add", first, apart), keys)
                f.store("v128.store", ZERO, second, keys + 16)
        for i in range(len(self.layout.streams)):
            with f.scope():
                place = const("i32", memory.at("coins", i, 4))
                old = f.let(word(place))
                with f.when(old):
                    f.do(library.give(old))
                    f.store("i32.store", place, ZERO)
        self._reset(f)
        look = self._look()
        if look is not None:
            with f.when(op("i64.eq", library.present.value, const("i64", -1))):
                f.do(look())
        return f

    def _reset(self, f: Function) -> None:
        library, memory = self.library, self.memory
        for slot in self.program.slots:
            if not slot.resets:
                continue
            at, real = memory.slot(slot.name, slot.type), slot.type == REAL
            f.do((library.give_field if real else library.give)(word(library.group.value, at)))
            if real and slot.default:
                new = self._constant_field()(const("f32", float(slot.default)))
            else:
                same = library.calm if real else library.everything if slot.default else library.nothing
                new = library.keep(same.value)
            f.store("i32.store", library.group.value, new, at)

    def _constant_field(self) -> Callee:
        f, library, memory = self.library.function("f32", "i32"), self.library, self.memory
        field = f.let(library.take_field())
        f.store("i32.store", field, const("i32", 1), SOME)
        with f.each(ZERO, library.lines.value) as line:
            f.store("i32.store8", field + line, const("i32", 1), HEADER)
            start = f.let(library.line_start(field, line))
            with f.each(ZERO, const("i32", 4 * memory.width), 4) as at:
                f.store("f32.store", start + at, f.param(0))
            library.finish_line(f, start)
        f.give(field)
        return library.module.add(f, "constant_field")

    def _look(self) -> Callee | None:
        """Finds which of the ids in `asked` are present, from products of their low and high bits."""
        library, memory = self.library, self.memory
        names = [name for name in self.layout.planes if name.startswith("element:")]
        ids = [code for code in range(1 << len(names)) if self.asked >> code & 1]
        if not ids:
            return None
        f = library.function()
        planes = [
            f.let(word(library.group.value, memory.slot(f"element:{i}", None))) for i in range(len(names))
        ]
        found = {code: f.let(const("v128", 0)) for code in ids}
        low = len(names) // 2

        def products(bits: Sequence[Value]) -> list[Local]:
            made = [f.let(const("v128", -1))]
            for bit in bits:
                rest = [f.let(op("v128.andnot", one, bit)) for one in made]
                made = [*rest, *(f.let(one & bit) for one in made)]
            return made

        with f.each(ZERO, library.cells.value, 16) as at, f.scope():
            bits = [f.let(load("v128.load", plane + at, memory.base)) for plane in planes]
            low_products, high = products(bits[:low]), products(bits[low:])
            for code in ids:
                both = low_products[code & (1 << low) - 1] & high[code >> low]
                f.set(found[code], found[code] | both)
        total = const("i64", 0)
        for code in ids:
            total = total | (counted(op("v128.any_true", found[code])) << code)
        f.set(library.present, total)
        return library.module.add(f, "look")
