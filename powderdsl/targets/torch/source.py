"""IR -> the Python source of one pass for the backend `torch`."""

from __future__ import annotations

import linecache
import re
from collections.abc import Callable, Mapping
from typing import Any
from zlib import crc32

from powderdsl.ir.ops import Node, PassGraph, Program, nodes_of

_QUOTED = re.compile(r"'[^']*'")
_PLANE = re.compile(r"\b[bfmns][0-9]+\b")


class _Writer:
    """Collects lines and constants; shifted planes are computed once."""

    def __init__(self, significant: Mapping[str, int]):
        self.lines: list[str] = []
        self.constants: dict[str, object] = {}
        self.names: dict[Node, str] = {}
        self.shifted: dict[tuple[str, int, int], str] = {}
        self.significant = significant

    def constant(self, value: object) -> str:
        for name, known in self.constants.items():
            if type(known) is type(value) and known == value:
                return name
        name = f"c{len(self.constants)}"
        self.constants[name] = value
        return name

    def roll(self, name: str, dy: int, dx: int) -> str:
        key = (name, dy, dx)
        if key not in self.shifted:
            self.shifted[key] = f"s{len(self.shifted)}"
            self.lines.append(f"{self.shifted[key]} = k.roll({name}, {dy}, {dx})")
        return self.shifted[key]

    def node(self, node: Node) -> None:
        args = [self.names[arg] for arg in node.args]
        if node.op == "const":
            self.names[node] = self.constant(node.attr)
        elif node.op == "shift" and node.attr[2]:
            self.names[node] = self.roll(args[0], *node.attr[:2])
        else:
            row = _KERNELS[node.op]
            text = row.format(*args, attr=node.attr) if isinstance(row, str) else row(self, node, *args)
            self.names[node] = f"n{len(self.names)}"
            self.lines.append(f"{self.names[node]} = {text}")


def _param(writer: _Writer, node: Node) -> str:
    name, threshold = node.attr
    if threshold is None:
        return f"k.param({name!r}, {node.type.name!r})"
    return f"k.limit({name!r}, {threshold.bits}, {threshold.strict})"


def _below(writer: _Writer, node: Node, limit: str) -> str:
    """A draw below a limit. Constant limits need only the bits down to their last one."""
    stream, bits = node.attr
    (argument,) = node.args
    if argument.op == "const":
        significant = writer.significant[stream]
        return f"k.draw({stream!r}, {significant}) < {int(argument.attr) >> (bits - significant)}"
    return f"k.draw({stream!r}, {bits}) < {limit}"


def _in_set(writer: _Writer, node: Node, value: str) -> str:
    members = sorted(node.attr)
    lo, hi = node.args[0].type.lo, node.args[0].type.hi
    others = [i for i in range(lo, hi + 1) if i not in members]
    if len(members) == 1:
        return f"{value} == {members[0]}"
    if len(others) == 1:
        return f"{value} != {others[0]}"
    if members[-1] - members[0] == len(members) - 1:
        if members[0] == lo:
            return f"{value} <= {members[-1]}"
        if members[-1] == hi:
            return f"{value} >= {members[0]}"
    if lo >= 0 and hi < 31:
        bits = sum(1 << i for i in members)
        return f"(({writer.constant(bits)} >> {value}) & 1) != 0"
    table = tuple(int(i in members) for i in range(lo, hi + 1))
    return f"{writer.constant(table)}[({value} - {lo}).long()] != 0"


def _select(writer: _Writer, node: Node, condition: str, yes: str, no: str) -> str:
    wide = ".long()" if node.type.hi >= 1 << 31 else ""  # thresholds of draws of 32 bits
    return f"torch.where({condition}, {yes}{wide}, {no}{wide})"


def _swap(writer: _Writer, node: Node, content: str, movers: str, rest: str) -> str:
    dy, dx = node.attr
    there, back = writer.roll(content, dy, dx), writer.roll(content, -dy, -dx)
    targets = writer.roll(movers, -dy, -dx)
    return f"torch.where({movers}, {there}, torch.where({targets}, {back}, {rest}))"


def _arrive(writer: _Writer, node: Node, content: str, movers: str, rest: str) -> str:
    dy, dx = node.attr
    targets, back = writer.roll(movers, -dy, -dx), writer.roll(content, -dy, -dx)
    return f"torch.where({targets}, {back}, {rest})"


_KERNELS: dict[str, str | Callable[..., str]] = {
    "input": "state[{attr!r}]",
    "param": _param,
    "coordinate": "k.coordinate({attr[0]!r}, {attr[1]})",
    "inside": "k.inside({attr[0]}, {attr[1]})",
    "below": _below,
    "draw": "k.draw_real({attr[0]!r})",
    "shift": "k.reach({0}, {attr[0]}, {attr[1]})",
    "count": "k.count({0}, {attr[0]}, {attr[1]})",
    "not": "~{0}",
    "and": "{0} & {1}",
    "or": "{0} | {1}",
    "xor": "{0} ^ {1}",
    "in_set": _in_set,
    "table": lambda writer, node, index: f"{writer.constant(node.attr)}[{index}.long()]",
    "eq": "{0} == {1}",
    "lt": "{0} < {1}",
    "le": "{0} <= {1}",
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "k.divide({0}, {1})",
    "quotient": "k.quotient({0}, {1})",
    "neg": "-{0}",
    "abs": "{0}.abs()",
    "min": "torch.minimum({0}, {1})",
    "max": "torch.maximum({0}, {1})",
    "mod": "torch.remainder({0}, {attr})",
    # torch's float32 square root is not always rounded correctly on CPUs; from float64 it is.
    "sqrt": "torch.sqrt({0}.double()).float()",
    "to_real": "{0}.float()",
    "settle": "k.settle({0}, {attr[0]!r}, {attr[1]!r})",
    "select": _select,
    "swap": _swap,
    "arrive": _arrive,
}
"""The expression of each operation, with numbered arguments, or a function of the arguments' names."""


def _significant_bits(pass_: PassGraph) -> dict[str, int]:
    """The number of bits of each stream that the pass needs: all bits, unless every limit is a constant."""
    needed: dict[str, int] = {}
    for node in nodes_of(pass_):
        if node.op in ("below", "draw"):
            stream, own = node.attr
            if node.args and node.args[0].op == "const" and (limit := int(node.args[0].attr)):
                own -= min((limit & -limit).bit_length() - 1, own - 1)
            needed[stream] = max(needed.get(stream, 1), own)
    return needed


def pass_source(pass_: PassGraph, number: int) -> tuple[str, str, dict[str, object]]:
    """Source, function name and constants of a pass. `number` makes the name unique."""
    writer = _Writer(_significant_bits(pass_))
    place = ""
    for node in nodes_of(pass_, substeps=False):
        if node.places and node.places[0] != place:
            place = node.places[0]
            writer.lines.append(f"# {comment_of(place)}")
        writer.node(node)
    name = f"pass_{number}"
    returned = ", ".join(f"{slot!r}: k.full({writer.names[node]})" for slot, node in pass_.outputs)
    header = [f"# {comment_of(pass_.name)}"] + [
        f"# {key} = {value}" for key, value in writer.constants.items()
    ]
    lines = [f"    {line}" for line in with_deletions(writer.lines, returned)]
    source = "\n".join([*header, f"def {name}(k, state):", *lines, f"    return {{{returned}}}"])
    return source + "\n", name, writer.constants


def with_deletions(lines: list[str], returned: str) -> list[str]:
    """The lines with `del` after the last use of each plane, so that a large world needs memory for few planes at once."""
    live = set(_PLANE.findall(returned))
    result: list[str] = []
    for line in reversed(lines):
        # Rules may call a field `n1`: what stands in quotes is no variable.
        used = [] if line.startswith("#") else _PLANE.findall(_QUOTED.sub("", line))
        dead = sorted(set(used[1:]) - live)
        if dead:
            result.append(f"del {', '.join(dead)}")
        live |= set(used)
        result.append(line)
    return result[::-1]


def comment_of(text: str) -> str:
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
