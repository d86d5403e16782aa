"""What hosts call: batches of worlds, cells in and out, steps. Each function is exported under its name (`Driver`).

Parameters and results are i32 unless said otherwise. `rows` are those of a world; the columns are those of the module. Boxes
end before `bottom` and `right`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from powderdsl.ir.ops import REAL, Program
from powderdsl.system.random import START_0, START_1
from powderdsl.targets.codec import Piece
from powderdsl.targets.layout import Layout
from powderdsl.targets.wasm.binary import (
    F32,
    I32,
    Body,
    Callee,
    Function,
    Local,
    Place,
    Value,
    const,
    load,
    op,
    vector,
)
from powderdsl.targets.wasm.library import (
    GOLDEN,
    GROUPS,
    HALOED,
    HEADER,
    LANES,
    LIVE,
    NEXT_BATCH,
    SIZE,
    SOME,
    STILL,
    SWAPPED,
    WORD,
    WORLDS,
    Library,
    counted,
    either,
    integers,
    splat,
    word,
)

LARGE_PLANE = 32 << 10
"""Bytes of a plane of two worlds from which it is too large to be kept near."""

WEIGHTS = bytes(1 << i for i in range(8)) * 2


def numbers_of(piece: Piece, layout: Layout, size: int) -> tuple[int, int, int, int]:
    """What `load` and `store` take for a piece of the state whose cells have some bytes: slot, planes, signed, size."""
    if piece.is_real:
        return len(layout.planes) + layout.reals[piece.slot], 0, 0, size
    return layout.planes[piece.planes[0]], len(piece.planes), int(piece.signed), size


class Batches:
    """Code that finds the parts of batches."""

    def __init__(self, library: Library):
        self.library, self.memory, self.layout = library, library.memory, library.memory.layout
        self.sizes = (24, len(self.layout.param_planes), 4 * len(self.layout.param_reals))
        """Bytes of the parts of a batch, for each world."""
        self.calls: dict[str, Callee] = {}

    def define(self, *bodies: Body, export: bool = False) -> None:
        """Add functions, to be called by name."""
        for body in bodies:
            self.calls[body.__name__.strip("_")] = self.library.module.define(body, export=export)

    def part(self, batch: Value, number: int) -> Value:
        """Where clocks (0), bits (1) or values (2) of parameters, or groups (3) begin, at a multiple of 16 bytes."""
        at = batch + HEADER
        for size in self.sizes[:number]:
            at = (at + batch[WORLDS] * size + 15) & ~15
        return at

    def clock_of(self, batch: Value, what: int, world: Value) -> Place:
        """Seed, index or step of a world."""
        return load("i64.load", self.part(batch, 0) + ((batch[WORLDS] * what + world) << 3))

    @contextmanager
    def each_group(self, f: Function, batch: Value) -> Iterator[Local]:
        first = f.let(self.part(batch, 3))
        stop = f.let(first + batch[GROUPS] * self.memory.group)
        with f.each(first, stop, self.memory.group) as group:
            yield group

    @contextmanager
    def each_lane(
        self, f: Function, batch: Value, address: Value, apart: Value, size: Value | int
    ) -> Iterator[tuple[Local, Local, Local]]:
        """Group, lane, and where its cells of some bytes lie in an array, of all lanes that are used."""
        strips, number = self.library.strips, f.let(0)
        with self.each_group(f, batch) as group:
            with f.each(0, LANES) as lane:
                world = f.let(either(strips, number, (number << 1) + lane))
                top = either(strips, lane * self.library.rows, 0)  # the world's row at which the lane begins
                with f.when(world < batch[WORLDS]):
                    yield group, lane, f.let(address + world * apart + top * self.memory.width * size)
            f.set(number, number + 1)

    @contextmanager
    def each_run(self, f: Function) -> Iterator[tuple[Local, Local]]:
        """The words of all rows of a lane: bytes from the first word, and how many columns they have."""
        memory = self.memory
        with f.each(0, self.library.cells, 16) as at:
            last = ((at % memory.row) >> 4).equals(memory.words - 1)
            yield at, f.let(either(last, const("i32", memory.width - WORD * (memory.words - 1)), WORD))

    @contextmanager
    def each_sixteen(self, f: Function, size: Value, x: Local, count: Value) -> Iterator[None]:
        """Sixteen cells of a byte at a time; `x` is the first one, and then the first that is left."""
        with f.block() as done, f.loop() as again:
            f.jump(done, op("i32.ne", size, 1) | (count < x + 16))
            yield
            f.set(x, x + 16)
            f.jump(again)

    @contextmanager
    def each_line(self, f: Function, lane: Value) -> Iterator[Local]:
        """The lines of a lane."""
        first = f.let(lane * self.library.rows)
        with f.each(first, first + self.library.rows) as line:
            yield line

    def close_line(self, f: Function, field: Value, line: Value, start: Value, alive: Value) -> None:
        """What comes after a line's values; `alive` is not 0 if one of them is not."""
        live = f.let(op("i32.ne", alive, 0))
        f.set((field + line)[LIVE], live)
        f.set(field[SOME], field[SOME] | live)
        self.library.finish_line(f, start)


class Driver(Batches):
    """Makes the functions that a host calls.

    Args:
        program: on bit planes.
        asked: the ids whose presence passes ask for.
    """

    def __init__(self, library: Library, program: Program, passes: Sequence[Callee], asked: int):
        super().__init__(library)
        self.program, self.passes, self.asked = program, passes, asked

    def add(self, *, export: bool) -> dict[str, Callee]:
        """Add the functions, and give them by name. `export`: hosts see them, and the passes by number."""
        self.define(self._setup, self._load_real, self._store_real)
        self.define(
            self.allocate, self.release, self.copy, self.scratch, self.load, self.store, export=export
        )
        self.define(self.enter, self.begin, self.leave, self.run, export=export)
        for number, pass_ in enumerate(self.passes if export else ()):
            self.library.module.export(pass_, str(number))
        return self.calls

    # Batches

    def allocate(self, f: Function, worlds: I32, rows: I32) -> Value:
        """A new batch. All worlds of an instance have the same number of rows."""
        library, memory = self.library, self.memory
        per_world = sum(self.sizes)
        library.trap_from(f, worlds, per_world + memory.group)
        library.trap_from(f, rows, 8 * memory.stride + memory.row)
        with f.when(library.world_rows.equals(0)):
            even = (rows & 1).equals(0)
            reachable = (rows >> 1) >= max(1, memory.extent.around)
            few = worlds.equals(1) | ((rows * memory.row) >= LARGE_PLANE)
            f.do(self.calls["setup"](rows, even & reachable & few))
            f.otherwise()
            with f.when(op("i32.ne", library.world_rows, rows)):
                f.trap()
        count = f.let((worlds + 1) >> library.strips.equals(0))
        f.set(count, either(library.strips, worlds, count))
        size = f.let((worlds * per_world + count * memory.group + (HEADER + 4 * 15)) & ~15)
        before, batch = f.let(0), f.let(library.batches)
        with f.block() as chosen:
            with f.block() as missing, f.loop() as again:
                f.jump(missing, batch.equals(0))
                with f.when(batch[SIZE].equals(size)):
                    with f.when(before):
                        f.set(before[NEXT_BATCH], batch[NEXT_BATCH])
                        f.otherwise()
                        f.set(library.batches, batch[NEXT_BATCH])
                    f.jump(chosen)
                f.set(before, batch)
                f.set(batch, batch[NEXT_BATCH])
                f.jump(again)
            f.set(batch, library.bump(size))
        for member, value in ((WORLDS, worlds), (GROUPS, count), (SIZE, size)):
            f.set(batch[member], value)
        with self.each_group(f, batch) as group:
            for member, real in memory.slots:
                f.set(group[member], library.keep(library.calm if real else library.nothing))
            f.set(group[memory.present], -1)
        return batch

    def release(self, f: Function, batch: I32) -> None:
        """Use the memory of a batch for others."""
        with self.each_group(f, batch) as group:
            for member, _ in self.memory.slots:
                f.do(self.library.give(group[member]))
        f.set(batch[NEXT_BATCH], self.library.batches)
        f.set(self.library.batches, batch)

    def copy(self, f: Function, old: I32) -> Value:
        """A new batch, which shares what is not changed later."""
        library, present = self.library, self.memory.present
        new = f.let(self.calls["allocate"](old[WORLDS], library.world_rows))
        begin = const("i32", HEADER)
        f.do(op("memory.copy", new + begin, old + begin, self.part(old, 3) - old - HEADER))
        apart = f.let(new - old)
        with self.each_group(f, old) as group:
            for member, _ in self.memory.slots:
                f.do(library.give((group + apart)[member]))
                f.set((group + apart)[member], library.keep(group[member]))
            f.set((group + apart)[present], group[present])
        return new

    def scratch(self, f: Function, size: I32) -> Value:
        """Memory for the host, until it asks for more."""
        library = self.library
        library.trap_from(f, size, 1)
        with f.when(library.scratch_end < library.scratch + size):
            more = f.let((size + 79) & ~15)
            f.set(library.scratch, library.bump(more))
            f.set(library.scratch_end, library.scratch + more - 64)
        return library.scratch

    # Cells

    def load(
        self, f: Function, batch: I32, slot: I32, planes: I32, signed: I32, size: I32, start: I32, apart: I32
    ) -> None:
        """Read cells [worlds, rows, columns] into planes from a slot on: integers of 1, 2 or 4 bytes, or f32 into a field if
        there are no planes. `apart`: bytes from one world to the next.
        """
        library, memory = self.library, self.memory
        with f.when(planes.equals(0)):
            f.do(self.calls["load_real"](batch, slot, start, apart))
            f.leave()
        with self.each_group(f, batch) as group:
            f.set(group[memory.present], -1)
            with f.each(0, planes) as bit:
                at = f.let(group + ((slot + bit) << 2))
                f.do(library.give(word(at)))
                plane = f.let(library.take())
                f.set(word(at), plane)
                f.do(op("memory.fill", plane + memory.base, 0, library.cells))
        with (
            self.each_lane(f, batch, start, apart, size) as (group, lane, source),
            self.each_run(f) as (at, count),
        ):
            with f.each(0, planes) as bit:
                plane = f.let(word(group + ((slot + bit) << 2)))
                flags, x = f.let(const("i64", 0)), f.let(0)
                with self.each_sixteen(f, size, x, count):
                    top_bits = op("i8x16.shl", load("v128.load", source + x), 7 - bit)
                    f.set(flags, flags | (counted(op("i8x16.bitmask", top_bits)) << counted(x)))
                with f.each(x, count, some=False) as x:
                    flag = (word(source + x * size) >> bit) & 1
                    f.set(flags, flags | (counted(flag) << counted(x)))
                f.set((plane + at + (lane << 3))[memory.half], flags)
                f.set(plane[SOME], plane[SOME] | op("i64.ne", flags, 0))
            f.set(source, source + count * size)

    def store(
        self, f: Function, batch: I32, slot: I32, planes: I32, signed: I32, size: I32, start: I32, apart: I32
    ) -> None:
        """Write cells, from first to last, each as 4 bytes of which `size` stay; `signed`: the last plane is the sign."""
        memory = self.memory
        with f.when(planes.equals(0)):
            f.do(self.calls["store_real"](batch, slot, start, apart))
            f.leave()
        with (
            self.each_lane(f, batch, start, apart, size) as (group, lane, target),
            self.each_run(f) as (at, count),
        ):
            place, x = f.let(at + (lane << 3)), f.let(0)

            def bits_from(bit: Value) -> Value:
                plane = word(group + ((slot + bit) << 2))
                return op("i32.wrap_i64", (plane + place)[memory.half] >> counted(x))

            def weight(bit: Value) -> Value:
                one = 1 << bit
                return either(signed & bit.equals(planes - 1), 0 - one, one)

            with self.each_sixteen(f, size, x, count):
                cells = f.let(const("v128", 0))
                with f.each(0, planes) as bit:
                    bits = op("i8x16.swizzle", splat(bits_from(bit)), vector(bytes(8) + b"\1" * 8))
                    chosen = op("i8x16.eq", bits & vector(WEIGHTS), vector(WEIGHTS))
                    f.set(cells, op("i8x16.add", cells, chosen & op("i8x16.splat", weight(bit))))
                f.set(load("v128.load", target), cells)
                f.set(target, target + 16)
            with f.each(x, count, some=False) as x:
                value = f.let(0)
                with f.each(0, planes) as bit:
                    f.set(value, value + (bits_from(bit) & 1) * weight(bit))
                f.set(word(target), value)
                f.set(target, target + size)

    def _load_real(self, f: Function, batch: I32, slot: I32, address: I32, apart: I32) -> None:
        library, memory = self.library, self.memory
        with self.each_group(f, batch) as group:
            at = f.let(group + (slot << 2))
            f.do(library.give(word(at)))
            field = f.let(library.take_field())
            f.set(word(at), field)
            f.do(op("memory.fill", field + HEADER, 0, library.live_size))
        with self.each_lane(f, batch, address, apart, 4) as (group, lane, source):
            field = f.let(word(group + (slot << 2)))
            with self.each_line(f, lane) as line:
                start, alive = f.let(library.line_start(field, line)), f.let(0)
                with f.each(0, 4 * memory.width, 4) as at:
                    value = f.let(word(source + at))
                    f.set(word(start + at), value)
                    f.set(alive, alive | (value << 1))
                self.close_line(f, field, line, start, alive)
                f.set(source, source + 4 * memory.width)

    def _store_real(self, f: Function, batch: I32, slot: I32, address: I32, apart: I32) -> None:
        memory = self.memory
        with self.each_lane(f, batch, address, apart, 4) as (group, lane, target):
            field = f.let(word(group + (slot << 2)))
            with self.each_line(f, lane) as line:
                start = f.let(self.library.line(field, line))
                with f.each(0, 4 * memory.width, 4) as at:
                    f.set(word(target + at), word(start + at))
                f.set(target, target + 4 * memory.width)

    # Steps

    def run(self, f: Function, batch: I32, steps: I32) -> None:
        """Run steps, and add them to those of the inputs."""
        with f.block() as nothing:
            f.jump(nothing, steps.equals(0))
            with f.each(0, batch[GROUPS]) as group:
                f.do(self.calls["enter"](batch, group))
                with f.each(0, steps) as step:
                    f.do(self.calls["begin"](batch, group, step))
                    for pass_ in self.passes:
                        f.do(pass_())
                f.do(self.calls["leave"]())
        with f.each(0, batch[WORLDS], some=False) as world:
            clock = self.clock_of(batch, 2, world)
            f.set(clock, clock + counted(steps))

    def world_of(self, f: Function, batch: Value, number: Value, lane: int) -> Local:
        """The world of a lane; unused lanes are the last world once more."""
        last = batch[WORLDS] - 1
        pair = f.let((number << 1) + lane)
        return f.let(either(self.library.strips, number, either(pair < last, pair, last)))

    def enter(self, f: Function, batch: I32, number: I32) -> None:
        """A group becomes the one that runs: parameters, and what the keys of its worlds have in common at all steps."""
        library, memory, layout = self.library, self.memory, self.layout
        f.set(library.group, self.part(batch, 3) + number * memory.group)
        f.set(library.present, library.group[memory.present])
        for lane in range(LANES):
            with f.scope():
                worlds, world = f.let(batch[WORLDS]), self.world_of(f, batch, number, lane)
                bits, values = f.let(self.part(batch, 1) + world), f.let(self.part(batch, 2) + (world << 2))
                for i in range(len(layout.param_planes)):
                    flags = 0 - counted(load("i32.load8_u", bits))
                    f.set(load("i64.load", 0, memory.at("params", i) + 8 * lane), flags)
                    f.set(bits, bits + worlds)
                for i in range(len(layout.param_reals)):
                    f.set(word(0, memory.at("reals", i) + 4 * lane), word(values))
                    f.set(values, values + (worlds << 2))
                seed, index = (f.let(self.clock_of(batch, i, world)) for i in range(2))
                parts = [op("i32.wrap_i64", part) for part in (seed, seed >> 32, index)]
                for i, start in enumerate((START_0, START_1)):
                    key: Value = const("i32", start)
                    for part in parts:
                        key = library.mix(key + part)
                    self._twice(f, key, memory.at("worlds", i) + 8 * lane)

    def _twice(self, f: Function, number: Value, at: int) -> None:
        """A number for both hashes of a lane's word."""
        f.set(load("i64.load", 0, at), counted(number) * (1 << 32 | 1))

    def begin(self, f: Function, batch: I32, number: I32, done: I32) -> None:
        """What comes before the passes of a step: batch, number of the group, steps that are done."""
        library, memory = self.library, self.memory
        for lane in range(LANES):
            with f.scope():
                start = self.clock_of(batch, 2, self.world_of(f, batch, number, lane))
                step = f.let(start + counted(done))
                self._twice(f, op("i32.wrap_i64", step), memory.at("clock") + 8 * lane)
                for (modulus, bit), i in self.layout.step_planes.items():
                    flag = (op("i64.rem_u", step, modulus) >> bit) & 1
                    f.set(load("i64.load", 0, memory.at("steps", i) + 8 * lane), 0 - flag)
        clock = load("v128.load", 0, memory.at("clock"))
        worlds = [load("v128.load", 0, memory.at("worlds", i)) for i in range(2)]
        bases = [library.mixed(f, op("i32x4.add", world, clock)) for world in worlds]
        apart = f.let(load("v128.load", 0, memory.at("apart")))
        for name, ident, _ in self.program.streams:
            with f.scope():
                first, second = (library.mixed(f, op("i32x4.add", base, integers(ident))) for base in bases)
                keys = memory.at("keys", self.layout.streams[name])
                f.set(load("v128.load", 0, keys), op("i32x4.add", first, apart))
                f.set(load("v128.load", 0, keys + 16), second)
        for i in range(len(self.layout.streams)):
            with f.scope():
                coin = word(memory.at("coins", i))
                old = f.let(coin)
                with f.when(old):
                    f.do(library.give(old))
                    f.set(coin, 0)
        for slot in self.program.slots:
            if slot.resets:
                held, real = library.group[memory.slot(slot.name, slot.type)], slot.type == REAL
                f.do(library.give(held))
                if real and slot.default:
                    make = library.module.define(self._constant_field)
                    f.set(held, make(const("f32", slot.default)))
                else:
                    same = library.calm if real else library.everything if slot.default else library.nothing
                    f.set(held, library.keep(same))
        names = [name for name in self.layout.planes if name.startswith("element:")]
        if ids := [code for code in range(1 << len(names)) if self.asked >> code & 1]:
            look = library.module.define(partial(self._look, names, ids), "look")
            with f.when(library.present.equals(-1)):
                f.do(look())

    def leave(self, f: Function) -> None:
        """The group keeps the ids that are present."""
        f.set(self.library.group[self.memory.present], self.library.present)

    def _constant_field(self, f: Function, value: F32) -> Value:
        """A new field of equal values."""
        library, width = self.library, self.memory.width
        field = f.let(library.take_field())
        f.set(field[SOME], 1)
        with f.each(0, library.lines) as line:
            f.set((field + line)[LIVE], 1)
            start = f.let(library.line_start(field, line))
            with f.each(0, 4 * width, 4) as at:
                f.set(load("f32.load", start + at), value)
            library.finish_line(f, start)
        return field

    def _look(self, names: Sequence[str], ids: Sequence[int], f: Function) -> None:
        """Finds which of some ids are present, from products of their low and high bits, which have planes."""
        library, memory = self.library, self.memory
        planes = [f.let(library.group[memory.slot(name, None)]) for name in names]
        found = {code: f.let(const("v128", 0)) for code in ids}
        low = len(names) // 2

        def products(bits: Sequence[Value]) -> list[Local]:
            made = [f.let(const("v128", -1))]
            for bit in bits:
                rest = [f.let(op("v128.andnot", one, bit)) for one in made]
                made = [*rest, *(f.let(one & bit) for one in made)]
            return made

        with f.each(0, library.cells, 16) as at, f.scope():
            bits = [f.let((plane + at)[memory.flags]) for plane in planes]
            low_products, high = products(bits[:low]), products(bits[low:])
            for code in ids:
                both = low_products[code & (1 << low) - 1] & high[code >> low]
                f.set(found[code], found[code] | both)
        total: Value = const("i64", 0)
        for code in ids:
            total = total | (counted(op("v128.any_true", found[code])) << code)
        f.set(library.present, total)

    # What an instance makes once, when it learns the number of rows: sizes, constant planes, tables

    def _setup(self, f: Function, height: I32, strips: I32) -> None:
        """Rows of a world, and whether the lanes are strips."""
        library, memory = self.library, self.memory
        f.set(library.world_rows, height)
        f.set(library.strips, strips)
        f.set(library.rows, height >> strips)
        f.set(library.lines, library.rows << 1)
        rows, lines = library.rows, library.lines
        f.set(library.cells, rows * memory.row)
        f.set(library.plane_size, rows * memory.row + (memory.base + memory.extent.around * memory.row))
        f.set(library.live_size, (lines + 16) & ~15)
        f.set(library.field_size, library.live_size + lines * (4 * memory.stride) + (HEADER + 64 & ~15))
        turn = load("v128.load", memory.at("turn"))
        with f.when(strips):
            f.set(turn, vector(SWAPPED))
            f.otherwise()
            f.set(turn, vector(STILL))
        # The four hashes of a vector differ by this: a word of a lane has two, and strips continue each other.
        strip = f.let(either(strips, rows, 0) * (-(-memory.width // 32) * 32 * GOLDEN))
        for number in range(4):
            hashes = strip * (number // 2) + number % 2 * 32 * GOLDEN
            f.set(word(0, memory.at("apart") + 4 * number), hashes)
        for plane in (library.nothing, library.everything, library.inside):
            f.set(plane, library.take())
        f.set(library.nothing[HALOED], 1)
        for plane in (library.everything, library.inside):
            with f.each(0, rows * memory.row, 8 * LANES) as at, f.scope():
                last = (at % memory.row).equals(memory.row - 8 * LANES)
                rest = const("v128", (1 << memory.width - WORD * (memory.words - 1)) - 1)
                full = const("v128", (1 << min(WORD, memory.width)) - 1)
                f.set((plane + at)[memory.flags], either(last, rest, full))
        self._beyond(f, rows)
        f.set(library.everything[SOME], 1)
        f.set(library.calm, library.take_field())
        f.set(library.zeros, library.bump(4 * memory.stride + 64 & ~15) + 4 * memory.halo)
        f.set(word(memory.at("rows")), library.bump((rows << 2) + 31 & ~15))
        columns = const("i32", memory.at("columns") + 4 * memory.halo)
        with f.each(0, 4 * memory.width, 4) as at:
            f.set(word(columns + at), -1)
        for dy in range(-memory.extent.lines, memory.extent.lines + 1):
            for wraps in (True, False):
                self._line_table(f, dy, wraps)
        for (kind, a, b), number in self.layout.fixed.items():
            self._fixed(f, kind, a, b, memory.at("fixed", number))

    def _beyond(self, f: Function, rows: Value) -> None:
        """In the halo, the rows of the other strip: the lower one lies below the upper one, and around it nothing."""
        memory, plane = self.memory, self.library.inside
        if not (size := memory.extent.around * memory.row):
            return
        with f.when(self.library.strips), f.each(0, size, 8 * LANES) as at, f.scope():
            below = rows * memory.row + at
            same = (plane + at % memory.row)[memory.half]
            f.set(load("i64.load", plane + at, HEADER + 8), same)
            f.set((plane + below)[memory.half], same)

    def _line_table(self, f: Function, dy: int, wraps: bool) -> None:
        library, lines = self.library, self.library.lines
        with f.scope():
            table = f.let(library.bump((lines << 2) + 15 & ~15))
            f.set(word(self.memory.table(dy, wraps=wraps)), table)
            height = f.let(library.world_rows)
            with f.each(0, lines) as line:
                y = f.let(line % height)
                other = f.let(y + dy)
                seen = line - y + other
                if wraps:
                    f.set(other, op("i32.rem_s", other, height))
                    f.set(other, either(op("i32.lt_s", other, 0), other + height, other))
                f.set(word(table + (line << 2)), seen if wraps else either(other < height, seen, lines))

    def _fixed(self, f: Function, kind: int, a: int, b: int, place: int) -> None:
        """A plane of a bit of coordinates (0: rows, 1: columns; modulus, bit), or of `inside` (rows, columns)."""
        library, memory = self.library, self.memory
        with f.scope():
            plane = f.let(library.take())
            f.set(word(place), plane)
            f.set(plane[SOME], 1)
            strips_rows = f.let(either(library.strips, library.rows, 0))
            with f.each(0, LANES) as lane, f.each(0, library.rows) as y:
                row = f.let(y + strips_rows * lane)
                with f.each(0, memory.width) as x, f.scope():
                    if kind == 2:
                        flag = ((row + a) < library.world_rows) & ((x + b) < memory.width)
                    else:
                        flag = (((x if kind else row) % a) >> b) & 1
                    half = f.let(plane + y * memory.row + ((x >> 6) << 4) + (lane << 3))[memory.half]
                    f.set(half, half | (counted(flag) << counted(x & 63)))
