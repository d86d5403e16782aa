"""Movements in place: planes change only in rows that movers leave or enter.

Rows are visited so that the row which movers enter comes before theirs. Then a row's old flags are still there when the
movers that it holds arrive elsewhere; those of the row before wait in a register, or in a row beside the planes. What
comes around the edge waits in the planes' halos.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from powderdsl.ir.ops import Offset
from powderdsl.schedule.types import Carried, Leftover, Move
from powderdsl.targets.wasm.binary import I32, Callee, Function, Local, Value, const, load, op
from powderdsl.targets.wasm.library import (
    HALOED,
    LIVE,
    SOME,
    WORD,
    ZERO,
    Library,
    choose,
    either,
    some,
    word,
)

TOGETHER = 4
"""Planes that a loop over rows of one word changes, since each waits for what it reads."""


def groups_in_place(move: Move) -> dict[Leftover, list[Carried]] | None:
    """The planes of a movement by what movers leave behind; None if it needs copies: swaps reach the next row only."""
    groups = move.leftovers()
    near = groups is not None and abs(move.offset[0]) <= 1 and groups.keys() == {"same"}
    return groups if near or move.op == "arrive" else None


def rows_that_move(library: Library, downwards: bool) -> Callee:
    """Lists the rows that movers leave or enter, if they move downwards from the bottom: planes of movers and of their
    targets → the end of the list.
    """
    memory, cells = library.memory, library.cells

    def rows(f: Function, movers: I32, targets: I32) -> Value:
        end = f.let(word(ZERO, memory.at("rows")))
        at = f.let(cells - memory.row if downwards else ZERO)
        with f.each(0, cells, memory.row), f.scope():
            flags = const("v128", 0)
            if memory.words <= 4:
                for w in range(memory.words):
                    for plane in (movers, targets):
                        flags = flags | load("v128.load", plane + at, memory.base + 16 * w)
            else:
                total = flags = f.let(flags)
                with f.each(at, at + memory.row, 16) as one:
                    for plane in (movers, targets):
                        f.set(total, total | (plane + one)[memory.flags])
            f.set(word(end), at)
            f.set(end, end + (some(flags) << 2))
            f.set(at, at - memory.row if downwards else at + memory.row)
        return end

    return library.lazily(("rows", downwards), lambda: library.module.define(rows, "rows_that_move"))


def mover(library: Library, kind: str, offset: Offset, leaves: Leftover) -> Callee:
    """Moves planes: those of movers and targets, the end of the list of rows, the end of the table of planes."""
    name = f"{kind}_{offset[0]}_{offset[1]}_{leaves}"
    body = _Mover(library, kind, offset, leaves).body
    return library.lazily(name, lambda: library.module.define(body, name))


class _Mover:
    """Writes a function that moves planes, some of them together."""

    def __init__(self, library: Library, kind: str, offset: Offset, leaves: Leftover):
        self.library, self.memory, self.kind, self.leaves = library, library.memory, kind, leaves
        self.dy, self.dx = offset

    def body(self, f: Function, movers: I32, targets: I32, rows_end: I32, end: I32) -> None:
        memory = self.memory
        self.f, self.movers, self.targets, self.rows_end = f, movers, targets, rows_end
        place = f.let(const("i32", memory.at("moving")))
        for count in (TOGETHER, 1) if memory.words == 1 else (1,):
            with f.block() as out, f.loop() as again, f.scope():
                f.jump(out, end < place + 4 * count)
                planes = [f.let(word(place, 4 * i)) for i in range(count)]
                self.rows(planes)
                for plane in planes:
                    f.set(plane[HALOED], 0)
                f.set(place, place + 4 * count)
                f.jump(again)

    def rows(self, planes: Sequence[Local]) -> None:
        f, memory = self.f, self.memory
        carries = self.kind == "swap" and self.dy != 0
        edge = self.library.cells if self.dy > 0 else const("i32", -memory.row)
        edges = [plane + edge + memory.base for plane in planes]
        if memory.words == 1:
            before = [f.let(load("v128.load", edge)) for edge in edges] if carries else []
        else:
            before = [f.let(edges[0])]
            self.here = f.let(const("i32", memory.at("change")))
        entry = f.let(word(ZERO, memory.at("rows")))
        with f.each(entry, self.rows_end, 4) as listed, f.scope():
            at = f.let(word(listed))
            if memory.words == 1:
                self.row(planes, before if carries else [], at)
            else:
                self.long_row(planes[0], before[0], at)

    def row(self, planes: Sequence[Local], before: Sequence[Local], at: Local) -> None:
        """A row of one word, in several planes."""
        f, memory, dx = self.f, self.memory, self.dx
        m, t = (f.let((plane + at)[memory.flags]) for plane in (self.movers, self.targets))
        olds = [f.let((plane + at)[memory.flags]) for plane in planes]
        for i, (plane, old) in enumerate(zip(planes, olds, strict=True)):
            source = old
            if self.dy:
                source = f.let(load("v128.load", plane + at, memory.base - self.dy * memory.row))
            back = self.library.rotated(f, source, -dx, wraps=True)
            there = self.library.rotated(f, before[i] if before else old, dx, wraps=True)
            f.set((plane + at)[memory.flags], self.moved(m, t, old, there, back))
            if before:
                f.set(before[i], old)

    def long_row(self, plane: Local, before: Local, at: Local) -> None:
        """A row of several words, of which the old ones are kept beside the planes."""
        f, memory, library, dx = self.f, self.memory, self.library, self.dx
        start = f.let(plane + at + memory.base)
        with f.each(0, memory.row, 16) as w:
            f.set(load("v128.load", self.here + w), load("v128.load", start + w))
        source = f.let(start - self.dy * memory.row) if self.dy else self.here
        other = before if self.dy else self.here
        with f.each(0, memory.row, 16) as w, f.scope():
            m, t = (f.let((p + at + w)[memory.flags]) for p in (self.movers, self.targets))
            old = f.let(load("v128.load", self.here + w))
            x = f.let(w << 2)

            def seen(row: Local, dx: int) -> Value:
                if not dx:
                    return load("v128.load", row + w)
                return library.columns(f, row, w, x, dx, wraps=True)

            there = f.let(seen(other, dx)) if self.kind == "swap" else old
            back = f.let(seen(source, -dx))
            f.set(load("v128.load", start + w), self.moved(m, t, old, there, back))
        f.set(before, self.here)
        f.set(self.here, self.here ^ (memory.at("change") ^ memory.at("change") + memory.row))

    def moved(self, m: Value, t: Value, old: Value, there: Value, back: Value) -> Value:
        if self.kind == "swap":
            return choose(m, there, choose(t, back, old))
        left = {"same": old, "nothing": op("v128.andnot", old, m), "everything": old | m}[self.leaves]
        return choose(t, back, left)


def move_groups(
    library: Library,
    f: Function,
    move: Move,
    movers: Local,
    groups: Mapping[Leftover, Sequence[Local]],
    targets: Callee,
) -> None:
    """Move planes in place, by what their movers leave behind. `targets` makes the plane of targets: movers, it."""
    entered = f.let(library.take())
    f.do(library.edges(movers))
    f.do(targets(movers, entered))
    rows = f.let(rows_that_move(library, move.offset[0] > 0)(movers, entered))
    for kind, planes in groups.items():
        end = f.let(library.memory.at("moving"))
        for plane in planes:
            with f.when(const("i32", 1) if kind == "everything" else plane[SOME]):
                f.set(plane, library.own(plane))
                f.do(library.edges(plane))
                f.set(word(end), plane)
                f.set(end, end + 4)
                if kind == "everything":
                    f.set(plane[SOME], 1)
        f.do(mover(library, move.op, move.offset, kind)(movers, entered, rows, end))
    f.do(library.give(entered))


def exchanger(library: Library, offset: Offset) -> Callee:
    """Movers and their targets exchange values of a field: movers, field."""
    memory, (dy, dx) = library.memory, offset

    def exchange(f: Function, movers: I32, field: I32) -> None:
        line = f.let(0)
        with f.each(0, 16, 8) as lane, f.each(lane, lane + library.cells, memory.row) as row:
            with f.scope(), f.block() as skip:
                flags = f.let(const("i64", 0))
                with f.each(row, row + memory.row, 16) as at:
                    f.set(flags, flags | (movers + at)[memory.half])
                f.jump(skip, op("i64.eqz", flags))
                other = f.let(library.other_line(line, dy, wraps=True))
                f.jump(skip, op("i32.eqz", (field + line)[LIVE] | (field + other)[LIVE]))
                here, there = (f.let(library.line_start(field, number)) for number in (line, other))
                for number, start in ((line, here), (other, there)):
                    with f.when(op("i32.eqz", (field + number)[LIVE])):
                        with f.each(0, 4 * memory.width, 16) as at:
                            f.set(load("v128.load", start + at), 0)
                        f.set((field + number)[LIVE], 1)
                x = f.let(0)
                with f.each(row, row + memory.row, 16) as at:
                    left = f.let((movers + at)[memory.half])
                    _exchange_word(f, left, x, here, there, dx % memory.width, memory.width)
                    f.set(x, x + WORD)
                library.finish_line(f, here)
                library.finish_line(f, there)
            f.set(line, line + 1)

    name = f"exchange_{dy}_{dx}"
    return library.lazily(name, lambda: library.module.define(exchange, name))


def _exchange_word(
    f: Function, left: Local, x: Local, here: Local, there: Local, by: int, width: int
) -> None:
    """Cells of the movers `left`, the first of which is in column `x`, exchange with those `by` columns on, around."""
    with f.block() as done, f.loop() as again, f.scope():
        f.jump(done, op("i64.eqz", left))
        column = f.let(x + op("i32.wrap_i64", op("i64.ctz", left)))
        f.set(left, left & (left - 1))
        target = f.let(column + by)
        if by:
            f.set(target, either(target < width, target, target - width))
        own, other = f.let(here + (column << 2)), f.let(there + (target << 2))
        kept = f.let(word(own))
        f.set(word(own), word(other))
        f.set(word(other), kept)
        f.jump(again)
