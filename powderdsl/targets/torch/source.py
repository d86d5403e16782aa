"""IR -> the Python source of one pass for the backend `torch`."""

from __future__ import annotations

import linecache
import re
from collections.abc import Callable, Mapping
from typing import Any
from zlib import crc32

from powderdsl.ir.ops import Node, PassGraph, Program, nodes_of

_INFIX = {
    "and": "&",
    "or": "|",
    "xor": "^",
    "eq": "==",
    "lt": "<",
    "le": "<=",
    "add": "+",
    "sub": "-",
    "mul": "*",
}


class _Writer:
    """Collects lines and constants; shifted planes are computed once."""

    def __init__(self, significant: dict[str, int]):
        self.lines: list[str] = []
        self.constants: dict[str, object] = {}
        self.names: dict[int, str] = {}
        self.shifted: dict[tuple[str, int, int], str] = {}
        self.significant = significant

    def constant(self, value: object) -> str:
        name = f"c{len(self.constants)}"
        for known, other in self.constants.items():
            if type(other) is type(value) and other == value:
                return known
        self.constants[name] = value
        return name

    def roll(self, name: str, dy: int, dx: int) -> str:
        key = (name, dy, dx)
        if key not in self.shifted:
            self.shifted[key] = f"s{len(self.shifted)}"
            self.lines.append(f"{self.shifted[key]} = k.roll({name}, {dy}, {dx})")
        return self.shifted[key]

    def node(self, node: Node) -> None:
        args = [self.names[id(arg)] for arg in node.args]
        if node.op == "const":
            self.names[id(node)] = self.constant(node.attr)
            return
        if node.op == "shift" and node.attr[2]:
            dy, dx, _ = node.attr
            self.names[id(node)] = self.roll(args[0], dy, dx)
            return
        expression = self.expression(node, args)
        name = f"n{len(self.names)}"
        self.names[id(node)] = name
        self.lines.append(f"{name} = {expression}")

    def expression(self, node: Node, args: list[str]) -> str:
        attr = node.attr
        if node.op in _INFIX:
            return f"{args[0]} {_INFIX[node.op]} {args[1]}"
        match node.op:
            case "input":
                return f"state[{attr!r}]"
            case "param":
                name, threshold = attr
                if threshold is None:
                    return f"k.param({name!r}, {node.type.name!r})"
                return f"k.limit({name!r}, {threshold.bits}, {threshold.strict})"
            case "coordinate":
                return f"k.coordinate({attr[0]!r}, {attr[1]})"
            case "inside":
                return f"k.inside({attr[0]}, {attr[1]})"
            case "below":
                return self.below(node, args[0])
            case "draw":
                return f"k.draw_real({attr[0]!r})"
            case "shift":
                return f"k.reach({args[0]}, {attr[0]}, {attr[1]})"
            case "count":
                return f"k.count({args[0]}, {attr[0]}, {attr[1]})"
            case "not":
                return f"~{args[0]}"
            case "in_set":
                return self.in_set(node, args[0])
            case "table":
                return f"{self.constant(attr)}[{args[0]}.long()]"
            case "div":
                return f"k.divide({args[0]}, {args[1]})"
            case "quotient":
                return f"k.quotient({args[0]}, {args[1]})"
            case "neg":
                return f"-{args[0]}"
            case "abs":
                return f"{args[0]}.abs()"
            case "min" | "max":
                return f"torch.{node.op}imum({args[0]}, {args[1]})"
            case "mod":
                return f"torch.remainder({args[0]}, {attr})"
            case "sqrt":
                # torch's float32 square root is not always rounded correctly on CPUs; from float64 it is.
                return f"torch.sqrt({args[0]}.double()).float()"
            case "to_real":
                return f"{args[0]}.float()"
            case "settle":
                return f"k.settle({args[0]}, {attr[0]!r}, {attr[1]!r})"
            case "select" if (
                node.type.name == "int" and node.type.hi >= 1 << 31
            ):  # thresholds of draws of 32 bits
                return f"torch.where({args[0]}, {args[1]}.long(), {args[2]}.long())"
            case "select":
                return f"torch.where({args[0]}, {args[1]}, {args[2]})"
            case "swap":
                dy, dx = attr
                there, back = self.roll(args[0], dy, dx), self.roll(args[0], -dy, -dx)
                return f"torch.where({args[1]}, {there}, torch.where({self.roll(args[1], -dy, -dx)}, {back}, {args[2]}))"
            case "arrive":
                dy, dx = attr
                return (
                    f"torch.where({self.roll(args[1], -dy, -dx)}, {self.roll(args[0], -dy, -dx)}, {args[2]})"
                )
        raise AssertionError(f"no torch kernel for {node.op}")

    def below(self, node: Node, limit: str) -> str:
        """A draw below a limit. Constant limits need only the bits down to their last one."""
        stream, bits = node.attr
        significant = self.significant[stream]
        argument = node.args[0]
        if argument.op == "const":
            return f"k.draw({stream!r}, {significant}) < {int(argument.attr) >> (bits - significant)}"
        return f"k.draw({stream!r}, {bits}) < {limit}"

    def in_set(self, node: Node, value: str) -> str:
        members = sorted(node.attr)
        lo, hi = node.args[0].type.lo, node.args[0].type.hi
        rest = [i for i in range(lo, hi + 1) if i not in members]
        if len(members) == 1:
            return f"{value} == {members[0]}"
        if len(rest) == 1:
            return f"{value} != {rest[0]}"
        if members[-1] - members[0] == len(members) - 1:
            if members[0] == lo:
                return f"{value} <= {members[-1]}"
            if members[-1] == hi:
                return f"{value} >= {members[0]}"
        if lo >= 0 and hi < 31:
            bits = sum(1 << i for i in members)
            return f"(({self.constant(bits)} >> {value}) & 1) != 0"
        table = tuple(int(i in members) for i in range(lo, hi + 1))
        return f"{self.constant(table)}[({value} - {lo}).long()] != 0"


def _significant_bits(pass_: PassGraph) -> dict[str, int]:
    """How many bits of each stream the pass needs: all of them, unless every limit is a constant."""
    needed: dict[str, int] = {}
    for node in nodes_of(pass_):
        if node.op not in ("below", "draw"):
            continue
        stream, bits = node.attr
        limit = int(node.args[0].attr) if node.op == "below" and node.args[0].op == "const" else None
        trailing = (limit & -limit).bit_length() - 1 if limit else 0
        own = bits - min(trailing, bits - 1) if limit is not None else bits
        needed[stream] = max(needed.get(stream, 1), own)
    return needed


def pass_source(pass_: PassGraph, number: int) -> tuple[str, str, dict[str, object]]:
    """Source, function name and constants of a pass. `number` makes the name unique."""
    writer = _Writer(_significant_bits(pass_))
    place = ""
    nodes = nodes_of(pass_, substeps=False)
    for node in nodes:
        if node.places and node.places[0] != place:
            place = node.places[0]
            writer.lines.append(f"# {comment(place)}")
        writer.node(node)
    name = f"pass_{number}"
    returned = ", ".join(f"{slot!r}: k.full({writer.names[id(node)]})" for slot, node in pass_.outputs)
    lines = with_deletions(writer.lines, returned)
    body = [f"def {name}(k, state):", *(f"    {line}" for line in lines), f"    return {{{returned}}}"]
    header = [f"# {comment(pass_.name)}"] + [f"# {key} = {value}" for key, value in writer.constants.items()]
    return "\n".join(header + body) + "\n", name, writer.constants


def with_deletions(lines: list[str], returned: str) -> list[str]:
    """The lines with `del` after the last use of each plane: so that a large world needs memory for few planes at once."""
    live = set(_PLANE.findall(returned))
    result: list[str] = []
    for line in reversed(lines):
        used = [] if line.startswith("#") else _PLANE.findall(line)
        dead = sorted(set(used[1:]) - live)
        if dead:
            result.append(f"del {', '.join(dead)}")
        live |= set(used)
        result.append(line)
    return result[::-1]


_PLANE = re.compile(r"\b[ns][0-9]+\b")


def comment(text: str) -> str:
    """A place as a comment. File names come from users: nothing in them may end the comment."""
    return "".join(char if char.isprintable() and ord(char) < 128 else "?" for char in text)


def load_source(source: str, name: str, constants: Mapping[str, object]) -> Callable[..., Any]:
    """The function of generated source, which contains only names chosen here; constants are passed separately."""
    filename = f"<powderdsl {name} {crc32(source.encode()):x}>"
    linecache.cache[filename] = (len(source), None, source.splitlines(True), filename)
    namespace: dict[str, Any] = dict(constants)
    exec(compile(source, filename, "exec"), namespace)
    return namespace[name]


def kernel_source(program: Program, only: str | None = None) -> str:
    """The generated source of all passes (or one), as `--emit kernels` prints it."""
    return "\n\n".join(
        pass_source(p, i)[0] for i, p in enumerate(program.passes) if only is None or p.name == only
    )
