"""Flags as CUDA C++: expressions on 32 columns, and what must stand in planes before a loop can compute them.

Gates commute with shifts on a torus, so what is cheap is computed again at a neighbour rather than stored there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from powderdsl.ir.ops import Node, Offset, PassGraph, nodes_of
from powderdsl.targets.cpp.loops import DRAWS, is_uniform
from powderdsl.targets.layout import Layout, param_key

RECOMPUTE = 24
"""Gates, summed over all neighbours that ask, up to which a value is computed again: a barrier costs about as much."""

REALS = ("eq", "lt", "le")
"""Flags that loops over cells make."""

Have = Callable[[Node], bool]


def sources_of(node: Node) -> list[tuple[Node, Offset]]:
    """What a node asks for at neighbours, and where."""
    if node.op == "shift":
        return [(node.args[0], node.attr[:2])]
    if node.op in ("swap", "arrive"):
        (dy, dx), (content, movers, _) = node.attr, node.args
        back = [(content, (-dy, -dx)), (movers, (-dy, -dx))]
        return [*back, (content, (dy, dx))] if node.op == "swap" else back
    return []


def askers(pass_: PassGraph) -> dict[int, int]:
    """How many neighbours' values of each node a pass asks for."""
    offsets: dict[int, set[Offset]] = {}
    for node in nodes_of(pass_):
        for source, offset in sources_of(node):
            offsets.setdefault(id(source), set()).add(offset)
    return {key: len(found) for key, found in offsets.items()}


def movable(node: Node, have: Have, most: int) -> bool:
    """Whether a flag can be computed at a neighbour with at most so many gates."""
    seen: set[tuple[int, Offset]] = set()
    stack = [(node, (0, 0))]
    while stack:
        top, (dy, dx) = stack.pop()
        if (id(top), (dy, dx)) in seen:
            continue
        if top.op in ("const", "param") or (top.op == "coordinate" and top.attr[0] == "step"):
            continue
        seen.add((id(top), (dy, dx)))
        if len(seen) > most:
            return False
        if have(top):
            continue
        if top.op == "shift" and top.attr[2]:
            stack.append((top.args[0], (dy + top.attr[0], dx + top.attr[1])))
        elif top.op in ("not", "and", "or", "xor", "select"):
            stack.extend((arg, (dy, dx)) for arg in top.args)
        else:
            return False
    return True


class Words:
    """What one pass can say about flags: which neighbours' values are computed again, and which must be stored."""

    def __init__(self, pass_: PassGraph):
        self.askers = askers(pass_)

    def again(self, node: Node, have: Have) -> bool:
        """Whether a node's value at a neighbour is at hand or cheap."""
        if have(node):
            return True
        return movable(node, have, max(1, RECOMPUTE // max(1, self.askers.get(id(node), 1))))

    def needs(self, node: Node, have: Have) -> list[Node]:
        """Nodes that must stand in planes before a loop can compute this one."""
        found: dict[int, Node] = {}
        seen: set[int] = set()
        stack = [node]
        while stack:
            top = stack.pop()
            if id(top) in seen or have(top) or is_uniform(top):
                continue
            seen.add(id(top))
            if top.op in REALS and top is not node:
                found[id(top)] = top
                continue
            sources = {id(source): source for source, _ in sources_of(top)}
            for source in sources.values():
                if not self.again(source, have):
                    found[id(source)] = source
                else:
                    stack.append(source)
            stack.extend(arg for arg in top.args if id(arg) not in sources)
        return list(found.values())


class WordLoop:
    """Collects the statements of one loop over words."""

    def __init__(self, planes: dict[int, str], layout: Layout):
        self.planes, self.layout = planes, layout
        self.lines: list[str] = []
        self.reads: dict[str, bool] = {}
        self.memo: dict[tuple[int, int, int], str] = {}
        self.counter = [0]

    def inner(self) -> WordLoop:
        """A nested block: it sees what stands outside, not the other way round."""
        nested = WordLoop(self.planes, self.layout)
        nested.memo, nested.counter, nested.reads = dict(self.memo), self.counter, self.reads
        return nested

    def have(self, node: Node) -> bool:
        return id(node) in self.planes

    def name(self, expression: str) -> str:
        """A new temporary."""
        self.counter[0] += 1
        self.lines.append(f"const u32 t{self.counter[0]} = {expression};")
        return f"t{self.counter[0]}"

    def value(self, node: Node, dy: int = 0, dx: int = 0) -> str:
        """The name of the node's word at the neighbour (dy, dx)."""
        key = (id(node), dy, dx)
        if key not in self.memo:
            expression = self.expression(node, dy, dx)
            self.memo[key] = expression if expression.isidentifier() else self.name(expression)
        return self.memo[key]

    def clean(self, node: Node) -> str:
        """The value with nothing beyond the grid's width."""
        return f"{self.value(node)} & valid"

    def expression(self, node: Node, dy: int, dx: int) -> str:
        if self.have(node):
            return self.load(self.planes[id(node)], dy, dx)
        args = node.args
        match node.op:
            case "const":
                return "valid" if node.attr else "0u"
            case "param":
                return f"PARAM_FLAG({self.layout.param_planes[param_key(node)]})"
            case "coordinate":
                axis, modulus, bit = node.attr
                if axis == "step":
                    return f"STEP_FLAG({self.layout.step_planes[modulus, bit]})"
                assert dy == dx == 0
                if axis == "row":
                    return f"spread(y % {modulus} >> {bit} & 1)"
                return f"COLUMNS_{self.layout.fixed[1, modulus, bit]}[w]"
            case "inside":
                assert dy == dx == 0
                return f"inside_word(y, w, {node.attr[0]}, {node.attr[1]})"
            case "chance" | "below_planes":
                assert dy == dx == 0
                return self.draw(node, "valid")
            case "shift":
                sy, sx, wraps = node.attr
                moved = self.value(args[0], dy + sy, dx + sx)
                if wraps:
                    return moved
                assert dy == dx == 0
                return f"{moved} & inside_word(y, w, {sy}, {sx})"
            case "not":
                return f"~{self.value(args[0], dy, dx)}"
            case "and":
                for a, b in (args, args[::-1]):
                    if b.op in DRAWS and a.op not in DRAWS and not self.have(b):
                        return self.draw(b, self.name(self.clean(a)))
                return f"{self.value(args[0], dy, dx)} & {self.value(args[1], dy, dx)}"
            case "or":
                return f"{self.value(args[0], dy, dx)} | {self.value(args[1], dy, dx)}"
            case "xor":
                return f"{self.value(args[0], dy, dx)} ^ {self.value(args[1], dy, dx)}"
            case "select":
                condition, yes, no = (self.value(arg, dy, dx) for arg in args)
                return f"mux({condition}, {yes}, {no})"
            case "swap" | "arrive":
                assert dy == dx == 0
                return self.movement(node)
        raise AssertionError(f"no cuda kernel for {node.op}")

    def load(self, plane: str, dy: int, dx: int) -> str:
        """The word of a stored plane at a neighbour."""
        self.reads[plane] = self.reads.get(plane, False) or (dy, dx) != (0, 0)
        if dx:
            return f"columns({plane} + {self.row(dy)}, w, {dx})"
        return f"{plane}[{self.row(dy)} + w]" if dy else f"{plane}[i]"

    def row(self, dy: int) -> str:
        key = (0, dy, 0)
        if key not in self.memo:
            self.counter[0] += 1
            self.lines.append(f"const int r{self.counter[0]} = row(l, y, {dy});")
            self.memo[key] = f"r{self.counter[0]}"
        return self.memo[key]

    def draw(self, node: Node, wanted: str) -> str:
        stream, bits, *limit = node.attr
        number = self.layout.streams[stream]
        if node.op == "chance":
            return f"draw_below({number}, l, y, w, {wanted}, {bits}, {limit[0]}ull)"
        planes = ", ".join(self.value(arg) for arg in node.args)
        self.counter[0] += 1
        name = f"limit{self.counter[0]}"
        self.lines.append(f"const u32 {name}[] = {{{planes}}};")
        return f"draw_below_planes({number}, l, y, w, {wanted}, {bits}, {name})"

    def movement(self, node: Node) -> str:
        content, movers, rest = node.args
        dy, dx = node.attr
        targets, back = self.value(movers, -dy, -dx), self.value(content, -dy, -dx)
        moved = f"mux({targets}, {back}, {self.value(rest)})"
        if node.op == "arrive":
            return moved
        return f"mux({self.value(movers)}, {self.value(content, dy, dx)}, {moved})"


def joined(loop: WordLoop, parts: Sequence[str]) -> str:
    """The conjunction of words, as the name of a temporary."""
    return loop.name(" & ".join([*parts, "valid"]))
