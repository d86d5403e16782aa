"""Movements in place: planes change only in rows that movers leave or enter.

Rows are visited so that the row that movers enter comes before theirs. Then a row's old flags are unchanged when its movers
arrive elsewhere; the old flags of the row before are saved in a register, or in a row outside the planes. Flags that come
around the edge are saved in the planes' halos.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from powderdsl.ir.ops import Offset
from powderdsl.schedule.types import Leftover, Move, Out
from powderdsl.targets.wasm.binary import I32, Callee, Local, Value, body, const, load, op
from powderdsl.targets.wasm.library import HALOED, LIVE, SOME, WORD, ZERO, Library, choose, either, some, word

TOGETHER = 4
"""Planes that a loop over rows of one word changes together, to hide the latency of reads."""


def groups_in_place(move: Move) -> dict[Leftover, list[Out]] | None:
    """The planes of a movement by their leftovers; None if it needs copies, as swaps beyond the next row do."""
    groups = move.leftovers()
    near = groups is not None and abs(move.offset[0]) <= 1 and groups.keys() == {"same"}
    return groups if near or move.op == "arrive" else None


def rows_that_move(library: Library, downwards: bool) -> Callee:
    """A function that lists the rows that movers leave or enter: movers, targets → the end of the list.

    If they move downwards, the list begins at the bottom.
    """
    memory, cells = library.memory, library.cells

    def rows(movers: I32, targets: I32) -> Value:
        end = body.let(library.row_list)
        at = body.let(cells - memory.row if downwards else ZERO)
        with body.each(0, cells, memory.row), body.scope():
            flags = library.row_flags([movers, targets], at, memory.flags)
            word(end).set(at)
            end += some(flags) << 2
            at.set(at - memory.row if downwards else at + memory.row)
        return end

    return library.module.once("rows_down" if downwards else "rows_up", rows)


class _Mover:
    """Writes a function that moves planes, some of them together.

    Its arguments: the planes of movers and targets, the end of the list of rows, the end of the table of planes.
    """

    def __init__(self, library: Library, kind: str, offset: Offset, leaves: Leftover):
        self.library, self.memory, self.kind, self.leaves = library, library.memory, kind, leaves
        self.dy, self.dx = offset

    def write(self, movers: I32, targets: I32, rows_end: I32, end: I32) -> None:
        memory = self.memory
        self.movers, self.targets, self.rows_end = movers, targets, rows_end
        place = body.let(memory.at("moving"))
        for count in (TOGETHER, 1) if memory.words == 1 else (1,):
            with body.block() as out, body.loop() as again, body.scope():
                body.jump(out, end < place + 4 * count)
                planes = [body.let(word(place, 4 * i)) for i in range(count)]
                self.rows(planes)
                for plane in planes:
                    plane[HALOED] = 0
                place += 4 * count
                body.jump(again)

    def rows(self, planes: Sequence[Local]) -> None:
        memory = self.memory
        carries = self.kind == "swap" and self.dy != 0
        edge = self.library.cells if self.dy > 0 else const("i32", -memory.row)
        edges = [plane + edge + memory.base for plane in planes]
        if memory.words == 1:
            before = [body.let(load("v128.load", edge)) for edge in edges] if carries else []
        else:
            before = [body.let(edges[0])]
            self.here = body.let(memory.at("change"))
        entry = body.let(self.library.row_list)
        with body.each(entry, self.rows_end, 4) as listed, body.scope():
            at = body.let(word(listed))
            if memory.words == 1:
                self.row(planes, before if carries else [], at)
            else:
                self.long_row(planes[0], before[0], at)

    def row(self, planes: Sequence[Local], before: Sequence[Local], at: Local) -> None:
        """A row of one word, in several planes."""
        memory, dx = self.memory, self.dx
        m, t = (body.let((plane + at)[memory.flags]) for plane in (self.movers, self.targets))
        olds = [body.let((plane + at)[memory.flags]) for plane in planes]
        for i, (plane, old) in enumerate(zip(planes, olds, strict=True)):
            source = old
            if self.dy:
                source = body.let(load("v128.load", plane + at, memory.base - self.dy * memory.row))
            back = self.library.rotated(source, -dx, wraps=True)
            there = self.library.rotated(before[i] if before else old, dx, wraps=True)
            (plane + at)[memory.flags] = self.moved(m, t, old, there, back)
            if before:
                before[i].set(old)

    def long_row(self, plane: Local, before: Local, at: Local) -> None:
        """A row of several words, whose old words are saved outside the planes."""
        memory, library, dx = self.memory, self.library, self.dx
        start = body.let(plane + at + memory.base)
        with body.each(0, memory.row, 16) as w:
            load("v128.load", self.here + w).set(load("v128.load", start + w))
        source = body.let(start - self.dy * memory.row) if self.dy else self.here
        other = before if self.dy else self.here
        with body.each(0, memory.row, 16) as w, body.scope():
            m, t = (body.let((p + at + w)[memory.flags]) for p in (self.movers, self.targets))
            old = body.let(load("v128.load", self.here + w))
            x = body.let(w << 2)

            def seen(row: Local, dx: int) -> Value:
                if not dx:
                    return load("v128.load", row + w)
                return library.columns(row, 0, w, x, dx, wraps=True)

            there = body.let(seen(other, dx)) if self.kind == "swap" else old
            back = body.let(seen(source, -dx))
            load("v128.load", start + w).set(self.moved(m, t, old, there, back))
        before.set(self.here)
        self.here ^= memory.at("change") ^ memory.at("change") + memory.row

    def moved(self, m: Value, t: Value, old: Value, there: Value, back: Value) -> Value:
        if self.kind == "swap":
            return choose(m, there, choose(t, back, old))
        left = {"same": old, "nothing": op("v128.andnot", old, m), "everything": old | m}[self.leaves]
        return choose(t, back, left)


def move_groups(
    library: Library, move: Move, movers: Local, groups: Mapping[Leftover, Sequence[Local]], targets: Callee
) -> None:
    """Move planes in place, by their leftovers. `targets` writes the plane of targets: movers, targets."""
    entered = body.let(library.take())
    body.do(library.edges(movers))
    body.do(targets(movers, entered))
    rows = body.let(rows_that_move(library, move.offset[0] > 0)(movers, entered))
    for kind, planes in groups.items():
        end = body.let(library.memory.at("moving"))
        for plane in planes:
            with body.when(const("i32", 1) if kind == "everything" else plane[SOME]):
                plane.set(library.own(plane))
                body.do(library.edges(plane))
                word(end).set(plane)
                end += 4
                if kind == "everything":
                    plane[SOME] = 1
        code = _Mover(library, move.op, move.offset, kind)
        name = f"{move.op}_{code.dy}_{code.dx}_{kind}"
        body.do(library.module.once(name, code.write)(movers, entered, rows, end))
    body.do(library.give(entered))


def exchanger(library: Library, offset: Offset) -> Callee:
    """Movers and their targets exchange values of a field: movers, field."""
    memory, (dy, dx) = library.memory, offset

    def exchange(movers: I32, field: I32) -> None:
        line = body.let(0)
        with body.each(0, 16, 8) as lane, body.each(lane, lane + library.cells, memory.row) as row:
            with body.scope(), body.block() as skip:
                body.jump(skip, op("i64.eqz", library.row_flags([movers], row, memory.half)))
                other = body.let(library.other_line(line, dy, wraps=True))
                body.jump(skip, op("i32.eqz", (field + line)[LIVE] | (field + other)[LIVE]))
                here, there = (body.let(library.line_start(field, number)) for number in (line, other))
                for number, start in ((line, here), (other, there)):
                    with body.when(op("i32.eqz", (field + number)[LIVE])):
                        with body.each(0, library.width * 4, 16) as at:
                            load("v128.load", start + at).set(0)
                        (field + number)[LIVE] = 1
                x = body.let(0)
                with body.each(row, row + memory.row, 16) as at:
                    left = body.let((movers + at)[memory.half])
                    _exchange_word(library, dx, left, x, here, there)
                    x += WORD
                library.finish_line(here)
                library.finish_line(there)
            line += 1

    return library.module.once(f"exchange_{dy}_{dx}", exchange)


def _exchange_word(library: Library, dx: int, left: Local, x: Local, here: Local, there: Local) -> None:
    """Exchange cells of the movers `left`, a word from column `x` on, with those `dx` columns to the right, around the edge."""
    with body.block() as done, body.loop() as again, body.scope():
        body.jump(done, op("i64.eqz", left))
        column = body.let(x + op("i32.wrap_i64", op("i64.ctz", left)))
        left &= left - 1
        target = body.let(column + library.turned(dx))
        if dx:
            target.set(either(target < library.width, target, target - library.width))
        own, other = body.let(here + (column << 2)), body.let(there + (target << 2))
        saved = body.let(word(own))
        word(own).set(word(other))
        word(other).set(saved)
        body.jump(again)
