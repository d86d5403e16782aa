"""What generated passes call: memory for planes and fields, rows around the edges, draws."""

from __future__ import annotations

from collections.abc import Callable

from powderdsl.system.random import MASK
from powderdsl.targets.wasm.binary import Callee, Function, Local, Module, Value, const, load, op, vector
from powderdsl.targets.wasm.memory import HALOED, HEADER, NEXT, REFS, SOME, WORD, Memory

PAGE = 1 << 16
GOLDEN, FIRST, SECOND = 0x9E3779B1, 0x7FEB352D, 0x846CA68B
AHEAD = 4
"""Bits of a draw that are made together, since the multiplications of one wait for each other."""

STILL, SWAPPED = bytes(range(16)), bytes([*range(8, 16), *range(8)])
"""For `i8x16.swizzle`: the lanes as they are, and exchanged."""


def splat(number: Value) -> Value:
    """A vector of four equal i32."""
    return op("i32x4.splat", number)


def integers(number: int) -> Value:
    return vector((number & MASK).to_bytes(4, "little") * 4)


def some(flags: Value) -> Value:
    """Whether any bit of a vector is set."""
    return op("v128.any_true", flags)


def either(condition: Value, yes: Value, no: Value) -> Value:
    """A choice between two integers."""
    return Value(yes.type, yes.code + no.code + condition.code + op("select").code)


def choose(mask: Value, yes: Value, no: Value) -> Value:
    """A choice between the bits of two vectors."""
    return op("v128.bitselect", yes, no, mask)


def word(address: Value, offset: int = 0) -> Value:
    return load("i32.load", address, offset)


def counted(value: Value) -> Value:
    """An i32 as i64, unsigned."""
    return op("i64.extend_i32_u", value)


ZERO = const("i32", 0)


class Library:
    """The functions and variables of a module."""

    def __init__(self, memory: Memory, module: Module):
        self.memory, self.module = memory, module
        variable = module.variable
        self.top = variable("i32", memory.top)
        """Where memory that was never used begins."""
        self.planes, self.fields, self.batches = variable("i32"), variable("i32"), variable("i32")
        """The first plane, field and batch that is free."""
        self.rows, self.lines, self.cells = variable("i32"), variable("i32"), variable("i32")
        """Rows of a lane; lines of both lanes; bytes of the rows of a plane."""
        self.strips, self.plane_size, self.field_size = variable("i32"), variable("i32"), variable("i32")
        self.live_size = variable("i32")
        self.nothing, self.everything, self.inside = variable("i32"), variable("i32"), variable("i32")
        """Planes: without a flag, with all; with all, and in the halo those of rows that lie in the world."""
        self.calm, self.zeros, self.group = variable("i32"), variable("i32"), variable("i32")
        """A field without a live line; a line of zeros; the group that runs."""
        self.present = variable("i64")
        self.world_rows = variable("i32")
        """Rows of a world; 0 before the first batch."""
        self.scratch, self.scratch_end = variable("i32"), variable("i32")
        self.bump = self._bump()
        self.take = self._take("take", self.planes, self.plane_size.value)
        self.take_field = self._take("take_field", self.fields, self.field_size.value)
        self.give, self.give_field = self._give("give", self.planes), self._give("give_field", self.fields)
        self.keep = self._keep()
        self.own = self._own()
        self.own_field = self._own_field()
        self.edges = self._edges()
        self.mix = self._mix()
        self.draw_below, self.draw_below_planes = self._draw_below(), self._draw_below_planes()
        self.coin = self._coin()
        self.made: dict[object, Callee] = {}
        """Functions that are made when they are first needed, by what they do."""

    def function(self, params: str = "", results: str = "") -> Function:
        return Function(params.split(), results.split())

    def lazily(self, key: object, make: Callable[[], Callee]) -> Callee:
        if key not in self.made:
            self.made[key] = make()
        return self.made[key]

    # Memory

    def _bump(self) -> Callee:
        """New memory: bytes, a multiple of 16 → address. Traps where the module's limit is reached."""
        f = self.function("i32", "i32")
        place = f.let(self.top.value)
        with f.when(f.param(0) >= self.module.most * PAGE):
            f.trap()
        end = f.let(place + f.param(0))
        pages, size = f.let((end + (PAGE - 1)) >> 16), op("memory.size", tail=b"\0")
        with f.when(pages >= size + 1):
            grown = op("memory.grow", pages - size, tail=b"\0")
            with f.when(grown.equals(const("i32", -1))):
                f.trap()
        f.set(self.top, end)
        f.give(place)
        return self.module.add(f, "bump")

    def trap_from(self, f: Function, count: Value, size: int) -> None:
        """Trap if items of a size, together with as much again, do not fit into the memory."""
        bytes = counted(count) * size
        with f.when(bytes >= self.module.most * PAGE // 2):
            f.trap()

    def _take(self, name: str, free, size: Value) -> Callee:  # type: ignore[no-untyped-def]
        f = self.function("", "i32")
        found = f.let(free.value)
        with f.when(found):
            f.set(free, word(found, NEXT))
            f.otherwise()
            f.set(found, self.bump(size))
        f.store("i64.store", found, const("i64", 1), REFS)
        f.store("i32.store", found, ZERO, HALOED)
        f.give(found)
        return self.module.add(f, name)

    def _give(self, name: str, free) -> Callee:  # type: ignore[no-untyped-def]
        f = self.function("i32")
        given = f.param(0)
        left = f.let(word(given, REFS) - 1)
        f.store("i32.store", given, left, REFS)
        with f.when(left.equals(0)):
            f.store("i32.store", given, free.value, NEXT)
            f.set(free, given)
        return self.module.add(f, name)

    def _keep(self) -> Callee:
        """One more owner of a plane or field, which is the result."""
        f = self.function("i32", "i32")
        f.store("i32.store", f.param(0), word(f.param(0), REFS) + 1, REFS)
        f.give(f.param(0))
        return self.module.add(f, "keep")

    def _own(self) -> Callee:
        """A plane of this owner alone, to be written over."""
        f = self.function("i32", "i32")
        with f.when(word(f.param(0), REFS).equals(1)):
            f.store("i32.store", f.param(0), ZERO, HALOED)
            f.give(f.param(0))
        self._duplicate(f, self.take, self.give, self.memory.base, self.cells.value)
        return self.module.add(f, "own")

    def _own_field(self) -> Callee:
        """A field of this owner alone, to be written over."""
        f = self.function("i32", "i32")
        with f.when(word(f.param(0), REFS).equals(1)):
            f.give(f.param(0))
        self._duplicate(f, self.take_field, self.give_field, HEADER, self.field_size.value - HEADER)
        return self.module.add(f, "own_field")

    def _duplicate(self, f: Function, take: Callee, give: Callee, first: int, size: Value) -> None:
        """Return a copy of the plane or field that is the first parameter, whose owner gives it back."""
        old, new = f.param(0), f.let(take())
        start = const("i32", first)
        f.copy(new + start, old + start, size)
        f.store("i32.store", new, word(old, SOME), SOME)
        f.do(give(old))
        f.give(new)

    def some(self, held: Value) -> Value:
        """Whether a plane or field may hold anything."""
        return word(held, SOME)

    # Rows around the edges

    def turned(self, row: Value) -> Value:
        """A row of the lanes as those see it that lie beyond an edge: strips see the other strip."""
        return op("i8x16.swizzle", row, load("v128.load", ZERO, self.memory.at("turn")))

    def _edges(self) -> Callee:
        """To be called before rows above and below are read."""
        f = self.function("i32")
        plane, memory, rows = f.param(0), self.memory, self.rows.value
        with f.when(word(plane, HALOED)):
            f.leave()
        f.store("i32.store", plane, const("i32", 1), HALOED)
        around = memory.extent.around
        if around:
            with f.each(const("i32", 1), const("i32", around + 1)) as k:
                for target, source in (
                    (const("i32", around) - k, (rows * around - k) % rows),
                    (rows + (k + (around - 1)), (k - 1) % rows),
                ):
                    to, came = (f.let(plane + place * memory.row) for place in (target, source))
                    with f.each(ZERO, const("i32", memory.row), 16) as w:
                        seen = self.turned(load("v128.load", came + w, memory.base))
                        f.store("v128.store", to + w, seen, HEADER)
        return self.module.add(f, "edges")

    # Draws

    def _mix(self) -> Callee:
        """The finalizer of keys."""
        f = self.function("i32", "i32")
        x = f.param(0)
        for by, factor in ((16, FIRST), (15, SECOND)):
            f.set(x, x ^ (x >> by))
            f.set(x, x * factor)
        f.give(x ^ (x >> 16))
        return self.module.add(f, "mix")

    def mixed(self, f: Function, numbers: Value, key: Value | None = None) -> Local:
        """The finalizer of keys, on a vector; with a second key added between the multiplications, that of draws."""
        h = f.let(numbers)

        def fold(by: int) -> None:
            f.set(h, h ^ op("i32x4.shr_u", h, const("i32", by)))

        fold(16)
        f.set(h, op("i32x4.mul", h, integers(FIRST)))
        fold(15)
        f.set(h, op("i32x4.mul", op("i32x4.add", h, key) if key is not None else h, integers(SECOND)))
        fold(16)
        return h

    def drawn(self, f: Function, number: Value, keys: Value) -> Local:
        """A bit of the draws of a word: `number` is that of the word and bit times GOLDEN, with the first key."""
        return self.mixed(f, number, load("v128.load", keys, 16))

    def first_number(self, word_number: Value, keys: Value) -> Value:
        """What `drawn` takes for bit 0 of a word; `number` of the word in the hash."""
        return op("i32x4.add", splat(word_number * GOLDEN), load("v128.load", keys))

    def ahead(self, f: Function, number: Local, keys: Value, count: int) -> list[Local]:
        """The next bits of the draws of a word."""
        found = []
        for i in range(count):
            at = op("i32x4.add", number, integers(i * GOLDEN)) if i else number
            found.append(self.drawn(f, at, keys))
        f.set(number, op("i32x4.add", number, integers(count * GOLDEN)))
        return found

    def _draw_below(self) -> Callee:
        """Which of the wanted cells draw below a constant: number of the word, wanted, keys, the limit's bits from the
        highest. Of the cells still open, those whose draw has a 0 where the limit has a 1 are below it; equal bits leave
        a cell open.
        """
        f = self.function("i32 v128 i32 i64", "v128")
        at, wanted, keys, limit = (f.param(i) for i in range(4))
        number = f.let(self.first_number(at, keys))
        below = f.let(const("v128", 0))
        with f.block() as done, f.loop() as again:
            for drawn in self.ahead(f, number, keys, AHEAD):
                wants = f.let(op("i64x2.splat", op("i64.shr_s", limit, const("i64", 63))))
                self._compare(f, below, wanted, drawn, wants)
                f.set(limit, limit << 1)
            f.jump(done, limit.equals(0))
            f.jump(again, some(wanted))
        f.give(below)
        return self.module.add(f, "draw_below")

    def _compare(self, f: Function, below: Local, still_open: Local, drawn: Value, limit: Value) -> None:
        f.set(below, below | op("v128.andnot", still_open & limit, drawn))
        f.set(still_open, op("v128.andnot", still_open, limit ^ drawn))

    def _draw_below_planes(self) -> Callee:
        """The same with a limit given plane by plane: number, wanted, keys, the limit's address, its end."""
        f = self.function("i32 v128 i32 i32 i32", "v128")
        at, wanted, keys, limit, end = (f.param(i) for i in range(5))
        number = f.let(self.first_number(at, keys))
        below = f.let(wanted & load("v128.load", limit))
        f.set(wanted, op("v128.andnot", wanted, load("v128.load", limit)))
        with f.block() as done:
            for count in (AHEAD, 1):
                with f.block() as out, f.loop() as again:
                    f.jump(out, end < limit + 16 * (count + 1))
                    f.jump(done, some(wanted).equals(0))
                    with f.scope():
                        for i, drawn in enumerate(self.ahead(f, number, keys, count)):
                            self._compare(f, below, wanted, drawn, load("v128.load", limit, 16 * (i + 1)))
                    f.set(limit, limit + 16 * count)
                    f.jump(again)
        f.give(below)
        return self.module.add(f, "draw_below_planes")

    def word_number(self, at: Value, y: Value | None) -> Value:
        """The number of a word in the hash; `at`: bytes from the first word of the plane, `y`: its row."""
        across = -(-self.memory.width // 32)
        if across == 2 * self.memory.words:
            return at << 2
        if across == 1:
            return at << 1
        assert y is not None
        return (at << 2) - (y << 5)

    def _coin(self) -> Callee:
        """The plane of the highest bit of a stream's draws. Several passes ask for it: it is made once a step."""
        f = self.function("i32 i32", "i32")
        place, keys = f.param(0), f.param(1)
        plane = f.let(word(place))
        with f.when(plane.equals(0)):
            f.set(plane, self.take())
            f.store("i32.store", place, plane)
            f.store("i32.store", plane, const("i32", 1), SOME)
            y = f.let(ZERO)
            with f.each(ZERO, self.cells.value, self.memory.row) as row:
                with f.each(row, row + self.memory.row, 16) as at, f.scope():
                    bit = self.drawn(f, self.first_number(self.word_number(at, y), keys), keys)
                    f.store("v128.store", plane + at, bit, self.memory.base)
                f.set(y, y + 1)
        f.give(plane)
        return self.module.add(f, "coin")

    def draw_float(self) -> Callee:
        """A draw of a cell as float32: number of the word, lane in bytes, column in the word, keys, bits."""
        return self.lazily("draw_float", self._draw_float)

    def _draw_float(self) -> Callee:
        f = self.function("i32 i32 i32 i32 i32", "f32")
        at, lane, column, keys, bits = (f.param(i) for i in range(5))
        number = f.let(self.first_number(at, keys))
        total = f.let(const("i64", 0))
        scratch = const("i32", self.memory.at("limits"))
        with f.each(ZERO, bits):
            (drawn,) = self.ahead(f, number, keys, 1)
            f.store("v128.store", scratch, drawn)
            bit = (load("i64.load", scratch + lane) >> counted(column)) & 1
            f.set(total, (total << 1) + bit)
        half = op("f64.add", op("f64.convert_i64_u", total), const("f64", 0.5))
        count = op("f64.convert_i64_u", const("i64", 1) << counted(bits))
        f.give(op("f32.demote_f64", op("f64.div", half, count)))
        return self.module.add(f, "draw_float")

    # Columns

    def columns(self, f: Function, row: Value, at: Value, x: Value, dx: int, *, wraps: bool) -> Value:
        """The flags `dx` columns to the right, of any row with more than a word. Beyond the width they are garbage.

        Args:
            row: the address of the row's first word.
            at: bytes from there to the word.
            x: the column of the word's first flag, as an i32.
        """
        memory = self.memory
        if memory.whole and abs(dx) < WORD:
            last = const("i32", memory.row - 16)
            here = load("v128.load", row + at)
            if dx > 0:
                next_at = either(at.equals(last), ZERO, at + 16)
                beyond = load("v128.load", row + next_at)
                if not wraps:
                    beyond = beyond & op("i64x2.splat", op("i64.extend_i32_s", ZERO - (at < last)))
                return (here >> dx) | (beyond << (WORD - dx))
            next_at = either(at, at - 16, last)
            beyond = load("v128.load", row + next_at)
            if not wraps:
                beyond = beyond & op("i64x2.splat", op("i64.extend_i32_s", ZERO - (ZERO < at)))
            return (here << -dx) | (beyond >> (WORD + dx))
        return self.lazily(("columns", wraps), lambda: self._columns(wraps))(row, x + dx)

    def _columns(self, wraps: bool) -> Callee:
        """64 columns of a row from a column on: address of the row, column."""
        f = self.function("i32 i32", "v128")
        row, first = f.param(0), f.param(1)
        width = self.memory.width
        filled = f.let(ZERO)
        found = f.let(const("v128", 0))
        if wraps:
            f.set(first, op("i32.rem_s", first, const("i32", width)))
            with f.when(op("i32.lt_s", first, ZERO)):
                f.set(first, first + width)
        else:
            with f.when(op("i32.lt_s", first, ZERO)):
                f.set(filled, ZERO - first)
                f.set(first, ZERO)
        with f.block() as out, f.loop() as again:
            f.jump(out, filled >= WORD)
            if not wraps:
                f.jump(out, first >= width)
            within = f.let(first & (WORD - 1))
            part = load("v128.load", row + ((first >> 6) << 4)) >> within
            f.set(found, found | (part << filled))
            left = f.let(const("i32", WORD) - within)
            rest = f.let(const("i32", width) - first)
            f.set(left, either(left < rest, left, rest))
            f.set(filled, filled + left)
            f.set(first, first + left)
            if wraps:
                f.set(first, either(first < width, first, ZERO))
            f.jump(again)
        f.give(found)
        return self.module.add(f, "columns" if wraps else "columns_inside")

    def rotated(self, f: Function, row: Value, dx: int, *, wraps: bool) -> Value:
        """The flags `dx` columns to the right, of rows of one word. Beyond the width they are garbage."""
        width = self.memory.width
        if not wraps:
            if abs(dx) >= WORD:
                return const("v128", 0)
            return row >> dx if dx > 0 else row << -dx
        by = dx % width
        if not by:
            return row
        held = row if isinstance(row, Local) else f.let(row)
        return (held >> by) | (held << (width - by))

    # Lines of fields

    def line(self, field: Value, line: Value) -> Value:
        """The first column of a line, or of zeros."""
        start = field + self.live_size.value + line * (4 * self.memory.stride)
        return either(
            load("i32.load8_u", field + line, HEADER),
            start + (HEADER + 4 * self.memory.halo),
            self.zeros.value,
        )

    def live(self, field: Value, line: Value) -> Value:
        """Whether a line of a field may hold anything."""
        return load("i32.load8_u", field + line, HEADER)

    def line_start(self, field: Value, line: Value) -> Value:
        return (
            field + self.live_size.value + line * (4 * self.memory.stride) + (HEADER + 4 * self.memory.halo)
        )

    def other_line(self, line: Value, dy: int, *, wraps: bool) -> Value:
        """The line `dy` below; outside the world, one that is never live."""
        if not dy:
            return line
        return word(word(ZERO, self.memory.table(dy, wraps=wraps)) + (line << 2))

    def finish_line(self, f: Function, start: Value) -> None:
        """Fill the columns of the torus beside a line."""
        width, reach, halo = self.memory.width, self.memory.extent.reach, self.memory.halo
        before = f.let(start - 4 * halo) if reach else start
        for i in range(reach):
            for at, source in ((width + i, i % width), (-1 - i, (width - 1 - i) % width)):
                f.store("i32.store", before, word(before, 4 * (halo + source)), 4 * (halo + at))
