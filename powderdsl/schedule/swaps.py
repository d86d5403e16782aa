"""Fields that a swap carries along exchange values in place, as planes do, instead of being computed everywhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from powderdsl.ir.ops import REAL, Node, Offset
from powderdsl.schedule.rewrite import without_unread
from powderdsl.schedule.types import (
    Carried,
    Compute,
    Move,
    Namer,
    Out,
    Schedule,
    Statement,
    combined,
    flat,
    is_zero,
    load,
    map_computes,
    planes_at_neighbors,
)


@dataclass(frozen=True)
class _Swap:
    """The movers of a swap, where they go, and the field whose values they exchange.

    `fresh` lists the flags under which the value is zero afterwards, the last one first to be asked.
    """

    movers: Node
    offset: Offset
    field: Node
    fresh: tuple[tuple[Node, Node], ...]

    @property
    def kind(self) -> object:
        """What fields have in common that one loop exchanges."""
        return self.movers, self.offset, tuple(mask for mask, _ in self.fresh)


def swaps(schedule: Schedule) -> Schedule:
    """Loops over cells that exchange values of fields, by the movers of a swap of planes, become swaps themselves.

    `swap by m [+1,+0]: …`, `b = settle(m ? a[1,0] : (m[-1,0] ? a[-1,0] : a))` → `swap by m [+1,+0]: b = a`. Values of a
    slot stay within its bounds wherever they are. What becomes zero afterwards does so in a loop over rows where it does.
    """
    offsets = {
        str(one.movers.attr): one.offset
        for one in flat(schedule.body)
        if isinstance(one, Move) and one.op == "swap"
    }
    if not offsets:
        return schedule
    shifted = planes_at_neighbors(schedule)
    slots = {str(node.attr): slot for slot, node in schedule.leaves if node.op == "load"}
    settled = {var.name: slot for slot, var in schedule.finds if var.type == REAL}
    """Fields that hold values of a slot, with the slot."""

    namer, graph = Namer(schedule), schedule.graph

    def change(loop: Compute) -> list[Statement]:
        floats = loop.over in ("cells", "choices")
        found = [_swap(out, offsets, shifted) for out in loop.outs] if floats else []
        first = found[0] if found else None
        if first is None:
            return [loop]
        planes, outs = [], []
        for out, swap in zip(loop.outs, found, strict=True):
            if swap is None or swap.kind != first.kind:
                return [loop]
            slot = settled.get(str(swap.field.attr))
            if out.value.op == "settle" and (slot is None or slots.get(out.var.name) != slot):
                return [loop]
            moved = namer.var(REAL) if swap.fresh else out.var
            if slot is not None:
                settled[moved.name] = settled[out.var.name] = slot
            planes.append(Carried(moved, swap.field, swap.field))
            value = load(graph, moved)
            for mask, number in swap.fresh:
                value = graph.node("select", REAL, (mask, number, value))
            outs.append(Out(out.var, value, None, load(graph, moved)))
        statements: list[Statement] = [Move("swap", first.offset, first.movers, tuple(planes), loop.place)]
        if first.fresh:
            region = combined("or", [mask for mask, _ in first.fresh], graph)
            statements.append(Compute(tuple(outs), loop.place, "cells", region))
        return statements

    return without_unread(map_computes(schedule, change))


def _swap(
    out: Out, offsets: Mapping[str, Offset], shifted: Mapping[str, tuple[str, tuple[int, int, bool]]]
) -> _Swap | None:
    """The swap whose result a value is. Movers come before or after their targets: no cell is both."""
    value = out.value.args[0] if out.value.op == "settle" else out.value
    fresh: list[tuple[Node, Node]] = []
    while value.op == "select" and value.args[0].op == "load" and is_zero(value.args[1]):
        fresh.insert(0, (value.args[0], value.args[1]))
        value = value.args[2]
    if value.op != "select" or value.args[2].op != "select":
        return None
    field = value.args[2].args[2]
    chosen = [(one.args[0], one.args[1]) for one in (value, value.args[2])]
    if field.op != "load" or field.type != REAL or any(mask.op != "load" for mask, _ in chosen):
        return None
    for (movers, there), (targets, back) in (chosen, chosen[::-1]):
        dy, dx = offset = offsets.get(str(movers.attr), (0, 0))
        opposite = (-dy, -dx, True)
        if (
            offset != (0, 0)
            and shifted.get(str(targets.attr)) == (movers.attr, opposite)
            and _reads(there, field, (dy, dx, True))
            and _reads(back, field, opposite)
        ):
            return _Swap(movers, offset, field, tuple(fresh))
    return None


def _reads(value: Node, field: Node, where: tuple[int, int, bool]) -> bool:
    return value.op == "shift" and value.args[0] is field and value.attr == where
