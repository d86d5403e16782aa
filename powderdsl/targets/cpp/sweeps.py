"""Reals as C++: sweeps over the rows of each world that compute float planes, and flags that compare them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from powderdsl.ir.ops import REAL, Node, PassGraph, walk
from powderdsl.targets.layout import Layout, literal, param_key

RECOMPUTE = 2
FAR = 100
"""The cost of what cannot be recomputed."""
_INFIX = {"add": "+", "sub": "-", "mul": "*"}


def real_cost(node: Node, have: Callable[[Node], bool]) -> int:
    """Operations that computing a real at a neighbour takes; large if it cannot be done there."""
    if have(node) or node.op in ("const", "param"):
        return 0
    if node.op in _INFIX or node.op == "neg":
        total = 1
        for arg in node.args:
            total += real_cost(arg, have)
            if total >= FAR:  # graphs share nodes: counting on would take forever
                return FAR
        return total
    if node.op == "shift" and node.attr[2]:
        return real_cost(node.args[0], have)
    return FAR


def sweep_needs(
    node: Node, have: Callable[[Node], bool], apart: Callable[[Node], bool] = lambda node: False
) -> tuple[list[Node], list[Node]]:
    """Flags and reals that must stand in planes before a sweep can compute this node.

    `apart` tells of reals that are made in another way.
    """
    flags: dict[int, Node] = {}
    reals: dict[int, Node] = {}
    seen: set[int] = set()
    stack = [node]
    while stack:
        top = stack.pop()
        if id(top) in seen or (top is not node and have(top)):
            continue
        seen.add(id(top))
        if top is not node and apart(top):
            reals[id(top)] = top
        elif top.type != REAL and top is not node:
            if top.op == "param":
                continue
            flags[id(top)] = top
        elif top.op == "shift":
            source = top.args[0]
            if have(source):
                continue
            if not top.attr[2]:
                reals[id(source)] = source
                continue
            parts = stored_parts(source, have)
            reals |= {id(part): part for part in parts}
            if not parts:
                stack.append(source)
        else:
            stack.extend(top.args)
    return list(flags.values()), list(reals.values())


class Sweep:
    """The statements that compute some reals and comparisons chunk by chunk."""

    def __init__(self, planes: dict[int, str], fields: dict[int, str], layout: Layout):
        self.planes, self.fields, self.layout = planes, fields, layout
        self.lines: list[str] = []
        self.memo: dict[tuple[int, int, int], str] = {}
        self.rows: dict[str, str] = {}
        self.words: dict[str, str] = {}
        self.flags: dict[int, str] = {}
        self.wanted: list[Node] = []
        """Choices that this sweep will compute anyway."""
        self.used: set[str] = set()
        self.reads: set[tuple[str, int, int]] = set()
        """Fields, and the rows and columns away that they are read at."""
        self.counter = [0]
        self.led: dict[str, tuple[Sweep, list[str]]] = {}
        """What is computed only where a comparison holds somewhere in the chunk, by its flag."""

    def have(self, node: Node) -> bool:
        return id(node) in self.fields or id(node) in self.planes

    def inner(self) -> Sweep:
        nested = Sweep(self.planes, self.fields, self.layout)
        nested.memo, nested.counter = dict(self.memo), self.counter
        nested.rows, nested.words, nested.used = self.rows, self.words, self.used
        nested.reads = self.reads
        return nested

    def row(self, field: str, dy: int, wraps: bool = True) -> str:
        """The pointer to a field's row, set up once a row."""
        self.used.add(field)
        self.layout.rows = max(self.layout.rows, abs(dy))
        call = (
            f"real_row_wrapped(c, {field}, l{field}, y + {dy})"
            if wraps
            else f"real_row_or_nothing(c, {field}, l{field}, y + {dy})"
        )
        if wraps and dy == 0:
            call = f"real_row(c, {field}, l{field}, y)"
        return self.rows.setdefault(call, f"r{len(self.rows)}")

    def word(self, node: Node) -> str:
        """The word of a flag's plane, read once a row and word."""
        if node.op == "param":
            return f"c.param_bits[{self.layout.param_planes[param_key(node)]}][l]"
        plane = self.planes[id(node)]
        self.used.add(plane)
        return self.words.setdefault(plane, f"m{len(self.words)}")

    def mask(self, node: Node) -> str:
        """Sixteen bits of a flag's plane."""
        return f"(u32)({self.word(node)} >> (x & 63) & 0xffff)"

    def temporary(self, expression: str) -> str:
        self.counter[0] += 1
        name = f"v{self.counter[0]}"
        self.lines.append(f"const F {name} = {expression};")
        return name

    def value(self, node: Node, dy: int = 0, dx: int = 0) -> str:
        """The name of the node's chunk at the neighbour (dy, dx)."""
        if node.op == "const":
            return f"splatf({literal(float(node.attr))})"
        key = (id(node), dy, dx)
        if key not in self.memo:
            self.memo[key] = self.compute(node, dy, dx)
        return self.memo[key]

    def compute(self, node: Node, dy: int, dx: int) -> str:
        if id(node) in self.fields:
            self.reads.add((self.fields[id(node)], dy, dx))
            return self.temporary(f"load({self.row(self.fields[id(node)], dy)}, x + {dx})")
        args = node.args
        if node.op == "select":
            return self.select(node)
        match node.op:
            case "param":
                return self.temporary(f"splatf(c.param_real[{self.layout.param_reals[node.attr[0]]}][l])")
            case "draw":
                stream, bits = node.attr
                self.counter[0] += 1
                name = f"d{self.counter[0]}"
                number = self.layout.streams[stream]
                cell = f"draw_cell(c, {number}, l, y, std::min(x + i, width - 1), {bits})"
                self.lines.append(f"F {name}; for (int i = 0; i < CHUNK; i++) {name}[i] = {cell};")
                return name
            case "shift":
                sy, sx, wraps = node.attr
                if wraps:
                    return self.value(args[0], dy + sy, dx + sx)
                assert dy == dx == 0
                self.reads.add((self.fields[id(args[0])], sy, sx))
                row = self.row(self.fields[id(args[0])], sy, wraps=False)
                loaded = f"load({row}, x + {sx})"
                return self.temporary(f"inside_columns({loaded}, x, {sx}, width)" if sx else loaded)
        values = [self.value(arg, dy, dx) for arg in args]
        match node.op:
            case "add" | "sub" | "mul":
                return self.temporary(f"{values[0]} {_INFIX[node.op]} {values[1]}")
            case "div":
                divisor = args[1]
                if divisor.op == "const" and divisor.attr:
                    return self.temporary(quotient(values[0], float(divisor.attr)))
                return self.temporary(f"divide({values[0]}, {values[1]})")
            case "neg":
                return self.temporary(f"-{values[0]}")
            case "abs":
                return self.temporary(f"magnitude({values[0]})")
            case "min":
                return self.temporary(f"smaller({values[0]}, {values[1]})")
            case "max":
                return self.temporary(f"larger({values[0]}, {values[1]})")
            case "sqrt":
                return self.temporary(f"root({values[0]})")
            case "settle":
                lo, hi = node.attr
                return self.temporary(f"settle({values[0]}, {literal(lo)}, {literal(hi)}, SNAP)")
        raise AssertionError(f"no native sweep for {node.op}")

    def chain(self, node: Node) -> list[Node]:
        """A choice and those below it in its third argument, the outermost first; empty if it is none."""
        chain: list[Node] = []
        while node.op == "select" and not self.have(node) and (id(node), 0, 0) not in self.memo:
            chain.append(node)
            node = node.args[2]
        return chain

    def comparison(self, node: Node, leaders: dict[int, Node]) -> str:
        """Sixteen bits of a comparison; nothing is computed where the comparison that leads it fails everywhere."""
        leader = leaders.get(id(node))
        known = self.flags.get(id(leader)) if leader is not None else None
        self.counter[0] += 1
        name = f"b{self.counter[0]}"
        block, ends = self.led.setdefault(known, (self.inner(), [])) if known else (self, self.lines)
        a, b = (block.value(arg) for arg in node.args)
        bits = f"bits_{node.op}({a}, {b})"
        if known:
            self.lines.append(f"u32 {name} = 0;")
            ends.append(f"{name} = {bits};")
        else:
            self.lines.append(f"const u32 {name} = {bits};")
        self.flags[id(node)] = name
        return name

    def close(self) -> None:
        """Write what hangs on comparisons."""
        for known, (block, ends) in self.led.items():
            self.lines.append(f"if ({known}) {{ {' '.join([*block.lines, *ends])} }}")

    def select(self, node: Node) -> str:
        """Choices laid over each other. Where no cell of the chunk is chosen, nothing of a choice is computed."""
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
            self.counter[0] += 1
            names.append(f"v{self.counter[0]}")
            self.lines.append(f"F {names[-1]} = {base};")
        block = self.inner()
        for level in reversed(range(len(chain))):
            self.counter[0] += 1
            bits = f"b{self.counter[0]}"
            nested = block.inner()
            for one, name in zip(chains, names, strict=True):
                nested.memo[id(one[level].args[2]), 0, 0] = (
                    name  # here only: further on the name holds another value
                )
            chosen = [nested.value(one[level].args[1]) for one in chains]
            blends = [
                f"{name} = blend({bits}, {value}, {name});" for name, value in zip(names, chosen, strict=True)
            ]
            block.lines.append(
                f"if (const u32 {bits} = {self.mask(masks[level])}) {{ {' '.join([*nested.lines, *blends])} }}"
            )
        for one, name in zip(chains[1:], names[1:], strict=True):
            self.memo[id(one[0]), 0, 0] = name
        name = names[0]
        self.lines.append("\n".join(block.lines))
        return name


def quotient(value: str, divisor: float) -> str:
    """A division by a constant. By a product, if the divisor's fraction is not all ones (Markstein 1990, theorem 8)."""
    short = np.float32(divisor)
    if short.view(np.uint32) & 0x7FFFFF == 0x7FFFFF or not 2.0**-60 < abs(divisor) < 2.0**60:
        return f"{value} / splatf({literal(divisor)})"
    return f"divide_by({value}, {literal(divisor)}, {literal(float(np.float32(1) / short))})"


def leading(node: Node, comparisons: list[Node], pass_: PassGraph) -> Node | None:
    """A comparison that everything which asks for `node` also asks for: where it fails, `node` may be anything."""
    for leader in comparisons:
        if (
            leader is not node
            and leader.args != node.args
            and all(_covered(root, node, leader) for _, root in pass_.outputs)
        ):
            return leader
    return None


def _covered(root: Node, node: Node, leader: Node) -> bool:
    """Whether each way from the root to the node leads through a conjunction with the leader."""
    seen: set[int] = set()
    stack = [root]
    while stack:
        top = stack.pop()
        if id(top) in seen:
            continue
        seen.add(id(top))
        if top is node:
            return False
        if top.op == "and":
            parts = conjuncts(top)
            if any(part is leader for part in parts):
                stack.append(leader)  # the other parts are asked together with it
                continue
        stack.extend(top.args)
    return True


def conjuncts(node: Node) -> list[Node]:
    """The parts of nested conjunctions."""
    if node.op != "and":
        return [node]
    return [part for arg in node.args for part in conjuncts(arg)]


def stored_parts(source: Node, have: Callable[[Node], bool]) -> list[Node]:
    """What must be stored so that a real can be computed at a neighbour: itself, or the costly things in it."""
    if real_cost(source, have) <= RECOMPUTE:
        return []
    if source.op in _INFIX or source.op == "neg":
        parts = [part for arg in source.args for part in stored_parts(arg, have)]
        ids = {id(part) for part in parts}
        if real_cost(source, lambda node: have(node) or id(node) in ids) <= RECOMPUTE:
            return parts
    return [source]


def quiet(
    nodes: list[Node], have: Callable[[Node], bool]
) -> tuple[list[float | bool] | None, list[Node], list[Node]]:
    """What the nodes are where all reals are zero and no mask holds; which masks and rows decide that it is so.

    The values are None if parameters or draws enter, so that no row may be skipped.
    """
    memo: dict[int, object] = {}
    masks: dict[int, Node] = {}
    sources: dict[int, Node] = {}

    def visit(node: Node) -> Any:
        if id(node) in memo:
            return memo[id(node)]
        if node.type == REAL and have(node) and node not in nodes:
            sources[id(node)] = node
            result: object = np.float32(0)
        elif node.op == "const":
            result = np.float32(node.attr)
        elif node.op == "select":
            masks[id(node.args[0])] = node.args[0]
            result = visit(node.args[2])
        elif node.op == "shift":
            source = node.args[0]
            result = visit(source)
            if not node.attr[2] and result:
                raise LookupError
        elif node.op in ("param", "draw"):
            raise LookupError
        else:
            values = [visit(arg) for arg in node.args]
            result = _QUIET[node.op](node, *values)
        memo[id(node)] = result
        return result

    with np.errstate(all="ignore"):
        try:
            found = [visit(node) for node in nodes]
        except LookupError:
            return None, [], []
    if any(isinstance(v, np.floating) and v != 0 for v in found):
        return None, [], []
    return found, list(masks.values()), list(sources.values())


_QUIET: dict[str, Callable] = {
    "add": lambda n, a, b: a + b,
    "sub": lambda n, a, b: a - b,
    "mul": lambda n, a, b: a * b,
    "div": lambda n, a, b: np.float32(0) if b == 0 else a / b,
    "neg": lambda n, a: -a,
    "abs": lambda n, a: abs(a),
    "min": lambda n, a, b: np.minimum(a, b),
    "max": lambda n, a, b: np.maximum(a, b),
    "sqrt": lambda n, a: np.sqrt(a),
    "settle": lambda n, a: np.float32(min(max(a, n.attr[0]), n.attr[1])) if a == a else np.float32(0),
    "eq": lambda n, a, b: bool(a == b),
    "lt": lambda n, a, b: bool(a < b),
    "le": lambda n, a, b: bool(a <= b),
}


def unchanged(node: Node) -> tuple[Node, list[Node]] | None:
    """For a settled slot under choices: the slot it was, and the masks without which it still is (it was settled)."""
    masks = []
    if node.op != "settle":
        return None
    node = node.args[0]
    while node.op == "select":
        masks.append(node.args[0])
        node = node.args[2]
    return (node, masks) if node.op == "input" and all(mask.op != "param" for mask in masks) else None


def rows_read(nodes: list[Node], have: Callable[[Node], bool]) -> list[tuple[Node, int, bool]]:
    """Fields and row offsets that the nodes read where no mask holds: (field, rows down, wraps)."""
    found: dict[tuple[int, int, bool], tuple[Node, int, bool]] = {}

    def visit(node: Node, dy: int, wraps: bool) -> None:
        if node.type == REAL and have(node) and node not in nodes:
            found[id(node), dy, wraps] = (node, dy, wraps)
        elif node.op == "shift":
            visit(node.args[0], dy + node.attr[0], node.attr[2])
        elif node.op == "select":
            visit(node.args[2], dy, wraps)
        else:
            for arg in node.args:
                visit(arg, dy, wraps)

    for node in nodes:
        for arg in node.args if node.type != REAL else (node,):
            visit(arg, 0, True)
    return list(found.values())


def reads_real(node: Node) -> bool:
    return any(inner.type == REAL for inner in walk(node))
