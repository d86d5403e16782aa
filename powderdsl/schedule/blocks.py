"""Movements on arrays: planes that move together share one array, and stay there from movement to movement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from powderdsl.ir.ops import FLAG, Node
from powderdsl.schedule.rewrite import with_values, without_unread
from powderdsl.schedule.types import (
    BLOCK,
    Carried,
    Compute,
    Guard,
    Move,
    Namer,
    Out,
    Schedule,
    Statement,
    Var,
    in_order,
    load,
)


def blocks(schedule: Schedule) -> Schedule:
    """Each `Move` as one operation on a block of planes.

    `swap by m: x = a, y = b` → `b1 = stack(a, b); b2 = swap(b1, m); x = member(b2, 0); y = member(b2, 1)`. A guard
    around a whole movement keeps the block.
    """
    return without_unread(_Blocks(schedule).schedule)


@dataclass
class _Blocks:
    given: Schedule
    members: dict[str, tuple[Var, int]] = field(default_factory=dict)
    """The block and position of each plane that lies in one."""
    size: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.namer, self.graph = Namer(self.given), self.given.graph
        self.schedule = replace(self.given, body=self.block(self.given.body))

    def block(self, body: Sequence[Statement]) -> tuple[Statement, ...]:
        result: list[Statement] = []
        for statement in body:
            match statement:
                case Move():
                    result += self.moved(statement)
                case Guard():
                    result += self.guard(statement)
                case _:
                    result.append(statement)
        return tuple(result)

    def guard(self, guard: Guard) -> list[Statement]:
        """A guard with its movements on blocks. It keeps a block instead of its planes if it keeps all of them."""
        before: list[Statement] = []
        after: list[Statement] = []
        inner: list[Statement] = []
        keeps = list(guard.keeps)
        known = dict(self.members)
        for statement in guard.body:
            if not isinstance(statement, Move):
                inner.append(statement)
                continue
            kept = {var.name: value for var, value in keeps}
            whole = all(kept.get(plane.new.name) is plane.old for plane in statement.planes)
            if not whole or not _is_simple(statement):
                inner += self.moved(statement)
                continue
            stack, old, positions = self.gathered(statement)
            before += stack
            new, compute, members = self.carried(statement, old, positions)
            inner.append(compute)
            gone = {plane.new.name for plane in statement.planes}
            keeps = [(var, value) for var, value in keeps if var.name not in gone]
            keeps.append((new, load(self.graph, old)))
            after.append(members)
            known |= {name: self.members[name] for name in in_order(gone)}
        self.members = known
        # The body reads moved planes from the block.
        names = {out.var.name: out for one in after if isinstance(one, Compute) for out in one.outs}
        own = self.with_members(inner, names)
        return [*before, replace(guard, body=tuple(own), keeps=tuple(keeps)), *after]

    def with_members(self, body: list[Statement], names: dict[str, Out]) -> list[Statement]:
        """A body that reads planes from blocks, since their names are defined only after it."""

        def rule(node: Node) -> Node | None:
            return names[node.attr].value if node.op == "load" and node.attr in names else None

        return [with_values(statement, self.graph, rule) for statement in body] if names else body

    def gathered(self, move: Move) -> tuple[list[Statement], Var, list[int]]:
        """The block in which the planes lie, if they are most of it; else a new one."""
        names = [str(plane.old.attr) for plane in move.planes]
        homes = {self.members[name][0].name: self.members[name][0] for name in names if name in self.members}
        once = len(set(names)) == len(names)  # a plane that becomes two needs two positions
        if len(homes) == 1 and once and all(name in self.members for name in names):
            block = next(iter(homes.values()))
            if 2 * len(names) > self.size[block.name]:
                return [], block, [self.members[name][1] for name in names]
        block, stack = self.stacked([plane.old for plane in move.planes], move)
        return [stack], block, list(range(len(names)))

    def stacked(self, planes: Sequence[Node], move: Move) -> tuple[Var, Compute]:
        block = self.namer.var(BLOCK)
        self.size[block.name] = len(planes)
        return block, Compute((Out(block, self.graph.node("stack", BLOCK, tuple(planes))),), move.place)

    def carried(self, move: Move, old: Var, positions: list[int]) -> tuple[Var, Compute, Compute]:
        """The block after a movement, the statement that computes it, and one that names its planes."""
        args = (load(self.graph, old), move.movers)
        new = self.namer.var(BLOCK)
        self.size[new.name] = self.size[old.name]
        if move.op == "swap":
            value = self.graph.node("swap", BLOCK, args, move.offset)
        else:
            left = _left(move.planes, move.movers, positions)
            value = self.graph.node("leave", BLOCK, args, (*move.offset, left))
        return new, Compute((Out(new, value),), move.place), self.named(move, new, positions)

    def named(self, move: Move, block: Var, positions: list[int]) -> Compute:
        outs = []
        for plane, position in zip(move.planes, positions, strict=True):
            member = self.graph.node("member", FLAG, (load(self.graph, block),), position)
            outs.append(Out(plane.new, member))
            self.members[plane.new.name] = (block, position)
        return Compute(tuple(outs), move.place)

    def moved(self, move: Move) -> list[Statement]:
        """A movement whose planes are named directly after it."""
        if _is_simple(move):
            stack, old, positions = self.gathered(move)
            _, compute, members = self.carried(move, old, positions)
            return [*stack, compute, members]
        contents, first = self.stacked([plane.old for plane in move.planes], move)
        rest, second = self.stacked([plane.leaves for plane in move.planes], move)
        new = self.namer.var(BLOCK)
        self.size[new.name] = len(move.planes)
        op = "arrive" if move.op == "arrive" else "swap_onto"
        args = (load(self.graph, contents), move.movers, load(self.graph, rest))
        compute = Compute((Out(new, self.graph.node(op, BLOCK, args, move.offset)),), move.place)
        return [first, second, compute, self.named(move, new, list(range(len(move.planes))))]


def _is_simple(move: Move) -> bool:
    """Whether every plane of cells that movers left is all zeros, all ones, or swapped."""
    if move.op == "swap":
        return all(plane.leaves is plane.old for plane in move.planes)
    return _left(move.planes, move.movers, range(len(move.planes))) is not None


def _left(planes: Sequence[Carried], movers: Node, positions: Sequence[int]) -> tuple[int, ...] | None:
    """Positions of the planes that are set where a mover left, if the others are cleared there; None otherwise."""
    found = []
    for plane, position in zip(planes, positions, strict=True):
        rest = plane.leaves
        if rest.op == "or" and plane.old in rest.args and movers in rest.args:
            found.append(position)
        elif not (
            rest.op == "and"
            and plane.old in rest.args
            and any(part.op == "not" and part.args[0] is movers for part in rest.args)
        ):
            return None
    return tuple(found)
