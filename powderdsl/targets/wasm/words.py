"""Loops over words of planes: 64 columns of two lanes at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from functools import reduce
from itertools import chain
from operator import or_

from powderdsl.ir.ops import Node, ordered
from powderdsl.schedule.costs import is_coin
from powderdsl.schedule.types import Compute, alternatives, loaded, reads_of
from powderdsl.targets.layout import Layout, fixed_key, param_key
from powderdsl.targets.printing import Values, drawn_where, limited_draw
from powderdsl.targets.wasm.binary import Callee, Function, Local, Value, body, const, load, op
from powderdsl.targets.wasm.library import MAX_PARAMS, SOME, WORD, ZERO, Library, choose, some


def plane_name(node: Node, layout: Layout) -> tuple[str, int] | None:
    """The table, and the number in it, of the plane of a coin, coordinate or `inside`; None for other nodes."""
    if is_coin(node):
        return "coins", layout.streams[node.attr[0]]
    if node.op == "inside" or (node.op == "coordinate" and node.attr[0] != "step"):
        return "fixed", layout.fixed[fixed_key(node)]
    return None


class Loop:
    """A function with one loop. Its parameters are the planes and fields that it reads and writes.

    `reads` are names of variables, or tables and numbers of permanent planes (`plane_name`).
    """

    kind: str

    def __init__(self, library: Library, loop: Compute, reads: Iterable[str | tuple[str, int]]):
        self.library, self.loop, self.memory = library, loop, library.memory
        self.reads = list(dict.fromkeys(reads))
        count = len(self.reads) + len(loop.outs)
        self.f = Function(["i32"] * min(count, MAX_PARAMS))
        params = [*self.f.params, *library.more_params(count - MAX_PARAMS)]
        self.addresses = dict(zip(self.reads, params, strict=False))
        self.outs = params[len(self.reads) :]
        self.nodes = ordered(out.value for out in loop.outs)
        self.haloed: list[str] = []
        """The planes that are read in other rows."""

    def write(self) -> None:
        raise NotImplementedError

    def build(self) -> Callee:
        """The function in the module, under the name of its place in the rules."""
        with body.of(self.f):
            self.write()
        return self.library.module.add(self.f, f"{self.kind}_{self.loop.place.rpartition('/')[2]}")


class WordLoop(Loop):
    """A loop over words."""

    kind = "words"

    def __init__(self, library: Library, loop: Compute):
        values = [out.value for out in loop.outs]
        self.mask_names = [str(node.attr) for node in alternatives(loop.region)]
        self.updates = loop.region is not None
        olds = {out.into for out in loop.outs if self.updates and out.into is not None}
        planes = (plane_name(node, library.memory.layout) for node in ordered(values))
        names = (name for name in loaded(values) if name not in olds)
        super().__init__(library, loop, chain(names, filter(None, planes), self.mask_names))
        self.haloed = list(dict.fromkeys(read.name for read in reads_of(values) if read.dy))
        for out, place in zip(loop.outs, self.outs, strict=True):
            if out.into in olds:  # the overwritten plane holds the old value
                self.addresses[str(out.into)] = place

    def write(self) -> None:
        library, memory = self.library, self.memory
        stop = body.let(library.cells)
        any_flags = [body.let(0, "v128") for _ in self.outs]
        self.y: Value | None = None
        if memory.words == 1:
            with body.each(0, stop, 16) as at:
                self.at = self.row = at
                self.within = self.x = ZERO
                self.word(any_flags)
        else:
            y = body.let(0)
            with body.each(0, stop, memory.row) as row:
                within, x = body.let(0), body.let(0)
                self.y, self.row, self.x, self.within = y, row, x, within
                with body.loop() as again:
                    self.at = body.let(row + within)
                    self.word(any_flags)
                    x += WORD
                    within += 16
                    body.jump(again, within < memory.row)
                y += 1
        for place, any_flag in zip(self.outs, any_flags, strict=True):
            before = place[SOME] if self.updates else ZERO
            place[SOME] = before | some(any_flag)

    def word(self, any_flags: Sequence[Local]) -> None:
        flags = self.memory.flags
        values = WordValues(self)
        with body.scope(), body.block() as skip:
            if self.updates:
                wanted = reduce(or_, [(self.addresses[name] + self.at)[flags] for name in self.mask_names])
                body.jump(skip, some(wanted).equals(0))
            new = []
            for out in self.loop.outs:
                value = values.clean(out.value)
                again = not isinstance(value, Local) or self.updates or len(self.outs) > 1
                new.append(body.let(value) if again else value)
            for place, some_flag, value in zip(self.outs, any_flags, new, strict=True):
                some_flag |= value
                (place + self.at)[flags] = value


class WordValues(Values[Value]):
    """Flags of a word. Values that are used once are not named."""

    def __init__(self, loop: WordLoop):
        super().__init__()
        self.loop, self.library, self.memory = loop, loop.library, loop.memory
        self.uses = Counter(id(arg) for node in loop.nodes for arg in node.args)
        self.uses.update(id(out.value) for out in loop.loop.outs)

    def named(self, node: Node, value: Value) -> Value:
        again = self.uses[id(node)] > 1 and not isinstance(value, Local) and node.op != "const"
        return body.let(value) if again else value

    def clean(self, node: Node) -> Value:
        """The value with zeros beyond the grid's width."""
        value = self.of(node)
        return value if self.memory.whole or node.op == "load" else value & self.valid()

    def valid(self) -> Value:
        if self.memory.words == 1 and self.memory.width is not None:
            return const("v128", (1 << self.memory.width) - 1)
        return (self.library.everything + self.loop.at)[self.memory.flags]

    def node(self, node: Node, args: Sequence[Value]) -> Value:
        if (draw := limited_draw(node)) is not None:
            return self.known[id(draw)]
        match node.op:
            case "coordinate" if node.attr[0] == "step":
                number = self.memory.layout.step_planes[node.attr[1:]]
                return load("v128.load", 0, self.memory.at("steps", number))
            case "load" | "inside" | "coordinate":
                return self.plane(node)
            case "and" | "or" | "xor":
                for value, other in (node.args, node.args[::-1]) if node.op == "and" else ():
                    if other.op == "not" and self.uses[id(other)] == 1:
                        return op("v128.andnot", self.known[id(value)], self.known[id(other.args[0])])
                return op(f"v128.{node.op}", *args)
            case "not":
                return ~args[0]
            case "select":
                return choose(*args)
            case "const":
                return const("v128", -1 if node.attr else 0)
            case "shift":
                return self.shift(node)
            case "when":
                return self.lazy(node)
            case "param":
                number = self.memory.layout.param_planes[param_key(node)]
                return load("v128.load", 0, self.memory.at("params", number))
            case "chance" | "below_planes" | "below_param":
                return self.draw(node, args)
        raise AssertionError(f"no function for {node.op} of flags")

    def plane(self, node: Node) -> Value:
        """A word of a variable or permanent plane."""
        name = plane_name(node, self.memory.layout) or str(node.attr)
        return (self.loop.addresses[name] + self.loop.at)[self.memory.flags]

    def lazy(self, node: Node) -> Value:
        """A conjunction whose second part is computed only where the first holds somewhere in the word."""
        value = body.let(0, "v128")
        with body.when(some(self.of(node.args[0]))), body.scope(), self.inner():
            value.set(self.of(node.args[1]))
        return value

    def shift(self, node: Node) -> Value:
        dy, dx, wraps = node.attr
        loop, memory = self.loop, self.memory
        plane = loop.addresses[str(node.args[0].attr)]
        offset = memory.base + dy * memory.row
        value: Value = load("v128.load", plane + loop.at, offset)
        if dx:
            row = plane + loop.row
            value = self.library.columns(row, offset, loop.within, loop.x, dx, wraps=wraps)
        if dy and not wraps:
            return value & load("v128.load", self.library.inside + loop.at, offset)
        if dx and not memory.whole:
            return value & self.valid()
        return value

    def draw(self, node: Node, args: Sequence[Value]) -> Value:
        """A draw below a limit: a number, or planes from the highest."""
        layout, memory, bits = self.memory.layout, self.memory, node.attr[1]
        keys = memory.at("keys", layout.streams[node.attr[0]])
        where = drawn_where(node)
        if where is not None:
            wanted = self.clean(where)
        else:
            wanted = const("v128", -1) if memory.whole else self.valid()
        if is_coin(node):
            return op("v128.andnot", wanted, self.plane(node))
        at = self.library.word_number(self.loop.at, self.loop.y)
        if node.op == "chance":
            return self.library.draw_below(at, wanted, keys, const("i64", node.attr[2] << (64 - bits)))
        if node.op == "below_param":
            limit = memory.at("params", layout.limit(node))
        else:
            limit = memory.at("limits")
            for i, plane in enumerate(args[: bits + 1]):
                load("v128.load", 0, limit + 16 * i).set(plane)
        drawn = self.library.draw_below_planes(at, wanted, keys, limit, limit + 16 * (bits + 1))
        return drawn if node.op == "below_param" else body.let(drawn)
