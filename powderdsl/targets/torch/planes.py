"""IR on bit planes -> the Python source of one pass for the backend `torch`: a pure function, tensors in and out.

``pass_0(k, words, fields, inputs)`` gets the bit planes of all slots as one tensor, int64 [planes, H, B, words of a row],
the floats of all slots as a tuple, and the `inputs` of the pass: draws, parameters, bits of the step. It returns the new
words and fields. `k` has the operations that depend on the layout of words and cells, see `library`. The same text runs
eagerly and compiled by inductor.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from powderdsl.ir.ops import COMMUTATIVE, OPS, REAL, Node, Offset, PassGraph, Program, needed
from powderdsl.ir.text import infix
from powderdsl.schedule.types import leftover
from powderdsl.targets.layout import param_key
from powderdsl.targets.torch.source import comment_of, with_deletions

Key = tuple[Any, ...]
"""An input of a pass: its kind, and which input of that kind.

Kinds are `draws`, `limit`, `bit`, `real`, `step` and those of `packed.FIXED`.
"""


class PassSource(NamedTuple):
    """The source of a pass, the name of its function, and the keys of its inputs in order."""

    text: str
    name: str
    inputs: tuple[Key, ...]


def pass_source(program: Program, pass_: PassGraph, number: int) -> PassSource:
    """The source of a pass of a program on bit planes. `number` makes the name unique."""
    writer = _Writer(program, pass_)
    returned = writer.body()
    name = f"pass_{number}"
    lines = [f"    {line}" for line in with_deletions(writer.printed(returned), returned)]
    header = [f"# {comment_of(pass_.name)}"]
    header += [f"# inputs[{i}]: {comment_of(' '.join(map(str, key)))}" for i, key in enumerate(writer.inputs)]
    text = [*header, f"def {name}(k, words, fields, inputs):", *lines, f"    return {returned}", ""]
    return PassSource("\n".join(text), name, tuple(writer.inputs))


@dataclass
class _Line:
    """A statement ``name = text``. `op` names an operation that creates a tensor or may overwrite an argument."""

    name: str
    text: str
    args: tuple[str, ...] = ()
    op: str = ""


@dataclass(eq=False)
class _Block:
    """Planes that moved together: the name of the tensor, and its planes."""

    name: str
    planes: list[Node | None]


_SHARED = ("chance", "below_planes", "param", "coordinate", "inside")
"""Operations whose result may be the memory of an input."""

_REUSING = ("k.carry(", "k.increase(")
"""Operations of `k` with a variant, ``k.carry_``, that overwrites the first argument."""

_IN_PLACE = {
    "and": "{0}.bitwise_and_({1})",
    "or": "{0}.bitwise_or_({1})",
    "xor": "{0}.bitwise_xor_({1})",
    "not": "{0}.bitwise_not_()",
    "add": "{0}.add_({1})",
    "sub": "{0}.sub_({1})",
    "mul": "{0}.mul_({1})",
    "neg": "{0}.neg_()",
    "abs": "{0}.abs_()",
}
"""Operations that may overwrite their first argument, or the second if they are commutative."""

_COMPARED = {"eq": "~({0} ^ {1})", "lt": "~{0} & {1}", "le": "~{0} | {1}"}
"""The comparison of two flags."""

_EXPRESSIONS = {
    **infix("and or xor add sub mul"),
    "not": "~{0}",
    "select": "{2} ^ ({0} & ({1} ^ {2}))",
    "div": "k.divide({0}, {1})",
    "neg": "-{0}",
    "abs": "{0}.abs()",
    "min": "k.minimum({0}, {1})",
    "max": "k.maximum({0}, {1})",
    "sqrt": "k.square_root({0})",
}
"""Other operations on flags and floats, except choices between floats."""


class _Writer:
    def __init__(self, program: Program, pass_: PassGraph):
        self.outputs = dict(pass_.outputs)
        slots = [(slot.name, slot.type == REAL) for slot in program.slots]
        self.planes = [name for name, is_real in slots if not is_real]
        self.fields = [name for name, is_real in slots if is_real]
        self.lines: list[_Line] = []
        self.values: dict[Node, str] = {}
        """The name of each node, or the text of a constant."""
        self.constants: dict[Node, float] = {}
        self.full: set[str] = set()
        """Names of planes that no operation broadcasts: only these can be overwritten."""
        self.known: dict[str, str] = {}
        self.inputs: dict[Key, int] = {}
        self.blocks: dict[Node, tuple[_Block, int]] = {}
        self.words = _Block("words", [None] * len(self.planes))

    # Order: each movement waits until nothing else can be computed, so that planes that move alike move together.

    def body(self) -> str:
        """Write all lines, and return the text of the result."""
        nodes = needed(self.outputs.values(), self.arguments)
        position = {node: i for i, node in enumerate(nodes)}
        users: dict[Node, list[Node]] = {node: [] for node in nodes}
        missing = {node: len(set(args)) for node, args in nodes.items()}
        for node, args in nodes.items():
            for arg in dict.fromkeys(args):
                users[arg].append(node)
        ready = [position[node] for node in nodes if not missing[node]]
        movements: dict[Key, list[Node]] = {}
        order = [*nodes]
        place = ""
        while ready or movements:
            key = None
            if ready:
                group = [order[heapq.heappop(ready)]]
                if (waiting := self.movement(group[0])) is not None:
                    movements.setdefault(waiting, []).append(group[0])
                    continue
            else:
                key = next(iter(movements))
                group = sorted(movements.pop(key), key=position.__getitem__)
            if group[0].places and group[0].places[0] != place:
                place = group[0].places[0]
                self.lines.append(_Line("", f"# {comment_of(place)}"))
            if key is None:
                self.node(group[0])
            else:
                self.move(group, *key)
            for done in group:
                for user in users[done]:
                    missing[user] -= 1
                    if not missing[user]:
                        heapq.heappush(ready, position[user])
        return self.result()

    def arguments(self, node: Node) -> Sequence[Node]:
        """The nodes that must have names before a node is written."""
        match node.op:
            case "arrive" if leftover(node.args[0], node.args[2], node.args[1]) is not None:
                return node.args[:2]
            case "below_planes" if self.limit(node):
                return ()
            case "select" if (parts := _carried(node)) is not None:
                return parts.old, parts.movers, parts.amount
        return node.args

    def movement(self, node: Node) -> Key | None:
        """The key of planes that move together: operation, offset, movers, and whether the rest is simple; else None."""
        if node.op not in ("swap", "arrive"):
            return None
        kind = leftover(node.args[0], node.args[2], node.args[1])
        simple = kind == "same" if node.op == "swap" else kind is not None
        return node.op, node.attr, node.args[1], simple

    # Lines

    def name(self, text: str, prefix: str = "n", args: Sequence[str] = (), op: str = "") -> str:
        """The name of a value: equal texts are computed once."""
        if text not in self.known:
            self.known[text] = f"{prefix}{len(self.known)}"
            self.lines.append(_Line(self.known[text], text, tuple(args), op))
        return self.known[text]

    def of(self, node: Node) -> str:
        """The name of a node's value."""
        if node not in self.values:
            block, i = self.blocks[node]
            self.values[node] = self.name(f"{block.name}[{i}]", args=(block.name,))
            self.full.add(self.values[node])
        return self.values[node]

    def input(self, *key: Any) -> str:
        return f"inputs[{self.inputs.setdefault(key, len(self.inputs))}]"

    def cells(self, flag: Node) -> str:
        """A flag as a mask of cells."""
        plane = self.of(flag)
        return self.name(f"k.mask({plane})", "m", (plane,))

    def node(self, node: Node) -> None:
        """Write a node's value."""
        is_real = node.type == REAL
        folds = is_real and OPS[node.op].evaluate is not None
        if folds and all(arg in self.constants for arg in node.args):
            # Python computes with float64: the result is rounded here.
            self.constant(node, OPS[node.op].value(node.attr, *map(self.constants.__getitem__, node.args)))
            return
        match node.op:
            case "input" if is_real:
                self.values[node] = self.name(f"fields[{self.fields.index(node.attr)}]", "f")
                self.full.add(self.values[node])
            case "input":
                i = self.planes.index(node.attr)
                self.words.planes[i] = node
                self.blocks[node] = (self.words, i)
            case "const" if is_real:
                self.constant(node, float(node.attr))
            case "const":
                self.values[node] = "k.everywhere" if node.attr else "k.nowhere"
            case "select" if (parts := _carried(node)) is not None:
                old, amount, mask = self.of(parts.old), self.of(parts.amount), self.cells(parts.movers)
                dy, dx = parts.offset
                text, args = f"k.carry({old}, {mask}, {amount}, {dy}, {dx})", [old, mask, amount]
                self.values[node] = self.name(text, "f", args, "carry")
                self.full.add(self.values[node])
            case _:
                text, args = self.real(node) if is_real else self.flag(node)
                value = self.values[node] = self.name(text, "f" if is_real else "n", args, node.op)
                whole = node.op in ("shift", "eq", "lt", "le", "draw")
                whole |= text.startswith(("k.choose", "k.increase"))
                if whole or not self.full.isdisjoint(args):
                    self.full.add(value)

    def constant(self, node: Node, value: float) -> None:
        self.constants[node] = value
        self.values[node] = repr(value) if value >= 0 else f"({value!r})"

    def flag(self, node: Node) -> tuple[str, list[str]]:
        """The text of a plane, and the names in it."""
        if node.op in ("chance", "below_planes"):
            stream, bits, *limit = node.attr
            draws = self.input("draws", stream)
            if limit:
                return f"k.chance({draws}, {limit[0]}, {bits})", []
            if key := self.limit(node):
                return f"k.below({draws}, {self.input('limit', *key)})", []
            args = [*map(self.of, node.args)]
            return f"k.below({draws}, ({', '.join(args)},))", args
        match node.op:
            case "param":
                return self.input("bit", *param_key(node)), []
            case "coordinate":
                return self.input(*node.attr), []
            case "inside":
                return self.input("inside", *node.attr), []
            case "shift":
                return self.shift(self.of(node.args[0]), *node.attr)
        args = [*map(self.of, node.args)]
        if node.op in _COMPARED and node.args[0].type == REAL:
            return f"k.compare({node.op!r}, {args[0]}, {args[1]})", args
        return (_COMPARED.get(node.op) or _EXPRESSIONS[node.op]).format(*args), args

    def shift(self, plane: str, dy: int, dx: int, wraps: bool) -> tuple[str, list[str]]:
        text, args = plane, [plane]
        if dx and dy:
            text = plane = self.name(f"k.columns({plane}, {dx})", args=args)
            self.full.add(plane)
            args = [plane]
        text = f"k.rows({plane}, {dy})" if dy else f"k.columns({plane}, {dx})"
        if not wraps:
            inner = self.name(text, args=args)
            self.full.add(inner)
            return f"{inner} & {self.input('inside', dy, dx)}", [inner]
        return text, args

    def real(self, node: Node) -> tuple[str, list[str]]:
        """The text of a float of each cell, and the names in it."""
        if node.op == "param":
            return self.input("real", node.attr[0]), []
        if node.op == "draw":
            stream, bits = node.attr
            return f"k.draw({self.input('draws', stream)}, {bits})", []
        if node.op == "select":
            return self.choice(*node.args)
        args = [*map(self.of, node.args)]
        if node.op == "shift":
            dy, dx, wraps = node.attr
            text = f"k.neighbor({args[0]}, {dy}, {dx})"
            if wraps:
                return text, args
            rolled = self.name(text, "f", args)
            return f"k.choose({self.input('inside_mask', dy, dx)}, {rolled}, 0.0)", [rolled]
        if node.op == "clamp":
            return f"k.clamp({args[0]}, {node.attr[0]!r}, {node.attr[1]!r})", args
        return _EXPRESSIONS[node.op].format(*args), args

    def choice(self, flag: Node, yes: Node, no: Node) -> tuple[str, list[str]]:
        mask, old = self.cells(flag), self.of(no)
        if yes.op in ("add", "sub") and yes.args[0] is no:
            other = self.of(yes.args[1])
            sign = "" if yes.op == "add" else ", -1"
            return f"k.increase({old}, {mask}, {other}{sign})", [old, mask, other]
        new = self.of(yes)
        return f"k.choose({mask}, {new}, {old})", [mask, new, old]

    def limit(self, node: Node) -> Key:
        """The parameter and threshold whose planes a draw is compared with, highest first; else nothing."""
        keys = [param_key(arg) if arg.op == "param" else None for arg in node.args]
        if None in keys or keys[0] is None:
            return ()
        name, threshold, _ = keys[0]
        if threshold is None or keys != [(name, threshold, bit) for bit in range(threshold.bits, -1, -1)]:
            return ()
        return name, threshold

    # Movements

    def move(self, group: list[Node], op: str, offset: Offset, movers: Node, simple: bool) -> None:
        """Write planes that move together, as one tensor."""
        dy, dx = offset
        contents = self.block([node.args[0] for node in group])
        mask = self.of(movers)
        args = [contents.name, mask]
        members: list[Node | None] = [*group]
        if contents.planes != [node.args[0] for node in group]:  # a tensor that has other planes too
            by_content = {node.args[0]: node for node in group}
            members = [by_content.get(plane) if plane else None for plane in contents.planes]
        if simple and op == "swap":
            text = f"k.swap({contents.name}, {mask}, {dy}, {dx})"
        elif simple:
            kinds = [leftover(node.args[0], node.args[2], movers) if node else "same" for node in members]
            text = f"k.leave({contents.name}, {mask}, {dy}, {dx}, {self.input('left', *kinds)})"
        else:
            if members != group:
                contents, members = self.stack([node.args[0] for node in group]), [*group]
            rest = self.stack([node.args[2] for node in group])
            args = [contents.name, mask, rest.name]
            text = f"k.{'exchange' if op == 'swap' else 'arrive'}({contents.name}, {mask}, {rest.name}, {dy}, {dx})"
        moved = _Block(self.name(text, "b", args), members)
        for i, plane in enumerate(members):
            if plane is not None:
                self.blocks[plane] = (moved, i)

    def block(self, planes: list[Node]) -> _Block:
        """A tensor that contains some planes: the one that they are in, unless it has many others."""
        home, _ = self.blocks.get(planes[0], (None, 0))
        alone = len(set(planes)) == len(planes)
        if home and alone and set(planes) <= set(home.planes) and len(home.planes) <= 2 * len(planes):
            return home
        return self.stack(planes)

    def stack(self, planes: list[Node]) -> _Block:
        names = [*map(self.of, planes)]
        return _Block(self.name(f"k.stack(({', '.join(names)},))", "b", names), [*planes])

    def result(self) -> str:
        """The text of the new words and fields."""
        outputs = [self.outputs.get(slot) for slot in self.planes]
        places = [self.blocks.get(node) if node else (self.words, i) for i, node in enumerate(outputs)]
        best, changed = self.words, [i for i, place in enumerate(places) if place != (self.words, i)]
        for place in places:
            if place and len(place[0].planes) == len(places):
                others = [i for i, other in enumerate(places) if other != (place[0], i)]
                if len(others) < len(changed):
                    best, changed = place[0], others
        words = best.name
        if changed:
            new = [(i, outputs[i]) for i in changed]
            names = [self.of(node) if node else self.name(f"words[{i}]") for i, node in new]
            text = f"k.replaced({words}, {tuple(changed)}, ({', '.join(names)},))"
            words = self.name(text, "b", [words, *names])
        floats = [
            self.name(f"k.all_cells({self.of(node)})", "f", (self.of(node),)) if node else f"fields[{i}]"
            for i, node in enumerate(map(self.outputs.get, self.fields))
        ]
        return f"{words}, ({''.join(f'{name}, ' for name in floats)})"

    def printed(self, returned: str) -> list[str]:
        """The lines as text. An operation writes into an argument that nothing reads afterwards."""
        last: dict[str, int] = {}
        for i, line in enumerate(self.lines):
            last |= dict.fromkeys(line.args, i)
        own: set[str] = set()
        """Planes in separate memory, which no other name shares."""
        texts = []
        for i, line in enumerate(self.lines):
            free = [arg for arg in line.args if arg in own and last[arg] == i and arg not in returned]
            text = _in_place(line, [arg for arg in free if arg in self.full], self.full) or line.text
            if line.op and line.op not in _SHARED:
                own.add(line.name)
            texts.append(f"{line.name} = {text}" if line.name else text)
        return texts


def _in_place(line: _Line, free: list[str], full: set[str]) -> str:
    """The text of an operation that overwrites an argument, or creates one temporary plane less; else nothing."""
    if line.text.startswith(_REUSING):
        return line.text.replace("(", "_(", 1) if line.args[0] in free else ""
    if line.op == "select" and line.name[0] == "n":
        condition, yes, no = line.args
        whole = yes in full or no in full
        return f"({yes} ^ {no}).bitwise_and_({condition}).bitwise_xor_({no})" if whole else ""
    if line.op not in _IN_PLACE or len(set(line.args)) < len(line.args):
        return ""
    for args in (line.args, line.args[::-1] if line.op in COMMUTATIVE else ()):
        if args and args[0] in free:
            return _IN_PLACE[line.op].format(*args)
    return ""


class _Carried(NamedTuple):
    """A float from which an amount leaves the cells of movers and enters their targets."""

    old: Node
    movers: Node
    amount: Node
    offset: tuple[int, int]


def _carried(node: Node) -> _Carried | None:
    """The parts of a choice ``select(targets, left + amount at the movers, left)``, where `left` is
    ``select(movers, old - amount, old)``; None for any other choice.
    """
    match node:
        case Node(
            "select", _, (
                Node("shift", _, (movers,), (dy, dx, True)),
                Node("add", _, (left, Node("shift", _, (amount,), (ey, ex, True)))),
                Node("select", _, (leaving, Node("sub", _, (old, lost)), other)) as rest,
            ),
        ) if node.type == REAL and left is rest and leaving is movers and lost is amount and other is old and (dy, dx) == (ey, ex):  # fmt: skip
            return _Carried(old, movers, amount, (dy, dx))
    return None
