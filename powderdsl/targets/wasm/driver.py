"""The functions that hosts call: batches of worlds, cells in and out, steps. Each is exported under its name (`Driver`).

Parameters and results are i32 unless noted. `rows` are those of a world; the module fixes the columns. Boxes end before
`bottom` and `right`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from powderdsl.ir.ops import REAL, Program
from powderdsl.system.random import MASK, START_0, START_1
from powderdsl.targets.wasm.binary import (
    F32,
    I32,
    Callee,
    Global,
    Local,
    Settable,
    Value,
    Writer,
    body,
    const,
    load,
    op,
    vector,
)
from powderdsl.targets.wasm.host import HEADER
from powderdsl.targets.wasm.library import (
    GOLDEN,
    GROUPS,
    HALOED,
    LANES,
    LIVE,
    SOME,
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
"""Bytes of a plane of two worlds that exceed a near cache; then the lanes are strips of one world."""

WEIGHTS = bytes(1 << i for i in range(8)) * 2


class Batches:
    """Code that finds the parts of batches."""

    def __init__(self, library: Library):
        self.library, self.memory, self.layout = library, library.memory, library.memory.layout
        self.sizes = (24, len(self.layout.param_planes), 4 * len(self.layout.param_reals))
        """Bytes of the parts of a batch, for each world."""
        self.calls: dict[str, Callee] = {}

    def define(self, *writers: Writer, export: bool = False) -> None:
        """Add functions, to be called by name."""
        for write in writers:
            self.calls[write.__name__.strip("_")] = self.library.module.define(write, export=export)

    def part(self, batch: Value, number: int) -> Value:
        """The address of the clocks (0), the bits (1) or values (2) of parameters, or the groups (3) of a batch."""
        at = batch + HEADER
        for size in self.sizes[:number]:
            at = (at + batch[WORLDS] * size + 15) & ~15
        return at

    def clock_of(self, batch: Value, what: int, world: Value) -> Settable:
        """Seed, index or step of a world."""
        return load("i64.load", self.part(batch, 0) + ((batch[WORLDS] * what + world) << 3))

    @contextmanager
    def each_group(self, batch: Value) -> Iterator[Local]:
        first = body.let(self.part(batch, 3))
        stop = body.let(first + batch[GROUPS] * self.memory.group)
        with body.each(first, stop, self.memory.group) as group:
            yield group

    @contextmanager
    def each_lane(
        self, batch: Value, address: Value, apart: Value, size: Value | int
    ) -> Iterator[tuple[Local, Local, Local]]:
        """All lanes in use: group, lane, and the address of the lane's cells of `size` bytes in an array."""
        strips, number = self.library.strips, body.let(0)
        with self.each_group(batch) as group:
            with body.each(0, LANES) as lane:
                world = body.let(either(strips, number, (number << 1) + lane))
                top = either(strips, lane * self.library.rows, 0)  # the world's row at which the lane begins
                with body.when(world < batch[WORLDS]):
                    yield group, lane, body.let(address + world * apart + top * self.library.width * size)
            number += 1

    @contextmanager
    def each_run(self) -> Iterator[tuple[Local, Local]]:
        """The words of all rows of a lane: bytes from the first word, and the number of columns."""
        memory = self.memory
        with body.each(0, self.library.cells, 16) as at:
            last = ((at % memory.row) >> 4).equals(memory.words - 1)
            yield at, body.let(either(last, self.library.width - WORD * (memory.words - 1), WORD))

    @contextmanager
    def each_sixteen(self, size: Value, x: Local, count: Value) -> Iterator[None]:
        """Sixteen cells of a byte at a time, from cell `x` on; afterwards, `x` is the first remaining cell."""
        with body.block() as done, body.loop() as again:
            body.jump(done, op("i32.ne", size, 1) | (count < x + 16))
            yield
            x += 16
            body.jump(again)

    @contextmanager
    def each_line(self, lane: Value) -> Iterator[Local]:
        first = body.let(lane * self.library.rows)
        with body.each(first, first + self.library.rows) as line:
            yield line


class Driver(Batches):
    """Makes the functions that a host calls, for a program on bit planes. Passes test the presence of ids `tested`."""

    def __init__(self, library: Library, program: Program, passes: Sequence[Callee], tested: int):
        super().__init__(library)
        self.program, self.passes, self.tested = program, passes, tested

    def add(self, *, export: bool) -> dict[str, Callee]:
        """Add the functions, and return them by name. `export`: hosts see them, and the passes by number."""
        self.define(self._setup, self._renew, self._load_real, self._store_real)
        self.define(self.allocate, self.release, self.copy, self.scratch, export=export)
        self.define(self.load, self.store, self.enter, self.begin, self.run, export=export)
        for number, pass_ in enumerate(self.passes if export else ()):
            self.library.module.export(pass_, str(number))
        return self.calls

    # Batches

    def allocate(self, worlds: I32, rows: I32, columns: I32) -> Value:
        """A new batch. All worlds of an instance have the same number of rows, and of columns."""
        library, memory = self.library, self.memory
        per_world = sum(self.sizes)
        library.trap_from(worlds, per_world + memory.group)
        library.trap_from(rows, 8 * memory.stride + memory.row)
        with body.when(library.world_rows.equals(0)):
            even = (rows & 1).equals(0)
            reachable = (rows >> 1) >= max(1, memory.extent.around)
            few = worlds.equals(1) | ((rows * memory.row) >= LARGE_PLANE)
            body.do(self.calls["setup"](rows, columns, even & reachable & few))
            body.otherwise()
            with body.when(op("i32.ne", library.world_rows, rows)):
                body.trap()
        count = body.let(either(library.strips, worlds, (worlds + 1) >> 1))
        size = (worlds * per_world + count * memory.group + (HEADER + 4 * 15)) & ~15
        batch = body.let(library.bump(size))
        batch[WORLDS], batch[GROUPS] = worlds, count
        body.do(self.calls["renew"](batch))
        return batch

    def _renew(self, batch: I32) -> None:
        """Empty planes and fields, for a batch that has none."""
        library, memory = self.library, self.memory
        with self.each_group(batch) as group:
            for member, real in memory.slots:
                group[member] = library.keep(library.calm if real else library.nothing)
            group[memory.present] = -1

    def release(self, batch: I32) -> None:
        """Clear a batch, so that its memory can be reused for the same number of worlds."""
        with self.each_group(batch) as group:
            for member, _ in self.memory.slots:
                body.do(self.library.give(group[member]))
        body.do(self.calls["renew"](batch))

    def copy(self, old: I32, new: I32) -> None:
        """Copy a batch into a new batch of the same size; planes and fields are shared until they change."""
        library, present = self.library, self.memory.present
        body.do(op("memory.copy", new + HEADER, old + HEADER, self.part(old, 3) - old - HEADER))
        apart = body.let(new - old)
        with self.each_group(old) as group:
            for member, _ in self.memory.slots:
                body.do(library.give((group + apart)[member]))
                (group + apart)[member] = library.keep(group[member])
            (group + apart)[present] = group[present]

    def scratch(self, size: I32) -> Value:
        """Memory for the host, valid until the next call."""
        library = self.library
        library.trap_from(size, 1)
        with body.when(library.scratch_end < library.scratch + size):
            more = body.let((size + 79) & ~15)
            library.scratch.set(library.bump(more))
            library.scratch_end.set(library.scratch + more - 64)
        return library.scratch

    # Cells

    def load(
        self, batch: I32, slot: I32, planes: I32, signed: I32, size: I32, start: I32, apart: I32
    ) -> None:
        """Read cells [worlds, rows, columns] into the planes from a slot on: integers of 1, 2 or 4 bytes.

        With 0 planes, read f32 into a field. `apart`: bytes from one world to the next.
        """
        library, memory = self.library, self.memory
        with body.when(planes.equals(0)):
            body.do(self.calls["load_real"](batch, slot, start, apart))
            body.leave()
        with self.each_group(batch) as group:
            group[memory.present] = -1
            with body.each(0, planes) as bit:
                at = body.let(group + ((slot + bit) << 2))
                body.do(library.give(word(at)))
                plane = body.let(library.take())
                word(at).set(plane)
                body.do(op("memory.fill", plane + memory.base, 0, library.cells))
        with (
            self.each_lane(batch, start, apart, size) as (group, lane, source),
            self.each_run() as (at, count),
        ):
            with body.each(0, planes) as bit:
                plane = body.let(word(group + ((slot + bit) << 2)))
                flags, x = body.let(0, "i64"), body.let(0)
                with self.each_sixteen(size, x, count):
                    top_bits = op("i8x16.shl", load("v128.load", source + x), 7 - bit)
                    flags |= counted(op("i8x16.bitmask", top_bits)) << counted(x)
                with body.each(x, count, some=False) as x:
                    flag = (word(source + x * size) >> bit) & 1
                    flags |= counted(flag) << counted(x)
                (plane + at + (lane << 3))[memory.half] = flags
                plane[SOME] |= op("i64.ne", flags, 0)
            source += count * size

    def store(
        self, batch: I32, slot: I32, planes: I32, signed: I32, size: I32, start: I32, apart: I32
    ) -> None:
        """Write cells from first to last, each as 4 bytes of which `size` remain; `signed`: the last plane is the sign."""
        memory = self.memory
        with body.when(planes.equals(0)):
            body.do(self.calls["store_real"](batch, slot, start, apart))
            body.leave()
        with (
            self.each_lane(batch, start, apart, size) as (group, lane, target),
            self.each_run() as (at, count),
        ):
            place, x = body.let(at + (lane << 3)), body.let(0)

            def bits_from(bit: Value) -> Value:
                plane = word(group + ((slot + bit) << 2))
                return op("i32.wrap_i64", (plane + place)[memory.half] >> counted(x))

            def weight(bit: Value) -> Value:
                power = 1 << bit
                return either(signed & bit.equals(planes - 1), 0 - power, power)

            with self.each_sixteen(size, x, count):
                cells = body.let(0, "v128")
                with body.each(0, planes) as bit:
                    bits = op("i8x16.swizzle", splat(bits_from(bit)), vector(bytes(8) + b"\1" * 8))
                    chosen = op("i8x16.eq", bits & vector(WEIGHTS), vector(WEIGHTS))
                    cells.set(op("i8x16.add", cells, chosen & op("i8x16.splat", weight(bit))))
                load("v128.load", target).set(cells)
                target += 16
            with body.each(x, count, some=False) as x:
                value = body.let(0)
                with body.each(0, planes) as bit:
                    value += (bits_from(bit) & 1) * weight(bit)
                word(target).set(value)
                target += size

    def _load_real(self, batch: I32, slot: I32, address: I32, apart: I32) -> None:
        library = self.library
        with self.each_group(batch) as group:
            at = body.let(group + (slot << 2))
            body.do(library.give(word(at)))
            field = body.let(library.take_field())
            word(at).set(field)
            body.do(op("memory.fill", field + HEADER, 0, library.live_size))
        with self.each_lane(batch, address, apart, 4) as (group, lane, source):
            field = body.let(word(group + (slot << 2)))
            with self.each_line(lane) as line:
                start, alive = body.let(library.line_start(field, line)), body.let(0)
                with body.each(0, library.width * 4, 4) as at:
                    value = body.let(word(source + at))
                    word(start + at).set(value)
                    alive |= value << 1
                live = body.let(op("i32.ne", alive, 0))
                (field + line)[LIVE] = live
                field[SOME] |= live
                library.finish_line(start)
                source += library.width * 4

    def _store_real(self, batch: I32, slot: I32, address: I32, apart: I32) -> None:
        library = self.library
        with self.each_lane(batch, address, apart, 4) as (group, lane, target):
            field = body.let(word(group + (slot << 2)))
            with self.each_line(lane) as line:
                start = body.let(library.line(field, line))
                with body.each(0, library.width * 4, 4) as at:
                    word(target + at).set(word(start + at))
                target += library.width * 4

    # Steps

    def run(self, batch: I32, steps: I32) -> None:
        """Run steps, and advance the clocks."""
        with body.block() as nothing:
            body.jump(nothing, steps.equals(0))
            with body.each(0, batch[GROUPS]) as group:
                body.do(self.calls["enter"](batch, group))
                with body.each(0, steps) as step:
                    body.do(self.calls["begin"](batch, group, step))
                    for pass_ in self.passes:
                        body.do(pass_())
        with body.each(0, batch[WORLDS], some=False) as world:
            clock = self.clock_of(batch, 2, world)
            clock += counted(steps)

    def world_of(self, batch: Value, number: Value, lane: int) -> Local:
        """The world of a lane; unused lanes repeat the last world."""
        last = batch[WORLDS] - 1
        pair = body.let((number << 1) + lane)
        return body.let(either(self.library.strips, number, either(pair < last, pair, last)))

    def enter(self, batch: I32, number: I32) -> None:
        """Select the group that runs: set its parameters, and the parts of its worlds' keys that all steps share."""
        library, memory, layout = self.library, self.memory, self.layout
        library.group.set(self.part(batch, 3) + number * memory.group)
        for lane in range(LANES):
            with body.scope():
                worlds, world = body.let(batch[WORLDS]), self.world_of(batch, number, lane)
                bits = body.let(self.part(batch, 1) + world)
                values = body.let(self.part(batch, 2) + (world << 2))
                for i in range(len(layout.param_planes)):
                    flags = 0 - counted(load("i32.load8_u", bits))
                    load("i64.load", 0, memory.at("params", i) + 8 * lane).set(flags)
                    bits += worlds
                for i in range(len(layout.param_reals)):
                    word(0, memory.at("reals", i) + 4 * lane).set(word(values))
                    values += worlds << 2
                seed, index = (body.let(self.clock_of(batch, i, world)) for i in range(2))
                parts = [op("i32.wrap_i64", part) for part in (seed, seed >> 32, index)]
                for i, start in enumerate((START_0, START_1)):
                    key: Value = const("i32", start)
                    for part in parts:
                        key = library.mix(key + part)
                    self._store_twice(key, memory.at("worlds", i) + 8 * lane)

    def _store_twice(self, number: Value, at: int) -> None:
        """Store a number twice, for both hashes of a lane's word."""
        load("i64.load", 0, at).set(counted(number) * (1 << 32 | 1))

    def begin(self, batch: I32, number: I32, done: I32) -> None:
        """Prepare a step: set the clock and the keys of draws, reset slots, update the present elements."""
        library, memory = self.library, self.memory
        for lane in range(LANES):
            with body.scope():
                start = self.clock_of(batch, 2, self.world_of(batch, number, lane))
                step = body.let(start + counted(done))
                self._store_twice(op("i32.wrap_i64", step), memory.at("clock") + 8 * lane)
                for (modulus, bit), i in self.layout.step_planes.items():
                    flag = (op("i64.rem_u", step, modulus) >> bit) & 1
                    load("i64.load", 0, memory.at("steps", i) + 8 * lane).set(0 - flag)
        clock = load("v128.load", 0, memory.at("clock"))
        worlds = [load("v128.load", 0, memory.at("worlds", i)) for i in range(2)]
        bases = [library.mixed(op("i32x4.add", world, clock)) for world in worlds]
        # The four hashes of a vector differ by this: a word of a lane has two, and strips continue each other.
        strip = splat(either(library.strips, library.rows, 0) * (((library.width + 31) >> 5) * (32 * GOLDEN)))
        within = vector(struct.pack("<4I", *[0, 32 * GOLDEN & MASK] * 2))
        second_lane = vector(struct.pack("<4I", 0, 0, 1, 1))
        apart = body.let(op("i32x4.add", op("i32x4.mul", strip, second_lane), within))
        for name, ident, _ in self.program.streams:
            with body.scope():
                first, second = (library.mixed(op("i32x4.add", base, integers(ident))) for base in bases)
                keys = memory.at("keys", self.layout.streams[name])
                load("v128.load", 0, keys).set(op("i32x4.add", first, apart))
                load("v128.load", 0, keys + 16).set(second)
        for i in range(len(self.layout.streams)):
            with body.scope():
                coin = word(memory.at("coins", i))
                old = body.let(coin)
                with body.when(old):
                    body.do(library.give(old))
                    coin.set(0)
        for slot in self.program.slots:
            if slot.resets:
                place, real = library.group[memory.slot(slot.name, slot.type)], slot.type == REAL
                body.do(library.give(place))
                if real and slot.default:
                    make = library.module.define(self._constant_field)
                    place.set(make(const("f32", slot.default)))
                else:
                    same = library.calm if real else library.everything if slot.default else library.nothing
                    place.set(library.keep(same))
        names = [name for name in self.layout.planes if name.startswith("element:")]
        if ids := [code for code in range(1 << len(names)) if self.tested >> code & 1]:
            look = library.module.define(partial(self._find_ids, names, ids), "look")
            with body.when(library.present.equals(-1)):
                body.do(look())

    def _constant_field(self, value: F32) -> Value:
        library = self.library
        field = body.let(library.take_field())
        field[SOME] = 1
        with body.each(0, library.lines) as line:
            (field + line)[LIVE] = 1
            start = body.let(library.line_start(field, line))
            with body.each(0, library.width * 4, 4) as at:
                load("f32.load", start + at).set(value)
            library.finish_line(start)
        return field

    def _find_ids(self, names: Sequence[str], ids: Sequence[int]) -> None:
        """Find the ids that are present, from products of the planes of their bits."""
        library, memory = self.library, self.memory
        planes = [body.let(library.group[memory.slot(name, None)]) for name in names]
        present = {code: body.let(0, "v128") for code in ids}
        with body.each(0, library.cells, 16) as at, body.scope():
            products: list[Value] = [const("v128", -1)]
            for plane in planes:
                bit = body.let((plane + at)[memory.flags])
                without = [body.let(op("v128.andnot", product, bit)) for product in products]
                products = [*without, *(body.let(product & bit) for product in products)]
            for code in ids:
                present[code] |= products[code]
        total: Value = const("i64", 0)
        for code in ids:
            total = total | (counted(op("v128.any_true", present[code])) << code)
        library.present.set(total)

    # Sizes, constant planes and tables, which an instance makes once the number of rows is known

    def _setup(self, height: I32, columns: I32, strips: I32) -> None:
        """Set the rows of a world, and the columns unless they are fixed; `strips` is 1 if the lanes are strips of one world."""
        library, memory = self.library, self.memory
        library.world_rows.set(height)
        if isinstance(library.width, Global):
            library.width.set(columns)
            for number, turned in library.turns.items():
                turned.set((columns * abs(number) + number) % columns)
        full = memory.at("columns") + 4 * memory.halo
        body.do(op("memory.fill", const("i32", full), 255, library.width * 4))
        library.strips.set(strips)
        library.rows.set(height >> strips)
        library.lines.set(library.rows << 1)
        rows, lines = library.rows, library.lines
        library.cells.set(rows * memory.row)
        library.plane_size.set(rows * memory.row + (memory.base + memory.extent.around * memory.row))
        library.live_size.set((lines + 16) & ~15)
        library.field_size.set(library.live_size + lines * (4 * memory.stride) + (HEADER + 64 & ~15))
        library.nothing.set(library.take())
        library.nothing[HALOED] = 1
        for plane in (library.everything, library.inside):
            plane.set(self._fixed(2, 0, 0))
        library.calm.set(library.take_field())
        library.zeros.set(library.bump(4 * memory.stride + 64 & ~15) + 4 * memory.halo)
        library.row_list.set(library.bump((rows << 2) + 31 & ~15))
        for dy in range(-memory.extent.lines, memory.extent.lines + 1):
            for wraps in (True, False):
                self._line_table(dy, wraps)
        for (kind, a, b), number in self.layout.fixed.items():
            word(memory.at("fixed", number)).set(self._fixed(kind, a, b))

    def _line_table(self, dy: int, wraps: bool) -> None:
        library, lines = self.library, self.library.lines
        with body.scope():
            table = body.let(library.bump((lines << 2) + 15 & ~15))
            word(self.memory.table(dy, wraps=wraps)).set(table)
            height = library.world_rows
            with body.each(0, lines) as line:
                y = body.let(line % height)
                if wraps:
                    other = line - y + (y + (height * abs(dy) + dy)) % height
                else:
                    other = either((y + dy) < height, line + dy, lines)
                word(table + (line << 2)).set(other)

    def _fixed(self, kind: int, a: int, b: int) -> Value:
        """A plane of a bit of coordinates (0: rows, 1: columns; modulus, bit), or of `inside` (2: rows, columns).

        Its halo holds the rows of the other strip; around the world nothing is inside.
        """
        library, memory = self.library, self.memory
        around = memory.extent.around

        def fixed() -> Value:
            plane = body.let(library.take())
            plane[SOME] = 1
            top = body.let(either(library.strips, library.rows, 0))
            with body.each(0, LANES) as lane, body.each(0, library.rows + 2 * around) as y:
                row = body.let(y + top * lane - around)
                with body.each(0, library.width) as x, body.scope():
                    if kind == 2:
                        flag = ((row + a) < library.world_rows) & ((x + b) < library.width)
                    else:
                        flag = (((x if kind else row) % a) >> b) & 1
                    at = body.let(plane + y * memory.row + ((x >> 6) << 4) + (lane << 3))
                    half = load("i64.load", at, HEADER)
                    half |= counted(flag) << counted(x & 63)
            return plane

        return library.module.define(fixed)()
