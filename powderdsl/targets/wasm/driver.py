"""What hosts call: batches of worlds, cells in and out, steps. Each function is exported under its name (`Driver`).

Parameters and results are i32 unless said otherwise. `rows` are those of a world; the columns are those of the module. Boxes
end before `bottom` and `right`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from powderdsl.ir.ops import REAL, Program
from powderdsl.system.random import START_0, START_1
from powderdsl.targets.wasm.binary import (
    F32,
    I32,
    Body,
    Callee,
    Function,
    Local,
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


class Batches:
    """Code that finds the parts of batches."""

    def __init__(self, library: Library):
        self.library, self.memory, self.layout = library, library.memory, library.memory.layout

    def clock(self, batch: Value, what: int, world: Value) -> Value:
        """Where seed, index or step of a world lies."""
        return batch + ((batch[WORLDS] * what + world) << 3) + HEADER

    def bits(self, batch: Value) -> Value:
        """Where the bits of parameters lie."""
        return batch + batch[WORLDS] * 24 + HEADER

    def values(self, batch: Value) -> Value:
        """Where the values of parameters lie."""
        return (self.bits(batch) + batch[WORLDS] * len(self.layout.param_planes) + 15) & ~15

    def first_group(self, batch: Value) -> Value:
        return (self.values(batch) + batch[WORLDS] * (4 * len(self.layout.param_reals)) + 15) & ~15

    @contextmanager
    def each_group(self, f: Function, batch: Value) -> Iterator[Local]:
        first = f.let(self.first_group(batch))
        stop = f.let(first + batch[GROUPS] * self.memory.group)
        with f.each(first, stop, self.memory.group) as group:
            yield group

    @contextmanager
    def each_lane(self, f: Function, batch: Value) -> Iterator[tuple[Local, Local, Local, Local]]:
        """Group, lane, world, and the world's row at which the lane begins, of all lanes that are used."""
        strips, number = self.library.strips, f.let(0)
        with self.each_group(f, batch) as group:
            with f.each(0, LANES) as lane:
                world = f.let(either(strips, number, (number << 1) + lane))
                top = f.let(either(strips, lane * self.library.rows, 0))
                with f.when(world < batch[WORLDS]):
                    yield group, lane, world, top
            f.set(number, number + 1)

    @contextmanager
    def each_box_row(
        self, f: Function, batch: Value, world: Value, top: Value, bottom: Value
    ) -> Iterator[tuple[Local, Local, Local]]:
        """Group, lane and row of the lane, for the rows of a box in a world."""
        rows, strips = self.library.rows, self.library.strips
        with f.each(top, bottom, some=False) as y:
            lane = f.let(either(strips, y // rows, world & 1))
            number = either(strips, world, world >> 1)
            group = f.let(self.first_group(batch) + number * self.memory.group)
            yield group, lane, f.let(either(strips, y % rows, y))

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
        self.calls: dict[str, Callee] = {}

    def add(self, *, export: bool) -> dict[str, Callee]:
        """Add the functions, and give them by name. `export`: hosts see them, and the passes by number."""
        module = self.library.module
        self.calls["setup"] = module.define(self._setup)
        self._define([self.allocate, self.enter, self.begin, self.leave], export=export)
        if export:
            module.define(self.groups, export=True)
            for number, pass_ in enumerate(self.passes):
                module.export(pass_, str(number))
        bodies: list[Body] = [
            self.copy,
            self.release,
            self.scratch,
            self.inputs,
            self.run,
            self.load,
            self.store,
        ]
        self._define([*bodies, self.load_real, self.store_real, self.fill, self.fill_real], export=export)
        return self.calls

    def _define(self, bodies: Iterable[Body], *, export: bool) -> None:
        for body in bodies:
            self.calls[body.__name__] = self.library.module.define(body, export=export)

    # Batches

    def allocate(self, f: Function, worlds: I32, rows: I32) -> Value:
        """A new batch. All worlds of an instance have the same number of rows."""
        library, memory = self.library, self.memory
        per_world = 24 + len(self.layout.param_planes) + 4 * len(self.layout.param_reals)
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
        size = f.let((worlds * per_world + count * memory.group + (HEADER + 32 + 15)) & ~15)
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
            for member, real in self.memory.slots:
                f.do(self.library.giver(real)(group[member]))
        f.set(batch[NEXT_BATCH], self.library.batches)
        f.set(self.library.batches, batch)

    def copy(self, f: Function, old: I32) -> Value:
        """A new batch, which shares what is not changed later."""
        library, present = self.library, self.memory.present
        new = f.let(self.calls["allocate"](old[WORLDS], library.world_rows))
        begin = const("i32", HEADER)
        f.copy(new + begin, old + begin, self.first_group(old) - old - HEADER)
        apart = f.let(new - old)
        with self.each_group(f, old) as group:
            for member, real in self.memory.slots:
                f.do(library.giver(real)((group + apart)[member]))
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

    def inputs(self, f: Function, batch: I32) -> Value:
        """Where i64 [3, worlds] lie: seed, index, step; then bits of parameters, bytes [bits, worlds]; then, from a
        multiple of 16 bytes on, their values, f32 [values, worlds].
        """
        return batch + HEADER

    # Cells

    def cell(self, address: Value, size: Value) -> Value:
        wide = either(size.equals(2), load("i32.load16_u", address), word(address))
        return either(size.equals(1), load("i32.load8_u", address), wide)

    def load(self, f: Function, batch: I32, slot: I32, planes: I32, size: I32, address: I32) -> None:
        """Read cells [worlds, rows, columns], integers of 1, 2 or 4 bytes, into planes from a slot on."""
        library, memory = self.library, self.memory
        with self.each_group(f, batch) as group:
            f.set(group[memory.present], -1)
            with f.each(0, planes) as bit:
                at = f.let(group + ((slot + bit) << 2))
                f.do(library.give(word(at)))
                plane = f.let(library.take())
                f.set(word(at), plane)
                f.fill(plane + memory.base, 0, library.cells)
        with self.each_lane(f, batch) as (group, lane, world, top):
            start = world * library.world_rows + top
            source = f.let(address + start * size * memory.width)
            with self.each_run(f) as (at, count):
                with f.each(0, planes) as bit:
                    plane = f.let(word(group + ((slot + bit) << 2)))
                    flags, x = f.let(const("i64", 0)), f.let(0)
                    with self.each_sixteen(f, size, x, count):
                        top_bits = op("i8x16.shl", load("v128.load", source + x), 7 - bit)
                        f.set(flags, flags | (counted(op("i8x16.bitmask", top_bits)) << counted(x)))
                    with f.each(x, count, some=False) as x:
                        flag = (self.cell(source + x * size, size) >> bit) & 1
                        f.set(flags, flags | (counted(flag) << counted(x)))
                    f.set((plane + at + (lane << 3))[memory.half], flags)
                    f.set(plane[SOME], plane[SOME] | op("i64.ne", flags, 0))
                f.set(source, source + count * size)

    def store(
        self, f: Function, batch: I32, slot: I32, planes: I32, negative: I32, size: I32, address: I32
    ) -> None:
        """Write cells; `negative`: the last plane is their sign."""
        library, memory = self.library, self.memory
        with self.each_lane(f, batch) as (group, lane, world, top):
            start = world * library.world_rows + top
            target = f.let(address + start * size * memory.width)
            with self.each_run(f) as (at, count):
                place, x = f.let(at + (lane << 3)), f.let(0)

                def bits_from(bit: Value) -> Value:
                    plane = word(group + ((slot + bit) << 2))
                    return op("i32.wrap_i64", (plane + place)[memory.half] >> counted(x))

                def weight(bit: Value) -> Value:
                    one = 1 << bit
                    return either(negative & bit.equals(planes - 1), 0 - one, one)

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
                    with f.when(size.equals(1)):
                        f.set(load("i32.load8_u", target), value)
                        f.otherwise()
                        with f.when(size.equals(2)):
                            f.set(load("i32.load16_u", target), value)
                            f.otherwise()
                            f.set(word(target), value)
                    f.set(target, target + size)

    def load_real(self, f: Function, batch: I32, slot: I32, address: I32, apart: I32) -> None:
        """Read cells, f32, into a field; `apart`: bytes from one world to the next."""
        library, memory = self.library, self.memory
        f.set(slot, slot + len(self.layout.planes))
        with self.each_group(f, batch) as group:
            at = f.let(group + (slot << 2))
            f.do(library.give_field(word(at)))
            field = f.let(library.take_field())
            f.set(word(at), field)
            f.fill(field + HEADER, 0, library.live_size)
        with self.each_lane(f, batch) as (group, lane, world, top):
            source = f.let(address + world * apart + top * (4 * memory.width))
            field = f.let(word(group + (slot << 2)))
            with self.each_line(f, lane) as line:
                start, alive = f.let(library.line_start(field, line)), f.let(0)
                with f.each(0, 4 * memory.width, 4) as at:
                    value = f.let(word(source + at))
                    f.set(word(start + at), value)
                    f.set(alive, alive | (value << 1))
                self.close_line(f, field, line, start, alive)
                f.set(source, source + 4 * memory.width)

    def store_real(self, f: Function, batch: I32, slot: I32, address: I32, apart: I32) -> None:
        """Write the cells of a field."""
        memory = self.memory
        f.set(slot, slot + len(self.layout.planes))
        with self.each_lane(f, batch) as (group, lane, world, top):
            target = f.let(address + world * apart + top * (4 * memory.width))
            field = f.let(word(group + (slot << 2)))
            with self.each_line(f, lane) as line:
                start = f.let(self.library.line(field, line))
                with f.each(0, 4 * memory.width, 4) as at:
                    f.set(word(target + at), word(start + at))
                f.set(target, target + 4 * memory.width)

    def fill(
        self,
        f: Function,
        batch: I32,
        world: I32,
        slot: I32,
        planes: I32,
        top: I32,
        bottom: I32,
        left: I32,
        right: I32,
        value: I32,
    ) -> None:
        """A box of equal cells."""
        library, memory = self.library, self.memory
        with self.each_box_row(f, batch, world, top, bottom) as (group, lane, y):
            f.set(group[memory.present], -1)
            with f.each(0, planes) as bit:
                at = f.let(group + ((slot + bit) << 2))
                plane = f.let(library.own(word(at)))
                f.set(word(at), plane)
                flag = f.let(counted((value >> bit) & 1))
                f.set(plane[SOME], plane[SOME] | op("i32.wrap_i64", flag))
                with f.each(left, right, some=False) as x:
                    place = f.let(plane + y * memory.row + ((x >> 6) << 4) + (lane << 3))
                    by = f.let(counted(x & 63))
                    others = place[memory.half] & (const("i64", -1) ^ (1 << by))
                    f.set(place[memory.half], others | (flag << by))

    def fill_real(
        self,
        f: Function,
        batch: I32,
        world: I32,
        slot: I32,
        top: I32,
        bottom: I32,
        left: I32,
        right: I32,
        value: F32,
    ) -> None:
        """A box of equal floats."""
        library, memory = self.library, self.memory
        f.set(slot, slot + len(self.layout.planes))
        with self.each_box_row(f, batch, world, top, bottom) as (group, lane, y):
            at = f.let(group + (slot << 2))
            field = f.let(library.own_field(word(at)))
            f.set(word(at), field)
            line = f.let(lane * library.rows + y)
            start, alive = f.let(library.line_start(field, line)), f.let(0)
            with f.when((field + line)[LIVE].equals(0)):
                f.fill(start, 0, 4 * memory.width)
            with f.each(left, right, some=False) as x:
                f.set(load("f32.load", start + (x << 2)), value)
            with f.each(0, 4 * memory.width, 4) as x:
                f.set(alive, alive | (word(start + x) << 1))
            self.close_line(f, field, line, start, alive)

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
            at = f.let(self.clock(batch, 2, world))
            f.set(load("i64.load", at), load("i64.load", at) + counted(steps))

    def groups(self, f: Function, batch: I32) -> Value:
        """The number of groups, each of which is entered, begins each step and leaves, if a host calls the passes."""
        return batch[GROUPS]

    def world_of(self, f: Function, batch: Value, number: Value, lane: int) -> Local:
        """The world of a lane; unused lanes are the last world once more."""
        last = batch[WORLDS] - 1
        pair = f.let((number << 1) + lane)
        return f.let(either(self.library.strips, number, either(pair < last, pair, last)))

    def enter(self, f: Function, batch: I32, number: I32) -> None:
        """A group becomes the one that runs: parameters, and what the keys of its worlds have in common at all steps."""
        library, memory, layout = self.library, self.memory, self.layout
        f.set(library.group, self.first_group(batch) + number * memory.group)
        f.set(library.present, library.group[memory.present])
        for lane in range(LANES):
            with f.scope():
                worlds, world = f.let(batch[WORLDS]), self.world_of(f, batch, number, lane)
                bits, values = f.let(self.bits(batch) + world), f.let(self.values(batch) + (world << 2))
                for i in range(len(layout.param_planes)):
                    flags = 0 - counted(load("i32.load8_u", bits))
                    f.set(load("i64.load", 0, memory.at("params", i) + 8 * lane), flags)
                    f.set(bits, bits + worlds)
                for i in range(len(layout.param_reals)):
                    f.set(word(0, memory.at("reals", i) + 4 * lane), word(values))
                    f.set(values, values + (worlds << 2))
                seed, index = (f.let(load("i64.load", self.clock(batch, i, world))) for i in range(2))
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
                start = load("i64.load", self.clock(batch, 2, self.world_of(f, batch, number, lane)))
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
                f.do(library.giver(real)(held))
                same = library.calm if real else library.everything if slot.default else library.nothing
                constant = real and slot.default
                f.set(held, self._constant(float(slot.default)) if constant else library.keep(same))
        names = [name for name in self.layout.planes if name.startswith("element:")]
        if ids := [code for code in range(1 << len(names)) if self.asked >> code & 1]:
            look = library.module.define(partial(self._look, names, ids), "look")
            with f.when(library.present.equals(-1)):
                f.do(look())

    def leave(self, f: Function) -> None:
        """The group keeps the ids that are present."""
        f.set(self.library.group[self.memory.present], self.library.present)

    def _constant(self, value: float) -> Value:
        """A new field of equal values."""
        library = self.library
        make = library.lazily("constant_field", lambda: library.module.define(self._constant_field))
        return make(const("f32", value))

    def _constant_field(self, f: Function, value: F32) -> Value:
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
        rows = f.let(library.rows)
        f.set(library.lines, rows << 1)
        lines = f.let(library.lines)
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
