"""Drops substeps that write the values that slots already have, and guards that are constant."""

from __future__ import annotations

from dataclasses import replace

from powderdsl.ir.ops import Node, PassGraph


def prune(pass_: PassGraph) -> PassGraph:
    """The pass without writes that change nothing, and without substeps that write nothing."""
    current: dict[str, Node] = {}

    def changes(slot: str, node: Node) -> bool:
        before, current[slot] = current.get(slot), node
        return before is not node if before is not None else not _keeps(slot, node)

    substeps = []
    for one in pass_.substeps:
        writes = tuple((slot, node) for slot, node in one.writes if changes(slot, node))
        guards = tuple(guard for guard in one.guards if guard.op != "const" or guard.attr)
        if writes:
            substeps.append(replace(one, writes=writes, guards=guards))
    outputs = tuple((slot, node) for slot, node in pass_.outputs if not _keeps(slot, node))
    return replace(pass_, substeps=tuple(substeps), outputs=outputs)


def _keeps(slot: str, node: Node) -> bool:
    """Whether a node is what the pass finds in the slot."""
    return node.op == "input" and node.attr == slot
