"""Expressions on planes as C++ statements of a loop over rows and words."""

from __future__ import annotations

from collections.abc import Callable

from powderdsl.ir.ops import REAL, Node
from powderdsl.targets.layout import Layout, param_key

RECOMPUTE = 6
"""Gates up to which a value of another row is computed again rather than stored."""

DRAWS = ("chance", "below_planes")
ANCHORS = ("swap", "arrive", "eq", "lt", "le")
"""Operations that always stand in a plane of their own."""


def is_uniform(node: Node) -> bool:
    """Whether a flag is the same in a whole world or fixed for a grid: no plane has to be computed."""
    return node.op in ("const", "param", "coordinate", "inside")


def gate_cost(node: Node, have: Callable[[Node], bool], limit: int = 1000) -> int:
    """Gates that computing a node in another row takes; `limit` if it cannot be done there."""
    if have(node) or is_uniform(node):
        return limit if node.op in ("coordinate", "inside") else 0
    if node.op in ANCHORS or node.op in DRAWS or node.op == "input":
        return limit
    if node.op == "shift":
        _dy, dx, wraps = node.attr
        if not wraps or dx:
            return limit
        return gate_cost(node.args[0], have, limit)
    total = 2 if node.op == "select" else 1
    for arg in node.args:
        total += gate_cost(arg, have, limit)
        if total >= limit:
            return limit
    return total


class Loop:
    """Collects the statements of one loop body. `planes` gives the variable of a node that stands in a plane."""

    def __init__(self, planes: dict[int, str], layout: Layout, pass_number: int = 0):
        self.planes = planes
        self.layout = layout
        self.lines: list[str] = []
        self.memo: dict[tuple[int, int], str] = {}
        self.used: set[str] = set()
        self.edges: dict[tuple[str, str], int] = {}
        """How many rows away planes are read, by the call that makes these ready and the plane."""
        self.counter = [0]

    def inner(self) -> Loop:
        """A nested block: it sees what stands outside, not the other way round."""
        nested = Loop(self.planes, self.layout)
        nested.memo = dict(self.memo)
        nested.counter = self.counter
        nested.used = self.used
        nested.edges = self.edges
        return nested

    def have(self, node: Node) -> bool:
        return id(node) in self.planes

    def value(self, node: Node, dy: int = 0) -> str:
        """The name of the node's word in row y + dy."""
        key = (id(node), dy)
        if key not in self.memo:
            expression = self.expression(node, dy)
            if expression.isidentifier():
                self.memo[key] = expression
            else:
                self.counter[0] += 1
                name = f"t{self.counter[0]}"
                self.lines.append(f"const V {name} = {expression};")
                self.memo[key] = name
        return self.memo[key]

    def plane(self, node: Node) -> str:
        name = self.planes[id(node)]
        self.used.add(name)
        return name

    def row(self, plane: str, dy: int) -> str:
        if dy == 0:
            return "y * words"
        self.reads(plane, dy)
        return f"c.row(y + {dy})"

    def reads(self, plane: str, dy: int, wraps: bool = True) -> None:
        """Note that rows of a plane are read that may lie in another strip."""
        if wraps:
            self.layout.around = max(self.layout.around, abs(dy))
        key = ("edges" if wraps else "bare_edges", plane)
        if dy:
            self.edges[key] = max(self.edges.get(key, 0), abs(dy))

    def ready(self) -> str:
        """Statements before the loop: rows of other strips that it reads."""
        return " ".join(f"{call}(c, {plane}, {rows});" for (call, plane), rows in self.edges.items())

    def expression(self, node: Node, dy: int) -> str:
        if self.have(node):
            plane = self.plane(node)
            return f"{plane}->data[{self.row(plane, dy)} + w]"
        args = node.args
        match node.op:
            case "const":
                return "valid" if node.attr else "splat(0)"
            case "param":
                return f"c.param_bits[{self.layout.param_planes[param_key(node)]}]"
            case "coordinate":
                axis, modulus, bit = node.attr
                if axis == "step":
                    return f"c.step_bits[{self.layout.step_planes[modulus, bit]}]"
                assert dy == 0
                return f"c.fixed[{self.layout.fixed[0 if axis == 'row' else 1, modulus, bit]}][y * words + w]"
            case "inside":
                assert dy == 0
                return f"c.fixed[{self.layout.fixed[2, node.attr[0], node.attr[1]]}][y * words + w]"
            case "chance" | "below_planes":
                return self.draw(node, "valid")
            case "shift":
                return self.shift(node, dy)
            case "not":
                return f"~{self.value(args[0], dy)}"
            case "and":
                for a, b in (args, args[::-1]):
                    if b.op in DRAWS and a.op not in DRAWS and not self.have(b):
                        return self.draw(b, self.clean(a, dy))
                return f"{self.value(args[0], dy)} & {self.value(args[1], dy)}"
            case "or":
                return f"{self.value(args[0], dy)} | {self.value(args[1], dy)}"
            case "xor":
                return f"{self.value(args[0], dy)} ^ {self.value(args[1], dy)}"
            case "select":
                condition, yes, no = (self.value(arg, dy) for arg in args)
                return f"mux({condition}, {yes}, {no})"
        raise AssertionError(f"no native plane kernel for {node.op}")

    def draw(self, node: Node, wanted: str) -> str:
        stream, bits, *limit = node.attr
        number = self.layout.streams[stream]
        if node.op == "chance":
            return f"draw_below(c, {number}, y, w, {wanted}, {bits}, {limit[0]}ull)"
        planes = ", ".join(self.value(arg) for arg in node.args)
        self.counter[0] += 1
        name = f"limit{self.counter[0]}"
        self.lines.append(f"const V {name}[] = {{{planes}}};")
        return f"draw_below_planes(c, {number}, y, w, {wanted}, {bits}, {name})"

    def shift(self, node: Node, dy: int) -> str:
        sy, sx, wraps = node.attr
        source = node.args[0]
        if not self.have(source):
            if source.op in ("const", "param") or (source.op == "coordinate" and source.attr[0] == "step"):
                assert wraps
                return self.value(source)
            assert wraps
            assert not sx
            return self.value(source, dy + sy)
        plane = self.plane(source)
        if wraps:
            if not sx:
                return f"{plane}->data[{self.row(plane, dy + sy)} + w]"
            return f"columns(c, {plane}->data + {self.row(plane, dy + sy)}, w, {sx})"
        assert dy == 0
        self.reads(plane, sy, wraps=False)
        if not sx:
            return f"row_or_nothing(c, {plane}, y + {sy})[w]"
        return f"columns_zero(c, row_or_nothing(c, {plane}, y + {sy}), w, {sx})"

    def clean(self, node: Node, dy: int = 0) -> str:
        """The value with nothing beyond the grid's width."""
        name = self.value(node, dy)
        if is_clean(node, self.have):
            return name
        self.counter[0] += 1
        cleaned = f"t{self.counter[0]}"
        self.lines.append(f"const V {cleaned} = {name} & valid;")
        return cleaned


def is_clean(node: Node, have: Callable[[Node], bool], known: dict[int, bool] | None = None) -> bool:
    """Whether bits beyond the width are surely zero. Graphs share nodes, so answers are kept in `known`."""
    known = {} if known is None else known
    if id(node) not in known:
        if have(node) or node.op in ("const", "inside", "coordinate", *DRAWS, *ANCHORS):
            known[id(node)] = not (node.op == "coordinate" and node.attr[0] == "step")
        elif node.op == "shift":
            # Read from a plane, it is clean; computed for another row, it holds what its source holds.
            known[id(node)] = is_clean(node.args[0], have, known)
        elif node.op == "and":
            known[id(node)] = any(is_clean(arg, have, known) for arg in node.args)
        elif node.op in ("or", "xor"):
            known[id(node)] = all(is_clean(arg, have, known) for arg in node.args)
        elif node.op == "select":
            known[id(node)] = all(is_clean(arg, have, known) for arg in node.args[1:])
        else:
            known[id(node)] = False
    return known[id(node)]


def prerequisites(node: Node, have: Callable[[Node], bool]) -> list[Node]:
    """Nodes that must stand in planes before a loop can compute this one."""
    found: dict[int, Node] = {}
    seen: set[int] = set()

    def visit(node: Node, top: bool) -> None:
        if id(node) in seen or have(node) or is_uniform(node):
            return
        seen.add(id(node))
        if not top and node.op in ANCHORS:
            found[id(node)] = node
            return
        if node.op == "shift":
            source = node.args[0]
            _, dx, wraps = node.attr
            constant = source.op in ("const", "param") or (
                source.op == "coordinate" and source.attr[0] == "step"
            )
            if have(source) or (constant and wraps):
                return
            if wraps and not dx and gate_cost(source, have) <= RECOMPUTE:
                visit(source, False)
                return
            found[id(source)] = source
            return
        for arg in node.args:
            if arg.type != REAL:
                visit(arg, False)

    visit(node, True)
    return list(found.values())


def zero_with(
    node: Node, planes: dict[int, str], known: dict[int, frozenset[str] | None] | None = None
) -> frozenset[str] | None:
    """Planes such that if all of them are empty, the value is too; None if none are known."""
    known = {} if known is None else known  # graphs share nodes: each is asked once
    if id(node) not in known:
        known[id(node)] = _zero_with(node, planes, known)
    return known[id(node)]


def _zero_with(
    node: Node, planes: dict[int, str], known: dict[int, frozenset[str] | None]
) -> frozenset[str] | None:
    if id(node) in planes:
        return frozenset({planes[id(node)]})
    if node.op == "const":
        return None if node.attr else frozenset()
    if node.op == "shift":
        return zero_with(node.args[0], planes, known)
    if node.op == "and":
        found = [names for arg in node.args if (names := zero_with(arg, planes, known)) is not None]
        return min(found, key=len, default=None)
    if node.op in ("or", "xor", "select"):
        parts = [zero_with(arg, planes, known) for arg in node.args[node.op == "select" :]]
        return (
            None
            if any(part is None for part in parts)
            else frozenset().union(*(part or () for part in parts))
        )
    return None
