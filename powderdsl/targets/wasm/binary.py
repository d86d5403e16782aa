"""The binary format of WebAssembly: typed expressions, functions, modules.

An expression (`Value`) is the code that leaves it on the stack, with its type. Nothing here knows rules or planes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

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
"""The instructions that are used, by number; those after a prefix as 0xFC and 0xFD followed by theirs."""


def unsigned(number: int) -> bytes:
    """LEB128 of a number from 0 on."""
    found = bytearray()
    while number > 127:
        found.append(number & 127 | 128)
        number >>= 7
    return bytes([*found, number])


def signed(number: int) -> bytes:
    """LEB128 of a signed number."""
    found = bytearray()
    while not -64 <= number < 64:
        found.append(number & 127 | 128)
        number >>= 7
    return bytes([*found, number & 127])


def _result(name: str) -> str:
    """The type of an instruction's result."""
    kind, _, rest = name.partition(".")
    if any(word in rest for word in ("any_true", "bitmask", "extract_lane")):
        return "i64" if kind == "i64x2" else "i32"
    if "x" in kind:
        return "v128"
    if rest.split("_")[0] in ("eqz", "eq", "ne", "lt", "gt", "le", "ge") or kind == "memory":
        return "i32"
    return kind


OPCODES: dict[str, bytes] = {}
NAMES: dict[int, str] = {}
for _first, _names in _NUMBERED:
    for _number, _name in enumerate(_names.split(), _first):
        NAMES[_number] = _name
        OPCODES[_name] = (
            bytes([_number]) if _number < 256 else bytes([_number >> 8]) + unsigned(_number & 255)
        )
RESULTS = {name: _result(name) for name in OPCODES}


class Value:
    """An expression. Operators are those of its type; integers are unsigned. A Python number becomes a constant."""

    __slots__ = ("code", "type")

    def __init__(self, type: str, code: bytes):
        self.type, self.code = type, code

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
    """A local variable or parameter, as an expression."""

    __slots__ = ("index",)

    def __init__(self, type: str, index: int):
        super().__init__(type, OPCODES["local.get"] + unsigned(index))
        self.index = index


def op(name: str, *args: Value, tail: bytes = b"") -> Value:
    """An instruction on its arguments; `tail`: its immediates."""
    return Value(RESULTS[name], b"".join([arg.code for arg in args]) + OPCODES[name] + tail)


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
    """A vector of 16 bytes."""
    return Value("v128", OPCODES["v128.const"] + octets)


def floats(number: float) -> Value:
    """A vector of four equal float32 values."""
    return vector(struct.pack("<4f", *[number] * 4))


_ALIGN = {"v128": 4, "i64": 3, "f64": 3, "i32": 2, "f32": 2, "8": 0, "16": 1, "32": 2, "64": 3}


def _access(name: str, offset: int) -> bytes:
    """The immediates of an access to memory: its natural alignment, which is only a hint, and the offset."""
    type, _, what = name.partition(".")
    size = "".join(c for c in what if c.isdigit())
    return unsigned(_ALIGN[size or type]) + unsigned(offset)


def load(name: str, address: Value, offset: int = 0) -> Value:
    """A value from memory by an instruction such as ``v128.load``."""
    return op(name, address, tail=_access(name, offset))


@dataclass(frozen=True)
class Callee:
    """A function of a module."""

    index: int
    results: tuple[str, ...]

    def __call__(self, *args: Value) -> Value:
        code = b"".join([arg.code for arg in args]) + OPCODES["call"] + unsigned(self.index)
        return Value(self.results[0] if self.results else "", code)


@dataclass(frozen=True)
class Global:
    """A mutable global variable of a module."""

    index: int
    type: str

    @property
    def value(self) -> Value:
        return Value(self.type, OPCODES["global.get"] + unsigned(self.index))


class Function:
    """A function under construction. Parameters are the first locals."""

    def __init__(self, params: Sequence[str] = (), results: Sequence[str] = ()):
        self.params, self.results = tuple(params), tuple(results)
        self.types = list(params)
        self.body = bytearray()
        self._depth = 0
        self._free: dict[str, list[int]] = {}
        self._scopes: list[list[Local]] = []

    def param(self, number: int) -> Local:
        return Local(self.types[number], number)

    def local(self, type: str) -> Local:
        """A variable that holds anything; in a scope, until its end."""
        free = self._free.get(type)
        if free:
            found = Local(type, free.pop())
        else:
            found = Local(type, len(self.types))
            self.types.append(type)
        if self._scopes:
            self._scopes[-1].append(found)
        return found

    @contextmanager
    def scope(self) -> Iterator[None]:
        """The variables made inside can be used again for others after it."""
        self._scopes.append([])
        yield
        for local in self._scopes.pop():
            self._free.setdefault(local.type, []).append(local.index)

    def let(self, value: Value) -> Local:
        """A new variable with a value."""
        local = self.local(value.type)
        self.set(local, value)
        return local

    def do(self, value: Value) -> None:
        """Run code that leaves nothing."""
        self.body += value.code

    def set(self, target: Local | Global, value: Value) -> None:
        name = "local.set" if isinstance(target, Local) else "global.set"
        self.body += value.code + OPCODES[name] + unsigned(target.index)

    def store(self, name: str, address: Value, value: Value, offset: int = 0) -> None:
        self.body += address.code + value.code + OPCODES[name] + _access(name, offset)

    def copy(self, target: Value, source: Value, size: Value) -> None:
        """Copy bytes in memory."""
        self.body += target.code + source.code + size.code + OPCODES["memory.copy"] + b"\0\0"

    def fill(self, target: Value, byte: Value, size: Value) -> None:
        """Set bytes in memory."""
        self.body += target.code + byte.code + size.code + OPCODES["memory.fill"] + b"\0"

    def give(self, value: Value) -> None:
        """The result of the function is this."""
        self.body += value.code + OPCODES["return"]

    def leave(self) -> None:
        """Return nothing."""
        self.body += OPCODES["return"]

    def trap(self) -> None:
        self.body += OPCODES["unreachable"]

    @contextmanager
    def _nested(self, name: str) -> Iterator[int]:
        self.body += OPCODES[name] + b"\x40"
        self._depth += 1
        yield self._depth
        self._depth -= 1
        self.body += OPCODES["end"]

    def block(self) -> AbstractContextManager[int]:
        """A block, by its label; jumping to it leaves it."""
        return self._nested("block")

    def loop(self) -> AbstractContextManager[int]:
        """A loop, by its label; jumping to it begins it again."""
        return self._nested("loop")

    @contextmanager
    def when(self, condition: Value) -> Iterator[None]:
        """Statements that run if a condition (i32) is not zero."""
        self.body += condition.code
        with self._nested("if"):
            yield

    def otherwise(self) -> None:
        self.body += OPCODES["else"]

    def jump(self, label: int, condition: Value | None = None) -> None:
        """Jump to a block or loop, if a condition holds."""
        depth = unsigned(self._depth - label)
        if condition is None:
            self.body += OPCODES["br"] + depth
        else:
            self.body += condition.code + OPCODES["br_if"] + depth

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

    def code(self) -> bytes:
        """Locals and body, as in the code section."""
        groups: list[list[int]] = []
        for type in self.types[len(self.params) :]:
            if groups and groups[-1][1] == TYPES[type]:
                groups[-1][0] += 1
            else:
                groups.append([1, TYPES[type]])
        declared = unsigned(len(groups)) + b"".join(unsigned(n) + bytes([t]) for n, t in groups)
        return declared + bytes(self.body) + OPCODES["end"]


class Module:
    """A module with one memory. Equal functions are one."""

    def __init__(self, pages: int, most: int):
        self.pages, self.most = pages, most
        self._types: dict[bytes, int] = {}
        self._functions: dict[tuple[int, bytes], Callee] = {}
        self._names: list[str] = []
        self._globals: list[tuple[str, int]] = []
        self._exports: list[bytes] = [_text("memory") + b"\x02\x00"]
        self._data: list[bytes] = []
        self._custom: list[bytes] = []

    def add(self, function: Function, name: str, *, export: bool = False) -> Callee:
        kind = b"\x60" + _vector([bytes([TYPES[t]]) for t in function.params])
        kind += _vector([bytes([TYPES[t]]) for t in function.results])
        key = (self._types.setdefault(kind, len(self._types)), function.code())
        found = self._functions.setdefault(key, Callee(len(self._functions), function.results))
        if found.index == len(self._names):
            self._names.append(name)
        if export:
            self.export(found, name)
        return found

    def export(self, function: Callee, name: str) -> None:
        self._exports.append(_text(name) + b"\x00" + unsigned(function.index))

    def variable(self, type: str, start: int = 0) -> Global:
        self._globals.append((type, start))
        return Global(len(self._globals) - 1, type)

    def restart(self, variable: Global, start: int) -> None:
        """Another value that a variable begins with."""
        self._globals[variable.index] = (variable.type, start)

    def data(self, address: int, octets: bytes) -> None:
        """Bytes that the memory of an instance begins with."""
        self._data.append(
            b"\0" + const("i32", address).code + OPCODES["end"] + unsigned(len(octets)) + octets
        )

    def custom(self, name: str, octets: bytes) -> None:
        """A custom section: hosts can read it, and running ignores it."""
        self._custom.append(_text(name) + octets)

    def code(self) -> bytes:
        """The module in the binary format."""
        functions = list(self._functions)
        ends = [const(type, start).code + OPCODES["end"] for type, start in self._globals]
        variables = [bytes([TYPES[t], 1]) + end for (t, _), end in zip(self._globals, ends, strict=True)]
        sections = (
            (1, list(self._types)),
            (3, [unsigned(type) for type, _ in functions]),
            (5, [b"\x01" + unsigned(self.pages) + unsigned(self.most)]),
            (6, variables),
            (7, self._exports),
            (10, [unsigned(len(code)) + code for _, code in functions]),
            *([(11, self._data)] if self._data else []),
        )
        found = [b"\0asm\1\0\0\0"]
        for number, inner in (
            *((number, _vector(items)) for number, items in sections),
            *((0, one) for one in self._custom),
        ):
            found.append(bytes([number]) + unsigned(len(inner)) + inner)
        return b"".join(found)

    @property
    def functions(self) -> list[tuple[str, bytes]]:
        """The name and code of each function, by number."""
        return [
            (f"{name}_{i}", code)
            for i, (name, (_, code)) in enumerate(zip(self._names, self._functions, strict=True))
        ]


def _vector(items: Sequence[bytes]) -> bytes:
    return unsigned(len(items)) + b"".join(items)


def _text(text: str) -> bytes:
    return unsigned(len(text.encode())) + text.encode()
