"""What an instance makes once, when it learns the number of rows: sizes, constant planes, tables."""

from __future__ import annotations

from powderdsl.targets.machine.functions import Callee, Function, Value, const, op
from powderdsl.targets.machine.library import GOLDEN, ZERO, Library, either
from powderdsl.targets.machine.memory import HALOED, HEADER, SOME


class Grid:
    """Makes the function that prepares an instance for worlds of some rows."""

    def __init__(self, library: Library):
        self.library, self.memory, self.layout = library, library.memory, library.memory.layout

    def setup(self) -> Callee:
        """Rows of a world, and whether the lanes are strips."""
        f, library, memory = self.library.function("i32 i32"), self.library, self.memory
        height, strips = f.param(0), f.param(1)
        f.set(library.world_rows, height)
        f.set(library.strips, strips)
        shape = memory.shape
        f.set(library.rows, either(strips, height >> shape.lanes.bit_length() - 1, height))
        rows = f.let(library.rows.value)
        f.set(library.lines, rows * shape.lanes)
        lines = f.let(library.lines.value)
        f.set(library.cells, rows * memory.row)
        f.set(library.plane_size, rows * memory.row + (memory.base + memory.extent.around * memory.row))
        f.set(library.live_size, (lines + 16) & ~15)
        f.set(library.field_size, library.live_size.value + lines * (4 * memory.stride) + (HEADER + 64 & ~15))
        turned = op("i32x4.splat", ZERO - strips)
        f.store("v128.store", ZERO, turned, memory.at("turn"))
        self._apart(f, either(strips, rows, ZERO))
        for plane in (library.nothing, library.everything, library.inside):
            f.set(plane, library.take())
        f.store("i32.store", library.nothing.value, const("i32", 1), HALOED)
        for plane in (library.everything, library.inside):
            self._filled(f, plane.value, rows)
        self._beyond(f, library.inside.value, rows)
        f.store("i32.store", library.everything.value, const("i32", 1), SOME)
        f.set(library.calm, library.take_field())
        f.set(library.zeros, library.bump(const("i32", 4 * memory.stride + 64 & ~15)) + 4 * memory.halo)
        f.store("i32.store", const("i32", memory.at("rows")), library.bump((rows << 2) + 31 & ~15))
        columns = const("i32", memory.at("columns") + 4 * memory.halo)
        with f.each(ZERO, const("i32", 4 * memory.width), 4) as at:
            f.store("i32.store", columns + at, const("i32", -1))
        for dy in range(-memory.extent.lines, memory.extent.lines + 1):
            for wraps in (True, False):
                self._line_table(f, dy, wraps)
        for (kind, a, b), number in self.layout.fixed.items():
            self._fixed(f, kind, a, b, memory.at("fixed", number, 4))
        return library.module.add(f, "setup")

    def _apart(self, f: Function, rows: Value) -> None:
        """What the hashes of lanes differ by: strips continue each other, and a word of 64 bits has two hashes.

        Args:
            rows: of a strip; 0 if lanes are worlds.
        """
        shape, across = self.memory.shape, -(-self.memory.width // 32)
        strip = f.let(rows * (across * 32 * GOLDEN))
        with f.each(ZERO, const("i32", shape.vector), 4) as at:
            hashes = strip * (at // shape.lane)
            if shape.word == 64:
                hashes = hashes + ((at >> 2) & 1) * (32 * GOLDEN)
            f.store("i32.store", at, hashes, self.memory.at("apart"))

    def _filled(self, f: Function, plane: Value, rows: Value) -> None:
        """All flags of the rows."""
        memory = self.memory
        shape = memory.shape
        with f.each(ZERO, rows * memory.row, shape.vector) as at, f.scope():
            last = (at % memory.row).equals(memory.row - shape.vector)
            full, rest = (
                self.library.flags((1 << min(shape.word, memory.width - shape.word * w)) - 1)
                for w in (0, memory.words - 1)
            )
            f.store("v128.store", plane + at, either(last, rest, full), memory.base)

    def _beyond(self, f: Function, plane: Value, rows: Value) -> None:
        """In the halo, the rows of other strips: each but the first has one above it, each but the last one below it."""
        memory, library, shape = self.memory, self.library, self.memory.shape
        size = memory.extent.around * memory.row
        if not size:
            return
        with f.when(library.strips.value), f.each(ZERO, const("i32", size), shape.vector) as at, f.scope():
            above, below = plane + at, plane + rows * memory.row + at
            flags = f.let(library.lane_word(plane + at % memory.row, memory.base))
            for lane in range(1, shape.lanes):
                place = shape.lane * lane
                f.store(f"{shape.scalar}.store", above, flags, memory.base - size + place)
                f.store(f"{shape.scalar}.store", below, flags, memory.base + place - shape.lane)

    def _line_table(self, f: Function, dy: int, wraps: bool) -> None:
        library = self.library
        lines = library.lines.value
        with f.scope():
            table = f.let(library.bump((lines << 2) + 15 & ~15))
            f.store("i32.store", const("i32", self.memory.table(dy, wraps=wraps)), table)
            height = f.let(library.world_rows.value)
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
            with (
                f.each(ZERO, const("i32", memory.shape.lanes)) as lane,
                f.each(ZERO, library.rows.value) as y,
            ):
                row = f.let(y + strips_rows * lane)
                with f.each(ZERO, const("i32", memory.width)) as x, f.scope():
                    if kind == 2:
                        within = (row + a) < library.world_rows.value
                        flag = within & ((x + b) < memory.width)
                    else:
                        flag = (((x if kind else row) % a) >> b) & 1
                    at = f.let(plane + y * memory.row + library.word_place(x) + lane * memory.shape.lane)
                    bit = library.as_word(flag) << library.as_word(x & memory.shape.word - 1)
                    kept = library.lane_word(at, memory.base)
                    f.store(f"{memory.shape.scalar}.store", at, kept | bit, memory.base)
