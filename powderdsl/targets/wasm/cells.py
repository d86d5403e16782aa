"""Loops over cells: line by line, four floats at a time. Lines outside the region are skipped."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from powderdsl.ir.ops import REAL, SNAP, Node, ordered
from powderdsl.schedule.rows import chains_of, region_of
from powderdsl.schedule.types import Compute, loaded
from powderdsl.targets.layout import param_key
from powderdsl.targets.printing import CellValues
from powderdsl.targets.wasm.binary import I32, Callee, Function, Local, Value, const, floats, load, op, vector
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

CHUNK = 4
BITS = struct.pack("<4I", 1, 2, 4, 8)
_ARITHMETIC = {"add", "sub", "mul", "neg", "abs", "sqrt", "eq", "lt", "le"}


class CellLoop:
    """A function with one loop over cells. Its parameters are planes and fields: those read, and those written."""

    def __init__(self, library: Library, loop: Compute):
        self.library, self.loop, self.memory = library, loop, library.memory
        values = [out.value for out in loop.outs]
        olds = [old for _, old in loop.unchanged() if old.op == "load"]
        region = [] if loop.region is None else [loop.region]
        self.reads = list(dict.fromkeys(loaded([*values, *region, *olds])))
        self.f = f = Function(["i32"] * (len(self.reads) + len(loop.outs)))
        self.held = dict(zip(self.reads, f.params, strict=False))
        self.outs = f.params[len(self.reads) :]
        self.nodes = ordered(values)
        self.starts: dict[tuple[str, int, bool], Local] = {}

    def made(self) -> Callee:
        """The function."""
        f, library, memory = self.f, self.library, self.memory
        line = self.line = f.let(0)
        self.somewhere = [f.let(0) for _ in self.outs]
        with f.each(0, 16, 8) as lane:
            self.lane = lane
            with f.each(lane, lane + library.cells, memory.row) as row:
                self.row = row
                with f.scope(), f.block() as skip:
                    self.skip = skip
                    self.starts = {}
                    self.lay() if self.loop.over == "choices" else self.body()
                f.set(line, line + 1)
        for out, place, found in zip(self.loop.outs, self.outs, self.somewhere, strict=True):
            f.set(place[SOME], found)
            if out.var.type != REAL:
                f.set(place[HALOED], 0)
        return library.module.add(f, f"cells_{self.loop.place.rpartition('/')[2]}")

    # Lines

    def start(self, field: str, dy: int = 0, *, wraps: bool = True) -> Local:
        """Where a line of a field begins; made before the loop over its cells."""
        return self.starts[field, dy, wraps]

    def find_starts(self) -> None:
        for node in self.nodes:
            if node.type != REAL or node.op not in ("load", "shift"):
                continue
            dy, _, wraps = node.attr if node.op == "shift" else (0, 0, True)
            name = str(node.args[0].attr if node.op == "shift" else node.attr)
            key = (name, dy, wraps or not dy)
            if key not in self.starts:
                line = self.library.other_line(self.line, dy, wraps=key[2])
                line = line if isinstance(line, Local) else self.f.let(line)
                self.starts[key] = self.f.let(self.library.line(self.held[name], line))

    def live(self, field: Value, line: Value | None = None) -> Value:
        return (field + (self.line if line is None else line))[LIVE]

    def set_live(self, place: int, value: Value) -> None:
        f = self.f
        value = f.let(value)
        f.set((self.outs[place] + self.line)[LIVE], value)
        f.set(self.somewhere[place], self.somewhere[place] | value)

    def flags(self, plane: Value, at: Value) -> Value:
        """The word of a plane for this lane; `at`: bytes from its first word."""
        return (plane + at)[self.memory.half]

    def row_flags(self, planes: Sequence[str]) -> Value:
        """Whether planes hold a flag in this row of the lane."""
        found = const("i64", 0)
        if self.memory.words <= 4:
            for name in planes:
                for w in range(self.memory.words):
                    found = found | load("i64.load", self.held[name] + self.row, self.memory.base + 16 * w)
            return op("i64.ne", found, const("i64", 0))
        f = self.f
        total = f.let(found)
        for name in planes:
            with f.each(0, self.memory.row, 16) as at:
                f.set(total, total | self.flags(self.held[name], self.row + at))
        return op("i64.ne", total, const("i64", 0))

    def copy(self, place: int, source: Local) -> None:
        """A line as it is in another field."""
        f = self.f
        self.set_live(place, self.live(source))
        with f.when(self.live(source)):
            self.copy_cells(
                self.library.line_start(self.outs[place], self.line),
                self.library.line_start(source, self.line),
            )

    def copy_cells(self, to: Value, source: Value) -> None:
        library = self.library
        copy = library.lazily("copy_line", lambda: library.module.define(self._copy_line))
        self.f.do(copy(to, source))

    def _copy_line(self, f: Function, to: I32, source: I32) -> None:
        begin = -4 * self.memory.halo
        with f.each(0, 4 * self.memory.stride - 16, 16) as at:
            f.set(load("v128.load", (to + begin) + at), load("v128.load", (source + begin) + at))

    # Values, chunk by chunk

    def skipped(self) -> None:
        """Skip a line outside the region."""
        f, loop = self.f, self.loop
        if loop.region is None:
            return
        fields, planes = region_of(loop)
        busy = ZERO
        for part in fields:
            line = self.library.other_line(self.line, part.attr[0], wraps=True)
            busy = busy | self.live(self.held[str(part.args[0].attr)], line)
        busy = busy | self.row_flags(planes) if planes else busy
        with f.when(op("i32.eqz", busy)):
            for i, out in enumerate(loop.outs):
                assert out.otherwise is not None
                if out.otherwise.op == "load":
                    self.copy(i, self.held[str(out.otherwise.attr)])
                elif out.var.type == REAL:
                    self.set_live(i, ZERO)
                else:
                    if out.otherwise.attr:
                        f.set(self.somewhere[i], const("i32", 1))
                    for w in range(self.memory.words):
                        value = const("i64", self.valid(w) if out.otherwise.attr else 0)
                        f.set(load("i64.load", self.outs[i] + self.row, self.memory.base + 16 * w), value)
            f.jump(self.skip)

    def valid(self, w: int) -> int:
        """The columns of a word that lie in the grid."""
        return (1 << min(WORD, self.memory.width - WORD * w)) - 1

    def body(self) -> None:
        f, memory, library = self.f, self.memory, self.library
        self.skipped()
        self.find_starts()
        width = memory.width
        fields = [(i, out) for i, out in enumerate(self.loop.outs) if out.var.type == REAL]
        flags = [(i, out) for i, out in enumerate(self.loop.outs) if out.var.type != REAL]
        lines = {i: f.let(library.line_start(self.outs[i], self.line)) for i, _ in fields}
        alive = {i: f.let(const("v128", 0)) for i, _ in fields}
        with self.each_word() as (at, x, stop):
            bits = {i: f.let(const("i64", 0)) for i, _ in flags}
            planes = [str(node.attr) for node in self.nodes if node.op == "load" and node.type != REAL]
            words = {name: f.let(self.flags(self.held[name], at)) for name in dict.fromkeys(planes)}
            with f.each(x, stop, CHUNK) as column, f.scope():
                self.column, self.at = column, at
                values = Chunks(self, words)
                found = [values.of(out.value) for out in self.loop.outs]
                found = [v if isinstance(v, Local) else f.let(v) for v in found]
                for i, _ in fields:
                    f.set(load("v128.load", lines[i] + (column << 2)), found[i])
                    kept = found[i]
                    if width % CHUNK:
                        kept = kept & load("v128.load", column << 2, memory.at("columns") + 4 * memory.halo)
                    f.set(alive[i], alive[i] | kept)
                for i, _ in flags:
                    four = op("i64.extend_i32_u", op("i32x4.bitmask", found[i]))
                    f.set(bits[i], bits[i] | (four << counted(column)))
            for i, _ in flags:
                value: Value = bits[i]
                if not memory.whole:
                    value = value & self.valid_word(at)
                    f.set(bits[i], value)
                f.set(self.somewhere[i], self.somewhere[i] | op("i64.ne", bits[i], const("i64", 0)))
                f.set((self.outs[i] + at)[memory.half], bits[i])
        for i, _ in fields:
            self.set_live(i, some(op("i32x4.shl", alive[i], const("i32", 1))))
            library.finish_line(f, lines[i])

    def valid_word(self, at: Value) -> Value:
        return (self.library.everything + at)[self.memory.half]

    @contextmanager
    def each_word(self) -> Iterator[tuple[Value, Value, Value]]:
        """The words of a row: bytes from the plane's first word, the first column, the column after the last."""
        f, memory = self.f, self.memory
        if memory.words == 1:
            yield self.row, ZERO, const("i32", memory.width)
            return
        at, x = f.let(self.row), f.let(0)
        with f.loop() as again:
            stop = x + WORD
            if not memory.whole:
                stop = f.let(stop)
                f.set(stop, either(stop < memory.width, stop, const("i32", memory.width)))
            yield at, x, stop
            f.set(at, at + 16)
            f.set(x, x + WORD)
            f.jump(again, x < memory.width)

    # Chains of choices

    def lay(self) -> None:
        """A line of all choices: chunk by chunk in which a choice holds, one choice after the other.

        What follows from the results comes last, if they are not the new fields themselves.
        """
        f, library, memory, outs = self.f, self.library, self.memory, self.loop.outs
        chains = chains_of(self.loop)
        bases = [self.held[str(chain[0].args[2].attr)] for chain in chains]
        masks = [str(choice.args[0].attr) for choice in chains[0]]
        continued = [chain[-1] for chain in chains] != [out.value for out in outs]
        any_flag = self.row_flags(list(dict.fromkeys(masks)))
        if continued:
            for base in bases:
                any_flag = any_flag | self.live(base)
        with f.when(op("i32.eqz", any_flag)):
            for i in range(len(outs)):
                self.set_live(i, ZERO) if continued else self.copy(i, bases[i])
            f.jump(self.skip)
        self.find_starts()
        for i in range(len(outs)):
            self.set_live(i, const("i32", 1))
        lines = [f.let(library.line_start(place, self.line)) for place in self.outs]
        running = lines
        if continued:
            first = memory.at("chains") + 4 * memory.halo
            running = [f.let(const("i32", first + 4 * memory.stride * i)) for i in range(len(chains))]
        for chain, line in zip(chains, running, strict=True):
            self.copy_cells(line, self.start(str(chain[0].args[2].attr)))
        with self.each_word() as (at, x, _):
            for level, mask in enumerate(masks):
                with f.scope():
                    self.choose(at, x, mask, [chain[level] for chain in chains], running)
        if continued:
            with f.each(0, memory.width, CHUNK) as self.column, f.scope():
                values = Chunks(self, {})
                for chain, line in zip(chains, running, strict=True):
                    values.known[id(chain[-1])] = f.let(load("v128.load", line + (self.column << 2)))
                for out, line in zip(outs, lines, strict=True):
                    f.set(load("v128.load", line + (self.column << 2)), values.of(out.value))
        for start in lines:
            library.finish_line(f, start)

    def choose(self, at: Value, x: Value, mask: str, choices: Sequence[Node], lines: Sequence[Local]) -> None:
        """Choices on a mask, in the chunks of a word in which it holds: `x` is the word's first column."""
        f = self.f
        left = f.let(self.flags(self.held[mask], at))
        with f.block() as done, f.loop() as again:
            f.jump(done, op("i64.eqz", left))
            nibble = f.let(op("i64.ctz", left) & (WORD - CHUNK))
            self.column = f.let(x + op("i32.wrap_i64", nibble))
            four = splat(op("i32.wrap_i64", left >> nibble))
            chosen = f.let(op("i32x4.eq", four & vector(BITS), vector(BITS)))
            f.set(left, left & (const("i64", -1) ^ (const("i64", 15) << nibble)))
            values = Chunks(self, {})
            places = [line + (self.column << 2) for line in lines]
            for choice, place in zip(choices, places, strict=True):
                values.known[id(choice.args[2])] = f.let(load("v128.load", place))
            for choice, place in zip(choices, places, strict=True):
                new = choose(chosen, values.of(choice.args[1]), values.known[id(choice.args[2])])
                f.set(load("v128.load", place), new)
            f.jump(again)


class Chunks(CellValues[Value]):
    """Values of four cells: floats, or flags as lanes of ones."""

    def __init__(self, loop: CellLoop, words: dict[str, Local]):
        super().__init__()
        self.loop, self.f, self.library, self.words = loop, loop.f, loop.library, words
        self.memory = loop.memory
        self.choices = [node for node in loop.nodes if node.op == "select"]
        self.uses = Counter(id(arg) for node in loop.nodes for arg in node.args)

    def nibble(self, node: Node) -> Value:
        """The bits of a flag's plane from this column on: i32."""
        if node.op == "param":
            number = self.memory.layout.param_planes[param_key(node)]
            return op("i32.wrap_i64", load("i64.load", self.loop.lane, self.memory.at("params", number)))
        return op("i32.wrap_i64", self.words[str(node.attr)] >> counted(self.loop.column))

    def spread(self, bits: Value) -> Value:
        """Four bits as lanes."""
        return op("i32x4.eq", splat(bits) & vector(BITS), vector(BITS))

    def node(self, node: Node) -> Value:
        value = self.made_of(node)
        once = isinstance(value, Local) or node.op == "const" or self.uses[id(node)] < 2
        return value if once else self.f.let(value)

    def made_of(self, node: Node) -> Value:
        attr, args = node.attr, [self.known[id(arg)] for arg in node.args if id(arg) in self.known]
        memory, loop = self.memory, self.loop
        match node.op:
            case "const":
                return floats(float(attr))
            case "load" | "param" if node.type != REAL:
                return self.spread(self.nibble(node))
            case "load":
                return load("v128.load", loop.start(str(attr)) + (loop.column << 2))
            case "param":
                number = memory.layout.param_reals[attr[0]]
                return load("v128.load32_splat", loop.lane >> 1, memory.at("reals", number))
            case "draw":
                return self.draw(node)
            case "shift":
                dy, dx, wraps = attr
                start = loop.start(str(node.args[0].attr), dy, wraps=wraps or not dy)
                value = self.beside(start, dx)
                if wraps or not dx:
                    return value
                return value & self.beside(const("i32", memory.at("columns") + 4 * memory.halo), dx)
            case "div":
                return op("v128.andnot", op("f32x4.div", *args), op("f32x4.eq", args[1], floats(0)))
            case "min" | "max":
                a, b = (arg if isinstance(arg, Local) else self.f.let(arg) for arg in args)
                best = op("f32x4.pmin" if node.op == "min" else "f32x4.pmax", b, a)
                return choose(op("f32x4.ne", a, a), a, best)
            case "settle":
                lo, hi = attr
                x = self.f.let(args[0])
                self.f.set(x, x & op("f32x4.eq", x, x))
                self.f.set(x, op("f32x4.pmin", op("f32x4.pmax", x, floats(lo)), floats(hi)))
                return x & op("f32x4.ge", op("f32x4.abs", x), floats(SNAP))
        if node.op in _ARITHMETIC:
            return op(f"f32x4.{node.op}", *args)
        raise AssertionError(f"no function for {node.op} of floats")

    def beside(self, start: Value, dx: int) -> Value:
        return load("v128.load", (start + (self.loop.column << 2)) + 4 * dx)

    def draw(self, node: Node) -> Value:
        stream, bits = node.attr
        keys = self.memory.at("keys", self.memory.layout.streams[stream])
        loop, f = self.loop, self.f
        row = op("i32.sub", loop.row, loop.lane)
        y = f.let(row // self.memory.row)
        at = f.let(self.library.word_number(loop.at - loop.lane, y))
        found = f.let(const("v128", 0))
        for i in range(CHUNK):
            within = (loop.column + i) & (WORD - 1)
            number = self.library.draw_float()(at, loop.lane, within, const("i32", keys), const("i32", bits))
            f.set(found, op("f32x4.replace_lane", found, number, tail=bytes([i])))
        return found

    def led(self, node: Node) -> Value:
        """A comparison, computed only where its leader holds somewhere in the chunk, together with others it leads."""
        leader = node.args[0]
        first = self.of(leader)
        first = self.known[id(leader)] = first if isinstance(first, Local) else self.f.let(first)
        led = [one for one in self.loop.nodes if one.op == "led" and one.args[0] is leader]
        values = [self.f.let(const("v128", 0)) for _ in led]
        with self.f.when(some(first)), self.inner():
            for one, value in zip(led, values, strict=True):
                self.f.set(value, self.of(one.args[1]) & first)
        self.known |= {id(one): value for one, value in zip(led, values, strict=True)}
        return self.known[id(node)]

    def variable(self, value: Value) -> Value:
        return self.f.let(value)

    def chosen(self, mask: Node, variables: Sequence[Value], values: Sequence[Node]) -> None:
        f = self.f
        bits = f.let(self.nibble(mask) & 15)
        with f.when(bits):
            lanes = f.let(self.spread(bits))
            new = [self.of(value) for value in values]
            new = [value if len(new) == 1 else f.let(value) for value in new]
            for variable, value in zip(variables, new, strict=True):
                assert isinstance(variable, Local)
                f.set(variable, choose(lanes, value, variable))
