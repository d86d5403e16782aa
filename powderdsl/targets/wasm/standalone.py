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
from dataclasses import dataclass
from functools import partial

from powderdsl.ir.ops import SNAP, Threshold
from powderdsl.targets.codec import Piece
from powderdsl.targets.wasm.binary import F64, I32, Callee, Function, Local, Value, const, load, op
from powderdsl.targets.wasm.driver import Batches
from powderdsl.targets.wasm.library import HEADER, PAGE, Library, aligned, either, word


@dataclass(frozen=True)
class Stored:
    """An array of the state: its parts, the bytes of a cell, and the values that cells may have.

    `usual`: by component and id, the value of a fresh cell. `holders`: the ids of elements whose cells can have another
    one; None for all. `of_element`: it comes and goes with the element.
    """

    name: str
    pieces: tuple[Piece, ...]
    size: int
    usual: tuple[tuple[float, ...], ...]
    low: float
    high: float
    holders: frozenset[int] | None
    of_element: bool
    names_element: bool


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


class Standalone(Batches):
    """Makes the functions of one world, on those of batches (`calls`)."""

    def __init__(self, library: Library, face: Face, calls: dict[str, Callee]):
        super().__init__(library)
        self.face, self.calls = face, calls
        self.batch = library.module.variable("i32")
        self.end = library.memory.top
        self.count = face.rows * self.memory.width
        self.valid = self._data(bytes(i if i in face.ids else face.ids[0] for i in range(256)))
        self.usual = {
            one.name: [self._values(one.pieces[0], values) for values in one.usual] for one in face.fields
        }
        self.holders = {
            one.name: self._data(bytes(i in one.holders for i in range(256)))
            for one in face.fields
            if one.holders is not None
        }
        self.buffers: dict[str, int] = {}
        for one in (face.element, *face.fields):
            self.buffers[one.name] = self._place(self.count * one.size * len(one.usual))
        self.cells_at = const("i32", self.buffers["element"])
        self.wide = self._place(4 * self.count)
        """Cells of 4 bytes, while fresh values are spread."""

    def _place(self, size: int) -> int:
        place, self.end = self.end, aligned(self.end + size)
        return place

    def _data(self, octets: bytes) -> int:
        place = self._place(len(octets))
        self.library.module.data(place, octets)
        return place

    def _values(self, piece: Piece, values: tuple[float, ...]) -> int:
        kind, numbers = ("f", values) if piece.is_real else ("i", tuple(map(int, values)))
        return self._data(struct.pack(f"<{len(numbers)}{kind}", *numbers))

    def add(self) -> None:
        """Add all functions, and grow the memory by what they need."""
        module, fields = self.library.module, self.face.fields
        self.ready = module.define(self._ready)
        self.shown = module.define(self.show)
        self.reads = [module.define(partial(self._read, one), "read") for one in fields]
        self.takes = [module.define(partial(self._take_values, one), "take_values") for one in fields]
        for body in (
            self.cells,
            self.begin,
            self.step,
            self.show,
            self.field,
            self.take,
            self.paint,
            self.set,
        ):
            module.define(body, export=True)
        module.define(self.parameter, export=True)
        module.define(self.clock_at, "clock", export=True)
        module.custom("powderdsl", self.face.about)
        module.pages = self.end // PAGE + 1
        module.restart(self.library.top, self.end)

    # The world

    def _ready(self, f: Function) -> None:
        """Makes the world where there is none: of the first element, with seed 0."""
        with f.when(self.batch):
            f.leave()
        f.set(self.batch, self.calls["allocate"](1, self.face.rows))
        for number, knob in enumerate(self.face.knobs):
            f.do(self._knob(number)(const("f64", knob.default)))
        f.fill(self.cells_at, self.face.ids[0], self.count)
        f.do(self._fresh()(0))

    def _fresh(self) -> Callee:
        """The ids in the buffer become a world of a seed, with fresh cells."""

        def fresh(f: Function, seed: I32) -> None:
            with f.each(0, self.count) as i:
                cell = load("i32.load8_u", self.cells_at + i)
                f.set(cell, load("i32.load8_u", cell, self.valid))
            (piece,) = self.face.element.pieces
            f.do(self._load(piece, self.cells_at, 1))
            for one in self.face.fields:
                for piece, table in zip(one.pieces, self.usual[one.name], strict=True):
                    with f.each(0, self.count) as i:
                        value = word(load("i32.load8_u", self.cells_at + i) << 2, table)
                        f.set(word(i << 2, self.wide), value)
                    f.do(self._load(piece, const("i32", self.wide), 4))
            for number, start in enumerate((op("i64.extend_i32_u", seed), const("i64", 0), const("i64", 0))):
                f.set(load("i64.load", self.batch, HEADER + 8 * number), start)

        return self.library.lazily("fresh", lambda: self.library.module.define(fresh))

    def _load(self, piece: Piece, address: Value, size: int) -> Value:
        if piece.is_real:
            return self.calls["load_real"](self.batch, self.layout.reals[piece.slot], address, 0)
        first = self.layout.planes[piece.planes[0]]
        return self.calls["load"](self.batch, first, len(piece.planes), size, address)

    def _store(self, piece: Piece, address: int, size: int) -> Value:
        if piece.is_real:
            return self.calls["store_real"](self.batch, self.layout.reals[piece.slot], address, 0)
        first = self.layout.planes[piece.planes[0]]
        return self.calls["store"](self.batch, first, len(piece.planes), int(piece.signed), size, address)

    def cells(self, f: Function) -> Value:
        f.do(self.ready())
        return self.cells_at

    def begin(self, f: Function, seed: I32) -> None:
        f.do(self.ready())
        f.do(self._fresh()(seed))

    def step(self, f: Function, count: I32) -> None:
        f.do(self.ready())
        f.do(self.calls["run"](self.batch, count))

    def clock_at(self, f: Function) -> Value:
        f.do(self.ready())
        return self.batch + HEADER

    def show(self, f: Function) -> Value:
        f.do(self.ready())
        (piece,) = self.face.element.pieces
        f.do(self._store(piece, self.buffers["element"], 1))
        return self.cells_at

    # Fields

    def _at(self, one: Stored, component: int) -> int:
        return self.buffers[one.name] + component * self.count * one.size

    def _read(self, one: Stored, f: Function) -> None:
        """Writes the values of a field into its buffer."""
        for component, piece in enumerate(one.pieces):
            f.do(self._store(piece, self._at(one, component), one.size))

    def _take_values(self, one: Stored, f: Function) -> None:
        """The values in a field's buffer become the field's, cut to what cells can have; the ids have been shown."""
        for component, piece in enumerate(one.pieces):
            at, table = self._at(one, component), self.usual[one.name][component]
            with f.scope(), f.each(0, self.count) as i:
                place = f.let(i * one.size)
                identity = f.let(load("i32.load8_u", self.cells_at + i))
                if piece.is_real:
                    cell, value = load("f32.load", place, at), f.let(load("f32.load", place, at))
                    low, high = const("f32", one.low), const("f32", one.high)
                    f.set(value, op("f32.min", op("f32.max", value, low), high))
                    # Without a number, and for small ones, the comparison does not hold.
                    large = op("f32.ge", op("f32.abs", value), const("f32", SNAP))
                    f.set(cell, either(large, value, const("f32", 0)))
                else:
                    name = "i32.load8_s" if piece.signed and one.size == 1 else _LOADS[one.size]
                    cell = load(name, place, at)
                    value = f.let(cell)
                    if one.names_element:
                        f.set(value, load("i32.load8_u", value, self.valid))
                    else:
                        self._bound(f, value, one)
                    f.set(cell, value)
                if one.name in self.holders:
                    holds = load("i32.load8_u", identity, self.holders[one.name])
                    with f.when(holds.equals(0)):
                        f.set(load(_LOADS[one.size], place, at), word(identity << 2, table))
            f.do(self._load(piece, const("i32", at), one.size))

    def _bound(self, f: Function, value: Local, one: Stored) -> None:
        low, high = int(one.low), int(one.high)
        f.set(value, either(op("i32.lt_s", value, low), low, value))
        f.set(value, either(op("i32.gt_s", value, high), high, value))

    def field(self, f: Function, number: I32) -> int:
        f.do(self.ready())
        for i, one in enumerate(self.face.fields):
            with f.when(number.equals(i)):
                f.do(self.reads[i]())
                f.give(self.buffers[one.name])
        return 0

    def take(self, f: Function, number: I32) -> None:
        f.do(self.shown())
        for i, take in enumerate(self.takes):
            with f.when(number.equals(i)):
                f.do(take())

    # Boxes

    def _cut(self, f: Function, start: Local, stop: Local, most: int) -> None:
        """A side of a box, within the grid; nothing is done with an empty one."""
        f.set(stop, either(op("i32.gt_s", stop, most), most, stop))
        f.set(start, either(op("i32.lt_s", start, 0), 0, start))
        with f.when(op("i32.ge_s", start, stop)):
            f.leave()

    def paint(self, f: Function, element: I32, top: I32, bottom: I32, left: I32, right: I32) -> None:
        f.do(self.ready())
        self._cut(f, top, bottom, self.face.rows)
        self._cut(f, left, right, self.memory.width)
        with f.when(element >= 256):
            f.leave()
        with f.when(op("i32.ne", load("i32.load8_u", element, self.valid), element)):
            f.leave()
        parts: list[tuple[Piece, Value]] = [(self.face.element.pieces[0], element)]
        for one in self.face.fields:
            for piece, table in zip(one.pieces, self.usual[one.name], strict=True):
                if one.of_element:
                    kind = "f32.load" if piece.is_real else "i32.load"
                    parts.append((piece, load(kind, element << 2, table)))
        for piece, value in parts:
            box = (top, bottom, left, right, value)
            if piece.is_real:
                f.do(self.calls["fill_real"](self.batch, 0, self.layout.reals[piece.slot], *box))
            else:
                first, count = self.layout.planes[piece.planes[0]], len(piece.planes)
                f.do(self.calls["fill"](self.batch, 0, first, count, *box))

    def set(
        self,
        f: Function,
        number: I32,
        component: I32,
        top: I32,
        bottom: I32,
        left: I32,
        right: I32,
        given: F64,
    ) -> None:
        f.do(self.shown())
        self._cut(f, top, bottom, self.face.rows)
        self._cut(f, left, right, self.memory.width)
        for i, one in enumerate(self.face.fields):
            with f.when(number.equals(i)), f.scope():
                with f.when(component >= len(one.pieces)):
                    f.leave()
                f.do(self.reads[i]())
                real = one.pieces[0].is_real
                value = f.let(op("f32.demote_f64" if real else "i32.trunc_sat_f64_s", given))
                if one.names_element:
                    f.set(value, either(value >= 256, 255, value))
                elif not real:
                    self._bound(f, value, one)
                base = f.let(component * (self.count * one.size))
                with f.each(top, bottom) as y, f.each(left, right) as x:
                    place = base + (y * self.memory.width + x) * one.size
                    kind = "f32.load" if real else _LOADS[one.size]
                    f.set(load(kind, place, self.buffers[one.name]), value)
                f.do(self.takes[i]())

    # Parameters

    def _knob(self, number: int) -> Callee:
        """Sets a parameter: its value, cut to its range, as bits and floats."""
        knob, layout = self.face.knobs[number], self.layout

        def set_knob(f: Function, value: F64) -> None:
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
                limit = value if threshold is None else _limit(value, threshold)
                limit = f.let(op("i64.trunc_sat_f64_s", limit))
                for bit, place in bits:
                    f.set(load("i64.load8_u", self.bits(self.batch) + place), (limit >> bit) & 1)
            if knob.name in layout.param_reals:
                at = self.values(self.batch) + 4 * layout.param_reals[knob.name]
                f.set(load("f32.load", at), op("f32.demote_f64", value))

        return self.library.lazily(("knob", number), lambda: self.library.module.define(set_knob, "knob"))

    def parameter(self, f: Function, number: I32, value: F64) -> None:
        f.do(self.ready())
        for i in range(len(self.face.knobs)):
            with f.when(number.equals(i)):
                f.do(self._knob(i)(value))


_LOADS = {1: "i32.load8_u", 2: "i32.load16_s", 4: "i32.load"}
"""The instruction that loads an integer of some bytes; one of a byte may also have a sign."""


def _limit(value: Value, threshold: Threshold) -> Value:
    """As `codec.limits`: how many draws lie below a chance, or not above it."""
    count = 1 << threshold.bits
    scaled = op("f64.sub", op("f64.mul", value, const("f64", count)), const("f64", 0.5))
    if threshold.strict:
        limit = op("f64.ceil", scaled)
    else:
        limit = op("f64.add", op("f64.floor", scaled), const("f64", 1))
    return op("f64.min", op("f64.max", limit, const("f64", 0)), const("f64", count))
