"""The memory of a module, and the functions that generated passes call: planes, fields, rows around the edges, draws.

Addresses are bytes. Everything is aligned to 16 bytes. A group is two lanes of work: two worlds, or the two halves of one.

    plane   refs, some, haloed, next: i32 each. Rows of words, lane by lane, with `around` rows above and below, which
            hold the rows that follow on the torus if `haloed`. `some`: it may hold a flag; if not, all words are zero.
    field   refs, some, 2, next. A byte a line: 1 if it is `live`; other lines are zero and must not be read. Then the
            lines, of both lanes one after the other, with `reach` columns of the torus on both sides.
    batch   worlds, groups. Seeds, indices and steps, i64 a world each. The bits of parameters, a byte a
            world each. Their float32 values. The groups.
    group   the planes and fields of slots, i32 each; i64: the present ids, of those that passes test.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import partial, reduce
from operator import or_
from typing import NamedTuple

from powderdsl.ir.ops import REAL
from powderdsl.schedule.rows import chains_of
from powderdsl.schedule.types import Move, Schedule, Sweeps, flat, reads_of
from powderdsl.system.random import MASK
from powderdsl.targets.layout import Layout
from powderdsl.targets.wasm import host
from powderdsl.targets.wasm.binary import (
    I32,
    I64,
    V128,
    Callee,
    Global,
    Local,
    Member,
    Module,
    Settable,
    Value,
    body,
    const,
    load,
    op,
    vector,
)
from powderdsl.targets.wasm.host import HEADER, aligned

WORD, LANES = 64, 2
REFS, SOME, HALOED, NEXT = (Member("i32.load", at) for at in (0, 4, 8, 12))
FIELD = 2
"""The value of `haloed` that marks fields."""

REFS_SOME = Member("i64.load", 0)
"""Both together."""

LIVE = Member("i32.load8_u", HEADER)
"""The live byte of a line, at the field's address plus the line's number."""

WORLDS, GROUPS = Member("i32.load", host.WORLDS), Member("i32.load", host.GROUPS)

PAGE = 1 << 16
GOLDEN, FIRST, SECOND = 0x9E3779B1, 0x7FEB352D, 0x846CA68B
MOST_BITS = 64
"""Maximum number of bits of a draw."""

AHEAD = 4
"""Bits of a draw that are computed together, since the multiplications of one bit wait for each other."""

MAX_PARAMS = 1000
"""Maximum number of parameters of a function in engines; more are passed in variables of the module."""

UNROLLED = 4
"""Words of a row up to which they are read without a loop."""

STILL, SWAPPED = bytes(range(16)), bytes([*range(8, 16), *range(8)])
"""Patterns for `i8x16.swizzle`: the lanes unmodified, and exchanged."""

ZERO = const("i32", 0)


class Extent(NamedTuple):
    """The largest distances of reads: planes in rows (`around`), fields in rows and columns; the most chains in a loop."""

    around: int
    lines: int
    reach: int
    chains: int


def extent_of(schedules: Sequence[Schedule]) -> Extent:
    around = lines = reach = chains = 0
    for statement in (statement for schedule in schedules for statement in flat(schedule.body)):
        if isinstance(statement, Move):
            around = max(around, abs(statement.offset[0]))
            lines = max(lines, abs(statement.offset[0]) if statement.outs[0].var.type == REAL else 0)
        elif isinstance(statement, Sweeps):
            laid = (loop for loop in statement.body if loop.over == "choices")
            chains = max(chains, *(len(chains_of(loop)) for loop in laid), 0)
        for read in reads_of(statement.values):
            if read.type != REAL:
                around = max(around, abs(read.dy))
            else:
                lines, reach = max(lines, abs(read.dy)), max(reach, abs(read.dx))
    return Extent(around, lines, reach, chains)


class Memory:
    """The sizes of rows, and the static addresses, of a program for grids of one width; None: of all below a word."""

    def __init__(self, width: int | None, extent: Extent, layout: Layout):
        self.width, self.extent, self.layout = width, extent, layout
        most = WORD - 1 if width is None else width
        self.words = -(-most // WORD)
        """The words of a row."""
        self.whole = most % WORD == 0
        """True if all words of a row are full."""
        self.row = 8 * LANES * self.words
        """The bytes of a plane's row, both lanes."""
        self.base = HEADER + extent.around * self.row
        """The offset of a plane's first row."""
        self.flags, self.half = Member("v128.load", self.base), Member("i64.load", self.base)
        """A word of a plane, and the part of a lane, at the plane's address plus the offset from the first word."""
        self.halo = aligned(extent.reach, 4)
        """The columns of padding on each side of a line."""
        self.stride = aligned(most, 4) + 2 * self.halo + 4
        """The floats of a line, with both halos and the overlap of a chunk."""
        self.slots = [(Member("i32.load", 4 * i), False) for i in range(len(layout.planes))]
        """The planes and fields of a group, by number; True for fields."""
        count = len(layout.planes) + len(layout.reals)
        self.slots += [(Member("i32.load", 4 * i), True) for i in range(len(layout.planes), count)]
        self.present = Member("i64.load", aligned(4 * len(self.slots), 8))
        """The ids that are present in a group."""
        self.group = aligned(self.present.offset + 8)
        """The bytes of a group."""
        self.top = 64
        self._tables: dict[str, tuple[int, int]] = {}
        for name, size, count in (
            ("worlds", 16, 2),
            ("clock", 16, 1),
            ("keys", 32, len(layout.streams)),
            ("params", 16, len(layout.param_planes)),
            ("reals", 8, len(layout.param_reals)),
            ("steps", 16, len(layout.step_planes)),
            ("limits", 16, MOST_BITS + 1),
            ("coins", 4, len(layout.streams)),
            ("fixed", 4, len(layout.fixed)),
            ("lines", 4, 2 * (2 * extent.lines + 1)),
            ("moving", 4, len(layout.planes) + 1),
            ("change", self.row, 2),
            ("columns", 4 * self.stride, 1),
            ("chains", 4 * self.stride, extent.chains),
        ):
            self._tables[name] = self.top, size
            self.top = aligned(self.top + size * count)

    def at(self, name: str, number: int = 0) -> int:
        """The address of an item of a static table."""
        start, size = self._tables[name]
        return start + number * size

    def slot(self, name: str, type: object) -> Member:
        layout = self.layout
        return self.slots[len(layout.planes) + layout.reals[name] if type == REAL else layout.planes[name]][0]

    def table(self, dy: int, *, wraps: bool) -> int:
        """The address of the pointer to a table of lines: for each line, the line `dy` below in its world."""
        return self.at("lines", 2 * (dy + self.extent.lines) + (not wraps))


def splat(number: Value) -> Value:
    """A vector of four equal i32."""
    return op("i32x4.splat", number)


def integers(number: int) -> Value:
    """A vector of four equal 32-bit integers."""
    return vector((number & MASK).to_bytes(4, "little") * 4)


def some(flags: Value) -> Value:
    """True if any bit of a vector is set."""
    return op("v128.any_true", flags)


def either(condition: Value, yes: Value | int, no: Value | int) -> Value:
    """A choice between two numbers, one of which is not constant."""
    type = yes.type if isinstance(yes, Value) else no.type if isinstance(no, Value) else "i32"
    yes, no = (value if isinstance(value, Value) else const(type, value) for value in (yes, no))
    return Value(type, yes.code + no.code + condition.code + op("select").code)


def choose(mask: Value, yes: Value, no: Value) -> Value:
    """A choice between the bits of two vectors."""
    return op("v128.bitselect", yes, no, mask)


def word(address: Value | int, offset: int = 0) -> Settable:
    return load("i32.load", address, offset)


def counted(value: Value) -> Value:
    """An i32 as i64, unsigned."""
    return op("i64.extend_i32_u", value)


class Library:
    """The functions and variables of a module."""

    def __init__(self, memory: Memory, module: Module):
        self.memory, self.module = memory, module
        self._more: list[Global] = []
        variable, define = module.variable, module.define
        self.width = variable("i32") if memory.width is None else memory.width
        self.turns = defaultdict[int, Global](partial(variable, "i32"))
        """Variables with numbers of columns modulo the width, unless that is fixed."""
        self.top = variable("i32", memory.top)
        """The beginning of memory that has never been used."""
        self.planes, self.fields = variable("i32"), variable("i32")
        """The first free plane and field."""
        self.rows, self.lines, self.cells = variable("i32"), variable("i32"), variable("i32")
        """Rows of a lane; lines of both lanes; bytes of the rows of a plane."""
        self.strips, self.plane_size, self.field_size = variable("i32"), variable("i32"), variable("i32")
        self.live_size = variable("i32")
        self.nothing, self.everything, self.inside = variable("i32"), variable("i32"), variable("i32")
        """Planes: without flags; with all flags; with all flags, in the halo only in rows of the world."""
        self.calm, self.zeros, self.group = variable("i32"), variable("i32"), variable("i32")
        """A field without live lines; a line of zeros; the group that runs."""
        self.world_rows = variable("i32")
        """Rows of a world; 0 before the first batch."""
        self.row_list = variable("i32")
        """The rows that movers leave or enter."""
        self.scratch, self.scratch_end = variable("i32"), variable("i32")
        for column in range(-memory.extent.reach, memory.extent.reach):
            self.turned(column)
        self.bump = define(self._bump)
        self.take = define(partial(self._take, self.planes, self.plane_size, 0), "take")
        self.take_field = define(partial(self._take, self.fields, self.field_size, FIELD), "take_field")
        self.give, self.keep = define(self._give), define(self._keep)
        self.own, self.own_field = define(self._own), define(self._own_field)
        self.edges = define(self._edges)
        self.mix = define(self._mix)
        self.draw_below, self.draw_below_planes = define(self._draw_below), define(self._draw_below_planes)
        self.coin = define(self._coin)

    def more_params(self, count: int) -> list[Global]:
        """Variables for parameters beyond MAX_PARAMS."""
        while len(self._more) < count:
            self._more.append(self.module.variable("i32"))
        return self._more[: max(count, 0)]

    @property
    def present(self) -> Settable:
        """The ids that are present in the group that runs."""
        return self.group[self.memory.present]

    # Memory

    def _bump(self, size: I32) -> Value:
        """New memory: bytes, a multiple of 16 → address. Traps at the module's limit."""
        place = body.let(self.top)
        with body.when(size >= self.module.most * PAGE):
            body.trap()
        end = body.let(place + size)
        pages, before = body.let((end + (PAGE - 1)) >> 16), op("memory.size")
        with body.when(pages >= before + 1):
            grown = op("memory.grow", pages - before)
            with body.when(grown.equals(-1)):
                body.trap()
        self.top.set(end)
        return place

    def trap_from(self, count: Value, size: int) -> None:
        """Trap if items of a size do not fit into half of the memory."""
        with body.when(counted(count) * size >= self.module.most * PAGE // 2):
            body.trap()

    def _take(self, free: Global, size: Global, kind: int) -> Value:
        place = body.let(free)
        with body.when(place):
            free.set(place[NEXT])
            body.otherwise()
            place.set(self.bump(size))
        place[REFS_SOME] = 1
        place[HALOED] = kind
        return place

    def _give(self, item: I32) -> None:
        """Remove an owner of a plane or field; without owners, it is free."""
        left = body.let(item[REFS] - 1)
        item[REFS] = left
        with body.when(left.equals(0)), body.when(item[HALOED].equals(FIELD)):
            item[NEXT] = self.fields
            self.fields.set(item)
            body.otherwise()
            item[NEXT] = self.planes
            self.planes.set(item)

    def _keep(self, item: I32) -> Value:
        """Add an owner of a plane or field, and return it."""
        item[REFS] += 1
        return item

    def _own(self, plane: I32) -> Value:
        """The plane if it has one owner, else a copy, so that it may be overwritten."""
        with body.when(plane[REFS].equals(1)):
            plane[HALOED] = 0
            body.give(plane)
        return self._copy(plane, self.take, self.memory.base, self.cells)

    def _own_field(self, field: I32) -> Value:
        """The field if it has one owner, else a copy, so that it may be overwritten."""
        with body.when(field[REFS].equals(1)):
            body.give(field)
        return self._copy(field, self.take_field, HEADER, self.field_size - HEADER)

    def _copy(self, old: Local, take: Callee, first: int, size: Value) -> Value:
        """A copy of a plane or field, which loses an owner."""
        new = body.let(take())
        body.do(op("memory.copy", new + first, old + first, size))
        new[SOME] = old[SOME]
        body.do(self.give(old))
        return new

    # Rows around the edges

    def _edges(self, plane: I32) -> None:
        """Fill the rows above and below a plane, before they are read; beyond an edge, strips continue in the other strip."""
        memory, rows, around = self.memory, self.rows, self.memory.extent.around
        with body.when(plane[HALOED]):
            body.leave()
        plane[HALOED] = 1
        if not around:
            return
        turn = body.let(either(self.strips, vector(SWAPPED), vector(STILL)))
        with body.each(1, around + 1) as k:
            for target, source in (
                (around - k, (rows * around - k) % rows),
                (rows + (k + (around - 1)), (k - 1) % rows),
            ):
                to, came = (body.let(plane + place * memory.row) for place in (target, source))
                with body.each(0, memory.row, 16) as w:
                    seen = op("i8x16.swizzle", (came + w)[memory.flags], turn)
                    load("v128.load", to + w, HEADER).set(seen)

    def row_flags(self, planes: Sequence[Value], row: Value, member: Member) -> Value:
        """The union of planes in a row: `member` is a word of both lanes, or of one lane."""
        if self.memory.words <= UNROLLED:
            places = [(plane + row, 16 * w) for plane in planes for w in range(self.memory.words)]
            return reduce(or_, [load(member.load, at, member.offset + more) for at, more in places])
        flags = body.let(0, "i64" if member == self.memory.half else "v128")
        with body.each(row, row + self.memory.row, 16) as at:
            for plane in planes:
                flags |= (plane + at)[member]
        return flags

    # Draws

    def _mix(self, x: I32) -> Value:
        """The finalizer of keys."""
        for by, factor in ((16, FIRST), (15, SECOND)):
            x ^= x >> by
            x *= factor
        return x ^ (x >> 16)

    def mixed(self, numbers: Value, key: Value | None = None) -> Local:
        """The finalizer of keys, on a vector; with a second key added between the multiplications, the hash of draws."""
        h = body.let(numbers)
        h ^= op("i32x4.shr_u", h, 16)
        h.set(op("i32x4.mul", h, integers(FIRST)))
        h ^= op("i32x4.shr_u", h, 15)
        h.set(op("i32x4.mul", op("i32x4.add", h, key) if key is not None else h, integers(SECOND)))
        h ^= op("i32x4.shr_u", h, 16)
        return h

    def first_number(self, word_number: Value, keys: Value) -> Value:
        """The argument `number` of `ahead` for bit 0 of a word, by the number of the word in the hash."""
        return op("i32x4.add", splat(word_number * GOLDEN), load("v128.load", keys))

    def ahead(self, number: Local, keys: Value, count: int) -> list[Local]:
        """The next bits of the draws of a word: `number` is the word's and the bit's times GOLDEN, with the first key."""
        drawn = []
        for i in range(count):
            at = op("i32x4.add", number, integers(i * GOLDEN)) if i else number
            drawn.append(self.mixed(at, load("v128.load", keys, 16)))
        number.set(op("i32x4.add", number, integers(count * GOLDEN)))
        return drawn

    def _draw_below(self, at: I32, wanted: V128, keys: I32, limit: I64) -> Value:
        """The wanted cells that draw below a constant, given as its bits from the highest, in the word numbered `at`.

        Of the undecided cells, those whose draw has a 0 where the limit has a 1 are below; equal bits leave a cell undecided.
        """
        number = body.let(self.first_number(at, keys))
        below = body.let(0, "v128")
        with body.block() as done, body.loop() as again:
            for drawn in self.ahead(number, keys, AHEAD):
                wants = body.let(op("i64x2.splat", op("i64.shr_s", limit, 63)))
                self._compare(below, wanted, drawn, wants)
                limit <<= 1
            body.jump(done, limit.equals(0))
            body.jump(again, some(wanted))
        return below

    def _compare(self, below: Local, still_open: Local, drawn: Value, limit: Value) -> None:
        below |= op("v128.andnot", still_open & limit, drawn)
        still_open.set(op("v128.andnot", still_open, limit ^ drawn))

    def _draw_below_planes(self, at: I32, wanted: V128, keys: I32, limit: I32, end: I32) -> Value:
        """The same with a limit given plane by plane, from an address to an end."""
        number = body.let(self.first_number(at, keys))
        below = body.let(wanted & load("v128.load", limit))
        wanted.set(op("v128.andnot", wanted, load("v128.load", limit)))
        with body.block() as done:
            for count in (AHEAD, 1):
                with body.block() as out, body.loop() as again:
                    body.jump(out, end < limit + 16 * (count + 1))
                    body.jump(done, some(wanted).equals(0))
                    with body.scope():
                        for i, drawn in enumerate(self.ahead(number, keys, count)):
                            self._compare(below, wanted, drawn, load("v128.load", limit, 16 * (i + 1)))
                    limit += 16 * count
                    body.jump(again)
        return below

    def word_number(self, at: Value, y: Value | None) -> Value:
        """The number of a word in the hash; `at`: bytes from the first word of the plane, `y`: its row."""
        across = (self.width + 31) >> 5
        if self.memory.words == 1:
            return at << across
        if across == 2 * self.memory.words:
            return at << 2
        assert y is not None
        return (at << 2) - (y << 5)

    def _coin(self, place: I32, keys: I32) -> Value:
        """The plane of the highest bit of a stream's draws, made once a step, since several passes use it."""
        plane = body.let(word(place))
        with body.when(plane.equals(0)):
            plane.set(self.take())
            word(place).set(plane)
            plane[SOME] = 1
            y = body.let(0)
            with body.each(0, self.cells, self.memory.row) as row:
                with body.each(row, row + self.memory.row, 16) as at, body.scope():
                    number = self.first_number(self.word_number(at, y), keys)
                    bit = self.mixed(number, load("v128.load", keys, 16))
                    (plane + at)[self.memory.flags] = bit
                y += 1
        return plane

    def draw_float(self, at: I32, lane: I32, column: I32, keys: I32, bits: I32) -> Value:
        """A draw of a cell as float32, in the word numbered `at`: lane in bytes, column in the word."""
        number = body.let(self.first_number(at, keys))
        total = body.let(0, "i64")
        scratch = const("i32", self.memory.at("limits"))
        with body.each(0, bits):
            (drawn,) = self.ahead(number, keys, 1)
            load("v128.load", scratch).set(drawn)
            bit = (load("i64.load", scratch + lane) >> counted(column)) & 1
            total.set((total << 1) + bit)
        half = op("f64.add", op("f64.convert_i64_u", total), 0.5)
        count = op("f64.convert_i64_u", 1 << counted(bits))
        return op("f32.demote_f64", op("f64.div", half, count))

    # Columns

    def columns(self, row: Value, offset: int, at: Value, x: Value, dx: int, *, wraps: bool) -> Value:
        """The flags `dx` columns to the right. Beyond the width they are garbage.

        Args:
            row, offset: the address of the row's first word.
            at: bytes from there to the word.
            x: the column of the word's first flag, as an i32.
        """
        memory = self.memory
        if memory.words == 1:
            return self.rotated(load("v128.load", row, offset), dx, wraps=wraps)
        row = body.let(row + offset)
        if not memory.whole or abs(dx) >= WORD:
            return self._columns(wraps=wraps)(row, x + dx)
        last = const("i32", memory.row - 16)
        here = load("v128.load", row + at)
        if dx > 0:
            other, inside = either(at.equals(last), 0, at + 16), at < last
        else:
            other, inside = either(at, at - 16, last), ZERO < at
        beyond: Value = load("v128.load", row + other)
        if not wraps:
            beyond = beyond & op("i64x2.splat", op("i64.extend_i32_s", 0 - inside))
        if dx > 0:
            return (here >> dx) | (beyond << (WORD - dx))
        return (here << -dx) | (beyond >> (WORD + dx))

    def _columns(self, *, wraps: bool) -> Callee:
        """64 columns of a row from a column on: address of the row, column."""
        width = self.width

        def columns(row: I32, first: I32) -> Value:
            filled, flags = body.let(0), body.let(0, "v128")
            if wraps:
                first.set(op("i32.rem_s", first, width))
            with body.when(op("i32.lt_s", first, 0)):
                if not wraps:
                    filled.set(0 - first)
                first.set(first + width if wraps else 0)
            with body.block() as out, body.loop() as again:
                body.jump(out, filled >= WORD)
                if not wraps:
                    body.jump(out, first >= width)
                within = body.let(first & (WORD - 1))
                part = load("v128.load", row + ((first >> 6) << 4)) >> within
                flags |= part << filled
                left, rest = body.let(WORD - within), body.let(width - first)
                left.set(either(left < rest, left, rest))
                filled += left
                first += left
                if wraps:
                    first.set(either(first < width, first, 0))
                body.jump(again)
            return flags

        return self.module.once("columns" if wraps else "columns_inside", columns)

    def rotated(self, row: Value, dx: int, *, wraps: bool) -> Value:
        """The flags `dx` columns to the right, of rows of one word. Beyond the width they are garbage."""
        if not wraps:
            if abs(dx) >= WORD:
                return const("v128", 0)
            return row >> dx if dx > 0 else row << -dx
        by = self.turned(dx) if dx else 0
        if not by:
            return row
        row = row if isinstance(row, Local) else body.let(row)
        return (row >> by) | (row << (self.width - by))

    def turned(self, columns: int) -> Value | int:
        """A number of columns modulo the width."""
        if isinstance(self.width, int):
            return columns % self.width
        return self.turns[columns]

    # Lines of fields

    def line(self, field: Value, line: Value) -> Value:
        """The first column of a line, or of zeros."""
        return either((field + line)[LIVE], self.line_start(field, line), self.zeros)

    def line_start(self, field: Value, line: Value) -> Value:
        memory = self.memory
        return field + self.live_size + line * (4 * memory.stride) + (HEADER + 4 * memory.halo)

    def other_line(self, line: Value, dy: int, *, wraps: bool) -> Value:
        """The line `dy` below; outside the world, a line that is never live."""
        return word(word(0, self.memory.table(dy, wraps=wraps)) + (line << 2)) if dy else line

    def finish_line(self, start: Value) -> None:
        """Fill the halo of a line with the columns around the edge."""
        reach, halo = self.memory.extent.reach, self.memory.halo
        before = body.let(start - 4 * halo) if reach else start
        for i in range(reach):
            for at, more, source in ((self.width, i, self.turned(i)), (-1 - i, 0, self.turned(-1 - i))):
                word(before + (at << 2), 4 * (halo + more)).set(word(before + (source << 2), 4 * halo))
