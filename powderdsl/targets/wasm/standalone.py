"""A module that is a world: a grid of one size with its elements' defaults, for a page or a game without powderdsl.

Numbers are i32 unless noted; rows and columns count from 0, and boxes end before `bottom` and `right`. Boxes are cut to the
grid, and values are clamped to the range of the rules, so that a host cannot make an invalid world.

    cells() → address                 the ids, a byte a cell, row by row
    begin(seed)                       the cells there become a new world, at step 0, with the usual values of fields
    step(count)
    show() → address                  the ids of the current world, at the same address
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
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from powderdsl.ir.ops import REAL, SNAP, SlotType, Threshold
from powderdsl.targets.wasm.binary import F64, I32, Callee, Local, Value, body, const, load, op
from powderdsl.targets.wasm.driver import Batches
from powderdsl.targets.wasm.host import HEADER, aligned, numbers_of
from powderdsl.targets.wasm.library import PAGE, Library, counted, either

Item = TypeVar("Item")


@dataclass(frozen=True)
class Stored:
    """An array of the state other than the element: its parts, the instruction that loads a cell, its bytes and range.

    `usual`: by component and id, the value of a fresh cell. `holders`: the ids of elements whose cells can have other
    values; None for all. `of_element`: the values travel with the element.
    """

    name: str
    pieces: tuple[SlotType, ...]
    load: str
    size: int
    usual: tuple[tuple[float, ...], ...]
    low: float
    high: float
    holders: frozenset[int] | None
    of_element: bool
    names_element: bool


@dataclass(frozen=True)
class ModuleParameter:
    """A parameter: its name, default and range."""

    name: str
    default: float
    low: float
    high: float
    whole: bool


@dataclass(frozen=True)
class ModuleData:
    """The data of a standalone module; `about` is for the custom section."""

    rows: int
    ids: tuple[int, ...]
    element: SlotType
    fields: tuple[Stored, ...]
    knobs: tuple[ModuleParameter, ...]
    about: bytes


class Standalone(Batches):
    """Makes the functions of one world, on those of batches (`calls`)."""

    def __init__(self, library: Library, face: ModuleData, calls: dict[str, Callee]):
        super().__init__(library)
        self.face, self.calls = face, calls
        self.batch = library.module.variable("i32")
        self.end = library.memory.top
        self.width = self.memory.width or 0
        self.count = face.rows * self.width
        self.valid = self._data(bytes(i if i in face.ids else face.ids[0] for i in range(256)))
        self.cells_at = const("i32", self._place(self.count))
        self.parts = {slot.name: list(self._parts(slot)) for slot in face.fields}
        """The pieces of fields, the addresses of their cells for the host, and tables of fresh values."""
        self.reads: dict[str, Callee] = {}
        self.takes: dict[str, Callee] = {}

    def _parts(self, slot: Stored) -> Iterator[tuple[SlotType, int, int]]:
        at = self._place(self.count * slot.size * len(slot.pieces))
        for i, (piece, values) in enumerate(zip(slot.pieces, slot.usual, strict=True)):
            table = self._data(struct.pack(f"<256{'f' if piece.type == REAL else 'i'}", *values))
            yield piece, at + i * self.count * slot.size, table

    def _place(self, size: int) -> int:
        """Static memory, with padding for bytes that `store` writes beyond the end."""
        place, self.end = self.end, aligned(self.end + size + 3)
        return place

    def _data(self, octets: bytes) -> int:
        place = self._place(len(octets))
        self.library.module.data(place, octets)
        return place

    def add(self) -> None:
        """Add all functions, and grow the memory by the size of their buffers."""
        module, define = self.library.module, self.library.module.define
        self.define(self.begin, self.show, self.parameter, export=True)
        for slot in self.face.fields:
            self.reads[slot.name] = define(partial(self._read, slot), "read")
            self.takes[slot.name] = define(partial(self._take_values, slot), "take_values")
        self.define(self.cells, self.step, self.clock, self.field, self.take, export=True)
        self.define(self.paint, self.set, export=True)
        module.start(define(self._start))
        module.custom("powderdsl", self.face.about)
        module.pages = self.end // PAGE + 1
        module.restart(self.library.top, self.end)

    # The world

    def _start(self) -> None:
        """Make a world of the first element, with seed 0."""
        self.batch.set(self.calls["allocate"](1, self.face.rows, self.width))
        for number, knob in enumerate(self.face.knobs):
            body.do(self.calls["parameter"](number, const("f64", knob.default)))
        body.do(op("memory.fill", self.cells_at, self.face.ids[0], self.count))
        body.do(self.calls["begin"](0))

    def begin(self, seed: I32) -> None:
        """Turn the ids in the buffer into a world of fresh cells with a seed."""
        with body.each(0, self.count) as i:
            cell = load("i32.load8_u", self.cells_at + i)
            cell.set(load("i32.load8_u", cell, self.valid))
            self._freshen(i, cell, self.face.fields)
        self._put(self.face.fields)
        for number, start in enumerate((counted(seed), *[const("i64", 0)] * 2)):
            load("i64.load", self.batch, HEADER + 8 * number).set(start)

    def _freshen(self, cell: Value, element: Value, slots: Iterable[Stored]) -> None:
        """Set the fields of a cell to the usual values of an element, for the host."""
        for slot in slots:
            for piece, at, usual in self.parts[slot.name]:
                load(slot.load, cell * slot.size, at).set(_fresh_value(piece, element, usual))

    def _put(self, slots: Iterable[Stored]) -> None:
        """Load the ids and fields that the host sees into the world."""
        self._move("load", self.face.element, self.cells_at, 1)
        for slot in slots:
            for piece, at, _ in self.parts[slot.name]:
                self._move("load", piece, at, slot.size)

    def _move(self, how: str, piece: SlotType, address: Value | int, size: int) -> None:
        """`load` or `store` the cells of a piece."""
        body.do(self.calls[how](self.batch, *numbers_of(piece, self.layout, size), address, 0))

    def cells(self) -> Value:
        return self.cells_at

    def step(self, count: I32) -> None:
        body.do(self.calls["run"](self.batch, count))

    def clock(self) -> Value:
        """The address of the world's seed, index and step."""
        return self.batch + HEADER

    def show(self) -> Value:
        self._move("store", self.face.element, self.cells_at, 1)
        return self.cells_at

    # Fields

    def _read(self, slot: Stored) -> None:
        """Write the values of a field into its buffer."""
        for piece, at, _ in self.parts[slot.name]:
            self._move("store", piece, at, slot.size)

    def _take_values(self, slot: Stored) -> None:
        """Load a field from its buffer, clamped to values that cells can have; `show` must have run before."""
        low, high = slot.low, slot.high
        for piece, at, usual in self.parts[slot.name]:
            with body.scope(), body.each(0, self.count) as i:
                place = body.let(i * slot.size)
                identity = body.let(load("i32.load8_u", self.cells_at + i))
                cell = load(slot.load, place, at)
                if piece.type == REAL:
                    value = body.let(_within(cell, low, high))
                    # The comparison is false for NaN and for tiny numbers.
                    large = op("f32.ge", op("f32.abs", value), SNAP)
                    cell.set(either(large, value, 0))
                else:
                    value = body.let(cell)
                    if slot.names_element:
                        value.set(load("i32.load8_u", value, self.valid))
                    else:
                        value.set(either(op("i32.lt_s", value, int(low)), int(low), value))
                        value.set(either(op("i32.gt_s", value, int(high)), int(high), value))
                    cell.set(value)
                if slot.holders is not None:
                    holders = self._data(bytes(i in slot.holders for i in range(256)))
                    with body.when(load("i32.load8_u", identity, holders).equals(0)):
                        cell.set(_fresh_value(piece, identity, usual))
            self._move("load", piece, at, slot.size)

    def field(self, number: I32) -> int:
        for slot in _of_number(number, self.face.fields):
            body.do(self.reads[slot.name]())
            body.give(self.parts[slot.name][0][1])
        return 0

    def take(self, number: I32) -> None:
        body.do(self.calls["show"]())
        for slot in _of_number(number, self.face.fields):
            body.do(self.takes[slot.name]())

    # Boxes

    @contextmanager
    def _each_cell(self, top: Local, bottom: Local, left: Local, right: Local) -> Iterator[Local]:
        """The cells of a box within the grid; the function returns before, if there are none."""
        for start, stop, most in ((top, bottom, self.face.rows), (left, right, self.width)):
            stop.set(either(op("i32.gt_s", stop, most), most, stop))
            start.set(either(op("i32.lt_s", start, 0), 0, start))
            with body.when(op("i32.ge_s", start, stop)):
                body.leave()
        with body.each(top, bottom) as y, body.each(left, right) as x:
            yield body.let(y * self.width + x)

    def paint(self, element: I32, top: I32, bottom: I32, left: I32, right: I32) -> None:
        with body.when(element >= 256):
            body.leave()
        with body.when(op("i32.ne", load("i32.load8_u", element, self.valid), element)):
            body.leave()
        body.do(self.calls["show"]())
        fresh = [slot for slot in self.face.fields if slot.of_element]
        for slot in fresh:
            body.do(self.reads[slot.name]())
        with self._each_cell(top, bottom, left, right) as cell:
            load("i32.load8_u", self.cells_at + cell).set(element)
            self._freshen(cell, element, fresh)
        self._put(fresh)

    def set(
        self, field: I32, component: I32, top: I32, bottom: I32, left: I32, right: I32, value: F64
    ) -> None:
        body.do(self.calls["show"]())
        for slot in _of_number(field, self.face.fields):
            with body.when(component >= len(slot.pieces)):
                body.leave()
            body.do(self.reads[slot.name]())
            convert = "f32.demote_f64" if slot.pieces[0].type == REAL else "i32.trunc_sat_f64_s"
            stored = body.let(op(convert, _within(value, slot.low, slot.high)))
            base = body.let(component * (self.count * slot.size))
            with self._each_cell(top, bottom, left, right) as cell:
                load(slot.load, base + cell * slot.size, self.parts[slot.name][0][1]).set(stored)
            body.do(self.takes[slot.name]())

    # Parameters

    def parameter(self, number: I32, value: F64) -> None:
        with body.when(op("f64.ne", value, value)):
            body.leave()
        for knob in _of_number(number, self.face.knobs):
            self._set_knob(knob, value)

    def _set_knob(self, knob: ModuleParameter, value: Local) -> None:
        """Store a parameter's value, clamped to its range, as bits and floats."""
        layout = self.layout
        value.set(_within(value, knob.low, knob.high))
        if knob.whole:
            value.set(op("f64.floor", op("f64.add", value, 0.5)))
        views: dict[Threshold | None, list[tuple[int, int]]] = {}
        for (name, threshold, bit), place in layout.param_planes.items():
            if name == knob.name:
                views.setdefault(threshold, []).append((bit, place))
        for threshold, bits in views.items():
            limit = value if threshold is None else _limit(value, threshold)
            limit = body.let(op("i64.trunc_sat_f64_s", limit))
            for bit, place in bits:
                load("i64.load8_u", self.part(self.batch, 1) + place).set((limit >> bit) & 1)
        if knob.name in layout.param_reals:
            at = self.part(self.batch, 2) + 4 * layout.param_reals[knob.name]
            load("f32.load", at).set(op("f32.demote_f64", value))


def _of_number(number: Value, items: Iterable[Item]) -> Iterator[Item]:
    """Statements for each item; those of the item with this number run."""
    for i, item in enumerate(items):
        with body.when(number.equals(i)), body.scope():
            yield item


def _fresh_value(piece: SlotType, element: Value, table: int) -> Value:
    return load("f32.load" if piece.type == REAL else "i32.load", element << 2, table)


def _within(value: Value, low: float, high: float) -> Value:
    """A float, clamped to a range."""
    kind = value.type
    return op(f"{kind}.min", op(f"{kind}.max", value, low), high)


def _limit(value: Value, threshold: Threshold) -> Value:
    """The number of draws below a chance, or not above it, as in `targets.layout.limits`."""
    count = 1 << threshold.bits
    scaled = op("f64.sub", value * count, 0.5)
    return _within(op("f64.ceil", scaled) if threshold.strict else op("f64.floor", scaled) + 1, 0, count)
