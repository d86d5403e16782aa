"""Loops over cells: line by line, four floats at a time. Lines outside the region are skipped."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial, reduce
from operator import or_

from powderdsl.ir.ops import REAL, SNAP, Node
from powderdsl.schedule.rows import chains_of, region_of
from powderdsl.schedule.types import Compute, loaded, reads_of
from powderdsl.targets.layout import param_key
from powderdsl.targets.printing import CellValues
from powderdsl.targets.wasm.binary import I32, Local, Value, body, const, floats, load, op, vector
from powderdsl.targets.wasm.library import (
    HALOED,
    LIVE,
    SOME,
    WORD,
    ZERO,
    Library,
    choose,
    counted,
    either,
    some,
    splat,
)
from powderdsl.targets.wasm.words import Loop

CHUNK = 4
BITS = struct.pack("<4I", 1, 2, 4, 8)


def _best(instruction: str, a: Value, b: Value) -> Value:
    """The smaller or larger number; NaN if either is NaN, as in NumPy's minimum and maximum."""
    a, b = (arg if isinstance(arg, Local) else body.let(arg) for arg in (a, b))
    return choose(op("f32x4.ne", a, a), a, op(instruction, b, a))


def _clamped(value: Value, low: float, high: float) -> Value:
    """A number that may be stored: clamped, and 0 for NaN and for tiny values."""
    x = body.let(value)
    x &= op("f32x4.eq", x, x)
    x.set(op("f32x4.pmin", op("f32x4.pmax", x, floats(low)), floats(high)))
    return x & op("f32x4.ge", op("f32x4.abs", x), floats(SNAP))


_FLOATS: dict[str, str | Callable[..., Value]] = {
    "eq": "f32x4.eq",
    "lt": "f32x4.lt",
    "le": "f32x4.le",
    "add": "f32x4.add",
    "sub": "f32x4.sub",
    "mul": "f32x4.mul",
    "div": lambda a, b: op("v128.andnot", op("f32x4.div", a, b), op("f32x4.eq", b, floats(0))),
    "neg": "f32x4.neg",
    "abs": "f32x4.abs",
    "min": partial(_best, "f32x4.pmin"),
    "max": partial(_best, "f32x4.pmax"),
    "sqrt": "f32x4.sqrt",
    "clamp": _clamped,
}
"""Each operation on floats: its instruction, or a function of the arguments and the attribute's numbers."""


class CellLoop(Loop):
    """A loop over cells."""

    kind = "cells"

    def __init__(self, library: Library, loop: Compute):
        super().__init__(library, loop, loaded(loop.values))
        self.columns = self.memory.at("columns") + 4 * self.memory.halo
        self.starts: dict[tuple[str, int, bool], Local] = {}

    def write(self) -> None:
        library, memory = self.library, self.memory
        line = self.line = body.let(0)
        self.somewhere = [body.let(0) for _ in self.outs]
        with body.each(0, 16, 8) as lane:
            self.lane = lane
            with body.each(lane, lane + library.cells, memory.row) as row:
                self.row = row
                with body.scope(), body.block() as skip:
                    self.skip = skip
                    self.starts = {}
                    self.write_choices() if self.loop.over == "choices" else self.write_cells()
                line += 1
        for out, place, some_live in zip(self.loop.outs, self.outs, self.somewhere, strict=True):
            place[SOME] = some_live
            if out.var.type != REAL:
                place[HALOED] = 0

    # Lines

    def find_starts(self) -> None:
        """Compute the addresses of the lines to read, before the loop over their cells."""
        for read in reads_of(self.loop.results):
            key = (read.name, read.dy, read.wraps or not read.dy)
            if read.type == REAL and key not in self.starts:
                line = self.library.other_line(self.line, read.dy, wraps=read.wraps)
                line = line if isinstance(line, Local) else body.let(line)
                self.starts[key] = body.let(self.library.line(self.addresses[read.name], line))

    def live(self, field: Value, line: Value | None = None) -> Value:
        """A flag: the line of a field has a nonzero number; without `line`, the current one."""
        return (field + (self.line if line is None else line))[LIVE]

    def set_live(self, place: int, value: Value) -> None:
        """Note if the current line of an output has a nonzero number."""
        value = body.let(value)
        (self.outs[place] + self.line)[LIVE] = value
        self.somewhere[place] |= value

    def flags(self, plane: Value, at: Value) -> Value:
        """The word of a plane for this lane; `at`: bytes from its first word."""
        return (plane + at)[self.memory.half]

    def row_flags(self, planes: Iterable[str]) -> Value:
        addresses = [self.addresses[name] for name in planes]
        return op("i64.ne", self.library.row_flags(addresses, self.row, self.memory.half), 0)

    def skip_unless(self, is_live: Value, values: Iterable[Node | None]) -> None:
        """Skip a line unless a flag holds. Its outputs get `values`: copies of fields, constants, or zeros for None."""
        with body.when(op("i32.eqz", is_live)):
            for i, value in enumerate(values):
                if value is not None and value.op == "load":
                    self.copy(i, self.addresses[str(value.attr)])
                elif self.loop.outs[i].var.type == REAL:
                    self.set_live(i, ZERO)
                else:
                    full = value is not None and value.attr
                    if full:
                        self.somewhere[i].set(1)
                    for w in range(self.memory.words):
                        at, everything = self.memory.base + 16 * w, self.library.everything
                        columns = load("i64.load", everything + self.row, at) if full else 0
                        load("i64.load", self.outs[i] + self.row, at).set(columns)
            body.jump(self.skip)

    def copy(self, place: int, source: Value) -> None:
        self.set_live(place, self.live(source))
        with body.when(self.live(source)):
            fields = (self.outs[place], source)
            self.copy_cells(*(self.library.line_start(field, self.line) for field in fields))

    def copy_cells(self, to: Value, source: Value) -> None:
        body.do(self.library.module.once("copy_line", self._copy_line)(to, source))

    def _copy_line(self, to: I32, source: I32) -> None:
        begin = -4 * self.memory.halo
        with body.each(0, 4 * self.memory.stride - 16, 16) as at:
            load("v128.load", (to + begin) + at).set(load("v128.load", (source + begin) + at))

    # Values, chunk by chunk

    def skip_outside_region(self) -> None:
        if self.loop.region is None:
            return
        fields, planes = region_of(self.loop)
        busy = self.row_flags(planes) if planes else ZERO
        for live in fields:
            line = self.library.other_line(self.line, live.attr[0], wraps=True)
            busy = busy | self.live(self.addresses[str(live.args[0].attr)], line)
        self.skip_unless(busy, [out.otherwise for out in self.loop.outs])

    def write_cells(self) -> None:
        memory, library = self.memory, self.library
        self.skip_outside_region()
        self.find_starts()
        fields = [i for i, out in enumerate(self.loop.outs) if out.var.type == REAL]
        flags = [i for i, out in enumerate(self.loop.outs) if out.var.type != REAL]
        lines = {i: body.let(library.line_start(self.outs[i], self.line)) for i in fields}
        alive = {i: body.let(0, "v128") for i in fields}
        with self.each_word() as (at, x, stop):
            bits = {i: body.let(0, "i64") for i in flags}
            planes = [str(node.attr) for node in self.nodes if node.op == "load" and node.type != REAL]
            words = {name: body.let(self.flags(self.addresses[name], at)) for name in dict.fromkeys(planes)}
            with body.each(x, stop, CHUNK) as column, body.scope():
                self.column, self.at = column, at
                chunks = Chunks(self, words)
                values = [chunks.of(out.value) for out in self.loop.outs]
                values = [value if isinstance(value, Local) else body.let(value) for value in values]
                for i in fields:
                    load("v128.load", lines[i] + (column << 2)).set(values[i])
                    inside = values[i]
                    if library.width % CHUNK:
                        inside = inside & load("v128.load", column << 2, self.columns)
                    alive[i] |= inside
                for i in flags:
                    bits[i] |= counted(op("i32x4.bitmask", values[i])) << counted(column)
            for i in flags:
                if not memory.whole:
                    bits[i] &= (library.everything + at)[memory.half]
                self.somewhere[i] |= op("i64.ne", bits[i], 0)
                (self.outs[i] + at)[memory.half] = bits[i]
        for i in fields:
            self.set_live(i, some(op("i32x4.shl", alive[i], 1)))
            library.finish_line(lines[i])

    @contextmanager
    def each_word(self) -> Iterator[tuple[Value, Value, Value | int]]:
        """The words of a row: bytes from the plane's first word, the first column, the column after the last."""
        memory = self.memory
        if memory.words == 1:
            yield self.row, ZERO, self.library.width
            return
        at, x = body.let(self.row), body.let(0)
        with body.loop() as again:
            stop = x + WORD
            if not memory.whole:
                stop = body.let(stop)
                stop.set(either(stop < self.library.width, stop, self.library.width))
            yield at, x, stop
            at += 16
            x += WORD
            body.jump(again, x < self.library.width)

    # Chains of choices

    def write_choices(self) -> None:
        """Write a line, one choice after the other, each in the chunks in which it holds.

        Operations on the results come last, if the results are not the new fields themselves.
        """
        library, memory, outs = self.library, self.memory, self.loop.outs
        chains = chains_of(self.loop)
        bases = [chain[0].args[2] for chain in chains]
        masks = [str(choice.args[0].attr) for choice in chains[0]]
        continued = [chain[-1] for chain in chains] != [out.value for out in outs]
        busy = self.row_flags(dict.fromkeys(masks))
        if continued:
            busy = reduce(or_, (self.live(self.addresses[str(base.attr)]) for base in bases), busy)
        self.skip_unless(busy, [None] * len(outs) if continued else bases)
        self.find_starts()
        for i in range(len(outs)):
            self.set_live(i, const("i32", 1))
        lines = [body.let(library.line_start(place, self.line)) for place in self.outs]
        running = lines
        if continued:
            first = memory.at("chains") + 4 * memory.halo
            running = [body.let(first + 4 * memory.stride * i) for i in range(len(chains))]
        for base, line in zip(bases, running, strict=True):
            self.copy_cells(line, self.starts[str(base.attr), 0, True])
        with self.each_word() as (at, x, _):
            for level, mask in enumerate(masks):
                with body.scope():
                    self.choose(at, x, mask, [chain[level] for chain in chains], running)
        if continued:
            with body.each(0, library.width, CHUNK) as self.column, body.scope():
                values = Chunks(self, {})
                for chain, line in zip(chains, running, strict=True):
                    values.known[id(chain[-1])] = body.let(load("v128.load", line + (self.column << 2)))
                for out, line in zip(outs, lines, strict=True):
                    load("v128.load", line + (self.column << 2)).set(values.of(out.value))
        for start in lines:
            library.finish_line(start)

    def choose(self, at: Value, x: Value, mask: str, choices: Sequence[Node], lines: Sequence[Local]) -> None:
        """Choices on a mask, in the chunks of a word in which it holds: `x` is the word's first column."""
        left = body.let(self.flags(self.addresses[mask], at))
        with body.block() as done, body.loop() as again:
            body.jump(done, op("i64.eqz", left))
            nibble = body.let(op("i64.ctz", left) & (WORD - CHUNK))
            self.column = body.let(x + op("i32.wrap_i64", nibble))
            chosen = body.let(spread(op("i32.wrap_i64", left >> nibble)))
            left &= const("i64", -1) ^ (const("i64", 15) << nibble)
            values = Chunks(self, {})
            places = [line + (self.column << 2) for line in lines]
            for choice, place in zip(choices, places, strict=True):
                values.known[id(choice.args[2])] = body.let(load("v128.load", place))
            for choice, place in zip(choices, places, strict=True):
                new = choose(chosen, values.of(choice.args[1]), values.known[id(choice.args[2])])
                load("v128.load", place).set(new)
            body.jump(again)


def spread(bits: Value) -> Value:
    """Four bits as lanes."""
    return op("i32x4.eq", splat(bits) & vector(BITS), vector(BITS))


class Chunks(CellValues[Value]):
    """Values of four cells: floats, or flags as lanes of ones."""

    def __init__(self, loop: CellLoop, words: dict[str, Local]):
        super().__init__(loop.nodes)
        self.loop, self.library, self.words = loop, loop.library, words
        self.memory = loop.memory
        self.uses = Counter(id(arg) for node in loop.nodes for arg in node.args)

    def nibble(self, node: Node) -> Value:
        """The bits of a flag's plane from this column on: i32."""
        if node.op == "param":
            number = self.memory.layout.param_planes[param_key(node)]
            return op("i32.wrap_i64", load("i64.load", self.loop.lane, self.memory.at("params", number)))
        return op("i32.wrap_i64", self.words[str(node.attr)] >> counted(self.loop.column))

    def named(self, node: Node, value: Value) -> Value:
        once = isinstance(value, Local) or node.op == "const" or self.uses[id(node)] < 2
        return value if once else body.let(value)

    def node(self, node: Node, args: Sequence[Value]) -> Value:
        attr, memory, loop = node.attr, self.memory, self.loop
        match node.op:
            case "const":
                return floats(float(attr))
            case "load" | "param" if node.type != REAL:
                return spread(self.nibble(node))
            case "load":
                return self.beside(loop.starts[str(attr), 0, True], 0)
            case "param":
                number = memory.layout.param_reals[attr[0]]
                return load("v128.load32_splat", loop.lane >> 1, memory.at("reals", number))
            case "draw":
                return self.draw(node)
            case "select":
                return self.choice(node)
            case "led":
                return self.led(node)
            case "shift":
                dy, dx, wraps = attr
                start = loop.starts[str(node.args[0].attr), dy, wraps or not dy]
                value = self.beside(start, dx)
                return value if wraps or not dx else value & self.beside(const("i32", loop.columns), dx)
        row = _FLOATS[node.op]
        return op(row, *args) if isinstance(row, str) else row(*args, *(attr or ()))

    def beside(self, start: Value, dx: int) -> Value:
        return load("v128.load", (start + (self.loop.column << 2)) + 4 * dx)

    def draw(self, node: Node) -> Value:
        stream, bits = node.attr
        keys = self.memory.at("keys", self.memory.layout.streams[stream])
        loop, draw = self.loop, self.library.module.once("draw_float", self.library.draw_float)
        y = body.let((loop.row - loop.lane) // self.memory.row)
        at = body.let(self.library.word_number(loop.at - loop.lane, y))
        numbers = body.let(0, "v128")
        for i in range(CHUNK):
            within = (loop.column + i) & (WORD - 1)
            number = draw(at, loop.lane, within, keys, bits)
            numbers.set(op("f32x4.replace_lane", numbers, number, tail=bytes([i])))
        return numbers

    def led(self, node: Node) -> Value:
        """A comparison, computed only where its leader holds somewhere in the chunk, together with others it leads."""
        leader = node.args[0]
        first = self.of(leader)
        first = self.known[id(leader)] = first if isinstance(first, Local) else body.let(first)
        led = self.led_by(leader)
        values = [body.let(0, "v128") for _ in led]
        with body.when(some(first)), body.scope(), self.inner():
            for comparison, value in zip(led, values, strict=True):
                value.set(self.of(comparison.args[1]) & first)
        self.known |= zip(map(id, led), values, strict=True)
        return self.known[id(node)]

    def variable(self, value: Value) -> Value:
        return body.let(value)

    def chosen(self, mask: Node, variables: Sequence[Value], values: Sequence[Node]) -> None:
        with body.scope(), body.when(bits := body.let(self.nibble(mask) & 15)):
            lanes = body.let(spread(bits))
            new = [self.of(value) for value in values]
            new = [value if len(new) == 1 else body.let(value) for value in new]
            for variable, value in zip(variables, new, strict=True):
                assert isinstance(variable, Local)
                variable.set(choose(lanes, value, variable))
