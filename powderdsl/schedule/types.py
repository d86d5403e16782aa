"""The schedule of a pass: a frozen, printable value between IR on bit planes and the text of a target.

A schedule names what it computes: a `Var` is assigned once, in one place, and says which node of the pass it `means`.
Values are IR nodes whose leaves are constants, parameters, draws and `load`s of variables. Stages map a schedule to
a schedule (`schedule/stages.py`); a target prints the last one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, Self, TypeVar

from powderdsl.ir.ops import FLAG, REAL, Graph, Item, Node, Type, ordered, walk
from powderdsl.ir.text import SIGNS, attr_text

ANSWER = Type("answer")
"""One truth value for all cells, such as whether a flag is set anywhere."""

_PREFIX = {"flag": "p", "real": "f", "answer": "q"}

Rule = Callable[[Node], Node | None]
"""Returns the node that replaces a node, or None."""


@dataclass(frozen=True, eq=False)
class Var:
    """A variable, assigned once. `means` is the node of the pass whose value it holds; helpers have None."""

    name: str
    type: Type
    means: Node | None = None


@dataclass(frozen=True)
class Out:
    """A variable and its value. `into` names the variable whose memory it reuses (set by `release`).

    `otherwise` is its value where the statement does nothing, such as outside its `region`: a constant or a load.
    """

    var: Var
    value: Node
    otherwise: Node | None = None
    into: str | None = None


Block = tuple["Statement", ...]


@dataclass(frozen=True)
class Statement:
    """A statement. All kinds define, read, contain and free variables by the same fields, which walks over schedules use.

    Words or rows in which `region` holds nowhere are skipped.
    """

    outs: tuple[Out, ...] = ()
    """The variables that it defines for statements after it."""
    place: str = ""
    """``rules/acme.yaml:12``."""
    region: Node | None = None
    when: Node | None = None
    """An answer: if it is false, every variable is its `otherwise` everywhere."""
    body: Block = ()
    otherwise: Block = ()
    """Statements that give variables their values if the body is skipped (set by `assign_buffers`)."""
    frees: tuple[str, ...] = ()
    """Variables whose memory it frees."""

    @property
    def loops(self) -> Sequence[Statement]:
        """The statements that define its variables: the statement itself, unless it only groups others."""
        return (self,)

    @cached_property
    def vars(self) -> dict[str, Var]:
        return {out.var.name: out.var for loop in self.loops for out in loop.outs}

    @cached_property
    def olds(self) -> dict[str, Node]:
        """The values that variables have where the statement does nothing."""
        return {out.var.name: out.otherwise for out in self.outs if out.otherwise is not None}

    @property
    def ended(self) -> set[str]:
        """The variables whose memory it frees, or takes for those that it defines."""
        return {*self.frees, *[out.into for loop in self.loops for out in loop.outs if out.into is not None]}

    @property
    def results(self) -> list[Node]:
        return [out.value for out in self.outs]

    @cached_property
    def values(self) -> list[Node]:
        """The values that it reads, without those of nested statements."""
        return [*self.results, *self.olds.values(), *filter(None, (self.region, self.when))]

    @cached_property
    def reads(self) -> set[str]:
        """The variables that it reads, or statements in it, without those that these define."""
        names = {node.attr for node in ordered(self.values) if node.op == "load"}
        return names | read_by(self.body) | read_by(self.otherwise)

    def with_values(self, new: Callable[[Node], Node]) -> Self:
        """The statement with each of its values replaced by another."""
        outs = []
        for out in self.outs:
            outs.append(replace(out, value=new(out.value), otherwise=out.otherwise and new(out.otherwise)))
        region, when = self.region and new(self.region), self.when and new(self.when)
        return replace(self, outs=tuple(outs), region=region, when=when)


@dataclass(frozen=True, kw_only=True)
class Compute(Statement):
    """Computes values of cells; all of them read the variables as they were before.

    `over` is the kind of loop that `cut` chose: over words of flags, over cells for floats, or over choices that are
    applied to floats one after another.
    """

    over: Literal["", "words", "cells", "choices"] = ""
    part: int = 0
    lag: int = 0
    """Where it runs in a `Sweeps`."""
    stores_last: bool = False
    """True if all values are computed before any is stored, since the loop overwrites planes that it reads at neighbors
    (set by `assign_buffers`)."""


Leftover = Literal["same", "nothing", "everything"]


def leftover(old: Node, leaves: Node, movers: Node) -> Leftover | None:
    """The flags that movers leave behind in the cells of a plane; None for any others."""
    if leaves is old:
        return "same"
    if leaves.op not in ("and", "or") or old not in leaves.args:
        return None
    (other,) = (arg for arg in leaves.args if arg is not old)
    if leaves.op == "or":
        return "everything" if other is movers else None
    return "nothing" if other.op == "not" and other.args[0] is movers else None


@dataclass(frozen=True, kw_only=True)
class Move(Statement):
    """Planes that move together: `swap` or `arrive` of the IR by an offset. The flags of the region are the movers.

    A variable's `otherwise` is the plane before, its `value` what a cell holds that its mover left and none entered: a
    value over loads, or the plane itself if cells keep their flags.
    """

    region: Node
    op: str
    offset: tuple[int, int]

    def leftovers(self) -> dict[Leftover, list[Out]] | None:
        """The planes by the flags that movers leave behind; None if these are any others in some plane."""
        groups: dict[Leftover, list[Out]] = {}
        for out in self.outs:
            left = leftover(self.olds[out.var.name], out.value, self.region)
            if left is None:
                return None
            groups.setdefault(left, []).append(out)
        return groups


@dataclass(frozen=True, kw_only=True)
class Guard(Statement):
    """Statements that run only `when` one of some flags holds in some cell.

    Its variables are those of the body that are read after the guard, with their values if the body is skipped.
    """

    when: Node


class Release(Statement):
    """Frees the buffers of variables that nothing reads later."""


@dataclass(frozen=True, kw_only=True)
class Sweeps(Statement):
    """Consecutive loops over cells that run together, world by world and row by row, so that data stay in the cache.

    Each loop runs `lag` rows behind the first of its part, when earlier loops have computed the rows that it reads. A
    loop that reads an earlier one around the edge is in a later part, which begins when all rows are done. The statement
    frees fields that only loops of one part read: they need memory for a few rows. Stages change it as a whole.
    """

    body: tuple[Compute, ...]

    @property
    def loops(self) -> tuple[Compute, ...]:
        return self.body


class Forget(Statement):
    """Discards the known presence of elements (`check_presence`)."""


class Sync(Statement):
    """A barrier: all threads have finished the statements before it."""


@dataclass(frozen=True)
class Schedule:
    """One pass. `inputs`: the slots that it reads; `outputs`: the slots that it changes. Nothing else outlives the pass."""

    name: str
    inputs: tuple[tuple[str, Var], ...]
    body: Block
    outputs: tuple[tuple[str, Node], ...]
    graph: Graph = field(compare=False, repr=False)
    """Interns values: equal ones are one object in all stages."""
    when: Node | None = None
    """An answer: if it is false, the pass changes nothing."""
    buffers: tuple[tuple[str, tuple[str, int]], ...] = ()
    """The kind and number of each variable's buffer, for targets that number buffers."""
    element_bits: int = 0
    """The number of planes of the element in the program, also of those that the pass does not read."""

    @cached_property
    def input_slots(self) -> dict[str, str]:
        """The slots whose values variables hold from the beginning."""
        return {var.name: slot for slot, var in self.inputs}

    @property
    def results(self) -> list[Node]:
        """The new values of slots."""
        return [node for _, node in self.outputs]

    @property
    def values(self) -> list[Node]:
        """All values: those of statements, then the results."""
        return [node for statement in flat(self.body) for node in statement.values] + self.results


# Values. Operations that only schedules have:
#
# `load`: the value of a variable. `below_param`: a draw below a parameter. `any` (flag): true if the flag holds in some
# cell; `some` (flags): true if any of them does. `when` (flag, flag): both, the second computed only in words where the
# first holds somewhere; `led` (comparison, comparison): the same in cells. `live` (field), attribute (rows, reach): true if
# the field may be nonzero that many rows down, within `reach` columns. `present`, attribute ids: true if one is present.


def load(graph: Graph, var: Var) -> Node:
    """The value of a variable in the cell itself."""
    return graph.node("load", var.type, (), var.name)


def is_zero(value: Node) -> bool:
    return value.op == "const" and not value.attr


def loaded(nodes: Iterable[Node]) -> Iterator[str]:
    """The names of the variables that values read, with repetitions."""
    for node in nodes:
        for part in walk(node):
            if part.op == "load":
                yield part.attr


def rewritten(roots: Iterable[Node], graph: Graph, rule: Rule) -> Callable[[Node], Node]:
    """Rebuild values bottom-up; return a function of the old values. `rule` maps nodes that have their new arguments."""
    done: dict[Node, Node] = {}
    for node in ordered(roots):
        args = tuple([done[arg] for arg in node.args])
        new = node if args == node.args else graph.node(node.op, node.type, args, node.attr)
        done[node] = rule(new) or new
    return done.__getitem__


def combined(op: str, nodes: Iterable[Node], graph: Graph, type: Type = FLAG) -> Node:
    """The conjunction or disjunction of flags or answers; of none, the constant of that type."""
    result: Node | None = None
    for node in nodes:
        result = node if result is None else graph.node(op, result.type, (result, node))
    return result or graph.node("const", type, (), op == "and")


def choices(value: Node) -> tuple[list[Node], Node]:
    """The choices of a chain, outermost first, and the value below them."""
    chain = []
    while value.op == "select":
        chain.append(value)
        value = value.args[2]
    return chain, value


def is_movement(node: Node) -> bool:
    """True if a node is a plane in which cells move."""
    return node.op in ("swap", "arrive") and node.type == FLAG


def alternatives(region: Node | None) -> list[Node]:
    """The flags whose disjunction a region is."""
    if region is None or region.op == "const":
        return []
    return [part for arg in region.args for part in alternatives(arg)] if region.op == "or" else [region]


Facts = dict[Node, None]
"""Flags, in the order of discovery."""


def on_all_paths(
    roots: Iterable[Node], below: Callable[[Node, Facts], Iterable[tuple[Node, Facts]]]
) -> dict[Node, Facts]:
    """The facts that all paths from the roots to a node have in common, by node.

    `below` returns the nodes that a node reads, each with the facts of the path through that node.
    """
    facts: dict[Node, Facts] = {root: {} for root in roots}
    for node in reversed(ordered([*facts])):  # users first
        if node in facts:  # else no path leads here
            for part, path in below(node, facts[node]):
                facts[part] = {fact: None for fact in facts.get(part, path) if fact in path}
    return facts


# Statements


def flat(body: Iterable[Statement]) -> Iterator[Statement]:
    """All statements, including nested ones, which come after those that contain them."""
    for statement in body:
        yield statement
        yield from flat(statement.body)
        yield from flat(statement.otherwise)


def in_order(names: Iterable[str]) -> list[str]:
    """Names of variables sorted by number, so that no order of a set reaches a schedule."""
    return sorted(names, key=lambda name: (int(name[1:]), name))


def variables(schedule: Schedule) -> dict[str, Var]:
    return {var.name: var for _, var in schedule.inputs} | made_in(schedule.body)


def map_blocks(schedule: Schedule, change: Callable[[Block], Block]) -> Schedule:
    """The schedule with every block of statements changed, inner blocks first."""

    def inner(part: Statement) -> Statement:
        return replace(part, body=block(part.body), otherwise=block(part.otherwise)) if part.body else part

    def block(body: Block) -> Block:
        return change(tuple(map(inner, body)))

    return replace(schedule, body=block(schedule.body))


Kind = TypeVar("Kind", bound=Statement)


def map_each(schedule: Schedule, kind: type[Kind], change: Callable[[Kind], Iterable[Statement]]) -> Schedule:
    """The schedule with every statement of a kind, nested or not, replaced by other statements."""

    def block(body: Block) -> Block:
        result: list[Statement] = []
        for old in body:
            result += change(old) if isinstance(old, kind) else (old,)
        return tuple(result)

    return map_blocks(schedule, block)


def map_values(schedule: Schedule, rule: Rule) -> Schedule:
    """The schedule with every value rewritten by a rule, see `rewritten`."""
    new = rewritten(schedule.values, schedule.graph, rule)
    changed = map_each(schedule, Statement, lambda statement: [statement.with_values(new)])
    return replace(changed, outputs=tuple((slot, new(node)) for slot, node in schedule.outputs))


# Reads and lifetimes


@dataclass(frozen=True)
class Read:
    """A read of a variable at an offset in rows and columns, or a test that it is zero near there (`live`)."""

    name: str
    type: Type
    dy: int = 0
    dx: int = 0
    wraps: bool = True
    live: bool = False
    far: bool = False
    """True if other cells are read or tested."""


def reads_of(values: Iterable[Node]) -> Iterator[Read]:
    """The reads of variables in values. A plane that is read at a neighbor is also read in the cell itself."""
    for node in ordered(values):
        if node.op == "load":
            yield Read(node.attr, node.type)
        elif node.args and node.args[0].op == "load" and node.op in ("shift", "live"):
            plane, (dy, dx, *wraps) = node.args[0], node.attr
            far, live = bool(dy or dx), node.op == "live"
            yield Read(plane.attr, plane.type, dy, 0 if live else dx, True in wraps, live, far)


def field_reads(loop: Compute) -> Iterator[Read]:
    return (read for read in reads_of(loop.values) if read.type == REAL)


def read_elsewhere(values: Iterable[Node]) -> set[str]:
    """The variables that values read at neighbors."""
    return {read.name for read in reads_of(values) if read.far}


def planes_at_neighbors(schedule: Schedule) -> dict[str, tuple[str, tuple[int, int, bool]]]:
    """Map each variable that is just a shifted copy to its source and its shift: rows, columns, and if it wraps."""
    return {
        out.var.name: (out.value.args[0].attr, out.value.attr)
        for statement in flat(schedule.body)
        if isinstance(statement, Compute)
        for out in statement.outs
        if out.value.op == "shift" and out.value.args[0].op == "load"
    }


def made_in(body: Iterable[Statement]) -> dict[str, Var]:
    """The variables that statements define, including nested ones, by name."""
    return {name: var for statement in flat(body) for name, var in statement.vars.items()}


def read_by(body: Block) -> set[str]:
    """The variables that statements read, without those that they define."""
    return set[str]().union(*[statement.reads for statement in body]) - made_in(body).keys()


def backwards(
    body: Block, live: set[str], change: Callable[[Statement, set[str]], Sequence[Statement]]
) -> tuple[Block, set[str]]:
    """Replace the statements of a block, last first; return the block and the variables that it reads.

    `live`: the variables that are read after the block. `change` gets a statement and the variables read after it.
    """
    result: list[Statement] = []
    for statement in reversed(body):
        if statements := change(statement, live):
            live = live.difference(statement.vars) | statements[0].reads
            result += reversed(statements)
    return tuple(reversed(result)), live


def drop_unread(schedule: Schedule) -> Schedule:
    """Remove unread variables; guards keep only variables that are read after them."""

    def change(statement: Statement, live: set[str]) -> list[Statement]:
        outs = tuple([out for out in statement.outs if out.var.name in live])
        inner, _ = backwards(statement.body, live, change)
        used = outs or Forget in map(type, (statement, *inner))
        return [replace(statement, outs=outs, body=inner)] if used else []

    body, live = backwards(schedule.body, set(loaded(schedule.results)), change)
    finds = tuple((slot, var) for slot, var in schedule.inputs if var.name in live)
    return replace(schedule, body=body, inputs=finds)


def connected(items: Sequence[Item], keys: Callable[[Item], set[Any]]) -> list[list[Item]]:
    """Group items that share keys, directly or through other items; groups and items stay in order."""
    groups: list[tuple[set[Any], list[int]]] = []
    for number, item in enumerate(items):
        group, apart = (keys(item), [number]), []
        for other in groups:
            if group[0].isdisjoint(other[0]):
                apart.append(other)
            else:
                group = group[0] | other[0], other[1] + group[1]
        groups = [*apart, group]
    members = sorted([sorted(numbers) for _, numbers in groups])
    return [[items[number] for number in numbers] for numbers in members]


class Namer:
    """Makes variables with new names."""

    def __init__(self, schedule: Schedule | None = None):
        names = variables(schedule) if schedule else ()
        self.count = max((int(name[1:]) for name in names), default=0)

    def var(self, type: Type, means: Node | None = None) -> Var:
        """A new variable, named by its type and a number; `means` is the node whose value it holds."""
        self.count += 1
        return Var(f"{_PREFIX[type.name]}{self.count}", type, means)


# A stable printed form, for `--emit schedule`, golden tests and bug reports. `x[dy,dx]` is the value at a neighbor, and
# zero outside the grid with `|0`; `a ? b : c` is a choice; `any p3 | p4` tests whether a flag holds in some cell; `else
# p5 = p1` gives the value of a variable if a guard's body is skipped.


def print_schedule(schedule: Schedule) -> str:
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
        if node.op in SIGNS and len(args) == 2:
            return f"({args[0]} {SIGNS[node.op]} {args[1]})"
        args += [] if node.attr is None else [attr_text(node.attr)]
        return f"{node.op}({', '.join(args)})"
