"""A program on bit planes → a module for grids of one width: a function for each pass, which calls those of its loops."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import reduce
from operator import or_

from powderdsl.ir.ops import FLAG, REAL, Node, PassGraph, Program
from powderdsl.ir.text import structure
from powderdsl.schedule.presence import tested_ids
from powderdsl.schedule.rows import is_copy
from powderdsl.schedule.stages import CPU, plan
from powderdsl.schedule.types import (
    Compute,
    Forget,
    Guard,
    Move,
    Out,
    Release,
    Schedule,
    Statement,
    Sweeps,
    Var,
    alternatives,
)
from powderdsl.schedule.words import difference, movement_loop, only_clears, target_loop
from powderdsl.system.cache import Memo, collection_paused
from powderdsl.targets.layout import layout_of
from powderdsl.targets.printing import Printer
from powderdsl.targets.wasm.binary import Local, Module, Value, body, const, op
from powderdsl.targets.wasm.cells import CellLoop
from powderdsl.targets.wasm.driver import Driver
from powderdsl.targets.wasm.library import MAX_PARAMS, PAGE, SOME, ZERO, Library, Memory, extent_of, word
from powderdsl.targets.wasm.moves import exchanger, groups_in_place, move_groups
from powderdsl.targets.wasm.standalone import ModuleData, Standalone
from powderdsl.targets.wasm.words import WordLoop

ONE = const("i32", 1)

PAGES = 1 << 15
"""Maximum number of pages of 64 KiB of a module's memory: 2 GiB, so that no sum of two sizes exceeds 32 bits."""


@collection_paused()
def wasm_module(
    program: Program, width: int | None, *, face: ModuleData | None = None, memo: Memo | None = None
) -> Module:
    """The module of a program on planes, for grids of this width; None: of any width below that of a word.

    With a face, the module is a world by itself (`standalone`) and exports only its functions. A memo stores schedules
    of passes.
    """
    schedules = [_schedule(program, pass_, memo) for pass_ in program.passes]
    memory = Memory(width, extent_of(schedules), layout_of(program))
    module = Module(memory.top // PAGE + 1, PAGES)
    library, passes = Library(memory, module), []
    for schedule in schedules:
        passes.append(module.define(PassCode(schedule, library).write, pass_function_name(schedule.name)))
    tested = reduce(or_, map(tested_ids, schedules), 0)
    calls = Driver(library, program, passes, tested).add(export=face is None)
    if face is not None:
        Standalone(library, face, calls).add()
    return module


def _schedule(program: Program, pass_: PassGraph, memo: Memo | None) -> Schedule:
    if memo is None:
        return plan(program, pass_, CPU)
    key = program.slots, structure(pass_, places=False)
    schedule = memo.of(("schedule", pass_.name), key, lambda: plan(program, pass_, CPU))
    return replace(schedule, graph=schedule.graph.copy())  # emitting code adds nodes to it


def pass_function_name(name: str) -> str:
    return f"pass_{name}"


class PassCode(Printer):
    """Variables are locals that hold the addresses of planes and fields."""

    def __init__(self, schedule: Schedule, library: Library):
        self.schedule, self.library = schedule, library
        self.nothing = schedule.graph.node("const", FLAG, (), False)
        self.vars: dict[str, Local] = {}

    def write(self) -> None:
        library, schedule = self.library, self.schedule
        memory, group = library.memory, library.group
        changed = {slot for slot, _ in schedule.outputs}
        if schedule.when is not None:
            with body.when(op("i32.eqz", self.answer(schedule.when))):
                body.leave()
        for slot, var in schedule.inputs:
            at = memory.slot(slot, var.type)
            if slot in changed:  # no other reference exists while the pass runs, so it may be overwritten
                self.define(var, group[at])
                group[at] = 0
            else:
                self.define(var, library.keep(group[at]))
        self.block(schedule.body)
        values = [body.let(self.keep(node)) for _, node in schedule.outputs]
        for (slot, node), value in zip(schedule.outputs, values, strict=True):
            at = memory.slot(slot, node.type)
            old = body.let(group[at])
            with body.when(old):
                body.do(library.give(old))
            group[at] = value
        self.give(dict.fromkeys(str(node.attr) for _, node in schedule.outputs if node.op == "load"))

    # Variables

    def define(self, var: Var, value: Value) -> Local:
        if var.name not in self.vars:
            self.vars[var.name] = body.variable("i32")
        self.vars[var.name].set(value)
        return self.vars[var.name]

    def of(self, node: Node) -> Local:
        return self.vars[str(node.attr)]

    def give(self, names: Iterable[str]) -> None:
        for name in names:
            body.do(self.library.give(self.vars[name]))

    def address(self, node: Node) -> Value:
        """The plane or field of a load or a constant."""
        if node.op == "load":
            return self.of(node)
        if node.type == REAL:
            return self.library.calm
        return self.library.everything if node.attr else self.library.nothing

    def keep(self, node: Node) -> Value:
        return self.library.keep(self.address(node))

    # Answers

    def answer(self, node: Node) -> Value:
        """A condition: i32, not zero if it holds."""
        match node.op:
            case "any" | "some":
                tests: list[Value] = [self.of(plane)[SOME] for plane in node.args]
                return reduce(or_, tests or [ZERO])
            case "present":
                return op("i64.ne", self.library.present & node.attr, 0)
            case "const":
                return const("i32", bool(node.attr))
        first, second = (self.answer(arg) for arg in node.args)
        return op("i32.ne", first, 0) & op("i32.ne", second, 0) if node.op == "and" else first | second

    # Statements

    def block(self, body: Sequence[Statement]) -> None:
        for statement in body:
            getattr(self, type(statement).__name__.lower())(statement)

    def release(self, release: Release) -> None:
        self.give(release.frees)

    def forget(self, _: Forget) -> None:
        self.library.present.set(-1)

    @contextmanager
    def where(self, condition: Value, olds: Mapping[Var, Node]) -> Iterator[None]:
        """Statements that run if a condition holds; otherwise, variables that they define get the values `olds`."""
        with body.when(condition):
            yield
            if olds:
                body.otherwise()
                for var, value in olds.items():
                    self.define(var, self.keep(value))

    def guard(self, guard: Guard) -> None:
        with self.where(self.answer(guard.when), {out.var: out.value for out in guard.outs}):
            self.block(guard.body)

    def sweeps(self, sweeps: Sweeps) -> None:
        for loop in sweeps.body:
            self.cells(loop)
            for out in loop.outs:
                if out.into is not None:
                    body.do(self.library.give(self.vars[out.into]))
        self.give(sweeps.frees)

    def cells(self, loop: Compute) -> None:
        """A loop over cells, if its region holds anywhere."""
        if is_copy(loop):  # fields are shared
            for out in loop.outs:
                self.define(out.var, self.keep(out.value))
        elif loop.region is None:
            self.run(CellLoop(self.library, loop))
        else:
            parts = alternatives(loop.region)
            places = (self.of(part.args[0] if part.op == "live" else part) for part in parts)
            olds = {loop.vars[name]: old for name, old in loop.olds.items()}
            with self.where(reduce(or_, (place[SOME] for place in places), ZERO), olds):
                self.run(CellLoop(self.library, loop))

    def words(self, loop: Compute) -> None:
        """A loop over words that computes new planes, if its condition holds."""
        code = WordLoop(self.library, loop)
        if loop.when is None:
            self.run(code)
            return
        with self.where(self.answer(loop.when), {out.var: self.nothing for out in loop.outs}):
            self.run(code)

    def run(self, code: CellLoop | WordLoop) -> None:
        """Call a loop that writes new planes and fields."""
        library = self.library
        for out in code.loop.outs:
            self.define(out.var, (library.take_field if out.var.type == REAL else library.take)())
        self.call(code)

    def call(self, code: CellLoop | WordLoop) -> None:
        """Call a loop with the planes and fields that it reads and writes."""
        for name in code.haloed:
            body.do(self.library.edges(self.vars[name]))
        function = code.build()
        args = [*map(self.read, code.reads), *(self.vars[out.var.name] for out in code.loop.outs)]
        more = self.library.more_params(len(args) - MAX_PARAMS)
        for variable, value in zip(more, args[MAX_PARAMS:], strict=True):
            variable.set(value)
        body.do(function(*args[:MAX_PARAMS]))

    def read(self, name: str | tuple[str, int]) -> Value:
        if isinstance(name, str):
            return self.vars[name]
        memory, (table, number) = self.library.memory, name
        place = memory.at(table, number)
        if table == "fixed":
            return word(0, place)
        return self.library.coin(place, memory.at("keys", number))

    def update(self, loop: Compute) -> None:
        """Planes that change only in words where a mask holds."""
        library = self.library
        for out in loop.outs:
            assert out.otherwise is not None
            self.define(out.var, self.of(out.otherwise) if out.into else self.keep(out.otherwise))
        code = WordLoop(library, loop)
        with body.when(reduce(or_, (self.vars[name][SOME] for name in code.mask_names), ZERO)):
            for out in loop.outs:
                plane = self.vars[out.var.name]
                needed = plane[SOME] if only_clears(out, self.schedule.graph) else ONE  # 0 stays 0
                with body.when(needed):
                    plane.set(library.own(plane))
            self.call(code)

    def whole(self, out: Out) -> None:
        """An operation on whole planes that tests for empty planes first."""
        value = out.value
        tests: list[tuple[Node, Node]]  # planes, each with the result if it is empty
        match value.op:
            case "load" | "const":
                self.define(out.var, self.keep(value))
                return
            case "and":
                stays, gone = difference(value)
                tests = [(stays, stays), (gone, stays)]
            case "or":
                first, second = value.args
                tests = [(second, first), (first, second)]
            case _:
                tests = [(value.args[0], self.nothing)]
        with ExitStack() as inner:
            for plane, rest in tests:
                inner.enter_context(self.where(self.of(plane)[SOME], {out.var: rest}))
            self.run(WordLoop(self.library, Compute((out,), over="words")))

    def move(self, move: Move) -> None:
        """Planes that move, or fields that exchange values; planes without movers stay unmodified."""
        library, graph = self.library, self.schedule.graph
        movers, fields = self.of(move.region), move.outs[0].var.type == REAL
        groups = None if fields else groups_in_place(move)
        if groups is None and not fields:
            self.run(WordLoop(library, movement_loop(move, graph)))
            for out in move.outs:
                if out.into is not None:
                    body.do(library.give(self.vars[out.into]))
            return
        for out in move.outs:
            old = move.olds[out.var.name]
            moved = self.define(out.var, self.of(old) if out.into is not None else self.keep(old))
            if fields:
                with body.when(movers[SOME] & moved[SOME]):
                    moved.set(library.own_field(moved))
                    body.do(exchanger(library, move.offset)(movers, moved))
        if groups is not None:
            with body.when(movers[SOME]), body.scope():
                entered = WordLoop(library, target_loop(move, graph)).build()
                planes = {kind: [self.vars[out.var.name] for out in group] for kind, group in groups.items()}
                move_groups(library, move, movers, planes, entered)
