"""Memory of arrays: where variables are released, and which variables reuse the array of one read for the last time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from powderdsl.ir.ops import REAL
from powderdsl.schedule.release import live_before, made_in, reads
from powderdsl.schedule.types import (
    BLOCK,
    Compute,
    Guard,
    Out,
    Release,
    Schedule,
    Statement,
    in_order,
    loaded,
)

_OVER = {
    "add": (0, 1), "mul": (0, 1), "sub": (0,), "settle": (0,),
    "choose": (2,), "update": (1,), "carry": (2,), "swap": (0,), "leave": (0,),
}  # fmt: skip
"""The arguments whose array an operation can overwrite with its result."""

_FULL = ("draw", "shift", "choose", "update", "carry", "settle")
"""Operations that give one float per cell, whatever their arguments are."""


def place(schedule: Schedule) -> Schedule:
    """Every variable is released, or its array is reused (`into`) by the operation that reads it last.

    `b = a + c`, where `a` is read for the last time → `b = a + c into a`. Expects single operations (`flatten`).
    """
    placing = _Placing({slot for slot, _ in schedule.leaves})
    live = set(loaded(node for _, node in schedule.leaves))
    for slot, var in schedule.finds:
        placing.found(slot, var.name, var.type == REAL)
    body = placing.block(schedule.body, live)
    leaves = []
    for slot, node in schedule.leaves:
        alone = node.type != REAL or (node.op == "load" and node.attr in placing.own)
        leaves.append((slot, node if alone else schedule.graph.node("copy", REAL, (node,))))
        placing.own.discard(node.attr)  # no two slots share an array of floats
    return replace(schedule, body=body, leaves=tuple(leaves))


@dataclass
class _Placing:
    changed: set[str]
    """Slots that the pass changes; their arrays may be overwritten."""
    own: set[str] = field(default_factory=set)
    """Blocks, and floats with one number per cell, whose arrays nothing else refers to."""
    full: set[str] = field(default_factory=set)
    views: dict[str, set[str]] = field(default_factory=dict)
    """The planes that are views of each block."""

    def found(self, slot: str, name: str, real: bool) -> None:
        if real:
            self.full.add(name)
            if slot in self.changed:
                self.own.add(name)

    def block(self, body: Sequence[Statement], live_end: set[str]) -> tuple[Statement, ...]:
        """A block of statements; `live_end`: the variables that are read after it."""
        lives: list[set[str]] = []
        live = set(live_end)
        for statement in reversed(body):
            lives.append(live)
            live = live_before(statement, live)
        result: list[Statement] = []
        for statement, after in zip(body, reversed(lives), strict=True):
            match statement:
                case Compute((out,), _):
                    placed = self.operation(out, after)
                    result.append(replace(statement, outs=(placed,)))
                    gone = {*loaded([out.value]), out.var.name} - after - {placed.into}
                case Guard():
                    guard, taken = self.guard(statement, after)
                    result.append(guard)
                    gone = reads(statement) - after - taken - made_in(statement.body)
                    gone |= {var.name for var, _ in statement.keeps} - after
                case _:
                    raise AssertionError("only single operations have places")
            if gone:
                result.append(Release(tuple(in_order(gone))))
        return tuple(result)

    def guard(self, guard: Guard, after: set[str]) -> tuple[Guard, set[str]]:
        """A guard, and the outer variables whose arrays its body reuses."""
        before = set(self.own)
        kept = {var.name for var, _ in guard.keeps}
        outside = reads(guard) - made_in(guard.body)
        # Outer variables are released after the guard, whether its body ran or not.
        body = self.block(guard.body, after | kept)
        body = tuple(_without(statement, outside) for statement in body)
        body = tuple(one for one in body if not isinstance(one, Release) or one.names)
        taken = {
            out.into
            for statement in body
            if isinstance(statement, Compute)
            for out in statement.outs
            if out.into is not None and out.into in outside
        }
        olds = [value.attr for _, value in guard.keeps if value.op == "load"]
        for var, value in guard.keeps:
            alone = value.op == "load" and value.attr in before and value.attr not in after
            if not (alone and olds.count(value.attr) == 1):
                self.own.discard(var.name)
            if value.op != "load" or value.attr not in self.full:
                self.full.discard(var.name)
            if value.op == "load":  # it may be the old array
                self.views.setdefault(var.name, set()).update(self.views.get(str(value.attr), ()))
        self.own -= set(olds) - kept
        return replace(guard, body=body), taken

    def operation(self, out: Out, after: set[str]) -> Out:
        """One operation, in the array of an argument that it reads last, if there is one."""
        node, name = out.value, out.var.name
        args = [str(arg.attr) if arg.op == "load" else "" for arg in node.args]
        places = _OVER.get(node.op, ())
        if node.op == "div" and node.args[1].op == "const" and node.args[1].attr:
            places = (0,)  # a division whose divisor may be zero is a call
        into = next((args[i] for i in places if self.is_last(args[i], args, after)), None)
        if node.type == BLOCK and node.op != "load":
            self.own.add(name)
        elif node.op == "member":
            self.views.setdefault(args[0], set()).add(name)
        elif node.op == "load":
            self.own.discard(str(node.attr))  # two names for one array
            if node.attr in self.full:
                self.full.add(name)
        elif node.type == REAL and (node.op in _FULL or any(arg in self.full for arg in args)):
            self.full.add(name)
            if node.op != "draw":
                self.own.add(name)
        if into is not None:
            self.own.discard(into)
        return replace(out, into=into)

    def is_last(self, name: str, args: list[str], after: set[str]) -> bool:
        """Whether an array may be overwritten by an operation on it."""
        seen = self.views.get(name, set()) & (after | set(args))
        return name in self.own and name not in after and not seen


def _without(statement: Statement, names: set[str]) -> Statement:
    if not isinstance(statement, Release):
        return statement
    return Release(tuple(name for name in statement.names if name not in names))
