"""A stable printed form of schedules, for `--emit schedule`, golden tests and bug reports.

`x[dy,dx]` is the value at a neighbor, and zero outside the grid with `|0`; `a ? b : c` is a choice; `any p3 | p4` tests
whether a flag holds in some cell; `else p5 = p1` gives the value of a variable if a guard's body is skipped.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from powderdsl.ir.ops import FLAG, Node, ordered
from powderdsl.ir.text import attr_text
from powderdsl.schedule.types import (
    Compute,
    Forget,
    Guard,
    Move,
    Out,
    Release,
    Schedule,
    Statement,
    Sweeps,
)

_INFIX = {
    "and": "&", "or": "|", "xor": "^", "add": "+", "sub": "-", "mul": "*", "div": "/", "eq": "==", "lt": "<", "le": "<=",
}  # fmt: skip


def print_schedule(schedule: Schedule) -> str:
    """A schedule as text."""
    names = _Names()
    lines = [f"schedule {schedule.name}"]
    if schedule.inputs:
        inputs = ", ".join(f"{names.of(var.name)} = {slot}" for slot, var in schedule.inputs)
        lines.append(f"  find {inputs}")
    if schedule.when is not None:
        lines.append(f"  when {_Values([schedule.when], names).text(schedule.when)}")
    lines += _block(schedule.body, "  ", names)
    for slot, node in schedule.outputs:
        lines.append(f"  leave {slot} = {_Values([node], names).text(node)}")
    return "\n".join(lines)


class _Names:
    """Printed names of variables, numbered in the order of the text."""

    def __init__(self) -> None:
        self.known: dict[str, str] = {}

    def of(self, name: str) -> str:
        return self.known.setdefault(name, f"{name[0]}{len(self.known)}")


def _block(body: Sequence[Statement], indent: str, names: _Names) -> Iterator[str]:
    place = ""
    for statement in body:
        if statement.place not in ("", place):
            place = statement.place
            yield f"{indent}# {place}"
        yield from _statement(statement, indent, names)


def _statement(statement: Statement, indent: str, names: _Names) -> Iterator[str]:
    values, outs = _Values(statement.values, names), statement.outs

    def assignment(out: Out, value: Node, word: str, rest: Node | None) -> Iterator[str]:
        text, other = values.text(value), f" {word} {values.text(rest)}" if rest is not None else ""
        yield from values.pop_lines(indent)
        into = f" into {names.of(out.into)}" if out.into else ""
        yield f"{indent}{names.of(out.var.name)} = {text}{other}{into}"

    match statement:
        case Compute(over=over, region=region, when=when):
            if over:
                where = f" over {values.text(region)}" if region is not None else ""
                where += f" when {values.text(when)}" if when is not None else ""
                yield from values.pop_lines(indent)
                yield f"{indent}loop {over}{where}"
                indent += "  "
            for out in outs:
                yield from assignment(out, out.value, "else", out.otherwise)
        case Sweeps(body=(loop,)):
            yield from _statement(loop, indent, names)
        case Sweeps(body=loops):
            for loop in loops:
                part = f", part {loop.part}" if loops[-1].part else ""
                behind = f", {loop.lag} behind" if loop.lag else ""
                yield f"{indent}row by row{part}{behind}"
                yield from _statement(loop, indent + "  ", names)
        case Move(region=movers, op=op, offset=(dy, dx), olds=olds):
            yield f"{indent}{op} by {values.text(movers)} [{dy:+d},{dx:+d}]"
            indent += "  "
            for out in outs:
                old = olds[out.var.name]
                yield from assignment(out, old, "leaving", None if out.value is old else out.value)
        case Guard(when=when, body=inner):
            flags = " | ".join(map(values.text, when.args or (when,)))
            yield from values.pop_lines(indent)
            yield f"{indent}if any {flags}"
            yield from _block(inner, indent + "  ", names)
            if outs:
                skipped = (f"{names.of(out.var.name)} = {values.text(out.value)}" for out in outs)
                yield f"{indent}else {', '.join(skipped)}"
        case Release(frees=released):
            yield f"{indent}release {', '.join(map(names.of, released))}"
        case Forget():
            yield f"{indent}forget elements"


class _Values:
    """The values of one statement; a value that is used twice gets its own line."""

    def __init__(self, roots: Iterable[Node], names: _Names):
        roots = list(roots)
        self.names = names
        self.uses = Counter(roots)
        self.uses.update(arg for node in ordered(roots) for arg in node.args)
        self.known: dict[Node, str] = {}
        self.lines: list[str] = []
        self.count = 0

    def pop_lines(self, indent: str) -> list[str]:
        """The lines added since the last call."""
        lines, self.lines = self.lines, []
        return [f"{indent}{line}" for line in lines]

    def text(self, root: Node) -> str:
        for node in ordered([root]):
            if node not in self.known:
                text = self._node(node)
                if self.uses[node] > 1 and node.args and node is not root:
                    self.count += 1
                    self.lines.append(f"  t{self.count} = {text}")
                    text = f"t{self.count}"
                self.known[node] = text
        return self.known[root]

    def _node(self, node: Node) -> str:
        args = [self.known[arg] for arg in node.args]
        match node.op:
            case "load":
                return self.names.of(node.attr)
            case "const":
                return str(int(node.attr)) if node.type == FLAG else repr(node.attr)
            case "not":
                return f"~{args[0]}"
            case "select":
                return f"({args[0]} ? {args[1]} : {args[2]})"
            case "shift":
                dy, dx, wraps = node.attr
                return f"{args[0]}[{dy},{dx}{'' if wraps else '|0'}]"
            case "present":
                return f"present({node.attr:#x})"
        if node.op in _INFIX and len(args) == 2:
            return f"({args[0]} {_INFIX[node.op]} {args[1]})"
        args += [] if node.attr is None else [attr_text(node.attr)]
        return f"{node.op}({', '.join(args)})"
