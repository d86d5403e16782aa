"""Batches of worlds: where their parts lie, and the functions that make, copy and release them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from powderdsl.targets.wasm.binary import Callee, Function, Local, Value, const, load, op
from powderdsl.targets.wasm.library import ZERO, Library, either, word
from powderdsl.targets.wasm.memory import HEADER, LANES

WORLDS, GROUPS, NEXT, SIZE = 0, 4, 8, 12
"""Where a batch keeps its numbers."""

LARGE_PLANE = 32 << 10
"""Bytes of a plane of two worlds from which it is too large to be kept near."""


class Batches:
    """Code that finds the parts of batches."""

    def __init__(self, library: Library):
        self.library, self.memory, self.layout = library, library.memory, library.memory.layout

    def clock(self, batch: Value, what: int, world: Value) -> Value:
        """Where seed, index or step of a world lies."""
        return batch + ((word(batch, WORLDS) * what + world) << 3) + HEADER

    def bits(self, batch: Value) -> Value:
        return batch + word(batch, WORLDS) * 24 + HEADER

    def values(self, batch: Value) -> Value:
        return (self.bits(batch) + word(batch, WORLDS) * len(self.layout.param_planes) + 15) & ~15

    def groups(self, batch: Value) -> Value:
        return (self.values(batch) + word(batch, WORLDS) * (4 * len(self.layout.param_reals)) + 15) & ~15

    def allocate(self, setup: Callee) -> Function:
        f, library, memory = self.library.function("i32 i32", "i32"), self.library, self.memory
        worlds, rows = f.param(0), f.param(1)
        per_world = 24 + len(self.layout.param_planes) + 4 * len(self.layout.param_reals)
        library.trap_from(f, worlds, per_world + memory.group)
        library.trap_from(f, rows, 8 * memory.stride + memory.row)
        with f.when(library.world_rows.value.equals(0)):
            even = (rows & 1).equals(0)
            reachable = (rows >> 1) >= max(1, memory.extent.around)
            few = worlds.equals(1) | ((rows * memory.row) >= LARGE_PLANE)
            f.do(setup(rows, even & reachable & few))
            f.otherwise()
            with f.when(op("i32.ne", library.world_rows.value, rows)):
                f.trap()
        count = f.let((worlds + 1) >> op("i32.eqz", library.strips.value))
        f.set(count, either(library.strips.value, worlds, count))
        size = f.let((worlds * per_world + count * memory.group + (HEADER + 32 + 15)) & ~15)
        before, batch = f.let(ZERO), f.let(library.batches.value)
        with f.block() as found:
            with f.block() as missing, f.loop() as again:
                f.jump(missing, op("i32.eqz", batch))
                with f.when(word(batch, SIZE).equals(size)):
                    with f.when(before):
                        f.store("i32.store", before, word(batch, NEXT), NEXT)
                        f.otherwise()
                        f.set(library.batches, word(batch, NEXT))
                    f.jump(found)
                f.set(before, batch)
                f.set(batch, word(batch, NEXT))
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

    def release(self) -> Function:
        f, library = self.library.function("i32"), self.library
        batch = f.param(0)
        with self.each_group(f, batch) as group:
            for at, real in self.slots():
                f.do((library.give_field if real else library.give)(word(group, at)))
        f.store("i32.store", batch, library.batches.value, NEXT)
        f.set(library.batches, batch)
        return f

    def slots(self) -> list[tuple[int, bool]]:
        """Where a group keeps its slots, and whether they are fields."""
        planes = len(self.layout.planes)
        return [(4 * i, i >= planes) for i in range(planes + len(self.layout.reals))]

    def copy(self, allocate: Callee) -> Function:
        f, library = self.library.function("i32", "i32"), self.library
        old = f.param(0)
        new = f.let(allocate(word(old, WORLDS), library.world_rows.value))
        begin = const("i32", HEADER)
        f.copy(new + begin, old + begin, self.groups(old) - old - HEADER)
        apart = f.let(new - old)
        with self.each_group(f, old) as group:
            for at, real in self.slots():
                f.do((library.give_field if real else library.give)(word(group + apart, at)))
                f.store("i32.store", group + apart, library.keep(word(group, at)), at)
            present = load("i64.load", group, self.memory.present)
            f.store("i64.store", group + apart, present, self.memory.present)
        f.give(new)
        return f

    def scratch(self) -> Function:
        f, library = self.library.function("i32", "i32"), self.library
        library.trap_from(f, f.param(0), 1)
        with f.when(library.scratch_end.value < library.scratch.value + f.param(0)):
            size = f.let((f.param(0) + 79) & ~15)
            f.set(library.scratch, self.library.bump(size))
            f.set(library.scratch_end, library.scratch.value + size - 64)
        f.give(library.scratch.value)
        return f

    def inputs(self) -> Function:
        f = self.library.function("i32", "i32")
        f.give(f.param(0) + HEADER)
        return f

    @contextmanager
    def each_lane(self, f: Function, batch: Value) -> Iterator[tuple[Local, Local, Local, Local]]:
        """Group, lane, world, and the world's row at which the lane begins, of all lanes that are used."""
        strips = self.library.strips.value
        number = f.let(ZERO)
        with self.each_group(f, batch) as group, self._lanes(f, number) as lane:
            world = f.let(either(strips, number, (number << 1) + lane))
            top = f.let(either(strips, lane * self.library.rows.value, ZERO))
            with f.when(world < word(batch, WORLDS)):
                yield group, lane, world, top

    @contextmanager
    def _lanes(self, f: Function, number: Local) -> Iterator[Local]:
        with f.each(ZERO, const("i32", LANES)) as lane:
            yield lane
        f.set(number, number + 1)
