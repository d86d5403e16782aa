"""A module that is a world: a grid of one size with its elements' defaults, for a page or a game without powderdsl.

Numbers are i32 unless said otherwise; rows and columns count from 0, and boxes end before `bottom` and `right`. What lies
outside the grid is left out, and values are cut to what rules allow: a host cannot make a world that rules do not know.

    cells() → address                 the ids, a byte a cell, row by row
    begin(seed)                       the cells there become a new world, at step 0, with the usual values of fields
    step(count)
    show() → address                  the ids of the world as it is, at the same address
    field(number) → address           the values of a field, [components, rows, columns] in its type
    take(number)                      the values there, where they can differ from the usual ones, become those of the field
    paint(element, top, bottom, left, right)                    a box of fresh cells
    set(number, component, top, bottom, left, right, value)     a field in a box; the value is f64
    parameter(number, value)          the value is f64
    clock() → address                 i64 [3]: seed, index, step; together with cells and fields they decide the future

The section `powderdsl` of the module is JSON: the size, and elements, fields and parameters in the order of their numbers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from powderdsl.ir.ops import Threshold
from powderdsl.targets.codec import Piece
from powderdsl.targets.wasm.binary import Callee, Function, Local, Value, const, load, op
from powderdsl.targets.wasm.library import PAGE, ZERO, Library, either, word
from powderdsl.targets.wasm.memory import HEADER, aligned
from powderdsl.targets.wasm.transfer import Transfer

Box = tuple[Local, Local, Local, Local]


@dataclass(frozen=True)
class Stored:
    """An array of the state: its parts, and the values that cells may have.

    `usual`: by component and id, the value of a fresh cell. `holders`: the ids of elements whose cells can have another
    one; None for all. `of_element`: it comes and goes with the element. `snap`: smaller floats are zero.
    """

    name: str
    pieces: tuple[Piece, ...]
    size: int
    usual: tuple[tuple[float, ...], ...]
    low: float
    high: float
    holders: frozenset[int] | None
    of_element: bool
    names_element: bool = False
    snap: float = 0.0


@dataclass(frozen=True)
class Knob:
    """A parameter: its name, default and range."""

    name: str
    default: float
    low: float
    high: float
    whole: bool


@dataclass(frozen=True)
class Face:
    """What a module needs to stand alone. `fields` are all slots but the element; `about` is for the custom section."""

    rows: int
    ids: tuple[int, ...]
    element: Stored
    fields: tuple[Stored, ...]
    knobs: tuple[Knob, ...]
    about: bytes


class Standalone(Transfer):
    """Makes the functions of one world, on those of batches."""

    def __init__(self, library: Library, face: Face, batch: dict[str, Callee]):
        super().__init__(library)
        self.face, self.batch_calls = face, batch
        self.module = library.module
        self.batch = self.module.variable("i32")
        self.at, self.end = library.memory.top, library.memory.top
        self.buffers: dict[str, int] = {}
        self.count = face.rows * self.memory.width
        self.valid = self._table([i if i in face.ids else face.ids[0] for i in range(256)])
        self.usual = {one.name: [self._values(one, part) for part in one.usual] for one in face.fields}
        self.holders = {
            one.name: self._table([i in one.holders for i in range(256)])
            for one in face.fields
            if one.holders is not None
        }
        for one in (face.element, *face.fields):
            self.buffers[one.name] = self._place(self.count * one.size * len(one.usual))
        self.wide = self._place(4 * self.count)
        """Cells of 4 bytes, while fresh values are spread."""

    def _place(self, size: int) -> int:
        place, self.end = self.end, aligned(self.end + size)
        return place

    def _data(self, octets: bytes) -> int:
        place = self._place(len(octets))
        self.module.data(place, octets)
        return place

    def _table(self, octets: Sequence[int]) -> int:
        return self._data(bytes(octets))

    def _values(self, one: Stored, values: tuple[float, ...]) -> int:
        real = one.pieces[0].is_real
        return self._data(
            struct.pack(f"<{len(values)}{'f' if real else 'i'}", *(values if real else map(int, values)))
        )

    def add(self) -> None:
        """Add all functions, and grow the memory by what they need."""
        ready = self._ready()
        show = self._show(ready)
        reads = [self._read(one) for one in self.face.fields]
        takes = [self._take_values(one) for one in self.face.fields]
        self._export("cells", "", "i32", lambda f: self._cells(f, ready))
        self._export("begin", "i32", "", lambda f: self._begin(f, ready))
        self._export("step", "i32", "", lambda f: self._step(f, ready))
        self.module.export(show, "show")
        self._export("field", "i32", "i32", lambda f: self._field(f, ready, reads))
        self._export("take", "i32", "", lambda f: self._take_number(f, show, takes))
        self._export("paint", "i32 " * 5, "", lambda f: self._paint(f, ready))
        self._export("set", "i32 " * 6 + "f64", "", lambda f: self._set(f, show, reads, takes))
        self._export("parameter", "i32 f64", "", lambda f: self._parameter(f, ready))
        self._export("clock", "", "i32", lambda f: self._clock(f, ready))
        self.module.custom("powderdsl", self.face.about)
        self.module.pages = self.end // PAGE + 1
        self.module.restart(self.library.top, self.end)

    def _export(self, name: str, params: str, results: str, fill: Callable[[Function], None]) -> None:
        f = self.library.function(params, results)
        fill(f)
        self.module.add(f, name, export=True)

    # The world

    def _ready(self) -> Callee:
        """Makes the world where there is none: of the first element, with seed 0."""
        f = self.library.function()
        with f.when(self.batch.value):
            f.leave()
        f.set(self.batch, self.batch_calls["allocate"](const("i32", 1), const("i32", self.face.rows)))
        for number, knob in enumerate(self.face.knobs):
            f.do(self._knob(number, knob)(const("f64", knob.default)))
        cells = const("i32", self.buffers["element"])
        f.fill(cells, const("i32", self.face.ids[0]), const("i32", self.count))
        f.do(self._fresh()(ZERO))
        return self.module.add(f, "ready")

    def _fresh(self) -> Callee:
        """The ids in the buffer become a world of a seed, with fresh cells."""

        def make() -> Callee:
            f, batch = self.library.function("i32"), self.batch.value
            cells = const("i32", self.buffers["element"])
            with f.each(ZERO, const("i32", self.count)) as i:
                found = load("i32.load8_u", load("i32.load8_u", cells + i), self.valid)
                f.store("i32.store8", cells + i, found)
            (piece,) = self.face.element.pieces
            f.do(self._load(piece, cells, 1))
            for one in self.face.fields:
                for piece, table in zip(one.pieces, self.usual[one.name], strict=True):
                    with f.each(ZERO, const("i32", self.count)) as i:
                        value = word(load("i32.load8_u", cells + i) << 2, table)
                        f.store("i32.store", i << 2, value, self.wide)
                    f.do(self._load(piece, const("i32", self.wide), 4))
            f.store("i64.store", batch, op("i64.extend_i32_u", f.param(0)), HEADER)
            f.store("i64.store", batch, const("i64", 0), HEADER + 8)
            f.store("i64.store", batch, const("i64", 0), HEADER + 16)
            return self.module.add(f, "fresh")

        return self.library.lazily("fresh", make)

    def _load(self, piece: Piece, address: Value, size: int) -> Value:
        batch, layout = self.batch.value, self.layout
        if piece.is_real:
            return self.batch_calls["load_real"](batch, const("i32", layout.reals[piece.slot]), address, ZERO)
        first, count = const("i32", layout.planes[piece.planes[0]]), const("i32", len(piece.planes))
        return self.batch_calls["load"](batch, first, count, const("i32", size), address)

    def _store(self, piece: Piece, address: Value, size: int) -> Value:
        batch, layout = self.batch.value, self.layout
        if piece.is_real:
            return self.batch_calls["store_real"](
                batch, const("i32", layout.reals[piece.slot]), address, ZERO
            )
        first, count = const("i32", layout.planes[piece.planes[0]]), const("i32", len(piece.planes))
        signed = const("i32", int(piece.signed))
        return self.batch_calls["store"](batch, first, count, signed, const("i32", size), address)

    def _cells(self, f: Function, ready: Callee) -> None:
        f.do(ready())
        f.give(const("i32", self.buffers["element"]))

    def _begin(self, f: Function, ready: Callee) -> None:
        f.do(ready())
        f.do(self._fresh()(f.param(0)))

    def _step(self, f: Function, ready: Callee) -> None:
        f.do(ready())
        f.do(self.batch_calls["run"](self.batch.value, f.param(0)))

    def _clock(self, f: Function, ready: Callee) -> None:
        f.do(ready())
        f.give(self.batch.value + HEADER)

    def _show(self, ready: Callee) -> Callee:
        f = self.library.function("", "i32")
        f.do(ready())
        cells = const("i32", self.buffers["element"])
        (piece,) = self.face.element.pieces
        f.do(self._store(piece, cells, 1))
        f.give(cells)
        return self.module.add(f, "show")

    # Fields

    @contextmanager
    def _chosen(self, f: Function, number: Value, which: int) -> Iterator[None]:
        with f.when(number.equals(which)):
            yield

    def _at(self, one: Stored, component: int) -> int:
        return self.buffers[one.name] + component * self.count * one.size

    def _read(self, one: Stored) -> Callee:
        """Writes the values of a field into its buffer."""
        f = self.library.function()
        for component, piece in enumerate(one.pieces):
            f.do(self._store(piece, const("i32", self._at(one, component)), one.size))
        return self.module.add(f, "read")

    def _take_values(self, one: Stored) -> Callee:
        """The values in a field's buffer become the field's, cut to what cells can have; the ids have been shown."""
        f = self.library.function()
        cells = const("i32", self.buffers["element"])
        for component, piece in enumerate(one.pieces):
            at, table = self._at(one, component), self.usual[one.name][component]
            with f.scope(), f.each(ZERO, const("i32", self.count)) as i:
                place = f.let(i * one.size)
                identity = f.let(load("i32.load8_u", cells + i))
                if piece.is_real:
                    self._cut_float(f, one, place, at)
                else:
                    self._cut_integer(f, one, piece, place, at)
                if one.name in self.holders:
                    holds = load("i32.load8_u", identity, self.holders[one.name])
                    with f.when(op("i32.eqz", holds)):
                        f.store(_STORES[one.size], place, word(identity << 2, table), at)
            f.do(self._load(piece, const("i32", at), one.size))
        return self.module.add(f, "take_values")

    def _cut_float(self, f: Function, one: Stored, place: Value, at: int) -> None:
        value = f.let(load("f32.load", place, at))
        low, high = const("f32", one.low), const("f32", one.high)
        f.set(value, op("f32.min", op("f32.max", value, low), high))
        # Without a number, and for small ones, the comparison does not hold.
        keeps = op("f32.ge", op("f32.abs", value), const("f32", one.snap))
        f.store("f32.store", place, either(keeps, value, const("f32", 0)), at)

    def _cut_integer(self, f: Function, one: Stored, piece: Piece, place: Value, at: int) -> None:
        name = {1: "i32.load8_s" if piece.signed else "i32.load8_u", 2: "i32.load16_s", 4: "i32.load"}[
            one.size
        ]
        value = f.let(load(name, place, at))
        if one.names_element:
            f.set(value, load("i32.load8_u", value, self.valid))
        else:
            self._bound(f, value, one)
        f.store(_STORES[one.size], place, value, at)

    def _bound(self, f: Function, value: Local, one: Stored) -> None:
        low, high = const("i32", int(one.low)), const("i32", int(one.high))
        f.set(value, either(op("i32.lt_s", value, low), low, value))
        f.set(value, either(op("i32.gt_s", value, high), high, value))

    def _field(self, f: Function, ready: Callee, reads: Sequence[Callee]) -> None:
        f.do(ready())
        for number, one in enumerate(self.face.fields):
            with self._chosen(f, f.param(0), number):
                f.do(reads[number]())
                f.give(const("i32", self.buffers[one.name]))
        f.give(ZERO)

    def _take_number(self, f: Function, show: Callee, takes: Sequence[Callee]) -> None:
        f.body += show().code + op("drop").code
        for number in range(len(self.face.fields)):
            with self._chosen(f, f.param(0), number):
                f.do(takes[number]())

    # Boxes

    def _box(self, f: Function, first: int) -> Box:
        """Top, bottom, left and right of a box, from parameters on, within the grid."""
        top, bottom, left, right = (f.param(first + i) for i in range(4))
        for start, stop, most in ((top, bottom, self.face.rows), (left, right, self.memory.width)):
            f.set(stop, either(op("i32.gt_s", stop, const("i32", most)), const("i32", most), stop))
            f.set(start, either(op("i32.lt_s", start, ZERO), ZERO, start))
            with f.when(op("i32.ge_s", start, stop)):
                f.leave()
        return top, bottom, left, right

    def _paint(self, f: Function, ready: Callee) -> None:
        f.do(ready())
        top, bottom, left, right = self._box(f, 1)
        element = f.param(0)
        with f.when(element >= 256):
            f.leave()
        with f.when(op("i32.ne", load("i32.load8_u", element, self.valid), element)):
            f.leave()
        batch, layout = self.batch.value, self.layout
        parts: list[tuple[Piece, Value]] = [(self.face.element.pieces[0], element)]
        for one in self.face.fields:
            for piece, table in zip(one.pieces, self.usual[one.name], strict=True):
                if one.of_element:
                    kind = "f32.load" if piece.is_real else "i32.load"
                    parts.append((piece, load(kind, element << 2, table)))
        for piece, value in parts:
            box = (top, bottom, left, right, value)
            if piece.is_real:
                f.do(self.batch_calls["fill_real"](batch, ZERO, const("i32", layout.reals[piece.slot]), *box))
            else:
                first, count = const("i32", layout.planes[piece.planes[0]]), const("i32", len(piece.planes))
                f.do(self.batch_calls["fill"](batch, ZERO, first, count, *box))

    def _set(self, f: Function, show: Callee, reads: Sequence[Callee], takes: Sequence[Callee]) -> None:
        f.body += show().code + op("drop").code
        top, bottom, left, right = self._box(f, 2)
        component, given = f.param(1), f.param(6)
        for number, one in enumerate(self.face.fields):
            with self._chosen(f, f.param(0), number), f.scope():
                with f.when(component >= len(one.pieces)):
                    f.leave()
                f.do(reads[number]())
                real = one.pieces[0].is_real
                if real:
                    value = f.let(op("f32.demote_f64", given))
                else:
                    value = f.let(op("i32.trunc_sat_f64_s", given))
                    if not one.names_element:
                        self._bound(f, value, one)
                    else:
                        f.set(value, either(value >= 256, const("i32", 255), value))
                base = f.let(component * (self.count * one.size))
                with f.each(top, bottom) as y, f.each(left, right) as x:
                    place = base + (y * self.memory.width + x) * one.size
                    f.store("f32.store" if real else _STORES[one.size], place, value, self.buffers[one.name])
                f.do(takes[number]())

    # Parameters

    def _knob(self, number: int, knob: Knob) -> Callee:
        """Sets a parameter: its value, cut to its range, as bits and floats."""

        def make() -> Callee:
            f, layout, batch = self.library.function("f64"), self.layout, self.batch.value
            value = f.param(0)
            with f.when(op("f64.ne", value, value)):
                f.leave()
            f.set(value, op("f64.min", op("f64.max", value, const("f64", knob.low)), const("f64", knob.high)))
            if knob.whole:
                f.set(value, op("f64.floor", op("f64.add", value, const("f64", 0.5))))
            views: dict[Threshold | None, list[tuple[int, int]]] = {}
            for (name, threshold, bit), place in layout.param_planes.items():
                if name == knob.name:
                    views.setdefault(threshold, []).append((bit, place))
            for threshold, bits in views.items():
                limit = f.let(
                    op("i64.trunc_sat_f64_s", value if threshold is None else _limit(value, threshold))
                )
                for bit, place in bits:
                    f.store("i64.store8", self.bits(batch) + place, (limit >> bit) & 1)
            if knob.name in layout.param_reals:
                f.store(
                    "f32.store",
                    self.values(batch) + 4 * layout.param_reals[knob.name],
                    op("f32.demote_f64", value),
                )
            return self.module.add(f, "knob")

        return self.library.lazily(("knob", number), make)

    def _parameter(self, f: Function, ready: Callee) -> None:
        f.do(ready())
        for number, knob in enumerate(self.face.knobs):
            with self._chosen(f, f.param(0), number):
                f.do(self._knob(number, knob)(f.param(1)))


_STORES = {1: "i32.store8", 2: "i32.store16", 4: "i32.store"}


def _limit(value: Value, threshold: Threshold) -> Value:
    """As `codec.limits`: how many draws lie below a chance, or not above it."""
    count = 1 << threshold.bits
    scaled = op("f64.sub", op("f64.mul", value, const("f64", count)), const("f64", 0.5))
    one = (
        op("f64.ceil", scaled)
        if threshold.strict
        else op("f64.add", op("f64.floor", scaled), const("f64", 1))
    )
    return op("f64.min", op("f64.max", one, const("f64", 0)), const("f64", count))
