"""IR -> the Python source of one pass for the backend `torch`."""

from __future__ import annotations

import linecache
import re
from collections.abc import Callable, Mapping
from typing import Any
from zlib import crc32

from powderdsl.ir.ops import Node, PassGraph, nodes_of
from powderdsl.ir.text import infix

_QUOTED = re.compile(r"'[^']*'")
_PLANE = re.compile(r"\b[bfmn][0-9]+\b")


class _Writer:
    """Collects lines and constants."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.constants: dict[tuple[type, object], str] = {}
        self.names: dict[Node, str] = {}

    def constant(self, value: object) -> str:
        return self.constants.setdefault((type(value), value), f"c{len(self.constants)}")

    def node(self, node: Node) -> None:
        args = [self.names[arg] for arg in node.args]
        if node.op == "const":
            self.names[node] = self.constant(node.attr)
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


def _in_set(writer: _Writer, node: Node, value: str) -> str:
    members, (lo, hi) = sorted(node.attr), (node.args[0].type.lo, node.args[0].type.hi)
    others = [i for i in range(lo, hi + 1) if i not in members]
    if len(members) == 1:
        return f"{value} == {members[0]}"
    if len(others) == 1:
        return f"{value} != {others[0]}"
    if lo >= 0 and hi < 31:  # several times as fast as `isin`
        return f"(({writer.constant(sum(1 << i for i in members))} >> {value}) & 1) != 0"
    return f"torch.isin({value}, {writer.constant(tuple(members))})"


def _select(writer: _Writer, node: Node, condition: str, yes: str, no: str) -> str:
    wide = ".long()" if node.type.hi >= 1 << 31 else ""  # thresholds of draws of 32 bits
    return f"torch.where({condition}, {yes}{wide}, {no}{wide})"


def _swap(writer: _Writer, node: Node, content: str, movers: str, rest: str) -> str:
    there = f"k.roll({content}, {node.attr[0]}, {node.attr[1]})"
    return f"torch.where({movers}, {there}, {_arrive(writer, node, content, movers, rest)})"


def _arrive(writer: _Writer, node: Node, content: str, movers: str, rest: str) -> str:
    back = f"{-node.attr[0]}, {-node.attr[1]}"
    return f"torch.where(k.roll({movers}, {back}), k.roll({content}, {back}), {rest})"


_KERNELS: dict[str, str | Callable[..., str]] = {
    "input": "state[{attr!r}]",
    "param": _param,
    "coordinate": "k.coordinate({attr[0]!r}, {attr[1]})",
    "inside": "k.inside({attr[0]}, {attr[1]})",
    "below": "k.draw({attr[0]!r}) < {0}",
    "draw": "k.draw_real({attr[0]!r})",
    "shift": lambda writer, node, x: "k.{}({}, {}, {})".format(
        "roll" if node.attr[2] else "reach", x, *node.attr[:2]
    ),
    "count": "k.count({0}, {attr[0]}, {attr[1]})",
    **infix("and or xor eq lt le add sub mul"),
    "not": "~{0}",
    "in_set": _in_set,
    "table": lambda writer, node, index: f"{writer.constant(node.attr)}[{index}.long()]",
    "div": "({0} / {1}).masked_fill({1} == 0, 0)",
    "quotient": (
        "torch.div({0}, {1}.masked_fill({1} == 0, 1), rounding_mode='floor').masked_fill({1} == 0, 0)"
    ),
    "neg": "-{0}",
    "abs": "{0}.abs()",
    "min": "torch.minimum({0}, {1})",
    "max": "torch.maximum({0}, {1})",
    "mod": "torch.remainder({0}, {attr})",
    # torch's float32 square root is not always rounded correctly on CPUs; from float64 it is.
    "sqrt": "torch.sqrt({0}.double()).float()",
    "to_real": "{0}.float()",
    "clamp": "k.clamp({0}, {attr[0]!r}, {attr[1]!r})",
    "select": _select,
    "swap": _swap,
    "arrive": _arrive,
}
"""The expression of each operation, with numbered arguments, or a function of the arguments' names."""


def pass_source(pass_: PassGraph, number: int) -> tuple[str, str, dict[str, object]]:
    """Source, function name and constants of a pass. `number` makes the name unique."""
    writer = _Writer()
    place = ""
    for node in nodes_of(pass_, substeps=False):
        if node.places and node.places[0] != place:
            place = node.places[0]
            writer.lines.append(f"# {comment_of(place)}")
        writer.node(node)
    name = f"pass_{number}"
    returned = ", ".join(f"{slot!r}: k.full({writer.names[node]})" for slot, node in pass_.outputs)
    constants = {key: value for (_, value), key in writer.constants.items()}
    header = [f"# {comment_of(pass_.name)}", *[f"# {key} = {value}" for key, value in constants.items()]]
    lines = [f"    {line}" for line in with_deletions(writer.lines, returned)]
    source = "\n".join([*header, f"def {name}(k, state):", *lines, f"    return {{{returned}}}"])
    return source + "\n", name, constants


def with_deletions(lines: list[str], returned: str) -> list[str]:
    """The lines with `del` after the last use of each plane, so that only few planes need memory at once."""
    live = set(_PLANE.findall(returned))
    result: list[str] = []
    for line in reversed(lines):
        # Rules may call a field `n1`: quoted text is not a variable.
        used = [] if line.startswith("#") else _PLANE.findall(_QUOTED.sub("", line))
        dead = sorted(set(used[1:]) - live)
        if dead:
            result.append(f"del {', '.join(dead)}")
        live |= set(used)
        result.append(line)
    return result[::-1]


def comment_of(text: str) -> str:
    """A place as a comment. File names come from users and must not end the comment."""
    return "".join(char if char.isprintable() and ord(char) < 128 else "?" for char in text)


def load_source(source: str, name: str, constants: Mapping[str, object]) -> Callable[..., Any]:
    """The function of generated source, which contains only names chosen here; constants are passed separately."""
    filename = f"<powderdsl {name} {crc32(source.encode()):x}>"
    linecache.cache[filename] = (len(source), None, source.splitlines(True), filename)
    namespace: dict[str, Any] = dict(constants)
    exec(compile(source, filename, "exec"), namespace)
    return namespace[name]
