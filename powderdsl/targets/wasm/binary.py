"""The binary format of WebAssembly: typed expressions, functions, modules, and their text.

An expression (`Value`) is code that leaves a value on the stack, with its type. Variables and items in memory (`Settable`)
are expressions that can be set. Statements belong to the function that is being written (`body`): `at += 16` changes a
variable when the function runs, `at + 16` is an expression. Nothing here depends on rules or planes.
"""

from __future__ import annotations

import inspect
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from itertools import groupby
from typing import Any, NamedTuple, TypeAlias

TYPES = {"i32": 0x7F, "i64": 0x7E, "f32": 0x7D, "f64": 0x7C, "v128": 0x7B}

_NUMBERED = (
    (0x00, "unreachable nop block loop if else"),
    (0x0B, "end br br_if"),
    (0x0F, "return call"),
    (0x1A, "drop select"),
    (0x20, "local.get local.set local.tee global.get global.set"),
    (0x28, "i32.load i64.load f32.load f64.load i32.load8_s i32.load8_u i32.load16_s i32.load16_u i64.load8_s"),
    (0x31, "i64.load8_u i64.load16_s i64.load16_u i64.load32_s i64.load32_u i32.store i64.store f32.store"),
    (0x39, "f64.store i32.store8 i32.store16 i64.store8 i64.store16 i64.store32 memory.size memory.grow"),
    (0x41, "i32.const i64.const f32.const f64.const"),
    (0x45, "i32.eqz i32.eq i32.ne i32.lt_s i32.lt_u i32.gt_s i32.gt_u i32.le_s i32.le_u i32.ge_s i32.ge_u"),
    (0x50, "i64.eqz i64.eq i64.ne i64.lt_s i64.lt_u i64.gt_s i64.gt_u i64.le_s i64.le_u i64.ge_s i64.ge_u"),
    (0x5B, "f32.eq f32.ne f32.lt f32.gt f32.le f32.ge f64.eq f64.ne"),
    (0x67, "i32.clz i32.ctz i32.popcnt i32.add i32.sub i32.mul i32.div_s i32.div_u i32.rem_s i32.rem_u i32.and"),
    (0x72, "i32.or i32.xor i32.shl i32.shr_s i32.shr_u i32.rotl i32.rotr"),
    (0x79, "i64.clz i64.ctz i64.popcnt i64.add i64.sub i64.mul i64.div_s i64.div_u i64.rem_s i64.rem_u i64.and"),
    (0x84, "i64.or i64.xor i64.shl i64.shr_s i64.shr_u i64.rotl i64.rotr"),
    (0x8B, "f32.abs"),
    (0x96, "f32.min f32.max"),
    (0x9B, "f64.ceil f64.floor"),
    (0xA0, "f64.add f64.sub f64.mul f64.div f64.min f64.max"),
    (0xA7, "i32.wrap_i64"),
    (0xAC, "i64.extend_i32_s i64.extend_i32_u"),
    (0xB6, "f32.demote_f64"),
    (0xB7, "f64.convert_i32_s"),
    (0xBA, "f64.convert_i64_u"),
    (0xFC02, "i32.trunc_sat_f64_s"),
    (0xFC06, "i64.trunc_sat_f64_s"),
    (0xFC0A, "memory.copy memory.fill"),
    (0xFD00, "v128.load"),
    (0xFD09, "v128.load32_splat v128.load64_splat v128.store v128.const i8x16.shuffle i8x16.swizzle"),
    (0xFD0F, "i8x16.splat"),
    (0xFD11, "i32x4.splat i64x2.splat f32x4.splat"),
    (0xFD1B, "i32x4.extract_lane i32x4.replace_lane i64x2.extract_lane i64x2.replace_lane"),
    (0xFD20, "f32x4.replace_lane"),
    (0xFD23, "i8x16.eq"),
    (0xFD37, "i32x4.eq i32x4.ne"),
    (0xFD41, "f32x4.eq f32x4.ne f32x4.lt f32x4.gt f32x4.le f32x4.ge"),
    (0xFD4D, "v128.not v128.and v128.andnot v128.or v128.xor v128.bitselect v128.any_true"),
    (0xFD64, "i8x16.bitmask"),
    (0xFD6B, "i8x16.shl"),
    (0xFD6E, "i8x16.add"),
    (0xFDA4, "i32x4.bitmask"),
    (0xFDAB, "i32x4.shl i32x4.shr_s i32x4.shr_u i32x4.add"),
    (0xFDB5, "i32x4.mul"),
    (0xFDCB, "i64x2.shl i64x2.shr_s i64x2.shr_u i64x2.add"),
    (0xFDE0, "f32x4.abs f32x4.neg"),
    (0xFDE3, "f32x4.sqrt f32x4.add f32x4.sub f32x4.mul f32x4.div"),
    (0xFDEA, "f32x4.pmin f32x4.pmax"),
)  # fmt: skip
"""The instructions in use, by number; numbers above 0xFF begin with the prefix 0xFC or 0xFD."""


def unsigned(number: int) -> bytes:
    """LEB128 of a number from 0 on."""
    octets = bytearray()
    while number > 127:
        octets.append(number & 127 | 128)
        number >>= 7
    return bytes([*octets, number])


def signed(number: int) -> bytes:
    """LEB128 of a signed number."""
    octets = bytearray()
    while not -64 <= number < 64:
        octets.append(number & 127 | 128)
        number >>= 7
    return bytes([*octets, number & 127])


def _vector(items: Sequence[bytes]) -> bytes:
    return unsigned(len(items)) + b"".join(items)


def _text(text: str) -> bytes:
    return _vector([bytes([octet]) for octet in text.encode()])


def _result(name: str) -> str:
    """The type of an instruction's result."""
    kind, _, rest = name.partition(".")
    if any(word in rest for word in ("any_true", "bitmask", "extract_lane")):
        return "i64" if kind == "i64x2" else "i32"
    if "x" in kind:
        return "v128"
    if name in ("memory.copy", "memory.fill"):
        return ""
    if rest.split("_")[0] in ("eqz", "eq", "ne", "lt", "gt", "le", "ge") or kind == "memory":
        return "i32"
    return kind


OPCODES: dict[str, bytes] = {}
NAMES: dict[int, str] = {}
for _first, _names in _NUMBERED:
    for _number, _name in enumerate(_names.split(), _first):
        NAMES[_number] = _name
        OPCODES[_name] = bytes([_number >> 8 or _number])
        OPCODES[_name] += unsigned(_number & 255) if _number > 255 else b""
for _name, _memories in (("size", 1), ("grow", 1), ("copy", 2), ("fill", 1)):
    OPCODES[f"memory.{_name}"] += bytes(_memories)  # their numbers
RESULTS = {name: _result(name) for name in OPCODES}
_NUMBERS = {name: kind if (kind := name.partition(".")[0]) in TYPES else "i32" for name in OPCODES}
"""The types of numbers among the arguments."""


class Member(NamedTuple):
    """A member of records in memory: the instruction that loads it, and the bytes from a record's beginning."""

    load: str
    offset: int


def _operator(name: str) -> Callable[[Value, Value | int], Value]:
    return lambda self, other: op(f"{self.type}.{name}", self, other)


def _reflected(name: str) -> Callable[[Value, int], Value]:
    return lambda self, other: op(f"{self.type}.{name}", other, self)


class Value:
    """An expression. Operators are those of its type; integers are unsigned. A Python number becomes a constant."""

    __slots__ = ("code", "type")

    def __init__(self, type: str, code: bytes):
        self.type, self.code = type, code

    __sub__, __rsub__ = _operator("sub"), _reflected("sub")
    __mod__, __floordiv__ = _operator("rem_u"), _operator("div_u")
    __and__, __or__, __xor__ = _operator("and"), _operator("or"), _operator("xor")
    __lt__, __ge__ = _operator("lt_u"), _operator("ge_u")
    __rlshift__ = _reflected("shl")

    def __add__(self, other: Value | int) -> Value:
        return self if isinstance(other, int) and not other else op(f"{self.type}.add", self, other)

    def __mul__(self, other: Value | int) -> Value:
        return self if isinstance(other, int) and other == 1 else op(f"{self.type}.mul", self, other)

    def equals(self, other: Value | int) -> Value:
        """True (i32) if two integers are equal."""
        return op(f"{self.type}.eqz", self) if other == 0 else op(f"{self.type}.eq", self, other)

    def __lshift__(self, by: Value | int) -> Value:
        return self._shifted("shl", by)

    def __rshift__(self, by: Value | int) -> Value:
        return self._shifted("shr_u", by)

    def _shifted(self, name: str, by: Value | int) -> Value:
        """Vectors are shifted as two words, by an i32."""
        if isinstance(by, int) and not by:
            return self
        return op(f"{'i64x2' if self.type == 'v128' else self.type}.{name}", self, by)

    def __invert__(self) -> Value:
        return op("v128.not", self)

    def __getitem__(self, member: Member) -> Settable:
        """A member of the record at this address."""
        return load(member.load, self, member.offset)

    def __setitem__(self, member: Member, value: Value | int) -> None:
        place = self[member]
        if not isinstance(value, Settable) or value.code != place.code:  # after `|=`, it has been set
            place.set(value)


def _in_place(operator: str) -> Callable[[Any, Value | int], Any]:
    def change(self: Settable, other: Value | int) -> Settable:
        self.set(getattr(self, operator)(other))
        return self

    return change


class Settable(Value):
    """A value that can be set, by code before and after the code of its new value."""

    __slots__ = ("after", "before")

    def __init__(self, type: str, code: bytes, before: bytes, after: bytes):
        super().__init__(type, code)
        self.before, self.after = before, after

    def set(self, value: Value | int) -> None:
        body.emit(self.before, _codes([value], self.type), self.after)

    __iadd__, __isub__, __imul__ = _in_place("__add__"), _in_place("__sub__"), _in_place("__mul__")
    __iand__, __ior__, __ixor__ = _in_place("__and__"), _in_place("__or__"), _in_place("__xor__")
    __ilshift__, __irshift__ = _in_place("__lshift__"), _in_place("__rshift__")


class _Variable(Settable):
    __slots__ = ("index",)
    get: bytes
    put: bytes

    def __init__(self, type: str, index: int):
        number = unsigned(index)
        super().__init__(type, self.get + number, b"", self.put + number)
        self.index = index


class Local(_Variable):
    """A local variable or parameter."""

    __slots__ = ()
    get, put = OPCODES["local.get"], OPCODES["local.set"]


class Global(_Variable):
    """A global variable of a module."""

    __slots__ = ()
    get, put = OPCODES["global.get"], OPCODES["global.set"]


I32: TypeAlias = Local
I64: TypeAlias = Local
F32: TypeAlias = Local
F64: TypeAlias = Local
V128: TypeAlias = Local
"""Parameters of functions, by type (`Module.define`)."""

Writer: TypeAlias = "Callable[..., Value | int | None]"
"""Writes a function, given its parameters, and returns the result, if it has one."""


def op(name: str, *args: Value | float, tail: bytes = b"") -> Value:
    """An instruction on its arguments. Numbers get its type, or i32 next to vectors; `tail`: its immediates."""
    return Value(RESULTS[name], _codes(args, _NUMBERS[name]) + OPCODES[name] + tail)


def _codes(values: Iterable[Value | float], type: str) -> bytes:
    """The code of values; numbers get the type `type`."""
    return b"".join([value.code if isinstance(value, Value) else const(type, value).code for value in values])


def const(type: str, number: float) -> Value:
    """A number; of a vector, two equal words."""
    if type == "v128":
        return vector(struct.pack("<QQ", *[int(number) & (1 << 64) - 1] * 2))
    if type in ("f32", "f64"):
        return Value(type, OPCODES[f"{type}.const"] + struct.pack("<f" if type == "f32" else "<d", number))
    bits = 32 if type == "i32" else 64
    number = int(number) & (1 << bits) - 1
    return Value(type, OPCODES[f"{type}.const"] + signed(number - (number >> bits - 1 << bits)))


def vector(octets: bytes) -> Value:
    return Value("v128", OPCODES["v128.const"] + octets)


def floats(number: float) -> Value:
    """A vector of four equal float32 values."""
    return vector(struct.pack("<4f", *[number] * 4))


_ALIGN = {"v128": 4, "i64": 3, "f64": 3, "i32": 2, "f32": 2, "8": 0, "16": 1, "32": 2, "64": 3}


def load(name: str, address: Value | int, offset: int = 0) -> Settable:
    """An item in memory, which an instruction such as ``v128.load`` reads."""
    before = _codes([address], "i32")
    get, put = _accesses(name, offset)
    return Settable(RESULTS[name], before + get, before, put)


@cache
def _accesses(name: str, offset: int) -> tuple[bytes, bytes]:
    """The code that loads an item at an address, and the code that stores it; the natural alignment is only a hint."""
    type, _, what = name.partition(".")
    size = "".join(c for c in what if c.isdigit())
    immediates = unsigned(_ALIGN[size or type]) + unsigned(offset)
    return OPCODES[name] + immediates, OPCODES.get(f"{type}.store{size}", b"") + immediates


@dataclass(frozen=True)
class Callee:
    """A function of a module."""

    index: int
    result: str

    def __call__(self, *args: Value | int) -> Value:
        """A call; numbers are i32."""
        return Value(self.result, _codes(args, "i32") + OPCODES["call"] + unsigned(self.index))


class Function:
    """A function. Parameters are the first locals."""

    def __init__(self, params: Sequence[str] = ()):
        self.types = list(params)
        self.params = [Local(type, i) for i, type in enumerate(params)]
        self.result = ""
        self.body = bytearray()
        self.depth = 0
        self.free: dict[str, list[int]] = {}
        self.scopes: list[list[Local]] = []

    def code(self) -> bytes:
        """Locals and body, as in the code section."""
        groups = groupby(self.types[len(self.params) :])
        declared = [unsigned(len(list(group))) + bytes([TYPES[type]]) for type, group in groups]
        return _vector(declared) + bytes(self.body) + OPCODES["end"]


class Body:
    """The body of the function that is being written: statements are added to it."""

    def __init__(self) -> None:
        self._written: ContextVar[Function] = ContextVar("written")

    @property
    def function(self) -> Function:
        return self._written.get()

    @contextmanager
    def of(self, function: Function) -> Iterator[None]:
        """Statements inside are those of a function."""
        token = self._written.set(function)
        yield
        self._written.reset(token)

    def emit(self, *code: bytes) -> None:
        """Add instructions to the function that is being written."""
        self.function.body += b"".join(code)

    def variable(self, type: str) -> Local:
        """An uninitialized variable; in a scope, it lasts until the end of the scope."""
        function = self.function
        if free := function.free.get(type):
            local = Local(type, free.pop())
        else:
            local = Local(type, len(function.types))
            function.types.append(type)
        if function.scopes:
            function.scopes[-1].append(local)
        return local

    @contextmanager
    def scope(self) -> Iterator[None]:
        """A scope, after which its variables can be reused."""
        function = self.function
        function.scopes.append([])
        yield
        for local in function.scopes.pop():
            function.free.setdefault(local.type, []).append(local.index)

    def let(self, value: Value | int, type: str = "i32") -> Local:
        """A new variable with a value; `type`: that of a number."""
        local = self.variable(value.type if isinstance(value, Value) else type)
        local.set(value)
        return local

    def do(self, value: Value) -> None:
        """Run code, and drop its result."""
        self.emit(value.code, OPCODES["drop"] if value.type else b"")

    def give(self, value: Value | int) -> None:
        """Return a value from the function; a number is an i32."""
        self.function.result = value.type if isinstance(value, Value) else "i32"
        self.emit(_codes([value], "i32"), OPCODES["return"])

    def leave(self) -> None:
        """Return nothing."""
        self.emit(OPCODES["return"])

    def trap(self) -> None:
        self.emit(OPCODES["unreachable"])

    @contextmanager
    def _nested(self, name: str) -> Iterator[int]:
        function = self.function
        self.emit(OPCODES[name], b"\x40")
        function.depth += 1
        yield function.depth
        function.depth -= 1
        self.emit(OPCODES["end"])

    def block(self) -> AbstractContextManager[int]:
        """A block; jumping to its label leaves the block."""
        return self._nested("block")

    def loop(self) -> AbstractContextManager[int]:
        """A loop; jumping to its label continues the loop."""
        return self._nested("loop")

    def when(self, condition: Value) -> AbstractContextManager[int]:
        """Statements that run if a condition (i32) is not zero."""
        self.emit(condition.code)
        return self._nested("if")

    def otherwise(self) -> None:
        self.emit(OPCODES["else"])

    def jump(self, label: int, condition: Value | None = None) -> None:
        """Jump to a block or loop, if a condition holds."""
        self.emit(OPCODES["br"] if condition is None else condition.code + OPCODES["br_if"])
        self.emit(unsigned(self.function.depth - label))

    @contextmanager
    def each(
        self, start: Value | int, stop: Value | int, step: int = 1, *, some: bool = True
    ) -> Iterator[Local]:
        """A loop over numbers from `start` to below `stop`; `some`: there is at least one."""
        number = self.let(start)
        with self.block() as out:
            if not some:
                self.jump(out, number >= stop)
            with self.loop() as again:
                yield number
                number += step
                self.jump(again, number < stop)


body = Body()


class Module:
    """A module with one memory. Equal functions are one."""

    def __init__(self, pages: int, most: int):
        self.pages, self.most = pages, most
        self._types: dict[bytes, int] = {}
        self._functions: dict[tuple[int, bytes], Callee] = {}
        self._once: dict[str, Callee] = {}
        self._names: list[str] = []
        self._globals: list[tuple[str, int]] = []
        self._exports: list[bytes] = [_text("memory") + b"\x02\x00"]
        self._data: list[bytes] = []
        self._start: list[bytes] = []
        self._custom: list[bytes] = []

    def define(self, write: Writer, name: str = "", *, export: bool = False) -> Callee:
        """Add a function; `write` has its parameters, annotated with types (`I32`), and its name unless `name` is given."""
        params = inspect.signature(write).parameters.values()
        function = Function([param.annotation.lower() for param in params])
        with body.of(function):
            if (result := write(*function.params)) is not None:
                body.give(result)
        return self.add(function, name or write.__name__.strip("_"), export=export)

    def once(self, name: str, write: Writer) -> Callee:
        """A function that is added when it is first needed."""
        if name not in self._once:
            self._once[name] = self.define(write, name)
        return self._once[name]

    def add(self, function: Function, name: str, *, export: bool = False) -> Callee:
        params = [bytes([TYPES[param.type]]) for param in function.params]
        kind = b"\x60" + _vector(params) + _vector([bytes([TYPES[type]]) for type in function.result.split()])
        key = (self._types.setdefault(kind, len(self._types)), function.code())
        callee = self._functions.setdefault(key, Callee(len(self._functions), function.result))
        if callee.index == len(self._names):
            self._names.append(name)
        if export:
            self.export(callee, name)
        return callee

    def export(self, function: Callee, name: str) -> None:
        self._exports.append(_text(name) + b"\x00" + unsigned(function.index))

    def start(self, function: Callee) -> None:
        """Call this whenever the module is instantiated."""
        self._start = [unsigned(function.index)]

    def variable(self, type: str, start: int = 0) -> Global:
        self._globals.append((type, start))
        return Global(type, len(self._globals) - 1)

    def restart(self, variable: Global, start: int) -> None:
        """Change the initial value of a variable."""
        self._globals[variable.index] = (variable.type, start)

    def data(self, address: int, octets: bytes) -> None:
        """Add initial bytes of an instance's memory."""
        place = b"\0" + const("i32", address).code + OPCODES["end"]
        self._data.append(place + unsigned(len(octets)) + octets)

    def custom(self, name: str, octets: bytes) -> None:
        """Add a custom section, which hosts can read and execution ignores."""
        self._custom.append(_text(name) + octets)

    @property
    def code(self) -> bytes:
        starts = [(TYPES[type], const(type, start).code) for type, start in self._globals]
        variables = [bytes([type, 1]) + start + OPCODES["end"] for type, start in starts]
        sections = [
            (1, _vector(list(self._types))),
            (3, _vector([unsigned(type) for type, _ in self._functions])),
            (5, _vector([b"\x01" + unsigned(self.pages) + unsigned(self.most)])),
            (6, _vector(variables)),
            (7, _vector(self._exports)),
            *((8, number) for number in self._start),
            (10, _vector([unsigned(len(code)) + code for _, code in self._functions])),
            *([(11, _vector(self._data))] if self._data else []),
            *((0, section) for section in self._custom),
        ]
        parts = (bytes([number]) + unsigned(len(section)) + section for number, section in sections)
        return b"\0asm\1\0\0\0" + b"".join(parts)

    def listing(self, only: str | None = None) -> str:
        """The functions in the notation of the text format; with `only`, one function and those that it calls."""
        names = [f"{name}_{i}" for i, name in enumerate(self._names)]
        bodies = [_listing(BytesIO(code), names) for _, code in self._functions]
        wanted = [i for i, name in enumerate(self._names) if only in (None, name)]
        for i in wanted:  # grows
            called = {int(line.rpartition("_")[2]) for line in bodies[i].splitlines() if " call $" in line}
            wanted += sorted(called - set(wanted))
        return "\n".join(f"(func ${names[i]}\n{bodies[i]})" for i in sorted(set(wanted)))


def _listing(code: BytesIO, names: Sequence[str]) -> str:
    """The instructions of a function, one a line, read back from its code."""
    kinds = {number: name for name, number in TYPES.items()}
    lines = []
    for _ in range(_read(code)):
        count = _read(code)
        lines.append(f"  (local {kinds[code.read(1)[0]]}) ;; {count}")
    depth = 1
    while depth:
        number = code.read(1)[0]
        name = NAMES[number if number not in (0xFC, 0xFD) else number << 8 | _read(code)]
        depth -= name in ("end", "else")
        if depth:
            lines.append("  " * depth + name + _immediates(name, code, names))
        depth += name in ("block", "loop", "if", "else")
    return "\n".join(lines)


def _read(code: BytesIO, *, signed: bool = False) -> int:
    """Read a number in LEB128."""
    number = shift = 0
    while True:
        (octet,) = code.read(1)
        number |= (octet & 127) << shift
        shift += 7
        if octet < 128:
            return number - (1 << shift) if signed and octet & 64 else number


def _immediates(name: str, code: BytesIO, names: Sequence[str]) -> str:
    kind, _, rest = name.partition(".")
    if name == "call":
        return f" ${names[_read(code)]}"
    if kind in ("br", "br_if", "local", "global"):
        return f" {_read(code)}"
    if rest == "const":
        if kind in ("i32", "i64"):
            return f" {_read(code, signed=True)}"
        if kind == "v128":
            return " i32x4 " + " ".join(f"{part:#x}" for part in struct.unpack("<4I", code.read(16)))
        return f" {struct.unpack('<f' if kind == 'f32' else '<d', code.read(4 if kind == 'f32' else 8))[0]}"
    if kind != "memory" and rest.startswith(("load", "store")):
        code.read(1)
        return f" offset={_read(code)}"
    if rest.endswith("_lane"):
        return f" {code.read(1)[0]}"
    code.read(2 if name == "memory.copy" else kind in ("memory", "block", "loop", "if"))
    return ""
