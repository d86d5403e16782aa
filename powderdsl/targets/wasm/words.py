"""Loops over words of planes: 64 columns of two lanes at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import reduce
from operator import or_

from powderdsl.ir.ops import Node, ordered
from powderdsl.schedule.costs import is_coin
from powderdsl.schedule.types import Compute, loaded
from powderdsl.schedule.words import asked
from powderdsl.targets.layout import param_key
from powderdsl.targets.wasm.binary import Callee, Function, Local, Value, const, load, op
from powderdsl.targets.wasm.library import SOME, WORD, ZERO, Library, choose, some

_DRAWS = ("chance", "below_param", "below_planes")


def plane_name(node: Node, library: Library) -> tuple[str, int] | None:
    """The table, and the number in it, of a plane that a leaf other than a variable stands for."""
    layout = library.memory.layout
    match node.op:
        case "chance" if is_coin(node):
            return "coins", layout.streams[node.attr[0]]
        case "coordinate" if node.attr[0] != "step":
            return "fixed", layout.fixed[0 if node.attr[0] == "row" else 1, node.attr[1], node.attr[2]]
        case "inside":
            return "fixed", layout.fixed[2, node.attr[0], node.attr[1]]
    return None


class WordLoop:
    """A function with one loop over words. Its parameters are planes: those that it reads, and those that it writes.

    `reads` are names of variables, or tables and numbers of planes that are there anyway (`plane_name`).
    """

    def __init__(self, library: Library, loop: Compute):
        self.library, self.loop = library, loop
        roots = [out.value for out in loop.outs]
        self.nodes = ordered(roots)
        self.updates = loop.region is not None
        olds = {out.into for out in loop.outs if self.updates and out.into is not None}
        names = [name for name in dict.fromkeys(loaded(roots)) if name not in olds]
        made = [name for node in self.nodes if (name := plane_name(node, library)) is not None]
        self.reads: list[str | tuple[str, int]] = [*names, *dict.fromkeys(made)]
        masks = self.mask_names = [str(node.attr) for node in asked(loop)] if self.updates else []
        self.reads += [name for name in masks if name not in self.reads]
        self.haloed = list(
            dict.fromkeys(str(n.args[0].attr) for n in self.nodes if n.op == "shift" and n.attr[0])
        )
        """The planes of which other rows are read."""
        count = len(self.reads) + len(loop.outs)
        self.f = Function(["i32"] * count)
        self.planes = dict(zip(self.reads, self.f.params, strict=False))
        self.outs = self.f.params[len(self.reads) :]
        for out, place in zip(loop.outs, self.outs, strict=True):
            if out.into in olds:  # what is overwritten holds the old value
                self.planes[str(out.into)] = place
        self.masks = [self.planes[name] for name in masks]

    def made(self) -> Callee:
        """The function."""
        f, library = self.f, self.library
        memory = library.memory
        stop = f.let(library.cells)
        kept = [f.let(const("v128", 0)) for _ in self.outs]
        self.y = self.row = self.x = None
        if memory.words == 1:
            with f.each(0, stop, 16) as at:
                self.at = at
                self.body(kept)
        else:
            y = f.let(0)
            with f.each(0, stop, memory.row) as row:
                within, x = f.let(0), f.let(0)
                self.y, self.row, self.x, self.within = y, row, x, within
                with f.loop() as again:
                    self.at = f.let(row + within)
                    self.body(kept)
                    f.set(x, x + WORD)
                    f.set(within, within + 16)
                    f.jump(again, within < memory.row)
                f.set(y, y + 1)
        for place, any_flag in zip(self.outs, kept, strict=True):
            before = place[SOME] if self.updates else ZERO
            f.set(place[SOME], before | some(any_flag))
        return library.module.add(f, f"words_{self.loop.place.rpartition('/')[2]}")

    def body(self, kept: Sequence[Local]) -> None:
        f, flags = self.f, self.library.memory.flags
        values = WordValues(self)
        with f.scope(), f.block() as skip:
            if self.updates:
                wanted = reduce(or_, [(mask + self.at)[flags] for mask in self.masks])
                f.jump(skip, some(wanted).equals(0))
            found = []
            for out in self.loop.outs:
                value = values.clean(out.value)
                found.append(f.let(value) if self.updates or len(self.outs) > 1 else value)
            for i, (place, value) in enumerate(zip(self.outs, found, strict=True)):
                value = value if isinstance(value, Local) else f.let(value)
                f.set(kept[i], kept[i] | value)
                f.set((place + self.at)[flags], value)


class WordValues:
    """Flags of a word. Values that are used once are not named."""

    def __init__(self, loop: WordLoop):
        self.loop, self.f, self.library = loop, loop.f, loop.library
        self.memory = loop.library.memory
        self.known: dict[int, Value] = {}
        self.uses = Counter(id(arg) for node in loop.nodes for arg in node.args)
        self.uses.update(id(out.value) for out in loop.loop.outs)

    def of(self, root: Node) -> Value:
        stack = [(root, False)]
        while stack:
            node, ready = stack.pop()
            if id(node) in self.known:
                continue
            if not ready:
                stack.append((node, True))
                below = node.args[:1] if node.op == "when" else () if node.op == "shift" else node.args
                stack.extend((arg, False) for arg in reversed(below))
                continue
            value = self.node(node)
            if self.uses[id(node)] > 1 and not isinstance(value, Local) and node.op != "const":
                value = self.f.let(value)
            self.known[id(node)] = value
        return self.known[id(root)]

    def named(self, node: Node) -> Local:
        value = self.of(node)
        if not isinstance(value, Local):
            value = self.known[id(node)] = self.f.let(value)
        return value

    def clean(self, node: Node) -> Value:
        """The value with zeros beyond the grid's width."""
        value = self.of(node)
        return value if self.memory.whole or node.op == "load" else value & self.valid()

    def valid(self) -> Value:
        if self.memory.words == 1:
            return const("v128", (1 << self.memory.width) - 1)
        return (self.library.everything + self.loop.at)[self.memory.flags]

    def node(self, node: Node) -> Value:
        args = node.args
        if node.op == "and":
            for value, draw in (args, args[::-1]):
                if draw.op in _DRAWS and draw.args[-1:] == (value,):
                    return self.known[id(draw)]  # it holds only where it is drawn
            for value, other in (args, args[::-1]):
                if other.op == "not" and self.uses[id(other)] == 1:
                    return op("v128.andnot", self.known[id(value)], self.known[id(other.args[0])])
        known = [self.known[id(arg)] for arg in args] if node.op not in ("shift", "when") else []
        match node.op:
            case "load":
                return (self.loop.planes[str(node.attr)] + self.loop.at)[self.memory.flags]
            case "and" | "or" | "xor":
                return op(f"v128.{node.op}", *known)
            case "not":
                return ~known[0]
            case "select":
                return choose(*known)
            case "const":
                return const("v128", -1 if node.attr else 0)
            case "shift":
                return self.shift(node)
            case "when":
                return self.lazy(node)
            case "param":
                number = self.memory.layout.param_planes[param_key(node)]
                return load("v128.load", ZERO, self.memory.at("params", number))
            case "coordinate" if node.attr[0] == "step":
                number = self.memory.layout.step_planes[node.attr[1], node.attr[2]]
                return load("v128.load", ZERO, self.memory.at("steps", number))
            case "coordinate" | "inside":
                return self.made_plane(node)
            case "chance" | "below_planes" | "below_param":
                return self.draw(node, known)
        raise AssertionError(f"no function for {node.op} of flags")

    def made_plane(self, node: Node) -> Value:
        name = plane_name(node, self.library)
        assert name is not None
        return (self.loop.planes[name] + self.loop.at)[self.memory.flags]

    def lazy(self, node: Node) -> Value:
        """A conjunction whose second part is computed only where the first holds somewhere in the word."""
        found = self.f.let(const("v128", 0))
        with self.f.when(some(self.of(node.args[0]))):
            known = dict(self.known)
            self.f.set(found, self.of(node.args[1]))
            self.known = known
        return found

    def shift(self, node: Node) -> Value:
        dy, dx, wraps = node.attr
        loop, memory, f = self.loop, self.memory, self.f
        plane = loop.planes[str(node.args[0].attr)]
        offset = memory.base + dy * memory.row
        if memory.words == 1:
            row = load("v128.load", plane + loop.at, offset)
            value = self.library.rotated(f, row, dx, wraps=wraps) if dx else row
        elif dx:
            assert loop.row is not None
            assert loop.x is not None
            start = f.let(plane + loop.row + offset)
            value = self.library.columns(f, start, loop.within, loop.x, dx, wraps=wraps)
        else:
            value = load("v128.load", plane + loop.at, offset)
        if dy and not wraps:
            return value & load("v128.load", self.library.inside + loop.at, offset)
        if dx and not memory.whole:
            return value & self.valid()
        return value

    def draw(self, node: Node, known: Sequence[Value]) -> Value:
        layout, memory = self.memory.layout, self.memory
        stream, bits, *rest = node.attr
        number = layout.streams[stream]
        keys = const("i32", memory.at("keys", number))
        given = node.args[-1:] if node.op != "below_planes" else node.args[bits + 1 :]
        wanted = self.clean(given[0]) if given else self.valid() if not memory.whole else const("v128", -1)
        if plane_name(node, self.library) is not None:
            return op("v128.andnot", wanted, self.made_plane(node))
        at = self.library.word_number(self.loop.at, self.loop.y)
        if node.op == "chance":
            return self.library.draw_below(at, wanted, keys, const("i64", rest[0] << (64 - bits)))
        if node.op == "below_param":
            name, view = rest
            numbers = [layout.param_planes[name, view, i] for i in range(bits, -1, -1)]
            if numbers == list(range(numbers[0], numbers[0] + bits + 1)):
                return self.below(at, wanted, keys, memory.at("params", numbers[0]), bits)
            known = [load("v128.load", ZERO, memory.at("params", n)) for n in numbers]
        for i in range(bits + 1):
            self.f.set(load("v128.load", ZERO, memory.at("limits", i)), known[i])
        return self.f.let(self.below(at, wanted, keys, memory.at("limits"), bits))

    def below(self, at: Value, wanted: Value, keys: Value, limit: int, bits: int) -> Value:
        end = const("i32", limit + 16 * (bits + 1))
        return self.library.draw_below_planes(at, wanted, keys, const("i32", limit), end)
