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

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from powderdsl.ir.ops import REAL, Program
from powderdsl.targets.wasm.binary import Callee, Function, Local, Value, const, load, op, vector
from powderdsl.targets.wasm.library import GOLDEN, STILL, SWAPPED, ZERO, Library, either, integers, word
from powderdsl.targets.wasm.memory import HALOED, HEADER, LANES, NEXT, SOME, WORD

WORLDS, GROUPS, SIZE = 0, 4, 12
"""Where a batch keeps its numbers."""

LARGE_PLANE = 32 << 10
"""Bytes of a plane of two worlds from which it is too large to be kept near."""


def counted(value: Value) -> Value:
    return op("i64.extend_i32_u", value)


@dataclass
class Driver:
    """Adds the functions that a host calls."""

    library: Library
    program: Program
    """On bit planes."""
    passes: Sequence[Callee]
    asked: int
    """The ids whose presence passes ask for."""

    def __post_init__(self) -> None:
        self.memory, self.layout, self.module = self.library.memory, self.library.memory.layout, self.library.module
        self.world_rows = self.module.variable("i32")
        self.scratch = self.module.variable("i32")
        self.scratch_end = self.module.variable("i32")

    def add(self) -> None:
        setup = self._setup()
        self._export(self._allocate(setup), "allocate")
        allocate = self.allocate
        self._export(self._release(), "release")
        self._export(self._copy(allocate), "copy")
        self._export(self._scratch(), "scratch")
        self._export(self._inputs(), "inputs")
        self._export(self._run(), "run")
        self._export(self._load(), "load")
        self._export(self._store(), "store")
        self._export(self._load_real(), "load_real")
        self._export(self._store_real(), "store_real")
        self._export(self._fill(), "fill")
        self._export(self._fill_real(), "fill_real")

    def _export(self, function: Function, name: str) -> None:
        made = self.module.add(function, name, export=True)
        if name == "allocate":
            self.allocate = made

    # Grids

    def _setup(self) -> Callee:
        """Rows of a world, and whether the lanes are strips."""
        f, library, memory = self.library.function("i32 i32"), self.library, self.memory
        height, strips = f.param(0), f.param(1)
        f.set(self.world_rows, height)
        f.set(library.strips, strips)
        f.set(library.rows, height >> strips)
        rows = f.let(library.rows.value)
        f.set(library.lines, rows << 1)
        lines = f.let(library.lines.value)
        f.set(library.cells, rows * memory.row)
        f.set(library.plane_size, rows * memory.row + (memory.base + memory.extent.around * memory.row))
        f.set(library.live_size, (lines + 16) & ~15)
        f.set(library.field_size, library.live_size.value + lines * (4 * memory.stride) + (HEADER + 64 & ~15))
        turn = const("i32", memory.at("turn"))
        with f.when(strips):
            f.store("v128.store", turn, vector(SWAPPED))
            f.otherwise()
            f.store("v128.store", turn, vector(STILL))
        for plane in (library.nothing, library.everything, library.inside):
            f.set(plane, library.take())
        f.store("i32.store", library.nothing.value, const("i32", 1), HALOED)
        for plane in (library.everything, library.inside):
            self._filled(f, plane.value, rows)
        f.store("i32.store", library.everything.value, const("i32", 1), SOME)
        f.set(library.calm, library.take_field())
        f.set(library.zeros, library.bump(const("i32", 4 * memory.stride + 64 & ~15)) + 4 * memory.halo)
        columns = const("i32", memory.at("columns") + 4 * memory.halo)
        with f.each(ZERO, const("i32", 4 * memory.width), 4) as at:
            f.store("i32.store", columns + at, const("i32", -1))
        for dy in range(-memory.extent.lines, memory.extent.lines + 1):
            for wraps in (True, False):
                self._line_table(f, dy, wraps)
        for (kind, a, b), number in self.layout.fixed.items():
            self._fixed(f, kind, a, b, memory.at("fixed", number, 4))
        return self.module.add(f, "setup")

    def _filled(self, f: Function, plane: Value, rows: Value) -> None:
        """All flags of the rows; of `inside`, also those of rows in the other strip."""
        memory, around = self.memory, self.memory.extent.around
        inside = plane.code == self.library.inside.value.code
        first = -around * memory.row if inside else 0
        with f.each(ZERO, rows * memory.row + 2 * -first, 16) as at, f.scope():
            w = (at % memory.row) >> 4
            valid = [(1 << min(WORD, memory.width - WORD * i)) - 1 for i in (0, memory.words - 1)]
            last = w.equals(memory.words - 1)
            found = f.let(either(last, const("i64", valid[1]), const("i64", valid[0])))
            for lane in range(LANES):
                kept = found
                if inside:
                    above, below = at < -first, at >= rows * memory.row - first
                    out = above | (below if lane else const("i32", 0)) if not lane else below
                    out = above if lane == 0 else below
                    other = (below if lane == 0 else above) & self.library.strips.value.equals(0)
                    kept = either(out | other, const("i64", 0), found)
                f.store("i64.store", plane + at, kept, memory.base + first + 8 * lane)

    def _line_table(self, f: Function, dy: int, wraps: bool) -> None:
        library = self.library
        lines = library.lines.value
        with f.scope():
            table = f.let(library.bump((lines << 2) + 15 & ~15))
            f.store("i32.store", const("i32", self.memory.table(dy, wraps=wraps)), table)
            height = f.let(self.world_rows.value)
            with f.each(ZERO, lines) as line:
                y = f.let(line % height)
                other = f.let(y + dy)
                if wraps:
                    f.set(other, op("i32.rem_s", other, height))
                    f.set(other, either(op("i32.lt_s", other, ZERO), other + height, other))
                    found = line - y + other
                else:
                    found = either(other < height, line - y + other, lines)
                f.store("i32.store", table + (line << 2), found)

    def _fixed(self, f: Function, kind: int, a: int, b: int, place: int) -> None:
        """A plane of a bit of coordinates (0: rows, 1: columns; modulus, bit), or of `inside` (rows, columns)."""
        library, memory = self.library, self.memory
        with f.scope():
            plane = f.let(library.take())
            f.store("i32.store", const("i32", place), plane)
            f.store("i32.store", plane, const("i32", 1), SOME)
            strips_rows = f.let(either(library.strips.value, library.rows.value, ZERO))
            with self.lanes(f) as lane:
                with f.each(ZERO, library.rows.value) as y:
                    row = f.let(y + strips_rows * lane)
                    with f.each(ZERO, const("i32", memory.width)) as x, f.scope():
                        if kind == 2:
                            within = (row + a) < self.world_rows.value
                            flag = within & ((x + b) < memory.width)
                        else:
                            flag = (((x if kind else row) % a) >> b) & 1
                        at = f.let(plane + y * memory.row + ((x >> 6) << 4) + (lane << 3))
                        bit = counted(flag) << counted(x & 63)
                        f.store("i64.store", at, load("i64.load", at, memory.base) | bit, memory.base)

    @contextmanager
    def lanes(self, f: Function) -> Iterator[Local]:
        with f.each(ZERO, const("i32", LANES)) as lane:
            yield lane

    # Batches

    def clock(self, batch: Value, what: int, world: Value) -> Value:
        """Where seed, index or step of a world lies."""
        return batch + ((word(batch, WORLDS) * what + world) << 3) + HEADER

    def bits(self, batch: Value) -> Value:
        return batch + word(batch, WORLDS) * 24 + HEADER

    def values(self, batch: Value) -> Value:
        return (self.bits(batch) + word(batch, WORLDS) * len(self.layout.param_planes) + 15) & ~15

    def groups(self, batch: Value) -> Value:
        return (self.values(batch) + word(batch, WORLDS) * (4 * len(self.layout.param_reals)) + 15) & ~15

    def _allocate(self, setup: Callee) -> Function:
        f, library, memory = self.library.function("i32 i32", "i32"), self.library, self.memory
        worlds, rows = f.param(0), f.param(1)
        with f.when(self.world_rows.value.equals(0)):
            even = (rows & 1).equals(0)
            reachable = (rows >> 1) >= max(1, memory.extent.around)
            few = worlds.equals(1) | ((rows * memory.row) >= LARGE_PLANE)
            f.do(setup(rows, even & reachable & few))
            f.otherwise()
            with f.when(op("i32.ne", self.world_rows.value, rows)):
                f.trap()
        count = f.let((worlds + 1) >> op("i32.eqz", library.strips.value))
        f.set(count, either(library.strips.value, worlds, count))
        per_world = 24 + len(self.layout.param_planes) + 4 * len(self.layout.param_reals)
        size = f.let((worlds * per_world + count * memory.group + (HEADER + 32 + 15)) & ~15)
        before, batch = f.let(ZERO), f.let(library.batches.value)
        with f.block() as found:
            with f.block() as missing, f.loop() as again:
                f.jump(missing, op("i32.eqz", batch))
                with f.when(word(batch, SIZE).equals(size)):
                    with f.when(before):
                        f.store("i32.store", before, word(batch, 8), 8)
                        f.otherwise()
                        f.set(library.batches, word(batch, 8))
                    f.jump(found)
                f.set(before, batch)
                f.set(batch, word(batch, 8))
                f.jump(again)
            f.set(batch, library.bump(size))
        for at, value in ((WORLDS, worlds), (GROUPS, count), (SIZE, size)):
            f.store("i32.store", batch, value, at)
        with self.each_group(f, batch) as group:
            for i in range(len(self.layout.planes)):
                f.store("i32.store", group, library.keep(library.nothing.value), 4 * i)
            for i in range(len(self.layout.planes), len(self.layout.planes) + len(self.layout.reals)):
                f.store("i32.store", group, library.keep(library.calm.value), 4 * i)
            f.store("i64.store", group, const("i64", -1), memory.present)
        f.give(batch)
        return f

    @contextmanager
    def each_group(self, f: Function, batch: Value) -> Iterator[Local]:
        group = f.let(self.groups(batch))
        stop = f.let(group + word(batch, GROUPS) * self.memory.group)
        with f.each(group, stop, self.memory.group) as one:
            yield one

    def _release(self) -> Function:
        f, library = self.library.function("i32"), self.library
        batch = f.param(0)
        with self.each_group(f, batch) as group:
            for at, real in self.slots():
                f.do((library.give_field if real else library.give)(word(group, at)))
        f.store("i32.store", batch, library.batches.value, 8)
        f.set(library.batches, batch)
        return f

    def slots(self) -> list[tuple[int, bool]]:
        """Where a group keeps its slots, and whether they are fields."""
        planes = len(self.layout.planes)
        return [(4 * i, i >= planes) for i in range(planes + len(self.layout.reals))]

    def _copy(self, allocate: Callee) -> Function:
        f, library = self.library.function("i32", "i32"), self.library
        old = f.param(0)
        new = f.let(allocate(word(old, WORLDS), self.world_rows.value))
        begin = const("i32", HEADER)
        f.body += (new + begin).code + (old + begin).code
        f.body += (self.groups(old) - old - HEADER).code + op("memory.copy", tail=b"\0\0").code
        apart = f.let(new - old)
        with self.each_group(f, old) as group:
            for at, real in self.slots():
                f.do((library.give_field if real else library.give)(word(group + apart, at)))
                f.store("i32.store", group + apart, library.keep(word(group, at)), at)
            present = load("i64.load", group, self.memory.present)
            f.store("i64.store", group + apart, present, self.memory.present)
        f.give(new)
        return f

    def _scratch(self) -> Function:
        f = self.library.function("i32", "i32")
        with f.when(self.scratch_end.value < self.scratch.value + f.param(0)):
            size = f.let((f.param(0) + 79) & ~15)
            f.set(self.scratch, self.library.bump(size))
            f.set(self.scratch_end, self.scratch.value + size - 64)
        f.give(self.scratch.value)
        return f

    def _inputs(self) -> Function:
        f = self.library.function("i32", "i32")
        f.give(f.param(0) + HEADER)
        return f

    # Steps

    def _run(self) -> Function:
        f, library, memory = self.library.function("i32 i32"), self.library, self.memory
        batch, steps = f.param(0), f.param(1)
        begin = self._begin()
        number = f.let(ZERO)
        with f.block() as nothing:
            f.jump(nothing, op("i32.eqz", steps))
            with self.each_group(f, batch) as group:
                f.set(library.group, group)
                f.set(library.present, load("i64.load", group, memory.present))
                self._parameters(f, batch, number)
                with f.each(ZERO, steps) as step:
                    f.do(begin(batch, number, step))
                    self._reset(f)
                    look = self._look()
                    if look is not None:
                        with f.when(op("i64.eq", library.present.value, const("i64", -1))):
                            f.do(look())
                    for one in self.passes:
                        f.do(one())
                f.store("i64.store", group, library.present.value, memory.present)
                f.set(number, number + 1)
        with f.each(ZERO, word(batch, WORLDS), some=False) as world:
            at = f.let(self.clock(batch, 2, world))
            f.store("i64.store", at, load("i64.load", at) + counted(steps))
        return f

    def world_of(self, f: Function, batch: Value, number: Value, lane: int) -> Local:
        """The world of a lane; unused lanes are the last world once more."""
        strips, last = self.library.strips.value, word(batch, WORLDS) - 1
        pair = f.let((number << 1) + lane)
        return f.let(either(strips, number, either(pair < last, pair, last)))

    def _parameters(self, f: Function, batch: Value, number: Value) -> None:
        layout, memory = self.layout, self.memory
        with f.scope():
            worlds = f.let(word(batch, WORLDS))
            for lane in range(LANES):
                world = self.world_of(f, batch, number, lane)
                bits, values = f.let(self.bits(batch) + world), f.let(self.values(batch) + (world << 2))
                place = f.let(const("i32", memory.at("params") + 8 * lane))
                for _ in layout.param_planes:
                    set_ = const("i64", 0)
                    set_ = op("i64.sub", set_, counted(load("i32.load8_u", bits)))
                    f.store("i64.store", place, set_)
                    f.set(bits, bits + worlds)
                    f.set(place, place + 16)
                for i in range(len(layout.param_reals)):
                    f.store("i32.store", const("i32", memory.at("reals", i, 8) + 4 * lane), word(values))
                    f.set(values, values + (worlds << 2))

    def _begin(self) -> Callee:
        """Keys and bits of a step: batch, number of the group, steps that are done."""
        f, library, memory = self.library.function("i32 i32 i32"), self.library, self.memory
        batch, number, done = (f.param(i) for i in range(3))
        strip = f.let(either(library.strips.value, library.rows.value, ZERO) * (-(-memory.width // 32) * 32))
        for lane in range(LANES):
            with f.scope():
                world = self.world_of(f, batch, number, lane)
                seed, index, start = (f.let(load("i64.load", self.clock(batch, i, world))) for i in range(3))
                step = f.let(start + counted(done))
                for name, ident, _ in self.program.streams:
                    keys = memory.at("keys", self.layout.streams[name], 32) + 8 * lane
                    first, second = library.key(
                        seed, op("i32.wrap_i64", index), op("i32.wrap_i64", step), ident
                    )
                    first = f.let(first + strip * lane * GOLDEN if lane else first)
                    second = f.let(second)
                    place = const("i32", keys)
                    f.store("i32.store", place, first)
                    f.store("i32.store", place, first + (32 * GOLDEN & 0xFFFFFFFF), 4)
                    f.store("i32.store", place, second, 16)
                    f.store("i32.store", place, second, 20)
                for (modulus, bit), i in self.layout.step_planes.items():
                    flag = (op("i64.rem_u", step, const("i64", modulus)) >> bit) & 1
                    f.store("i64.store", const("i32", memory.at("steps", i) + 8 * lane), op("i64.sub", const("i64", 0), flag))
        for i in range(len(self.layout.streams)):
            with f.scope():
                place = const("i32", memory.at("coins", i, 4))
                old = f.let(word(place))
                with f.when(old):
                    f.do(library.give(old))
                    f.store("i32.store", place, ZERO)
        return self.module.add(f, "begin")

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
        return self.module.add(f, "constant_field")

    def _look(self) -> Callee | None:
        """Finds which of the ids in `asked` are present, from products of their low and high bits."""
        library, memory = self.library, self.memory
        names = [name for name in self.layout.planes if name.startswith("element:")]
        ids = [code for code in range(1 << len(names)) if self.asked >> code & 1]
        if not ids:
            return None
        f = library.function()
        planes = [f.let(word(library.group.value, memory.slot(f"element:{i}", None))) for i in range(len(names))]
        found = {code: f.let(const("v128", 0)) for code in ids}
        low = len(names) // 2

        def products(bits: Sequence[Value]) -> list[Local]:
            made = [f.let(const("v128", -1))]
            for i, bit in enumerate(bits):
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
        return self.module.add(f, "look")

    # Cells in and out

    @contextmanager
    def each_lane(self, f: Function, batch: Value) -> Iterator[tuple[Local, Local, Local, Local]]:
        """Group, lane, world, and the world's row at which the lane begins, of all lanes that are used."""
        strips = self.library.strips.value
        number = f.let(ZERO)
        with self.each_group(f, batch) as group, self.lanes_then(f, number) as lane:
            world = f.let(either(strips, number, (number << 1) + lane))
            top = f.let(either(strips, lane * self.library.rows.value, ZERO))
            with f.when(world < word(batch, WORLDS)):
                yield group, lane, world, top

    @contextmanager
    def lanes_then(self, f: Function, number: Local) -> Iterator[Local]:
        with self.lanes(f) as lane:
            yield lane
        f.set(number, number + 1)

    def cell(self, address: Value, size: Value) -> Value:
        wide = either(size.equals(2), load("i32.load16_u", address), word(address))
        return either(size.equals(1), load("i32.load8_u", address), wide)

    def _load(self) -> Function:
        f, library, memory = self.library.function("i32 i32 i32 i32 i32"), self.library, self.memory
        batch, slot, planes, size, address = (f.param(i) for i in range(5))
        with self.each_group(f, batch) as group:
            f.store("i64.store", group, const("i64", -1), memory.present)
            with f.each(ZERO, planes) as bit:
                at = f.let(group + ((slot + bit) << 2))
                f.do(library.give(word(at)))
                plane = f.let(library.take())
                f.store("i32.store", at, plane)
                fill = (plane + memory.base).code + ZERO.code + library.cells.value.code
                f.body += fill + op("memory.fill", tail=b"\0").code
        with self.each_lane(f, batch) as (group, lane, world, top):
            start = world * self.world_rows.value + top
            source = f.let(address + start * size * memory.width)
            with self.each_run(f) as (at, count):
                with f.each(ZERO, planes) as bit:
                    plane = f.let(word(group + ((slot + bit) << 2)))
                    found = f.let(const("i64", 0))
                    with f.each(ZERO, count) as x:
                        flag = (self.cell(source + x * size, size) >> bit) & 1
                        f.set(found, found | (counted(flag) << counted(x)))
                    f.store("i64.store", plane + at + (lane << 3), found, memory.base)
                    f.store("i32.store", plane, word(plane, SOME) | op("i64.ne", found, const("i64", 0)), SOME)
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

    def _store(self) -> Function:
        f, memory = self.library.function("i32 i32 i32 i32 i32 i32"), self.memory
        batch, slot, planes, negative, size, address = (f.param(i) for i in range(6))
        with self.each_lane(f, batch) as (group, lane, world, top):
            start = world * self.world_rows.value + top
            target = f.let(address + start * size * memory.width)
            with self.each_run(f) as (at, count), f.each(ZERO, count) as x:
                value, place = f.let(ZERO), f.let(at + (lane << 3))
                with f.each(ZERO, planes) as bit:
                    plane = word(group + ((slot + bit) << 2))
                    flag = (load("i64.load", plane + place, memory.base) >> counted(x)) & 1
                    flag = op("i32.wrap_i64", flag)
                    last = negative & bit.equals(planes - 1)
                    f.set(value, value + (either(last, ZERO - flag, flag) << bit))
                with f.when(size.equals(1)):
                    f.store("i32.store8", target, value)
                    f.otherwise()
                    with f.when(size.equals(2)):
                        f.store("i32.store16", target, value)
                        f.otherwise()
                        f.store("i32.store", target, value)
                f.set(target, target + size)
        return f

    def _load_real(self) -> Function:
        f, library, memory = self.library.function("i32 i32 i32 i32"), self.library, self.memory
        batch, slot, address, apart = (f.param(i) for i in range(4))
        f.set(slot, slot + len(self.layout.planes))
        with self.each_group(f, batch) as group:
            at = f.let(group + (slot << 2))
            f.do(library.give_field(word(at)))
            field = f.let(library.take_field())
            f.store("i32.store", at, field)
            fill = (field + HEADER).code + ZERO.code + library.live_size.value.code
            f.body += fill + op("memory.fill", tail=b"\0").code
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

    def _store_real(self) -> Function:
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
    def each_box_row(self, f: Function, batch: Value, world: Value, top: Value, bottom: Value) -> Iterator[tuple[Local, Local, Local]]:
        """Group, lane and row of the lane, for the rows of a box in a world."""
        rows, strips = self.library.rows.value, self.library.strips.value
        with f.each(top, bottom, some=False) as y:
            lane = f.let(either(strips, y // rows, world & 1))
            number = either(strips, world, world >> 1)
            group = f.let(self.groups(batch) + number * self.memory.group)
            yield group, lane, f.let(either(strips, y % rows, y))

    def _fill(self) -> Function:
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

    def _fill_real(self) -> Function:
        f, library, memory = self.library.function("i32 " * 7 + "f32"), self.library, self.memory
        batch, world, slot, top, bottom, left, right, value = (f.param(i) for i in range(8))
        own = self._own_field()
        f.set(slot, slot + len(self.layout.planes))
        with self.each_box_row(f, batch, world, top, bottom) as (group, lane, y):
            at = f.let(group + (slot << 2))
            field = f.let(own(word(at)))
            f.store("i32.store", at, field)
            line = f.let(lane * library.rows.value + y)
            start, alive = f.let(library.line_start(field, line)), f.let(ZERO)
            with f.when(op("i32.eqz", load("i32.load8_u", field + line, HEADER))):
                fill = start.code + ZERO.code + const("i32", 4 * memory.width).code
                f.body += fill + op("memory.fill", tail=b"\0").code
            with f.each(left, right, some=False) as x:
                f.store("f32.store", start + (x << 2), value)
            with f.each(ZERO, const("i32", 4 * memory.width), 4) as x:
                f.set(alive, alive | (word(start + x) << 1))
            self.close_line(f, field, line, start, alive)
        return f

    def _own_field(self) -> Callee:
        f, library = self.library.function("i32", "i32"), self.library
        old = f.param(0)
        with f.when(word(old).equals(1)):
            f.give(old)
        new = f.let(library.take_field())
        f.body += (new + HEADER).code + (old + HEADER).code
        f.body += (library.field_size.value - HEADER).code + op("memory.copy", tail=b"\0\0").code
        f.store("i32.store", new, word(old, SOME), SOME)
        f.do(library.give_field(old))
        f.give(new)
        return self.module.add(f, "own_field")


__all__ = ["Driver", "integers", "NEXT"]
