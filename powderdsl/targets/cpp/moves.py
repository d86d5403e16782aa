"""Movements done in place: which writes of a moment only carry planes along, and the call that does it."""

from __future__ import annotations

from dataclasses import dataclass

from powderdsl.ir.ops import FLAG, Node, walk


@dataclass(frozen=True)
class Movement:
    """One plane that moves: by `swap`, or by `arrive` with what movers leave behind as planes.hpp calls it."""

    op: str
    content: Node
    movers: Node
    offset: tuple[int, int]
    leaves: str

    def goes_with(self, other: Movement) -> bool:
        """Whether one call can do both."""
        return self.movers is other.movers and (self.op, self.offset) == (other.op, other.offset)


def movement_of(node: Node) -> Movement | None:
    """How a write carries its old content along; None if it does more than that, or goes too far."""
    if node.op not in ("swap", "arrive") or node.type != FLAG:
        return None
    content, movers, rest = node.args
    leaves = "SAME"
    if rest is not content:
        if node.op == "swap":
            return None
        if rest.op == "and" and any(
            kept is content and gone.op == "not" and gone.args[0] is movers
            for kept, gone in (rest.args, rest.args[::-1])
        ):
            leaves = "NOTHING"
        elif rest.op == "or" and set(map(id, rest.args)) == {id(content), id(movers)}:
            leaves = "EVERYTHING"
        else:
            return None
    if node.op == "arrive" and abs(node.attr[0]) > 1:
        return None
    return Movement(node.op, content, movers, node.attr, leaves)


def movements(writes: list[Node], olds: list[Node | None]) -> dict[int, Movement]:
    """The writes of a moment, by id, that move what their slot held, all with the same movers and offset."""
    found: dict[int, Movement] = {}
    for node, old in zip(writes, olds, strict=True):
        movement = movement_of(node)
        if movement is None or movement.content is not old:
            continue
        first = next(iter(found.values()), movement)
        if movement.goes_with(first):
            found[id(node)] = movement
    return found


def depends(nodes: list[Node], on: dict[int, Movement]) -> bool:
    """Whether computing the nodes takes what has moved."""
    return any(id(inner) in on for node in nodes for inner in walk(node))


def move_calls(moved: list[tuple[str, Movement]], movers: str) -> str:
    """The statements that move variables in place; each owns its plane, or gets one of its own."""
    first = moved[0][1]
    kinds: dict[str, list[str]] = {}
    for name, movement in moved:
        kinds.setdefault(movement.leaves, []).append(f"&{name}")
    dy, dx = first.offset
    calls = []
    for leaves, names in kinds.items():
        function = "swap_planes" if first.op == "swap" else f"arrive_planes<{leaves}>"
        call = f"{function}(c, {movers}, {dy}, {dx}, all, {len(names)});"
        calls.append(f"{{ Plane** const all[] = {{{', '.join(names)}}}; {call} }}")
    return " ".join(calls)
