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
    Callee,
    Local,
    Place,
    Value,
    Writer,
    body,
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

    def define(self, *writers: Writer, export: bool = False) -> None:
        """Add functions, to be called by name."""
        for write in writers:
            self.calls[write.__name__.strip("_")] = self.library.module.define(write, export=export)

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
    def each_group(self, batch: Value) -> Iterator[Local]:
        first = body.let(self.part(batch, 3))
        stop = body.let(first + batch[GROUPS] * self.memory.group)
        with body.each(first, stop, self.memory.group) as group:
            yield group

    @contextmanager
    def each_lane(
        self, batch: Value, address: Value, apart: Value, size: Value | int
    ) -> Iterator[tuple[Local, Local, Local]]:
        """Group, lane, and where its cells of some bytes lie in an array, of all lanes that are used."""
        strips, number = self.library.strips, body.let(0)
        with self.each_group(batch) as group:
            with body.each(0, LANES) as lane:
                world = body.let(either(strips, number, (number << 1) + lane))
                top = either(strips, lane * self.library.rows, 0)  # the world's row at which the lane begins
                with body.when(world < batch[WORLDS]):
                    yield group, lane, body.let(address + world * apart + top * self.memory.width * size)
            number += 1

    @contextmanager
    def each_run(self) -> Iterator[tuple[Local, Local]]:
        """The words of all rows of a lane: bytes from the first word, and how many columns they have."""
        memory = self.memory
        with body.each(0, self.library.cells, 16) as at:
            last = ((at % memory.row) >> 4).equals(memory.words - 1)
            yield at, body.let(either(last, memory.width - WORD * (memory.words - 1), WORD))

    @contextmanager
    def each_sixteen(self, size: Value, x: Local, count: Value) -> Iterator[None]:
        """Sixteen cells of a byte at a time; `x` is the first one, and then the first that is left."""
        with body.block() as done, body.loop() as again:
            body.jump(done, op("i32.ne", size, 1) | (count < x + 16))
            yield
            x += 16
            body.jump(again)

    @contextmanager
    def each_line(self, lane: Value) -> Iterator[Local]:
        """The lines of a lane."""
        first = body.let(lane * self.library.rows)
        with body.each(first, first + self.library.rows) as line:
            yield line

    def close_line(self, field: Value, line: Value, start: Value, alive: Value) -> None:
        """What comes after a line's values; `alive` is not 0 if one of them is not."""
        live = body.let(op("i32.ne", alive, 0))
        (field + line)[LIVE] = live
        field[SOME] |= live
        self.library.finish_line(start)


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

    def allocate(self, worlds: I32, rows: I32) -> Value:
        """A new batch. All worlds of an instance have the same number of rows."""
        library, memory = self.library, self.memory
        per_world = sum(self.sizes)
        library.trap_from(worlds, per_world + memory.group)
        library.trap_from(rows, 8 * memory.stride + memory.row)
        with body.when(library.world_rows.equals(0)):
            even = (rows & 1).equals(0)
            reachable = (rows >> 1) >= max(1, memory.extent.around)
            few = worlds.equals(1) | ((rows * memory.row) >= LARGE_PLANE)
            body.do(self.calls["setup"](rows, even & reachable & few))
            body.otherwise()
            with body.when(op("i32.ne", library.world_rows, rows)):
                body.trap()
        count = body.let((worlds + 1) >> library.strips.equals(0))
        count.set(either(library.strips, worlds, count))
        size = body.let((worlds * per_world + count * memory.group + (HEADER + 4 * 15)) & ~15)
        before, batch = body.let(0), body.let(library.batches)
        with body.block() as chosen:
            with body.block() as missing, body.loop() as again:
                body.jump(missing, batch.equals(0))
                with body.when(batch[SIZE].equals(size)):
                    with body.when(before):
                        before[NEXT_BATCH] = batch[NEXT_BATCH]
                        body.otherwise()
                        library.batches.set(batch[NEXT_BATCH])
                    body.jump(chosen)
                before.set(batch)
                batch.set(batch[NEXT_BATCH])
                body.jump(again)
            batch.set(library.bump(size))
        for member, value in ((WORLDS, worlds), (GROUPS, count), (SIZE, size)):
            batch[member] = value
        with self.each_group(batch) as group:
            for member, real in memory.slots:
                group[member] = library.keep(library.calm if real else library.nothing)
            group[memory.present] = -1
        return batch

    def release(self, batch: I32) -> None:
        """Use the memory of a batch for others."""
        with self.each_group(batch) as group:
            for member, _ in self.memory.slots:
                body.do(self.library.give(group[member]))
        batch[NEXT_BATCH] = self.library.batches
        self.library.batches.set(batch)

    def copy(self, old: I32) -> Value:
        """A new batch, which shares what is not changed later."""
        library, present = self.library, self.memory.present
        new = body.let(self.calls["allocate"](old[WORLDS], library.world_rows))
        body.do(op("memory.copy", new + HEADER, old + HEADER, self.part(old, 3) - old - HEADER))
        apart = body.let(new - old)
        with self.each_group(old) as group:
            for member, _ in self.memory.slots:
                body.do(library.give((group + apart)[member]))
                (group + apart)[member] = library.keep(group[member])
            (group + apart)[present] = group[present]
        return new

    def scratch(self, size: I32) -> Value:
        """Memory for the host, until it asks for more."""
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
        """Read cells [worlds, rows, columns] into planes from a slot on: integers of 1, 2 or 4 bytes, or f32 into a field if
        there are no planes. `apart`: bytes from one world to the next.
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
        """Write cells, from first to last, each as 4 bytes of which `size` stay; `signed`: the last plane is the sign."""
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
                one = 1 << bit
                return either(signed & bit.equals(planes - 1), 0 - one, one)

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
        library, memory = self.library, self.memory
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
                with body.each(0, 4 * memory.width, 4) as at:
                    value = body.let(word(source + at))
                    word(start + at).set(value)
                    alive |= value << 1
                self.close_line(field, line, start, alive)
                source += 4 * memory.width

    def _store_real(self, batch: I32, slot: I32, address: I32, apart: I32) -> None:
        memory = self.memory
        with self.each_lane(batch, address, apart, 4) as (group, lane, target):
            field = body.let(word(group + (slot << 2)))
            with self.each_line(lane) as line:
                start = body.let(self.library.line(field, line))
                with body.each(0, 4 * memory.width, 4) as at:
                    word(target + at).set(word(start + at))
                target += 4 * memory.width

    # Steps

    def run(self, batch: I32, steps: I32) -> None:
        """Run steps, and add them to those of the inputs."""
        with body.block() as nothing:
            body.jump(nothing, steps.equals(0))
            with body.each(0, batch[GROUPS]) as group:
                body.do(self.calls["enter"](batch, group))
                with body.each(0, steps) as step:
                    body.do(self.calls["begin"](batch, group, step))
                    for pass_ in self.passes:
                        body.do(pass_())
                body.do(self.calls["leave"]())
        with body.each(0, batch[WORLDS], some=False) as world:
            clock = self.clock_of(batch, 2, world)
            clock += counted(steps)

    def world_of(self, batch: Value, number: Value, lane: int) -> Local:
        """The world of a lane; unused lanes are the last world once more."""
        last = batch[WORLDS] - 1
        pair = body.let((number << 1) + lane)
        return body.let(either(self.library.strips, number, either(pair < last, pair, last)))

    def enter(self, batch: I32, number: I32) -> None:
        """A group becomes the one that runs: parameters, and what the keys of its worlds have in common at all steps."""
        library, memory, layout = self.library, self.memory, self.layout
        library.group.set(self.part(batch, 3) + number * memory.group)
        library.present.set(library.group[memory.present])
        for lane in range(LANES):
            with body.scope():
                worlds, world = body.let(batch[WORLDS]), self.world_of(batch, number, lane)
                bits, values = (
                    body.let(self.part(batch, 1) + world),
                    body.let(self.part(batch, 2) + (world << 2)),
                )
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
                    self._twice(key, memory.at("worlds", i) + 8 * lane)

    def _twice(self, number: Value, at: int) -> None:
        """A number for both hashes of a lane's word."""
        load("i64.load", 0, at).set(counted(number) * (1 << 32 | 1))

    def begin(self, batch: I32, number: I32, done: I32) -> None:
        """What comes before the passes of a step: batch, number of the group, steps that are done."""
        library, memory = self.library, self.memory
        for lane in range(LANES):
            with body.scope():
                start = self.clock_of(batch, 2, self.world_of(batch, number, lane))
                step = body.let(start + counted(done))
                self._twice(op("i32.wrap_i64", step), memory.at("clock") + 8 * lane)
                for (modulus, bit), i in self.layout.step_planes.items():
                    flag = (op("i64.rem_u", step, modulus) >> bit) & 1
                    load("i64.load", 0, memory.at("steps", i) + 8 * lane).set(0 - flag)
        clock = load("v128.load", 0, memory.at("clock"))
        worlds = [load("v128.load", 0, memory.at("worlds", i)) for i in range(2)]
        bases = [library.mixed(op("i32x4.add", world, clock)) for world in worlds]
        apart = body.let(load("v128.load", 0, memory.at("apart")))
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
                held, real = library.group[memory.slot(slot.name, slot.type)], slot.type == REAL
                body.do(library.give(held))
                if real and slot.default:
                    make = library.module.define(self._constant_field)
                    held.set(make(const("f32", slot.default)))
                else:
                    same = library.calm if real else library.everything if slot.default else library.nothing
                    held.set(library.keep(same))
        names = [name for name in self.layout.planes if name.startswith("element:")]
        if ids := [code for code in range(1 << len(names)) if self.asked >> code & 1]:
            look = library.module.define(partial(self._look, names, ids), "look")
            with body.when(library.present.equals(-1)):
                body.do(look())

    def leave(self) -> None:
        """The group keeps the ids that are present."""
        self.library.group[self.memory.present] = self.library.present

    def _constant_field(self, value: F32) -> Value:
        """A new field of equal values."""
        library, width = self.library, self.memory.width
        field = body.let(library.take_field())
        field[SOME] = 1
        with body.each(0, library.lines) as line:
            (field + line)[LIVE] = 1
            start = body.let(library.line_start(field, line))
            with body.each(0, 4 * width, 4) as at:
                load("f32.load", start + at).set(value)
            library.finish_line(start)
        return field

    def _look(self, names: Sequence[str], ids: Sequence[int]) -> None:
        """Finds which of some ids are present, from products of their low and high bits, which have planes."""
        library, memory = self.library, self.memory
        planes = [body.let(library.group[memory.slot(name, None)]) for name in names]
        found = {code: body.let(0, "v128") for code in ids}
        low = len(names) // 2

        def products(bits: Sequence[Value]) -> list[Local]:
            made = [body.let(-1, "v128")]
            for bit in bits:
                rest = [body.let(op("v128.andnot", one, bit)) for one in made]
                made = [*rest, *(body.let(one & bit) for one in made)]
            return made

        with body.each(0, library.cells, 16) as at, body.scope():
            bits = [body.let((plane + at)[memory.flags]) for plane in planes]
            low_products, high = products(bits[:low]), products(bits[low:])
            for code in ids:
                both = low_products[code & (1 << low) - 1] & high[code >> low]
                found[code] |= both
        total: Value = const("i64", 0)
        for code in ids:
            total = total | (counted(op("v128.any_true", found[code])) << code)
        library.present.set(total)

    # What an instance makes once, when it learns the number of rows: sizes, constant planes, tables

    def _setup(self, height: I32, strips: I32) -> None:
        """Rows of a world, and whether the lanes are strips."""
        library, memory = self.library, self.memory
        library.world_rows.set(height)
        library.strips.set(strips)
        library.rows.set(height >> strips)
        library.lines.set(library.rows << 1)
        rows, lines = library.rows, library.lines
        library.cells.set(rows * memory.row)
        library.plane_size.set(rows * memory.row + (memory.base + memory.extent.around * memory.row))
        library.live_size.set((lines + 16) & ~15)
        library.field_size.set(library.live_size + lines * (4 * memory.stride) + (HEADER + 64 & ~15))
        turn = load("v128.load", memory.at("turn"))
        with body.when(strips):
            turn.set(vector(SWAPPED))
            body.otherwise()
            turn.set(vector(STILL))
        # The four hashes of a vector differ by this: a word of a lane has two, and strips continue each other.
        strip = body.let(either(strips, rows, 0) * (-(-memory.width // 32) * 32 * GOLDEN))
        for number in range(4):
            hashes = strip * (number // 2) + number % 2 * 32 * GOLDEN
            word(0, memory.at("apart") + 4 * number).set(hashes)
        for plane in (library.nothing, library.everything, library.inside):
            plane.set(library.take())
        library.nothing[HALOED] = 1
        for plane in (library.everything, library.inside):
            with body.each(0, rows * memory.row, 8 * LANES) as at, body.scope():
                last = (at % memory.row).equals(memory.row - 8 * LANES)
                rest = const("v128", (1 << memory.width - WORD * (memory.words - 1)) - 1)
                full = const("v128", (1 << min(WORD, memory.width)) - 1)
                (plane + at)[memory.flags] = either(last, rest, full)
        self._beyond(rows)
        library.everything[SOME] = 1
        library.calm.set(library.take_field())
        library.zeros.set(library.bump(4 * memory.stride + 64 & ~15) + 4 * memory.halo)
        word(memory.at("rows")).set(library.bump((rows << 2) + 31 & ~15))
        columns = const("i32", memory.at("columns") + 4 * memory.halo)
        with body.each(0, 4 * memory.width, 4) as at:
            word(columns + at).set(-1)
        for dy in range(-memory.extent.lines, memory.extent.lines + 1):
            for wraps in (True, False):
                self._line_table(dy, wraps)
        for (kind, a, b), number in self.layout.fixed.items():
            self._fixed(kind, a, b, memory.at("fixed", number))

    def _beyond(self, rows: Value) -> None:
        """In the halo, the rows of the other strip: the lower one lies below the upper one, and around it nothing."""
        memory, plane = self.memory, self.library.inside
        if not (size := memory.extent.around * memory.row):
            return
        with body.when(self.library.strips), body.each(0, size, 8 * LANES) as at, body.scope():
            below = rows * memory.row + at
            same = (plane + at % memory.row)[memory.half]
            load("i64.load", plane + at, HEADER + 8).set(same)
            (plane + below)[memory.half] = same

    def _line_table(self, dy: int, wraps: bool) -> None:
        library, lines = self.library, self.library.lines
        with body.scope():
            table = body.let(library.bump((lines << 2) + 15 & ~15))
            word(self.memory.table(dy, wraps=wraps)).set(table)
            height = body.let(library.world_rows)
            with body.each(0, lines) as line:
                y = body.let(line % height)
                other = body.let(y + dy)
                seen = line - y + other
                if wraps:
                    other.set(op("i32.rem_s", other, height))
                    other.set(either(op("i32.lt_s", other, 0), other + height, other))
                word(table + (line << 2)).set(seen if wraps else either(other < height, seen, lines))

    def _fixed(self, kind: int, a: int, b: int, place: int) -> None:
        """A plane of a bit of coordinates (0: rows, 1: columns; modulus, bit), or of `inside` (rows, columns)."""
        library, memory = self.library, self.memory
        with body.scope():
            plane = body.let(library.take())
            word(place).set(plane)
            plane[SOME] = 1
            strips_rows = body.let(either(library.strips, library.rows, 0))
            with body.each(0, LANES) as lane, body.each(0, library.rows) as y:
                row = body.let(y + strips_rows * lane)
                with body.each(0, memory.width) as x, body.scope():
                    if kind == 2:
                        flag = ((row + a) < library.world_rows) & ((x + b) < memory.width)
                    else:
                        flag = (((x if kind else row) % a) >> b) & 1
                    half = body.let(plane + y * memory.row + ((x >> 6) << 4) + (lane << 3))[memory.half]
                    half |= counted(flag) << counted(x & 63)
