"""Functions of a machine with one memory, as values: typed expressions, statements, functions, modules.

Nothing here knows rules or planes, or how functions are written: `binary` and `listing` do that.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import Any

TYPES = ("i32", "i64", "f32", "f64", "v128")


@cache
def result_of(name: str) -> str:
    """The type of an instruction's result."""
    kind, _, rest = name.partition(".")
    if any(word in rest for word in ("any_true", "bitmask", "extract_lane")):
        return "i64" if kind == "i64x2" else "i32"
    if "x" in kind:
        return "v128"
    if rest.split("_")[0] in ("eqz", "eq", "ne", "lt", "gt", "le", "ge") or kind == "memory":
        return "i32"
    return kind


class Value:
    """An expression. Operators are those of its type; integers are unsigned. A Python number becomes a constant.

    `attr` is what the instruction has beside its arguments: the number of a constant or lane, an offset, a callee.
    """

    __slots__ = ("args", "attr", "op", "type")

    def __init__(self, op: str, type: str, args: tuple[Value, ...] = (), attr: Any = None):
        self.op, self.type, self.args, self.attr = op, type, args, attr

    def _with(self, name: str, other: Value | int) -> Value:
        if isinstance(other, int):
            other = const(self.type, other)
        return op(f"{self.type}.{name}", self, other)

    def __add__(self, other: Value | int) -> Value:
        return self if isinstance(other, int) and not other else self._with("add", other)

    def __sub__(self, other: Value | int) -> Value:
        return self._with("sub", other)

    def __mul__(self, other: Value | int) -> Value:
        return self if isinstance(other, int) and other == 1 else self._with("mul", other)

    def __mod__(self, other: Value | int) -> Value:
        return self._with("rem_u", other)

    def __floordiv__(self, other: Value | int) -> Value:
        return self._with("div_u", other)

    def __and__(self, other: Value | int) -> Value:
        return self._with("and", other)

    def __or__(self, other: Value | int) -> Value:
        return self._with("or", other)

    def __xor__(self, other: Value | int) -> Value:
        return self._with("xor", other)

    def __lt__(self, other: Value | int) -> Value:
        return self._with("lt_u", other)

    def __ge__(self, other: Value | int) -> Value:
        return self._with("ge_u", other)

    def equals(self, other: Value | int) -> Value:
        """Whether two integers are equal: i32."""
        return op(f"{self.type}.eqz", self) if other == 0 else self._with("eq", other)

    def __lshift__(self, by: Value | int) -> Value:
        return self._shifted("shl", by)

    def __rshift__(self, by: Value | int) -> Value:
        return self._shifted("shr_u", by)

    def _shifted(self, name: str, by: Value | int) -> Value:
        """Vectors are shifted as two words, by an i32."""
        if isinstance(by, int):
            if not by:
                return self
            by = const("i32" if self.type == "v128" else self.type, by)
        return op(f"{'i64x2' if self.type == 'v128' else self.type}.{name}", self, by)

    def __invert__(self) -> Value:
        return op("v128.not", self)


class Local(Value):
    """A local variable or parameter, as an expression; `attr` is its number."""

    __slots__ = ()

    def __init__(self, type: str, number: int):
        super().__init__("local.get", type, (), number)


def op(name: str, *args: Value, attr: Any = None) -> Value:
    """An instruction on its arguments."""
    return Value(name, result_of(name), args, attr)


def const(type: str, number: float) -> Value:
    """A number; of a vector, two equal words."""
    if type == "v128":
        return vector(struct.pack("<QQ", *[int(number) & (1 << 64) - 1] * 2))
    if type in ("i32", "i64"):
        bits = 32 if type == "i32" else 64
        number = int(number) & (1 << bits) - 1
        number -= number >> bits - 1 << bits
    return Value(f"{type}.const", type, (), number)


def vector(octets: bytes) -> Value:
    """A vector of 16 bytes."""
    return Value("v128.const", "v128", (), octets)


def floats(number: float) -> Value:
    """A vector of four equal float32 values."""
    return vector(struct.pack("<4f", *[number] * 4))


def load(name: str, address: Value, offset: int = 0) -> Value:
    """A value from memory by an instruction such as ``v128.load``."""
    return op(name, address, attr=offset)


@dataclass(frozen=True)
class Callee:
    """A function of a module."""

    index: int
    results: tuple[str, ...]

    def __call__(self, *args: Value) -> Value:
        return Value("call", self.results[0] if self.results else "", args, self)


@dataclass(frozen=True)
class Global:
    """A mutable global variable of a module."""

    index: int
    type: str

    @property
    def value(self) -> Value:
        return Value("global.get", self.type, (), self.index)


@dataclass(eq=False, slots=True)
class Statement:
    """An instruction that leaves no value, on its arguments.

    A `block`, `loop` or `if` has a body, and is what jumps name: they leave a block, and begin a loop again.
    """

    op: str
    args: tuple[Value, ...] = ()
    attr: Any = None
    body: list[Statement] = field(default_factory=list)
    otherwise: list[Statement] | None = None


class Function:
    """A function under construction. Parameters are the first locals."""

    def __init__(self, params: Sequence[str] = (), results: Sequence[str] = ()):
        self.params, self.results = tuple(params), tuple(results)
        self.types = list(params)
        self.body: list[Statement] = []
        self._block, self._open = self.body, [Statement("block")]
        self._free: dict[str, list[int]] = {}
        self._scopes: list[list[Local]] = []

    def param(self, number: int) -> Local:
        return Local(self.types[number], number)

    def local(self, type: str) -> Local:
        """A variable that holds anything; in a scope, until its end."""
        free = self._free.get(type)
        if free:
            local = Local(type, free.pop())
        else:
            local = Local(type, len(self.types))
            self.types.append(type)
        if self._scopes:
            self._scopes[-1].append(local)
        return local

    @contextmanager
    def scope(self) -> Iterator[None]:
        """The variables made inside can be used again for others after it."""
        self._scopes.append([])
        yield
        for local in self._scopes.pop():
            self._free.setdefault(local.type, []).append(local.attr)

    def let(self, value: Value) -> Local:
        """A new variable with a value."""
        local = self.local(value.type)
        self.set(local, value)
        return local

    def _add(self, op: str, *args: Value, attr: Any = None) -> None:
        self._block.append(Statement(op, args, attr))

    def do(self, value: Value) -> None:
        """Call a function for what it does."""
        self._add("drop" if value.type else "do", value)

    def set(self, target: Local | Global, value: Value) -> None:
        if isinstance(target, Local):
            self._add("local.set", value, attr=target.attr)
        else:
            self._add("global.set", value, attr=target.index)

    def store(self, name: str, address: Value, value: Value, offset: int = 0) -> None:
        self._add(name, address, value, attr=offset)

    def copy(self, target: Value, source: Value, size: Value) -> None:
        """Copy bytes in memory."""
        self._add("memory.copy", target, source, size)

    def fill(self, target: Value, byte: Value, size: Value) -> None:
        """Set bytes in memory."""
        self._add("memory.fill", target, byte, size)

    def give(self, value: Value) -> None:
        """The result of the function is this."""
        self._add("return", value)

    def leave(self) -> None:
        """Return nothing."""
        self._add("return")

    def trap(self) -> None:
        self._add("unreachable")

    @contextmanager
    def _nested(self, op: str, *args: Value) -> Iterator[Statement]:
        around, statement = self._block, Statement(op, args)
        around.append(statement)
        self._open.append(statement)
        self._block = statement.body
        yield statement
        self._open.pop()
        self._block = around

    def block(self) -> AbstractContextManager[Statement]:
        """A block; jumping to it leaves it."""
        return self._nested("block")

    def loop(self) -> AbstractContextManager[Statement]:
        """A loop; jumping to it begins it again."""
        return self._nested("loop")

    def when(self, condition: Value) -> AbstractContextManager[Statement]:
        """Statements that run if a condition (i32) is not zero."""
        return self._nested("if", condition)

    def otherwise(self) -> None:
        self._block = self._open[-1].otherwise = []

    def jump(self, target: Statement, condition: Value | None = None) -> None:
        """Jump to a block or loop that is open, if a condition holds."""
        if condition is None:
            self._add("br", attr=target)
        else:
            self._add("br_if", condition, attr=target)

    @contextmanager
    def each(self, start: Value, stop: Value, step: int = 1, *, some: bool = True) -> Iterator[Local]:
        """A loop over numbers from `start` to below `stop`; `some`: there is at least one."""
        number = self.let(start)
        with self.block() as out:
            if not some:
                self.jump(out, number >= stop)
            with self.loop() as again:
                yield number
                self.set(number, number + step)
                self.jump(again, number < stop)


class Module:
    """A module with one memory. Equal functions are one.

    Args:
        pages: of 64 KiB, with which the memory begins; `most`: to which it may grow.
        printer: the code of a function.
    """

    def __init__(self, pages: int, most: int, printer: Callable[[Function], Hashable]):
        self.pages, self.most, self._printer = pages, most, printer
        self._callees: dict[Hashable, Callee] = {}
        self.functions: list[tuple[str, Function, Any]] = []
        """Names, functions and their code, by number."""
        self.variables: list[tuple[str, int]] = []
        """Types of global variables, and what they begin with."""
        self.exports: list[tuple[str, Callee]] = []
        self.data: list[tuple[int, bytes]] = []
        """Bytes that the memory of an instance begins with, by their address."""
        self.custom: list[tuple[str, bytes]] = []
        """Custom sections: hosts can read them, and running ignores them."""

    def add(self, function: Function, name: str, *, export: bool = False) -> Callee:
        code = self._printer(function)
        callee = Callee(len(self._callees), function.results)
        callee = self._callees.setdefault((function.params, function.results, code), callee)
        if callee.index == len(self.functions):
            self.functions.append((f"{name}_{callee.index}", function, code))
        if export:
            self.exports.append((name, callee))
        return callee

    def variable(self, type: str, start: int = 0) -> Global:
        self.variables.append((type, start))
        return Global(len(self.variables) - 1, type)
