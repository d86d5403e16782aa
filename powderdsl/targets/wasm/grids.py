"""What an instance makes once, when it learns the number of rows: sizes, constant planes, tables."""

from __future__ import annotations

from powderdsl.targets.wasm.binary import Callee, Function, Value, const, load, op, vector
from powderdsl.targets.wasm.library import GOLDEN, STILL, SWAPPED, ZERO, Library, counted, either
from powderdsl.targets.wasm.memory import HALOED, HEADER, LANES, SOME, WORD


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
        """What the four hashes of a vector differ by: a word of a lane has two, and strips continue each other.

        Args:
            rows: of a strip; 0 if lanes are worlds.
        """
        strip = f.let(rows * (-(-self.memory.width // 32) * 32 * GOLDEN))
        for number in range(4):
            hashes = strip * (number // 2) + number % 2 * 32 * GOLDEN
            f.store("i32.store", ZERO, hashes, self.memory.at("apart") + 4 * number)

    def _filled(self, f: Function, plane: Value, rows: Value) -> None:
        """All flags of the rows."""
        memory = self.memory
        with f.each(ZERO, rows * memory.row, 8 * LANES) as at, f.scope():
            last = (at % memory.row).equals(memory.row - 8 * LANES)
            full, rest = (
                const("v128", (1 << min(WORD, memory.width - WORD * w)) - 1) for w in (0, memory.words - 1)
            )
            f.store("v128.store", plane + at, either(last, rest, full), memory.base)

    def _beyond(self, f: Function, plane: Value, rows: Value) -> None:
        """In the halo, the rows of the other strip: the lower one lies below the upper one, and around it nothing."""
        memory, library = self.memory, self.library
        size = memory.extent.around * memory.row
        if not size:
            return
        with f.when(library.strips.value), f.each(ZERO, const("i32", size), 8 * LANES) as at, f.scope():
            below = rows * memory.row + at
            same = load("i64.load", plane + at % memory.row, memory.base)
            f.store("i64.store", plane + at, same, HEADER + 8)
            f.store("i64.store", plane + below, same, memory.base)

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
            with f.each(ZERO, const("i32", LANES)) as lane, f.each(ZERO, library.rows.value) as y:
                row = f.let(y + strips_rows * lane)
                with f.each(ZERO, const("i32", memory.width)) as x, f.scope():
                    if kind == 2:
                        within = (row + a) < library.world_rows.value
                        flag = within & ((x + b) < memory.width)
                    else:
                        flag = (((x if kind else row) % a) >> b) & 1
                    at = f.let(plane + y * memory.row + ((x >> 6) << 4) + (lane << 3))
                    bit = counted(flag) << counted(x & 63)
                    f.store("i64.store", at, load("i64.load", at, memory.base) | bit, memory.base)
