"""Cells in and out of batches: what a host writes, reads and paints."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from powderdsl.targets.wasm.batches import Batches
from powderdsl.targets.wasm.binary import Function, Local, Value, const, load, op, vector
from powderdsl.targets.wasm.library import ZERO, counted, either, splat, word
from powderdsl.targets.wasm.memory import HEADER, SOME, WORD

WEIGHTS = bytes(1 << i for i in range(8)) * 2


class Transfer(Batches):
    """Makes these functions."""

    def cell(self, address: Value, size: Value) -> Value:
        wide = either(size.equals(2), load("i32.load16_u", address), word(address))
        return either(size.equals(1), load("i32.load8_u", address), wide)

    def load(self) -> Function:
        f, library, memory = self.library.function("i32 i32 i32 i32 i32"), self.library, self.memory
        batch, slot, planes, size, address = (f.param(i) for i in range(5))
        with self.each_group(f, batch) as group:
            f.store("i64.store", group, const("i64", -1), memory.present)
            with f.each(ZERO, planes) as bit:
                at = f.let(group + ((slot + bit) << 2))
                f.do(library.give(word(at)))
                plane = f.let(library.take())
                f.store("i32.store", at, plane)
                f.fill(plane + memory.base, ZERO, library.cells.value)
        with self.each_lane(f, batch) as (group, lane, world, top):
            start = world * self.library.world_rows.value + top
            source = f.let(address + start * size * memory.width)
            with self.each_run(f) as (at, count):
                with f.each(ZERO, planes) as bit:
                    plane = f.let(word(group + ((slot + bit) << 2)))
                    found, x = f.let(const("i64", 0)), f.let(ZERO)
                    with self.each_sixteen(f, size, x, count):
                        top_bits = op("i8x16.shl", load("v128.load", source + x), const("i32", 7) - bit)
                        f.set(found, found | (counted(op("i8x16.bitmask", top_bits)) << counted(x)))
                    with f.each(x, count, some=False) as x:
                        flag = (self.cell(source + x * size, size) >> bit) & 1
                        f.set(found, found | (counted(flag) << counted(x)))
                    f.store("i64.store", plane + at + (lane << 3), found, memory.base)
                    f.store(
                        "i32.store", plane, word(plane, SOME) | op("i64.ne", found, const("i64", 0)), SOME
                    )
                f.set(source, source + count * size)
        return f

    @contextmanager
    def each_run(self, f: Function) -> Iterator[tuple[Local, Local]]:
        """The words of all rows of a lane: bytes from the first word, and how many columns they have."""
        memory = self.memory
        with f.each(ZERO, self.library.cells.value, 16) as at:
            last = ((at % memory.row) >> 4).equals(memory.words - 1)
            rest = memory.width - WORD * (memory.words - 1)
            yield at, f.let(either(last, const("i32", rest), const("i32", WORD)))

    def store(self) -> Function:
        f, memory = self.library.function("i32 i32 i32 i32 i32 i32"), self.memory
        batch, slot, planes, negative, size, address = (f.param(i) for i in range(6))
        with self.each_lane(f, batch) as (group, lane, world, top):
            start = world * self.library.world_rows.value + top
            target = f.let(address + start * size * memory.width)
            with self.each_run(f) as (at, count):
                place, x = f.let(at + (lane << 3)), f.let(ZERO)

                def bits_from(bit: Value) -> Value:
                    plane = word(group + ((slot + bit) << 2))
                    return op("i32.wrap_i64", load("i64.load", plane + place, memory.base) >> counted(x))

                def weight(bit: Value) -> Value:
                    one = const("i32", 1) << bit
                    return either(negative & bit.equals(planes - 1), ZERO - one, one)

                with self.each_sixteen(f, size, x, count):
                    cells = f.let(const("v128", 0))
                    with f.each(ZERO, planes) as bit:
                        bits = op("i8x16.swizzle", splat(bits_from(bit)), vector(bytes(8) + b"\1" * 8))
                        chosen = op("i8x16.eq", bits & vector(WEIGHTS), vector(WEIGHTS))
                        f.set(cells, op("i8x16.add", cells, chosen & op("i8x16.splat", weight(bit))))
                    f.store("v128.store", target, cells)
                    f.set(target, target + 16)
                with f.each(x, count, some=False) as x:
                    value = f.let(ZERO)
                    with f.each(ZERO, planes) as bit:
                        f.set(value, value + (bits_from(bit) & 1) * weight(bit))
                    with f.when(size.equals(1)):
                        f.store("i32.store8", target, value)
                        f.otherwise()
                        with f.when(size.equals(2)):
                            f.store("i32.store16", target, value)
                            f.otherwise()
                            f.store("i32.store", target, value)
                    f.set(target, target + size)
        return f

    @contextmanager
    def each_sixteen(self, f: Function, size: Value, x: Local, count: Value) -> Iterator[None]:
        """Sixteen cells of a byte at a time; `x` is the first one, and then the first that is left."""
        with f.block() as done, f.loop() as again:
            f.jump(done, op("i32.ne", size, const("i32", 1)) | (count < x + 16))
            yield
            f.set(x, x + 16)
            f.jump(again)

    def load_real(self) -> Function:
        f, library, memory = self.library.function("i32 i32 i32 i32"), self.library, self.memory
        batch, slot, address, apart = (f.param(i) for i in range(4))
        f.set(slot, slot + len(self.layout.planes))
        with self.each_group(f, batch) as group:
            at = f.let(group + (slot << 2))
            f.do(library.give_field(word(at)))
            field = f.let(library.take_field())
            f.store("i32.store", at, field)
            f.fill(field + HEADER, ZERO, library.live_size.value)
        with self.each_lane(f, batch) as (group, lane, world, top):
            source = f.let(address + world * apart + top * (4 * memory.width))
            field = f.let(word(group + (slot << 2)))
            with self.each_line(f, lane) as line:
                start = f.let(library.line_start(field, line))
                alive = f.let(ZERO)
                with f.each(ZERO, const("i32", 4 * memory.width), 4) as at:
                    value = f.let(word(source + at))
                    f.store("i32.store", start + at, value)
                    f.set(alive, alive | (value << 1))
                self.close_line(f, field, line, start, alive)
                f.set(source, source + 4 * memory.width)
        return f

    def close_line(self, f: Function, field: Value, line: Value, start: Value, alive: Value) -> None:
        live = f.let(op("i32.ne", alive, ZERO))
        f.store("i32.store8", field + line, live, HEADER)
        f.store("i32.store", field, word(field, SOME) | live, SOME)
        self.library.finish_line(f, start)

    @contextmanager
    def each_line(self, f: Function, lane: Value) -> Iterator[Local]:
        first = f.let(lane * self.library.rows.value)
        with f.each(first, first + self.library.rows.value) as line:
            yield line

    def store_real(self) -> Function:
        f, library, memory = self.library.function("i32 i32 i32 i32"), self.library, self.memory
        batch, slot, address, apart = (f.param(i) for i in range(4))
        f.set(slot, slot + len(self.layout.planes))
        with self.each_lane(f, batch) as (group, lane, world, top):
            target = f.let(address + world * apart + top * (4 * memory.width))
            field = f.let(word(group + (slot << 2)))
            with self.each_line(f, lane) as line:
                start = f.let(library.line(field, line))
                with f.each(ZERO, const("i32", 4 * memory.width), 4) as at:
                    f.store("i32.store", target + at, word(start + at))
                f.set(target, target + 4 * memory.width)
        return f

    @contextmanager
    def each_box_row(
        self, f: Function, batch: Value, world: Value, top: Value, bottom: Value
    ) -> Iterator[tuple[Local, Local, Local]]:
        """Group, lane and row of the lane, for the rows of a box in a world."""
        rows, strips = self.library.rows.value, self.library.strips.value
        with f.each(top, bottom, some=False) as y:
            lane = f.let(either(strips, y // rows, world & 1))
            number = either(strips, world, world >> 1)
            group = f.let(self.groups(batch) + number * self.memory.group)
            yield group, lane, f.let(either(strips, y % rows, y))

    def fill(self) -> Function:
        f, library, memory = self.library.function("i32 " * 9), self.library, self.memory
        batch, world, slot, planes, top, bottom, left, right, value = (f.param(i) for i in range(9))
        with self.each_box_row(f, batch, world, top, bottom) as (group, lane, y):
            f.store("i64.store", group, const("i64", -1), memory.present)
            with f.each(ZERO, planes) as bit:
                at = f.let(group + ((slot + bit) << 2))
                plane = f.let(library.own(word(at)))
                f.store("i32.store", at, plane)
                flag = f.let(counted((value >> bit) & 1))
                f.store("i32.store", plane, word(plane, SOME) | op("i32.wrap_i64", flag), SOME)
                with f.each(left, right, some=False) as x:
                    place = f.let(plane + y * memory.row + ((x >> 6) << 4) + (lane << 3))
                    by = f.let(counted(x & 63))
                    kept = load("i64.load", place, memory.base) & (const("i64", -1) ^ (const("i64", 1) << by))
                    f.store("i64.store", place, kept | (flag << by), memory.base)
        return f

    def fill_real(self) -> Function:
        f, library, memory = self.library.function("i32 " * 7 + "f32"), self.library, self.memory
        batch, world, slot, top, bottom, left, right, value = (f.param(i) for i in range(8))
        f.set(slot, slot + len(self.layout.planes))
        with self.each_box_row(f, batch, world, top, bottom) as (group, lane, y):
            at = f.let(group + (slot << 2))
            field = f.let(library.own_field(word(at)))
            f.store("i32.store", at, field)
            line = f.let(lane * library.rows.value + y)
            start, alive = f.let(library.line_start(field, line)), f.let(ZERO)
            with f.when(op("i32.eqz", load("i32.load8_u", field + line, HEADER))):
                f.fill(start, ZERO, const("i32", 4 * memory.width))
            with f.each(left, right, some=False) as x:
                f.store("f32.store", start + (x << 2), value)
            with f.each(ZERO, const("i32", 4 * memory.width), 4) as x:
                f.set(alive, alive | (word(start + x) << 1))
            self.close_line(f, field, line, start, alive)
        return f
