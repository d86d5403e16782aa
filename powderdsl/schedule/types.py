"""The schedule of a pass: a frozen, printable value between IR on bit planes and the text of a target.

A schedule names what it computes: a `Var` is assigned once, in one place, and says which node of the pass it `means`.
Values are IR nodes whose leaves are constants, parameters, draws and `load`s of variables. Stages map a schedule to
a schedule (`schedule/stages.py`); a target prints the last one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Literal, Self

from powderdsl.ir.ops import FLAG, REAL, Graph, Node, Type, ordered

ANSWER = Type("answer")
"""One truth value for all cells, such as whether a flag is set anywhere."""

_PREFIX = {"flag": "p", "real": "f", "answer": "q"}


@dataclass(frozen=True, eq=False)
class Var:
    """A variable, assigned once. `means` is the node of the pass whose value it holds; helpers have None."""

    name: str
    type: Type
    means: Node | None = None


@dataclass(frozen=True)
class Out:
    """A variable and its value. `into` names the variable whose memory it reuses (set by `buffers` and `release`).

    `otherwise` is its value outside the statement's `region`: a constant or a load.
    """

    var: Var
    value: Node
    into: str | None = None
    otherwise: Node | None = None


@dataclass(frozen=True)
class Statement:
    """A statement says once what values it reads and what variables it makes; all walks over schedules follow from that."""

    def values(self) -> Iterator[Node]:
        """The values that it reads, without those of nested statements."""
        return iter(())

    def with_values(self, new: Callable[[Node], Node]) -> Self:
        """The statement with each of these values replaced by another."""
        return self

    def defined(self) -> Iterator[Var]:
        """The variables that it defines for statements after it."""
        return iter(())

    def unchanged(self) -> Iterator[tuple[Var, Node]]:
        """Variables with the value that they have where the statement does nothing."""
        return iter(())


@dataclass(frozen=True)
class Compute(Statement):
    """Computes values of cells; all of them read the variables as they were before. `place`: ``rules/acme.yaml:12``.

    `over` is the kind of loop that `cut` chose: over words of flags, over cells for floats, or over choices that are
    applied to floats one after another. Words or rows in which `region` holds nowhere are skipped.
    """

    outs: tuple[Out, ...]
    place: str = ""
    over: Literal["", "words", "cells", "choices"] = ""
    region: Node | None = None
    when: Node | None = None
    """An answer: if it is false, every variable is its `otherwise` (a constant) everywhere."""
    held: bool = False
    """Whether all values are computed before any is stored, since it overwrites what it reads at neighbors (`buffers`)."""

    def values(self) -> Iterator[Node]:
        yield from (out.value for out in self.outs)
        yield from (out.otherwise for out in self.outs if out.otherwise is not None)
        yield from (node for node in (self.region, self.when) if node is not None)

    def with_values(self, new: Callable[[Node], Node]) -> Self:
        outs = tuple(
            replace(out, value=new(out.value), otherwise=out.otherwise and new(out.otherwise))
            for out in self.outs
        )
        return replace(
            self, outs=outs, region=self.region and new(self.region), when=self.when and new(self.when)
        )

    def defined(self) -> Iterator[Var]:
        return (out.var for out in self.outs)

    def unchanged(self) -> Iterator[tuple[Var, Node]]:
        return ((out.var, out.otherwise) for out in self.outs if out.otherwise is not None)


Leftover = Literal["same", "nothing", "everything"]


@dataclass(frozen=True)
class Carried:
    """A plane in a movement: its new value, its old value, and what a cell holds that its mover left and none entered.

    `leaves` is a value over loads; if it is `old` itself, the cell keeps its flag.
    """

    new: Var
    old: Node
    leaves: Node
    into: str | None = None
    """The variable whose memory the new one reuses, since nothing reads it later: the old one, or what is left (`release`)."""

    def leftover(self, movers: Node) -> Leftover | None:
        """The flags that movers leave behind in their cells; None for any others."""
        if self.leaves is self.old:
            return "same"
        if self.leaves.op not in ("and", "or") or self.old not in self.leaves.args:
            return None
        (other,) = (arg for arg in self.leaves.args if arg is not self.old)
        if self.leaves.op == "or":
            return "everything" if other is movers else None
        return "nothing" if other.op == "not" and other.args[0] is movers else None


@dataclass(frozen=True)
class Move(Statement):
    """Planes that move together: `swap` or `arrive` of the IR with the same movers and offset."""

    op: str
    offset: tuple[int, int]
    movers: Node
    planes: tuple[Carried, ...]
    place: str = ""

    def values(self) -> Iterator[Node]:
        yield self.movers
        for plane in self.planes:
            yield from (plane.old, plane.leaves)

    def with_values(self, new: Callable[[Node], Node]) -> Self:
        planes = (replace(plane, old=new(plane.old), leaves=new(plane.leaves)) for plane in self.planes)
        return replace(self, movers=new(self.movers), planes=tuple(planes))

    def defined(self) -> Iterator[Var]:
        return (plane.new for plane in self.planes)

    def unchanged(self) -> Iterator[tuple[Var, Node]]:
        return ((plane.new, plane.old) for plane in self.planes)

    def leftovers(self) -> dict[Leftover, list[Carried]] | None:
        """The planes by the flags that movers leave behind; None if these are any others in some plane."""
        groups: dict[Leftover, list[Carried]] = {}
        for plane in self.planes:
            leftover = plane.leftover(self.movers)
            if leftover is None:
                return None
            groups.setdefault(leftover, []).append(plane)
        return groups


@dataclass(frozen=True)
class Guard(Statement):
    """Statements that run only if one of the flags `when` holds in some cell.

    `keeps` lists the variables of the body that are read after it, each with its value if the body is skipped.
    """

    when: tuple[Node, ...]
    body: tuple[Statement, ...]
    keeps: tuple[tuple[Var, Node], ...]
    place: str = ""
    otherwise: tuple[Statement, ...] = ()
    """Statements that give `keeps` their values if the body is skipped and they share no buffers (set by `buffers`)."""

    def values(self) -> Iterator[Node]:
        yield from self.when
        yield from (value for _, value in self.keeps)

    def with_values(self, new: Callable[[Node], Node]) -> Self:
        keeps = tuple((var, new(value)) for var, value in self.keeps)
        return replace(self, when=tuple(map(new, self.when)), keeps=keeps)

    def defined(self) -> Iterator[Var]:
        return (var for var, _ in self.keeps)

    def unchanged(self) -> Iterator[tuple[Var, Node]]:
        return iter(self.keeps)


@dataclass(frozen=True)
class Release(Statement):
    """Frees the buffers of variables that nothing reads later."""

    names: tuple[str, ...]


@dataclass(frozen=True)
class Sweeps(Statement):
    """Consecutive loops over cells that run together, world by world and row by row, so that data stay in the cache.

    Each loop runs `lags` rows behind the first of its part: then the rows that it reads of earlier loops are there. A
    loop that reads an earlier one around the edge is in a later part, which begins when all rows are done.
    `passing` lists fields that only loops of one part read: they need memory for a few rows.
    """

    loops: tuple[Compute, ...]
    parts: tuple[int, ...]
    lags: tuple[int, ...]
    passing: tuple[str, ...]

    def values(self) -> Iterator[Node]:
        for loop in self.loops:
            yield from loop.values()

    def with_values(self, new: Callable[[Node], Node]) -> Self:
        return replace(self, loops=tuple(loop.with_values(new) for loop in self.loops))

    def defined(self) -> Iterator[Var]:
        for loop in self.loops:
            yield from (var for var in loop.defined() if var.name not in self.passing)

    def unchanged(self) -> Iterator[tuple[Var, Node]]:
        return chain.from_iterable(loop.unchanged() for loop in self.loops)


@dataclass(frozen=True)
class Forget(Statement):
    """Discards what is known about which elements occur (`presence`)."""


@dataclass(frozen=True)
class Sync(Statement):
    """A barrier: all threads have finished the statements before it."""


@dataclass(frozen=True)
class Schedule:
    """One pass. `finds`: the slots that it reads; `leaves`: the slots that it changes. Nothing else outlives the pass."""

    name: str
    finds: tuple[tuple[str, Var], ...]
    body: tuple[Statement, ...]
    leaves: tuple[tuple[str, Node], ...]
    graph: Graph = field(compare=False, repr=False)
    """Interns values: equal ones are one object in all stages."""
    when: Node | None = None
    """An answer: if it is false, the pass changes nothing."""
    buffers: tuple[tuple[str, tuple[str, int]], ...] = ()
    """The kind and number of each variable's buffer, for targets that number buffers."""


# Values


def load(graph: Graph, var: Var) -> Node:
    """The value of a variable in the cell itself."""
    return graph.node("load", var.type, (), var.name)


def is_zero(value: Node) -> bool:
    """Whether a value is the constant 0."""
    return value.op == "const" and not value.attr


def loaded(nodes: Iterable[Node]) -> Iterator[str]:
    """The names of the variables that values read, with repetitions."""
    for node in nodes:
        seen: set[int] = set()
        stack = [node]
        while stack:  # as `walk`
            top = stack.pop()
            if id(top) not in seen:
                seen.add(id(top))
                if top.op == "load":
                    yield str(top.attr)
                stack.extend(top.args)


def with_args(node: Node, args: tuple[Node, ...], graph: Graph) -> Node:
    """The same operation on other arguments."""
    return node if args == node.args else graph.node(node.op, node.type, args, node.attr, node.places)


def rewritten(roots: Iterable[Node], graph: Graph, rule: Callable[[Node], Node | None]) -> dict[int, Node]:
    """Values rebuilt bottom-up, by the id of the old node. `rule` maps nodes that have their new arguments already."""
    done: dict[int, Node] = {}
    for node in ordered(roots):
        new = with_args(node, tuple([done[id(arg)] for arg in node.args]), graph)
        done[id(node)] = rule(new) or new
    return done


def over_variables(root: Node, graph: Graph, known: Callable[[Node], Node | None]) -> Node:
    """A value rebuilt in `graph`. Where `known` gives a node, that node replaces the old one and all below it."""
    done: dict[int, Node] = {}
    stack = [(root, False)]
    while stack:
        node, ready = stack.pop()
        if id(node) in done:
            continue
        if ready:
            args = tuple(done[id(arg)] for arg in node.args)
            done[id(node)] = graph.node(node.op, node.type, args, node.attr, node.places)
        elif (found := known(node)) is not None:
            done[id(node)] = found
        else:
            stack.append((node, True))
            stack.extend((arg, False) for arg in reversed(node.args))
    return done[id(root)]


def combined(op: Literal["and", "or"], nodes: Iterable[Node], graph: Graph) -> Node:
    """The conjunction or disjunction of one or more flags or answers."""
    first, *rest = nodes
    for node in rest:
        first = graph.node(op, first.type, (first, node))
    return first


def is_movement(node: Node) -> bool:
    """Whether a node is a plane in which cells move."""
    return node.op in ("swap", "arrive") and node.type == FLAG


def conjuncts(node: Node) -> list[Node]:
    """The flags that must all hold for a flag to hold, each once, in order."""
    seen: dict[int, Node] = {}
    stack = [node]
    while stack:
        top = stack.pop()
        if id(top) not in seen:
            seen[id(top)] = top
            stack.extend(reversed(top.args) if top.op == "and" else ())
    return [part for part in seen.values() if part.op != "and"]


def alternatives(region: Node) -> list[Node]:
    """The flags of which one must hold for a region to hold."""
    if region.op == "or":
        return [part for arg in region.args for part in alternatives(arg)]
    return [] if region.op == "const" else [region]


def read_elsewhere(values: Iterable[Node]) -> set[str]:
    """The planes that values read at neighbors."""
    return {str(name) for node in ordered(values) if node.op == "shift" for name in loaded(node.args)}


# Statements


def flat(body: Iterable[Statement]) -> Iterator[Statement]:
    """All statements, including nested ones; a guard comes before its body."""
    for statement in body:
        yield statement
        if isinstance(statement, Guard):
            yield from flat(statement.body)
            yield from flat(statement.otherwise)


def planes_at_neighbors(schedule: Schedule) -> dict[str, tuple[str, tuple[int, int, bool]]]:
    """The variables that are another one, read at a neighbor: by name, the other one and where it is read."""
    return {
        out.var.name: (str(out.value.args[0].attr), out.value.attr)
        for one in flat(schedule.body)
        if isinstance(one, Compute)
        for out in one.outs
        if out.value.op == "shift" and out.value.args[0].op == "load"
    }


def in_order(names: Iterable[str]) -> list[str]:
    """Names of variables sorted by number, so that no order of a set reaches a schedule."""
    return sorted(sorted(names), key=lambda name: int(name[1:]))


def variables(schedule: Schedule) -> dict[str, Var]:
    """All variables by name."""
    found = {var.name: var for _, var in schedule.finds}
    for statement in flat(schedule.body):
        loops = statement.loops if isinstance(statement, Sweeps) else (statement,)  # with what only passes
        found |= {var.name: var for one in loops for var in one.defined()}
    return found


def map_blocks(
    body: Sequence[Statement], change: Callable[[tuple[Statement, ...]], tuple[Statement, ...]]
) -> tuple[Statement, ...]:
    """A body in which every block of statements is changed, inner blocks first."""
    inner = tuple(
        replace(one, body=map_blocks(one.body, change), otherwise=map_blocks(one.otherwise, change))
        if isinstance(one, Guard)
        else one
        for one in body
    )
    return change(inner)


def map_computes(schedule: Schedule, change: Callable[[Compute], Iterable[Statement]]) -> Schedule:
    """The schedule with every `Compute`, nested or not, replaced by other statements."""

    def block(body: tuple[Statement, ...]) -> tuple[Statement, ...]:
        return tuple(new for one in body for new in (change(one) if isinstance(one, Compute) else (one,)))

    return replace(schedule, body=map_blocks(schedule.body, block))


class Namer:
    """Makes variables with new names."""

    def __init__(self, schedule: Schedule | None = None):
        names = variables(schedule) if schedule else ()
        self.count = max((int(name[1:]) for name in names), default=0)

    def var(self, type: Type, means: Node | None = None) -> Var:
        self.count += 1
        return Var(f"{_PREFIX[type.name]}{self.count}", type, means)


__all__ = [
    "ANSWER", "FLAG", "REAL",
    "Carried", "Compute", "Forget", "Guard", "Move", "Namer", "Out", "Release", "Schedule", "Statement", "Sweeps", "Sync", "Var",
    "combined", "conjuncts", "flat", "in_order", "is_movement", "is_zero", "load", "loaded", "map_blocks", "map_computes", "ordered",
    "over_variables", "planes_at_neighbors", "read_elsewhere", "rewritten", "variables", "with_args",
]  # fmt: skip
