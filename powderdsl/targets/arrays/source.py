"""Schedules -> Python: a function for each pass, one line per operation on packed words (flags) or cells (floats).

The functions that it calls (`k`) are `targets.arrays.kernels.ArrayKernels`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from powderdsl.ir.ops import REAL, Node, PassGraph, Program
from powderdsl.schedule.stages import ARRAYS, plan
from powderdsl.schedule.types import Compute, Guard, Out, Release, Schedule, Statement
from powderdsl.targets.torch.source import comment

_INFIX = {
    "and": "&", "or": "|", "xor": "^", "add": "+", "sub": "-", "mul": "*", "eq": "==", "lt": "<", "le": "<=",
}  # fmt: skip
_CALLS = {
    "shift": "shift", "coordinate": "coordinate", "inside": "inside", "draw": "draw_real", "cells": "cells", "places": "places", "moved": "moved",
    "arrive": "arrive", "swap_onto": "swap_onto", "div": "div", "min": "min", "max": "max", "sqrt": "sqrt", "copy": "copy",
}  # fmt: skip
_OVER = {"swap", "leave", "settle", "choose", "update", "carry"}
"""Functions with an argument that says whether they may overwrite an array."""


def pass_source(pass_: PassGraph, number: int) -> tuple[str, str, dict[str, float]]:
    """Source, function name and constants of a pass on bit planes."""
    schedule = plan(pass_, ARRAYS)
    printer = _Printer()
    body = list(printer.function(schedule))
    name = f"pass_{number}"
    if schedule.calm is not None:
        slots = [f"state[{slot!r}]" for slot, var in schedule.finds if var.type == REAL]
        quiet = list(printer.function(schedule.calm))
        body = [f"if k.all_zero({', '.join(slots)}):", *(f"    {line}" for line in quiet), *body]
    constants = {key: value for value, key in printer.constants.items()}
    lines = [
        f"# {comment(pass_.name)}",
        *(f"# {key} = {value!r}" for key, value in constants.items()),
        f"def {name}(k, state):",
        "    valid, zero = k.valid, k.zero",
        *(f"    {line}" for line in body),
    ]
    return "\n".join(lines) + "\n", name, constants


def kernel_source(program: Program, only: str | None = None) -> str:
    """The generated source of all passes (or one) of a program on planes."""
    return "\n\n".join(
        pass_source(pass_, i)[0]
        for i, pass_ in enumerate(program.passes)
        if only is None or pass_.name == only
    )


class _Printer:
    def __init__(self) -> None:
        self.constants: dict[float, str] = {}
        self.names: dict[str, str] = {}
        """The names of variables: a variable that reuses an array has that array's name."""
        self.place = ""

    def function(self, schedule: Schedule) -> Iterator[str]:
        self.names = {}
        for slot, var in schedule.finds:
            yield f"{self.name(var.name)} = state[{slot!r}]"
        yield from self.block(schedule.body)
        returned = ", ".join(f"{slot!r}: {self.value(node)}" for slot, node in schedule.leaves)
        yield f"return {{{returned}}}"

    def name(self, name: str) -> str:
        return self.names.setdefault(name, name)

    def block(self, body: Sequence[Statement]) -> Iterator[str]:
        for statement in body:
            place = getattr(statement, "place", "")
            if place and place != self.place:
                self.place = place
                yield f"# {comment(place)}"
            match statement:
                case Compute((out,)):
                    yield self.operation(out)
                case Release(names):
                    yield f"del {', '.join(map(self.name, names))}"
                case Guard(when, inner, keeps):
                    yield f"if k.some({', '.join(map(self.value, when))}):"
                    before = {id(value): self.value(value) for _, value in keeps}
                    yield from (f"    {line}" for line in self.block(inner))
                    pairs = [(self.name(var.name), before[id(value)]) for var, value in keeps]
                    otherwise = [f"    {new} = {old}" for new, old in pairs if new != old]
                    if otherwise:
                        yield "else:"
                        yield from otherwise
                case _:
                    raise AssertionError("arrays take single operations")

    def operation(self, out: Out) -> str:
        node = out.value
        if out.into is None:
            return f"{self.name(out.var.name)} = {self.value(node)}"
        over = self.names[out.var.name] = self.name(out.into)
        if node.op in ("add", "sub", "mul", "div"):
            args = [self.value(arg) for arg in node.args]
            other = args[0] if args[1] == over and args[0] != over else args[1]
            return f"{over} {_INFIX.get(node.op, '/')}= {other}"
        return f"{over} = {self.value(node, over=True)}"

    def value(self, node: Node, *, over: bool = False) -> str:
        """An operation on variables and constants."""
        attr = node.attr
        if node.op == "load":
            return self.name(attr)
        if node.op == "const" and node.type == REAL:
            return self.constants.setdefault(float(attr), f"c{len(self.constants)}")
        if node.op == "const":
            return "valid" if attr else "zero"
        args = [self.value(arg) for arg in node.args]
        if node.op in ("eq", "lt", "le"):
            return f"k.pack({args[0]} {_INFIX[node.op]} {args[1]})"
        if node.op in _INFIX:
            return f"{args[0]} {_INFIX[node.op]} {args[1]}"
        match node.op:
            case "not":
                return f"{args[0]} ^ valid"
            case "select":
                return f"{args[2]} ^ ({args[0]} & ({args[1]} ^ {args[2]}))"
            case "neg":
                return f"-{args[0]}"
            case "abs":
                return f"abs({args[0]})"
            case "member":
                return f"{args[0]}[{attr}]"
            case "stack":
                return f"k.stack(({', '.join(args)},))"
            case "div" if node.args[1].op == "const" and node.args[1].attr:
                return f"{args[0]} / {args[1]}"  # a division whose divisor may be zero is a call
            case "shift" if node.type == REAL:
                return _call("shift_cells", args, attr)
            case "below_planes":
                stream, bits = attr
                where = args[bits + 1 :]
                return _call(
                    "below", [repr(stream), str(bits), f"({', '.join(args[: bits + 1])},)", *where], ()
                )
            case "chance":
                return _call("chance", [*map(repr, attr), *args], ())
            case "below_param":
                stream, bits, name, threshold = attr
                return _call(
                    "below_param", [repr(stream), str(bits), repr(name), str(threshold.strict), *args], ()
                )
            case "param":
                name, threshold, *bit = attr
                if threshold is None:
                    return _call("param", [], (name, *bit))
                return _call("limit", [], (name, threshold.bits, threshold.strict, *bit))
        given = attr if isinstance(attr, tuple) else () if attr is None else (attr,)
        if node.op in _OVER:
            return _call(node.op, [*args, str(over)], given)
        return _call(_CALLS[node.op], args, given)


def _call(name: str, args: Sequence[str], attr: Sequence[object]) -> str:
    return f"k.{name}({', '.join([*args, *map(repr, attr)])})"
