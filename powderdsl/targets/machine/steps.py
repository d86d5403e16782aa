"""Steps of batches: what comes before and between the passes of a program."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from powderdsl.ir.ops import REAL, Program
from powderdsl.system.random import START_0, START_1
from powderdsl.targets.machine.batches import GROUPS, WORLDS, Batches
from powderdsl.targets.machine.functions import Callee, Function, Local, Value, const, load, op
from powderdsl.targets.machine.library import ZERO, Library, counted, either, integers, word
from powderdsl.targets.machine.memory import HEADER, SOME


class Steps(Batches):
    """Makes the function that runs steps."""

    def __init__(self, library: Library, program: Program, passes: Sequence[Callee], asked: int):
        super().__init__(library)
        self.program, self.passes, self.asked = program, passes, asked

    def run(self, *, apart: bool) -> Function:
        """Runs a batch. `apart`: what it calls is exported too, so that a host can measure the time of passes."""
        f, module = self.library.function("i32 i32"), self.library.module
        batch, steps = f.param(0), f.param(1)
        enter = module.add(self._enter(), "enter", export=apart)
        begin = module.add(self._begin(), "begin", export=apart)
        leave = module.add(self._leave(), "leave", export=apart)
        if apart:
            count = self.library.function("i32", "i32")
            count.give(word(count.param(0), GROUPS))
            module.add(count, "groups", export=True)
            for number, one in enumerate(self.passes):
                module.exports.append((str(number), one))
        with f.block() as nothing:
            f.jump(nothing, op("i32.eqz", steps))
            with f.each(ZERO, word(batch, GROUPS)) as group:
                f.do(enter(batch, group))
                with f.each(ZERO, steps) as step:
                    f.do(begin(batch, group, step))
                    for one in self.passes:
                        f.do(one())
                f.do(leave())
        with f.each(ZERO, word(batch, WORLDS), some=False) as world:
            at = f.let(self.clock(batch, 2, world))
            f.store("i64.store", at, load("i64.load", at) + counted(steps))
        return f

    def _enter(self) -> Function:
        """A group becomes the one that runs: batch, number of the group."""
        f, library, memory = self.library.function("i32 i32"), self.library, self.memory
        batch, number = f.param(0), f.param(1)
        f.set(library.group, self.groups(batch) + number * memory.group)
        f.set(library.present, load("i64.load", library.group.value, memory.present))
        self._parameters(f, batch, number)
        return f

    def _leave(self) -> Function:
        f, library = self.library.function(), self.library
        f.store("i64.store", library.group.value, library.present.value, self.memory.present)
        return f

    @contextmanager
    def each_lane_of(self, f: Function, batch: Value, number: Value) -> Iterator[tuple[Local, Local]]:
        """The lanes of a group: bytes from the first one, and the world. Unused lanes are the last world once more."""
        shape = self.memory.shape
        last = f.let(word(batch, WORLDS) - 1)
        with f.each(ZERO, const("i32", shape.vector), shape.lane) as lane, f.scope():
            world = f.let(number * shape.lanes + (lane >> shape.lane.bit_length() - 1))
            f.set(world, either(self.library.strips.value, number, either(world < last, world, last)))
            yield lane, world

    def _parameters(self, f: Function, batch: Value, number: Value) -> None:
        """The parameters and the keys of a group's worlds."""
        layout, memory, library = self.layout, self.memory, self.library
        scalar = memory.shape.scalar
        with f.scope(), self.each_lane_of(f, batch, number) as (lane, world):
            worlds = f.let(word(batch, WORLDS))
            bits, values = f.let(self.bits(batch) + world), f.let(self.values(batch) + (world << 2))
            for i in range(len(layout.param_planes)):
                flags = op(f"{scalar}.sub", library.zero(), library.as_word(load("i32.load8_u", bits)))
                f.store(f"{scalar}.store", lane, flags, memory.at("params", i))
                f.set(bits, bits + worlds)
            for i in range(len(layout.param_reals)):
                place = lane >> memory.shape.lane // 8
                f.store("i32.store", place, word(values), memory.at("reals", i, 4 * memory.shape.lanes))
                f.set(values, values + (worlds << 2))
            seed, index = (f.let(load("i64.load", self.clock(batch, i, world))) for i in range(2))
            parts = [op("i32.wrap_i64", part) for part in (seed, seed >> 32, index)]
            for i, start in enumerate((START_0, START_1)):
                key = const("i32", start)
                for part in parts:
                    key = library.mix(key + part)
                self.in_lane(f, lane, f.let(key), memory.at("worlds", i))

    def in_lane(self, f: Function, lane: Value, number: Value, at: int) -> None:
        """A number for each hash of a lane."""
        for offset in range(0, self.memory.shape.lane, 4):
            f.store("i32.store", lane, number, at + offset)

    def _begin(self) -> Function:
        """What comes before the passes of a step: batch, number of the group, steps that are done."""
        f, library, memory = self.library.function("i32 i32 i32"), self.library, self.memory
        batch, number, done = (f.param(i) for i in range(3))
        scalar = memory.shape.scalar
        with self.each_lane_of(f, batch, number) as (lane, world):
            step = f.let(load("i64.load", self.clock(batch, 2, world)) + counted(done))
            self.in_lane(f, lane, f.let(op("i32.wrap_i64", step)), memory.at("clock"))
            for (modulus, bit), i in self.layout.step_planes.items():
                flag = op("i32.wrap_i64", (op("i64.rem_u", step, const("i64", modulus)) >> bit) & 1)
                flags = op(f"{scalar}.sub", library.zero(), library.as_word(flag))
                f.store(f"{scalar}.store", lane, flags, memory.at("steps", i))
        bases = []
        for i in range(2):
            base = load("v128.load", ZERO, memory.at("worlds", i))
            bases.append(library.mixed(f, op("i32x4.add", base, load("v128.load", ZERO, memory.at("clock")))))
        apart = f.let(load("v128.load", ZERO, memory.at("apart")))
        for name, ident, _ in self.program.streams:
            with f.scope():
                first, second = (library.mixed(f, op("i32x4.add", base, integers(ident))) for base in bases)
                f.store("v128.store", ZERO, op("i32x4.add", first, apart), memory.keys(name))
                f.store("v128.store", ZERO, second, memory.keys(name) + memory.shape.vector)
        for i in range(len(self.layout.streams)):
            with f.scope():
                place = const("i32", memory.at("coins", i, 4))
                old = f.let(word(place))
                with f.when(old):
                    f.do(library.give(old))
                    f.store("i32.store", place, ZERO)
        self._reset(f)
        look = self._look()
        if look is not None:
            with f.when(op("i64.eq", library.present.value, const("i64", -1))):
                f.do(look())
        return f

    def _reset(self, f: Function) -> None:
        library, memory = self.library, self.memory
        for slot in self.program.slots:
            if not slot.resets:
                continue
            at, real = memory.slot(slot.name, slot.type), slot.type == REAL
            f.do((library.give_field if real else library.give)(word(library.group.value, at)))
            if real and slot.default:
                new = self._constant_field()(const("f32", float(slot.default)))
            else:
                same = library.calm if real else library.everything if slot.default else library.nothing
                new = library.keep(same.value)
            f.store("i32.store", library.group.value, new, at)

    def _constant_field(self) -> Callee:
        f, library, memory = self.library.function("f32", "i32"), self.library, self.memory
        field = f.let(library.take_field())
        f.store("i32.store", field, const("i32", 1), SOME)
        with f.each(ZERO, library.lines.value) as line:
            f.store("i32.store8", field + line, const("i32", 1), HEADER)
            start = f.let(library.line_start(field, line))
            with f.each(ZERO, const("i32", 4 * memory.width), 4) as at:
                f.store("f32.store", start + at, f.param(0))
            library.finish_line(f, start)
        f.give(field)
        return library.module.add(f, "constant_field")

    def _look(self) -> Callee | None:
        """Finds which of the ids in `asked` are present, from products of their low and high bits."""
        library, memory = self.library, self.memory
        names = [name for name in self.layout.planes if name.startswith("element:")]
        ids = [code for code in range(1 << len(names)) if self.asked >> code & 1]
        if not ids:
            return None
        f = library.function()
        planes = [
            f.let(word(library.group.value, memory.slot(f"element:{i}", None))) for i in range(len(names))
        ]
        found = {code: f.let(const("v128", 0)) for code in ids}
        low = len(names) // 2

        def products(bits: Sequence[Value]) -> list[Local]:
            made = [f.let(const("v128", -1))]
            for bit in bits:
                rest = [f.let(op("v128.andnot", one, bit)) for one in made]
                made = [*rest, *(f.let(one & bit) for one in made)]
            return made

        with f.each(ZERO, library.cells.value, memory.shape.vector) as at, f.scope():
            bits = [f.let(load("v128.load", plane + at, memory.base)) for plane in planes]
            low_products, high = products(bits[:low]), products(bits[low:])
            for code in ids:
                both = low_products[code & (1 << low) - 1] & high[code >> low]
                f.set(found[code], found[code] | both)
        total = const("i64", 0)
        for code in ids:
            total = total | (counted(op("v128.any_true", found[code])) << code)
        f.set(library.present, total)
        return library.module.add(f, "look")
