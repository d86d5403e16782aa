"""Schedules → functions: one for each pass, which calls those of its loops and movements."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from powderdsl.ir.ops import FLAG, REAL, Node, Offset
from powderdsl.schedule.types import (
    Compute,
    Guard,
    Move,
    Out,
    Schedule,
    Statement,
    Sweeps,
    Var,
)
from powderdsl.schedule.words import is_cleared
from powderdsl.targets.statements import printed
from powderdsl.targets.wasm.binary import Callee, Function, Local, Value, const, op
from powderdsl.targets.wasm.cells import sweep
from powderdsl.targets.wasm.library import SOME, ZERO, Library, word
from powderdsl.targets.wasm.moves import exchanger, moves_in_place
from powderdsl.targets.wasm.moves import move as in_place
from powderdsl.targets.wasm.words import WordLoop

ONE = const("i32", 1)


def pass_function(schedule: Schedule, library: Library) -> Callee:
    """The function of a pass."""
    printer = Pass(schedule, library)
    return library.module.add(printer.made(), pass_function_name(schedule.name))


def pass_function_name(name: str) -> str:
    """The name of a pass's function."""
    return f"pass_{name}"


class Pass:
    """Variables are locals that hold the addresses of planes and fields."""

    def __init__(self, schedule: Schedule, library: Library):
        self.schedule, self.library, self.f = schedule, library, Function()
        self.vars: dict[str, Local] = {}
        self.types: dict[str, bool] = {}

    def made(self) -> Function:
        f, library, schedule = self.f, self.library, self.schedule
        memory, group = library.memory, library.group
        changed = {slot for slot, _ in schedule.leaves}
        if schedule.when is not None:
            with f.when(op("i32.eqz", self.answer(schedule.when))):
                f.leave()
        for slot, var in schedule.finds:
            at = memory.slot(slot, var.type)
            if slot in changed:  # nothing else refers to it while the pass runs, so it may be overwritten
                self.define(var, group[at])
                f.set(group[at], 0)
            else:
                self.define(var, library.keep(group[at]))
        self.block(schedule.body)
        left = []
        for slot, node in schedule.leaves:
            left.append((memory.slot(slot, node.type), f.let(self.kept(node)), node))
        for at, value, node in left:
            old = f.let(group[at])
            with f.when(old):
                f.do(library.giver(node.type == REAL)(old))
            f.set(group[at], value)
        names = dict.fromkeys(str(node.attr) for _, node in schedule.leaves if node.op == "load")
        self.release(names)
        return f

    # Variables

    def define(self, var: Var, value: Value) -> Local:
        self.declare(var)
        self.f.set(self.vars[var.name], value)
        return self.vars[var.name]

    def declare(self, var: Var) -> None:
        """A variable that is set later."""
        if var.name not in self.vars:
            self.vars[var.name] = self.f.local("i32")
        self.types[var.name] = var.type == REAL

    def of(self, node: Node) -> Local:
        return self.vars[str(node.attr)]

    def release(self, names: Iterable[str]) -> None:
        for name in names:
            self.f.do(self.library.giver(self.types[name])(self.vars[name]))

    def held(self, node: Node) -> Value:
        """The plane or field of a load or a constant."""
        if node.op == "load":
            return self.of(node)
        if node.type == REAL:
            return self.library.calm
        return self.library.everything if node.attr else self.library.nothing

    def kept(self, node: Node) -> Value:
        return self.library.keep(self.held(node))

    # Answers

    def answer(self, node: Node) -> Value:
        """A condition: i32, not zero if it holds."""
        match node.op:
            case "any":
                return self.of(node.args[0])[SOME]
            case "present":
                return op("i64.ne", self.library.present & node.attr, const("i64", 0))
            case "const":
                return const("i32", bool(node.attr))
        first, second = (self.answer(arg) for arg in node.args)
        return self.both(first, second) if node.op == "and" else first | second

    def both(self, first: Value, second: Value) -> Value:
        return op("i32.ne", first, ZERO) & op("i32.ne", second, ZERO)

    # Statements

    def block(self, body: Sequence[Statement]) -> None:
        for statement in body:
            printed(self, statement)

    def sweeps(self, sweeps: Sweeps) -> None:
        for loop in sweeps.loops:
            sweep(self, loop)
        self.release(sweeps.passing)

    def forget(self) -> None:
        self.f.set(self.library.present, const("i64", -1))

    def guard(self, guard: Guard) -> None:
        f = self.f
        asked = ZERO
        for node in guard.when:
            asked = self.of(node)[SOME] if asked is ZERO else asked | self.of(node)[SOME]
        for var, _ in guard.keeps:
            self.declare(var)
        with f.when(asked):
            self.block(guard.body)
            if guard.keeps:
                f.otherwise()
                for var, value in guard.keeps:
                    self.define(var, self.kept(value))

    def words(self, loop: Compute) -> None:
        f, library = self.f, self.library
        if loop.when is None:
            return self.loop(loop)
        for out in loop.outs:
            self.declare(out.var)
        with f.when(self.answer(loop.when)):
            self.loop(loop)
            f.otherwise()
            for out in loop.outs:
                self.define(out.var, library.keep(library.nothing))

    def loop(self, loop: Compute) -> None:
        """Planes that are all computed anew."""
        for out in loop.outs:
            self.define(out.var, self.library.take())
        self.call(loop, [self.vars[out.var.name] for out in loop.outs])

    def call(self, loop: Compute, outs: Sequence[Value]) -> None:
        made = WordLoop(self.library, loop)
        for name in made.haloed:
            self.f.do(self.library.edges(self.vars[name]))
        self.f.do(made.made()(*(self.read(name) for name in made.reads), *outs))

    def read(self, name: str | tuple[str, int]) -> Value:
        if isinstance(name, str):
            return self.vars[name]
        memory, (table, number) = self.library.memory, name
        place = memory.at(table, number)
        if table == "fixed":
            return word(ZERO, place)
        return self.library.coin(const("i32", place), const("i32", memory.at("keys", number)))

    def update(self, loop: Compute) -> None:
        """Planes that change only in words where a mask holds."""
        f, library = self.f, self.library
        assert loop.region is not None
        for out in loop.outs:
            assert out.otherwise is not None
            self.define(out.var, self.of(out.otherwise) if out.into else self.kept(out.otherwise))
        made = WordLoop(library, loop)
        asked = ZERO
        for name in made.mask_names:
            asked = asked | self.vars[name][SOME]
        with f.when(asked):
            for out in loop.outs:
                plane = self.vars[out.var.name]
                needed = plane[SOME] if is_cleared(out, self.schedule.graph) else ONE  # 0 stays 0
                with f.when(needed):
                    f.set(plane, library.own(plane))
            for name in made.haloed:
                f.do(library.edges(self.vars[name]))
            function = made.made()
            f.do(
                function(
                    *(self.read(name) for name in made.reads), *(self.vars[o.var.name] for o in loop.outs)
                )
            )

    def whole(self, out: Out) -> None:
        """An operation on whole planes that tests for empty ones first."""
        library, value = self.library, out.value
        if value.op in ("load", "const"):
            self.define(out.var, self.kept(value))
            return
        args = value.args
        tests: list[tuple[Value, Value]]
        if value.op == "and":  # kept and not gone
            kept, gone = (
                (self.of(args[0]), args[1].args[0])
                if args[1].op == "not"
                else (self.of(args[1]), args[0].args[0])
            )
            tests = [(kept, kept), (self.of(gone), kept)]
        elif value.op == "or":
            first, second = map(self.of, args)
            tests = [(second, first), (first, second)]
        else:
            tests = [(self.of(args[0]), library.nothing)]
        self.declare(out.var)
        self._tested(tests, out)

    def _tested(self, tests: Sequence[tuple[Value, Value]], out: Out) -> None:
        if not tests:
            self.loop(Compute((out,), "", "words"))
            return
        (plane, rest), *others = tests
        with self.f.when(plane[SOME]):
            self._tested(others, out)
            self.f.otherwise()
            self.define(out.var, self.library.keep(rest))

    def move(self, move: Move) -> None:
        """Planes that move; those that nothing moves stay as they are."""
        f, library = self.f, self.library
        movers = self.of(move.movers)
        if move.planes[0].new.type == REAL:
            self.exchange(move)
            return
        if not moves_in_place(move):
            self.loop(self.moved(move))
            for plane in move.planes:
                if plane.into is not None:
                    f.do(library.give(self.vars[plane.into]))
            return
        for plane in move.planes:
            self.define(plane.new, self.of(plane.old) if plane.into is not None else self.kept(plane.old))
        with f.when(movers[SOME]), f.scope():
            targets = self.shifted(move.movers, move.offset)
            in_place(library, f, move, movers, [self.vars[plane.new.name] for plane in move.planes], targets)

    def exchange(self, move: Move) -> None:
        """Fields that exchange values."""
        f, library = self.f, self.library
        for field in move.planes:
            old = self.of(field.old) if field.into is not None else self.kept(field.old)
            self.define(field.new, old)
            held = self.vars[field.new.name]
            with f.when(self.of(move.movers)[SOME] & held[SOME]):
                f.set(held, library.own_field(held))
                f.do(exchanger(library, move.offset)(self.of(move.movers), held))

    def shifted(self, movers: Node, offset: Offset) -> Callee:
        """A function that makes the plane of targets: movers, it."""
        value = self.seen(movers, -offset[0], -offset[1])
        loop = Compute((Out(Var("targets", FLAG), value),), "", "words")
        return WordLoop(self.library, loop).made()

    def seen(self, node: Node, dy: int, dx: int) -> Node:
        """A plane at a neighbor."""
        return self.schedule.graph.node("shift", FLAG, (node,), (dy, dx, True))

    def moved(self, move: Move) -> Compute:
        """A movement as a loop over words."""
        graph, (dy, dx) = self.schedule.graph, move.offset
        outs = []
        targets = self.seen(move.movers, -dy, -dx)
        for plane in move.planes:
            value = graph.node("select", FLAG, (targets, self.seen(plane.old, -dy, -dx), plane.leaves))
            if move.op == "swap":
                value = graph.node("select", FLAG, (move.movers, self.seen(plane.old, dy, dx), value))
            outs.append(Out(plane.new, value))
        return Compute(tuple(outs), move.place, "words")
