"""Check the contents of a checkpoint before torch reads it: a small machine follows its pickle and builds nothing.

torch's reader executes nothing either, but believes sizes: a storage of ten numbers may call itself a storage of a
thousand million, a tensor may repeat one number without end, and containers may be nested until the stack overflows.
Here only what `torch.save` writes of tensors, numbers, text, lists, tuples and dicts passes.
"""

from __future__ import annotations

import io
import pickletools
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from math import prod
from typing import Any

from powderdsl.system.archives import BadArchive, check_directory

MAX_PICKLE = 1 << 20
"""Maximum bytes of everything but the numbers of tensors."""
MAX_RECORDS = 1 << 14
MAX_DEPTH = 32

_SIZES = {
    "Byte": 1, "Char": 1, "Bool": 1, "Short": 2, "Half": 2, "BFloat16": 2, "Int": 4, "Float": 4, "Long": 8, "Double": 8,
}  # fmt: skip
_ORDERED, _TENSOR = "collections OrderedDict", "torch._utils _rebuild_tensor_v2"


class NotSaved(Exception):
    """A file has contents that no training saves."""


@dataclass
class _Node:
    """A value. `kind`: ``atom``, ``tuple``, ``list``, ``dict``, ``ordered``, ``global``, ``storage`` or ``tensor``."""

    kind: str
    value: Any = None
    depth: int = 0


_MARK = _Node("mark")


def checked(data: bytes) -> io.BytesIO:
    """A checkpoint with the same contents and nothing else, for `torch.load`.

    Raises:
        Exception: whatever is wrong with it: it is not an archive, or holds what no training saves.
    """
    file = io.BytesIO(data)
    check_directory(file, MAX_RECORDS, 1 << 24)
    clean = io.BytesIO()
    with zipfile.ZipFile(file) as archive, zipfile.ZipFile(clean, "w") as out:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise BadArchive("its records are packed")
        if sum(entry.file_size for entry in entries) > len(data):
            raise BadArchive("its records overlap")
        sizes = {entry.filename: entry.file_size for entry in entries}
        if len(sizes) != len(entries):
            raise BadArchive("two of its records have one name")
        found = [name for name in sizes if name.count("/") == 1 and name.endswith("/data.pkl")]
        if len(found) != 1 or sizes[found[0]] > MAX_PICKLE:
            raise BadArchive("it has no description, or one that is too long")
        prefix = found[0].removesuffix("data.pkl")
        _Machine({name.removeprefix(f"{prefix}data/"): size for name, size in sizes.items()}).run(
            archive.read(found[0])
        )
        for entry in entries:
            out.writestr(zipfile.ZipInfo(entry.filename), archive.read(entry))
    clean.seek(0)
    return clean


class _Machine:
    """Follows the operations of a pickle. `records`: the bytes of each storage, by its name."""

    def __init__(self, records: dict[str, int]):
        self.records = records
        self.stack: list[_Node] = []
        self.memo: dict[int, _Node] = {}

    def run(self, text: bytes) -> None:
        for opcode, argument, _ in pickletools.genops(text):
            if opcode.name not in _STEPS:
                raise NotSaved(f"it uses {opcode.name}")
            _STEPS[opcode.name](self, argument)

    def push(self, kind: str, value: Any = None) -> None:
        self.stack.append(_Node(kind, value))

    def push_tuple(self, items: list[_Node]) -> None:
        self.stack.append(self.holding(_Node("tuple", items), items))

    def remember(self, number: int) -> None:
        self.memo[number] = self.stack[-1]

    def recall(self, number: int) -> None:
        found = self.memo[number]
        if found.kind in ("list", "dict", "ordered"):
            raise NotSaved("two of its values are one")
        self.stack.append(found)

    def pop(self, count: int) -> list[_Node]:
        found = self.stack[-count:]
        if len(found) < count or _MARK in found:
            raise NotSaved("it is cut off")
        del self.stack[-count:]
        return found

    def pop_to_mark(self) -> list[_Node]:
        found: list[_Node] = []
        while self.stack[-1] is not _MARK:
            found.append(self.stack.pop())
        self.stack.pop()
        return found[::-1]

    def holding(self, node: _Node, items: list[_Node]) -> _Node:
        """The node, as deep as with these items in it."""
        node.depth = max([node.depth, *(1 + one.depth for one in items)])
        if node.depth > MAX_DEPTH:
            raise NotSaved("it is nested too deep")
        return node

    def fill(self, kinds: tuple[str, ...], items: list[_Node]) -> None:
        target = self.stack[-1]
        if target.kind not in kinds:
            raise NotSaved("it fills what is not a container")
        if target.kind != "list":
            keys = items[::2]
            if len(items) % 2 or any(one.kind != "atom" for one in keys):
                raise NotSaved("it has keys that are not words")
            target.value += [one.value for one in keys]
        self.holding(target, items)

    def storage(self) -> None:
        (found,) = self.pop(1)
        what, kind, key, _, count = (one.value for one in found.value)
        module, _, name = str(kind).partition(" ")
        size = _SIZES.get(name.removesuffix("Storage"))
        if what != "storage" or module != "torch" or size is None or type(count) is not int or count < 0:
            raise NotSaved("it has a storage that is none")
        if self.records.get(key) != count * size:
            raise NotSaved(f"the storage {key} does not have the bytes that it says")
        self.push("storage", count)

    def reduce(self) -> None:
        function, arguments = self.pop(2)
        if function.kind != "global" or arguments.kind != "tuple":
            raise NotSaved("it calls what is not a function")
        if function.value == _ORDERED and not arguments.value:
            self.push("ordered", [])
        elif function.value == _TENSOR:
            self.stack.append(_tensor(arguments.value))
        else:
            raise NotSaved(f"it calls {function.value}")

    def build(self) -> None:
        target, state = self.pop(2)
        # torch keeps the versions of modules so.
        if target.kind != "ordered" or state.kind != "dict" or state.value != ["_metadata"]:
            raise NotSaved("it sets attributes")
        self.stack.append(target)


def _tensor(arguments: list[_Node]) -> _Node:
    """A tensor, if it lies in its storage and repeats nothing."""
    storage, offset, shape, strides, *_ = arguments
    numbers = [offset, *shape.value, *strides.value]
    if storage.kind != "storage" or any(type(one.value) is not int or one.value < 0 for one in numbers):
        raise NotSaved("it has a tensor that is none")
    sides, steps = [one.value for one in shape.value], [one.value for one in strides.value]
    last = offset.value + sum((side - 1) * step for side, step in zip(sides, steps, strict=True))
    if prod(sides) > storage.value or (prod(sides) and last >= storage.value):
        raise NotSaved("it has a tensor that is larger than its storage")
    return _Node("tensor")


_Step = Callable[[_Machine, Any], None]
_ATOMS = (
    "BINUNICODE", "BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "NONE", "NEWTRUE", "NEWFALSE",
)  # fmt: skip
_STEPS: dict[str, _Step] = {
    "PROTO": lambda machine, _: None,
    "STOP": lambda machine, _: None,
    **dict.fromkeys(_ATOMS, lambda machine, value: machine.push("atom", value)),
    "GLOBAL": lambda machine, name: machine.push("global", name),
    "EMPTY_DICT": lambda machine, _: machine.push("dict", []),
    "EMPTY_LIST": lambda machine, _: machine.push("list", []),
    "EMPTY_TUPLE": lambda machine, _: machine.push("tuple", []),
    "TUPLE1": lambda machine, _: machine.push_tuple(machine.pop(1)),
    "TUPLE2": lambda machine, _: machine.push_tuple(machine.pop(2)),
    "TUPLE3": lambda machine, _: machine.push_tuple(machine.pop(3)),
    "TUPLE": lambda machine, _: machine.push_tuple(machine.pop_to_mark()),
    "MARK": lambda machine, _: machine.stack.append(_MARK),
    "BINPUT": _Machine.remember,
    "LONG_BINPUT": _Machine.remember,
    "BINGET": _Machine.recall,
    "LONG_BINGET": _Machine.recall,
    "APPEND": lambda machine, _: machine.fill(("list",), machine.pop(1)),
    "APPENDS": lambda machine, _: machine.fill(("list",), machine.pop_to_mark()),
    "SETITEM": lambda machine, _: machine.fill(("dict", "ordered"), machine.pop(2)),
    "SETITEMS": lambda machine, _: machine.fill(("dict", "ordered"), machine.pop_to_mark()),
    "BINPERSID": lambda machine, _: machine.storage(),
    "REDUCE": lambda machine, _: machine.reduce(),
    "BUILD": lambda machine, _: machine.build(),
}
"""What each operation does, with its argument. No other operation passes."""
