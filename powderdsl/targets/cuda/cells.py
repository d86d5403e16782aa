"""Reals as CUDA C++: scalar code of one cell, which a warp runs for the 32 cells of a word; masks are tested by word."""

from __future__ import annotations

from collections.abc import Callable

from powderdsl.ir.ops import REAL, Node
from powderdsl.targets.layout import Layout, literal, param_key

_INFIX = {"add": "+", "sub": "-", "mul": "*"}
_COMPARE = {"eq": "==", "lt": "<", "le": "<="}
_CALLS = {"abs": "MAGNITUDE", "sqrt": "ROOT", "div": "divide", "min": "smaller", "max": "larger"}


class Cells:
    """The statements that compute some reals and comparisons in one cell."""

    def __init__(self, planes: dict[int, str], fields: dict[int, str], layout: Layout):
        self.planes, self.fields, self.layout = planes, fields, layout
        self.lines: list[str] = []
        self.memo: dict[tuple[int, int, int], str] = {}
        self.words: dict[str, str] = {}
        """Masks' words by plane, read before the cells."""
        self.index: dict[tuple[str, int], str] = {}
        self.flags: dict[int, str] = {}
        self.wanted: list[Node] = []
        """Choices that this loop will compute anyway."""
        self.reads: dict[str, bool] = {}
        self.counter = [0]

    def inner(self) -> Cells:
        """A nested block: it sees what stands outside, not the other way round."""
        nested = Cells(self.planes, self.fields, self.layout)
        nested.memo, nested.index, nested.flags = dict(self.memo), dict(self.index), self.flags
        nested.words, nested.reads, nested.counter = self.words, self.reads, self.counter
        return nested

    def have(self, node: Node) -> bool:
        return id(node) in self.fields or id(node) in self.planes

    def fresh(self, prefix: str) -> str:
        self.counter[0] += 1
        return f"{prefix}{self.counter[0]}"

    def name(self, expression: str) -> str:
        name = self.fresh("v")
        self.lines.append(f"const float {name} = {expression};")
        return name

    def place(self, axis: str, by: int) -> str:
        """The row's first cell or the column at a neighbour."""
        if (axis, by) not in self.index:
            self.index[axis, by] = name = self.fresh("a")
            what = f"row(l, y, {by}) / ROW_WORDS * WIDTH" if axis == "row" else f"around(x, {by}, WIDTH)"
            self.lines.append(f"const int {name} = {what};")
        return self.index[axis, by]

    def load(self, node: Node, dy: int, dx: int, wraps: bool) -> str:
        field = self.fields[id(node)]
        self.reads[field] = self.reads.get(field, False) or (dy, dx) != (0, 0)
        if (dy, dx) == (0, 0):
            return f"{field}[cell]"
        value = f"{field}[{self.place('row', dy)} + {self.place('column', dx)}]"
        if wraps:
            return value
        within = f"y + {dy} >= 0 && y + {dy} < HEIGHT && x + {dx} >= 0 && x + {dx} < WIDTH"
        return f"{within} ? {value} : 0.0f"

    def word(self, node: Node) -> str:
        """The word of a flag's plane."""
        if node.op == "param":
            return f"PARAM_FLAG({self.layout.param_planes[param_key(node)]})"
        plane = self.planes[id(node)]
        self.reads.setdefault(plane, False)
        return self.words.setdefault(plane, f"m{len(self.words)}")

    def value(self, node: Node, dy: int = 0, dx: int = 0) -> str:
        """The name of the node's number at the neighbour (dy, dx)."""
        if node.op == "const":
            return literal(float(node.attr))
        key = (id(node), dy, dx)
        if key not in self.memo:
            self.memo[key] = self.compute(node, dy, dx)
        return self.memo[key]

    def compute(self, node: Node, dy: int, dx: int) -> str:
        if id(node) in self.fields:
            return self.name(self.load(node, dy, dx, True))
        args = node.args
        match node.op:
            case "select":
                assert dy == dx == 0
                return self.select(node)
            case "param":
                return self.name(f"PARAM_REAL({self.layout.param_reals[node.attr[0]]})")
            case "draw":
                assert dy == dx == 0
                stream, bits = node.attr
                return self.name(f"draw_cell({self.layout.streams[stream]}, l, y, x, {bits})")
            case "shift":
                sy, sx, wraps = node.attr
                if wraps:
                    return self.value(args[0], dy + sy, dx + sx)
                assert dy == dx == 0
                return self.name(self.load(args[0], sy, sx, False))
        values = [self.value(arg, dy, dx) for arg in args]
        if node.op in _INFIX:
            return self.name(f"{values[0]} {_INFIX[node.op]} {values[1]}")
        if node.op in _CALLS:
            return self.name(f"{_CALLS[node.op]}({', '.join(values)})")
        if node.op == "neg":
            return self.name(f"-{values[0]}" if values[0][0] != "-" else f"-({values[0]})")
        if node.op == "settle":
            lo, hi = node.attr
            return self.name(f"settle({values[0]}, {literal(lo)}, {literal(hi)})")
        raise AssertionError(f"no cuda kernel for {node.op}")

    def comparison(self, node: Node, leaders: dict[int, Node]) -> str:
        """A comparison; not computed where the one that leads it fails."""
        leader = leaders.get(id(node))
        known = self.flags.get(id(leader)) if leader is not None else None
        block = self.inner() if known else self
        a, b = (block.value(arg) for arg in node.args)
        test = f"{a} {_COMPARE[node.op]} {b}"
        name = self.fresh("b")
        if known:
            lines = "\n".join(block.lines)
            self.lines.append(f"bool {name} = false; if ({known}) {{\n{lines}\n{name} = {test}; }}")
        else:
            self.lines.append(f"const bool {name} = {test};")
        self.flags[id(node)] = name
        return name

    def chain(self, node: Node) -> list[Node]:
        """A choice and those below it in its third argument, the outermost first; empty if it is none."""
        chain: list[Node] = []
        while node.op == "select" and not self.have(node) and (id(node), 0, 0) not in self.memo:
            chain.append(node)
            node = node.args[2]
        return chain

    def select(self, node: Node) -> str:
        """Choices laid over each other. Where no cell of the word is chosen, nothing of a choice is computed."""
        chain = self.chain(node)
        masks = [choice.args[0] for choice in chain]
        # Parts of a vector hang on the same masks: they are tested once for both.
        alike = [
            self.chain(other)
            for other in self.wanted
            if other is not node and (id(other), 0, 0) not in self.memo
        ]
        chains = [chain, *(c for c in alike if len(c) > 1 and [choice.args[0] for choice in c] == masks)]
        names = []
        for one in chains:
            base = self.value(one[-1].args[2])
            names.append(self.fresh("v"))
            self.lines.append(f"float {names[-1]} = {base};")
        for level in reversed(range(len(chain))):
            nested = self.inner()
            for one, name in zip(chains, names, strict=True):
                nested.memo[id(one[level].args[2]), 0, 0] = name  # here only: the name's value changes
            chosen = [nested.value(one[level].args[1]) for one in chains]
            mask = self.word(masks[level])
            blends = [
                f"if (BIT({mask})) {name} = {value};" for name, value in zip(names, chosen, strict=True)
            ]
            self.lines.append("\n".join([f"if ({mask}) {{", *nested.lines, *blends, "}"]))
        for one, name in zip(chains[1:], names[1:], strict=True):
            self.memo[id(one[0]), 0, 0] = name
        return names[0]


def quiet_reads(nodes: list[Node], have: Callable[[Node], bool]) -> list[tuple[Node, int, int]]:
    """Fields that the nodes read where no mask holds: the field, rows down, and columns at most to either side."""
    reach: dict[tuple[int, int], int] = {}
    fields: dict[int, Node] = {}
    seen: set[tuple[int, int, int]] = set()

    def visit(node: Node, dy: int, dx: int) -> None:
        if (id(node), dy, dx) in seen:
            return
        seen.add((id(node), dy, dx))
        if node.type == REAL and have(node) and node not in nodes:
            fields[id(node)] = node
            reach[id(node), dy] = max(reach.get((id(node), dy), 0), abs(dx))
        elif node.op == "shift":
            visit(node.args[0], dy + node.attr[0], dx + node.attr[1])
        elif node.op == "select":
            visit(node.args[2], dy, dx)
        else:
            for arg in node.args:
                visit(arg, dy, dx)

    for node in nodes:
        visit(node, 0, 0)
    return [(fields[key], dy, dx) for (key, dy), dx in reach.items()]
