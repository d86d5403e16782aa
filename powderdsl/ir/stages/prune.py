"""Moments that write what was there already are dropped; guards that are constant too."""

from __future__ import annotations

from dataclasses import replace

from powderdsl.ir.ops import Node, PassGraph, Step


def prune(pass_: PassGraph) -> PassGraph:
    """The pass without writes that change nothing, and without moments that write nothing."""
    current: dict[str, Node] = {}
    moments = []
    for step in pass_.moments:
        writes = []
        for slot, node in step.writes:
            unchanged = current.get(slot) is node or (
                slot not in current and node.op == "input" and node.attr == slot
            )
            current[slot] = node
            if not unchanged:
                writes.append((slot, node))
        guards = tuple(guard for guard in step.guards if guard.op != "const" or guard.attr)
        if writes:
            moments.append(Step(step.label, step.place, tuple(writes), guards))
    outputs = tuple(
        (slot, node) for slot, node in pass_.outputs if not (node.op == "input" and node.attr == slot)
    )
    return replace(pass_, moments=tuple(moments), outputs=outputs)
