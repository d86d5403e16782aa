"""Assigns numbered buffers to variables for their lifetimes.

A variable that replaces another reuses its buffer where possible, so that a skipped guard costs nothing. Elsewhere
statements are added that copy the old value.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from powderdsl.ir.ops import FLAG, REAL, Graph, Node, ordered
from powderdsl.schedule.types import (
    ANSWER,
    Compute,
    Guard,
    Namer,
    Out,
    Schedule,
    Statement,
    Var,
    load,
)

FOREVER = 1 << 30

Buffer = tuple[str, int]
"""Kind (`flag` or `real`) and number."""


@dataclass
class Pool:
    """Numbers of buffers by kind: those that belong to slots, and all."""

    slots: dict[str, int]
    size: dict[str, int]


def buffers(schedule: Schedule, homes: Mapping[str, int], pool: Pool, *, in_place: bool) -> Schedule:
    """The schedule with a buffer for every variable; `leaves` are loads from the slots' own buffers.

    Args:
        homes: the number of each slot's own buffer.
        pool: shared by all passes; it grows.
        in_place: whether a loop may overwrite planes that it reads at neighbors, by storing only after all reads.
    """
    found = {var.name: homes[slot] for slot, var in schedule.finds}
    types = {var.name: var.type.name for _, var in schedule.finds}
    changed = {slot for slot, _ in schedule.leaves}
    plan = _Plan(schedule, pool, in_place)
    plan.buffer = {name: (types[name], number) for name, number in found.items()}
    plan.open = {(node.type.name, homes[slot]) for slot, node in schedule.leaves}
    plan.wanted = {}
    for slot, node in schedule.leaves:
        if node.op == "load":
            plan.wanted.setdefault(node.attr, homes[slot])
    plan.run(kept=[var.name for slot, var in schedule.finds if slot not in changed])
    return _explicit(schedule, plan, homes)


@dataclass
class _Plan:
    schedule: Schedule
    pool: Pool
    in_place: bool
    buffer: dict[str, Buffer] = field(default_factory=dict)
    open: set[Buffer] = field(default_factory=set)
    """Buffers of the slots that the pass changes; until its end they may hold other values."""
    wanted: dict[str, int] = field(default_factory=dict)
    """The slot's buffer in which a variable must end up."""
    last: dict[str, int] = field(default_factory=dict)
    defined: dict[str, int] = field(default_factory=dict)
    follows: dict[str, str] = field(default_factory=dict)
    """The variable whose value each variable has if its statement is skipped."""
    ends: dict[str, int] = field(default_factory=dict)
    """The position at which that value must be in place."""

    def run(self, kept: Sequence[str]) -> None:
        """Assign all buffers; those of the variables `kept` hold slots that the pass does not change."""
        order = list(_in_order(self.schedule.body))
        for position, statement in enumerate(order):
            self.number(statement, position)
        self.last |= dict.fromkeys(kept, FOREVER)
        end = len(order)
        for _, node in self.schedule.leaves:
            if node.op == "load":
                self.last[node.attr] = max(self.last.get(node.attr, -1), end)
        for name, old in self.follows.items():
            if name in self.defined:
                self.last[old] = max(self.last.get(old, -1), self.defined[name])
        busy = {number: name for name, number in self.buffer.items()}
        for position, statement in enumerate(order):
            busy = {key: name for key, name in busy.items() if self.last.get(name, -1) >= position}
            if not isinstance(statement, Compute):
                continue
            reads = neighbors(statement)
            for out in statement.outs:
                if out.var.type == ANSWER:
                    continue
                found = self.taken_over(out.var, statement, reads, position, busy)
                if found is None:
                    found = self.free(out.var, busy)
                    if old := self.follows.get(
                        out.var.name, ""
                    ):  # it is copied there, so it must still exist
                        self.last[old] = max(self.last.get(old, -1), self.ends[out.var.name])
                kind, number = found
                self.pool.size[kind] = max(self.pool.size[kind], number + 1)
                self.buffer[out.var.name] = found
                busy[found] = out.var.name

    def number(self, statement: Statement, position: int) -> None:
        """Note where variables are defined and last read, and what they replace."""
        if isinstance(statement, Compute):
            for name in neighbors(statement):
                self.last[name] = position
            for out in statement.outs:
                self.defined[out.var.name] = position
                self.last.setdefault(out.var.name, position)
                if out.otherwise is not None and out.otherwise.op == "load":
                    self.follow(out.var.name, out.otherwise.attr, position)
        elif isinstance(statement, Guard):
            for var, value in statement.keeps:
                self.ends[var.name] = position
                if value.op == "load":
                    self.follow(var.name, value.attr, position)
                    self.last[var.name] = max(self.last.get(var.name, -1), position)

    def follow(self, name: str, old: str, position: int) -> None:
        self.follows[name], self.ends[name] = old, position

    def taken_over(
        self, var: Var, loop: Compute, reads: Mapping[str, bool], position: int, busy: Mapping[Buffer, str]
    ) -> Buffer | None:
        """The buffer to reuse: that of the variable it replaces, or its slot's, if nothing reads it after this loop."""
        home = busy.get((var.type.name, self.wanted.get(var.name, -1)), "")
        for old in (self.follows.get(var.name, ""), home):
            if not old or self.last.get(old, -1) > position:
                continue
            if busy.get(self.buffer[old]) != old:
                continue
            if reads.get(old) and not (self.in_place and loop.over == "words"):
                continue
            if old in reads and loop.over == "cells" and var.type == FLAG:
                continue  # one thread would write a word that others read
            return self.buffer[old]
        return None

    def free(self, var: Var, busy: Mapping[Buffer, str]) -> Buffer:
        """The buffer of the slot in which the variable ends up, or the first free one."""
        kind = var.type.name
        home = self.wanted.get(var.name)
        if home is not None and (kind, home) not in busy:
            return kind, home
        return kind, next(
            n
            for n in range(FOREVER)
            if (kind, n) not in busy and (n >= self.pool.slots[kind] or (kind, n) in self.open)
        )


def _in_order(body: Sequence[Statement]) -> Iterator[Statement]:
    """All statements in order; a guard comes after its body."""
    for statement in body:
        if isinstance(statement, Guard):
            yield from _in_order(statement.body)
        yield statement


def neighbors(statement: Statement) -> dict[str, bool]:
    """The variables that a statement reads, and whether it reads them at neighbors too."""
    found: dict[str, bool] = {}
    for node in ordered(statement.values()):
        if node.op == "load":
            found.setdefault(node.attr, False)
        elif node.op in ("shift", "live") and node.args[0].op == "load" and any(node.attr[:2]):
            found[node.args[0].attr] = True
    return found


def _explicit(schedule: Schedule, plan: _Plan, homes: Mapping[str, int]) -> Schedule:
    """The schedule with the copies that the assignment requires."""
    graph, namer = schedule.graph, Namer(schedule)
    numbers = dict(plan.buffer)

    def block(body: Sequence[Statement]) -> tuple[Statement, ...]:
        result: list[Statement] = []
        for statement in body:
            if isinstance(statement, Guard):
                pairs = [
                    (var, value)
                    for var, value in statement.keeps
                    if value.op != "load" or numbers[value.attr] != numbers[var.name]
                ]
                result.append(
                    replace(statement, body=block(statement.body), otherwise=tuple(copies(pairs, graph)))
                )
            elif isinstance(statement, Compute):
                across = {numbers[name] for name, far in neighbors(statement).items() if far}
                held = any(numbers.get(out.var.name) in across for out in statement.outs)
                moved = any(
                    out.otherwise is not None
                    and out.otherwise.op == "load"
                    and numbers[out.otherwise.attr] != numbers[out.var.name]
                    for out in statement.outs
                )
                result.append(replace(statement, held=held, region=None if moved else statement.region))
            else:
                result.append(statement)
        return tuple(result)

    body = block(schedule.body)
    leaves, pairs = [], []
    for slot, node in schedule.leaves:
        home = (node.type.name, homes[slot])
        if node.op == "load" and numbers[node.attr] == home:
            leaves.append((slot, node))
            continue
        var = namer.var(node.type)
        numbers[var.name] = home
        pairs.append((var, node))
        leaves.append((slot, load(graph, var)))
    end = tuple(copies(pairs, graph))
    return replace(schedule, body=(*body, *end), leaves=tuple(leaves), buffers=tuple(sorted(numbers.items())))


def copies(pairs: Sequence[tuple[Var, Node]], graph: Graph) -> Iterator[Compute]:
    """Loops that assign values to variables; each reads everything before it writes anything."""
    flags = tuple(Out(var, value) for var, value in pairs if var.type == FLAG)
    if flags:
        yield Compute(flags, "", "words")
    floats = [(var, value) for var, value in pairs if var.type == REAL]
    if floats:
        zero = graph.node("const", REAL, (), 0.0)
        region: Node = graph.node("const", FLAG, (), False)
        outs = []
        for var, value in floats:
            if value.op == "load":
                live = graph.node("live", FLAG, (value,), (0, 0))
                region = live if region.op == "const" else graph.node("or", FLAG, (region, live))
            outs.append(Out(var, value, None, zero))
        yield Compute(tuple(outs), "", "cells", region)
