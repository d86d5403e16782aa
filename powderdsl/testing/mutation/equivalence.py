"""Proves that a mutant means the same as the original: pass by pass, and substep by substep."""

from __future__ import annotations

from powderdsl.ir.lower.rules import lower_pass, lower_substep, slot_names
from powderdsl.ir.ops import Graph, Node
from powderdsl.model.state import slots
from powderdsl.model.types import Pass, Ruleset
from powderdsl.testing.mutation.equal_nodes import Cells, Comparison, Holders


def proven_equal(first: Ruleset, second: Ruleset) -> bool:
    """Whether two compositions turn every world into the same one. False proves nothing.

    Worlds must hold the same, so that a changed range, default or kind of a field is a difference by itself.
    """
    if not _same_worlds(first, second):
        return False
    same_tables = first.properties == second.properties
    cells = _cells(first)
    for one, other in zip(first.passes, second.passes, strict=True):
        if same_tables and one == other:
            continue
        if not _same_pass(first, one, second, other, cells):
            return False
    return True


def _same_worlds(first: Ruleset, second: Ruleset) -> bool:
    streams = {stream.name: stream for stream in first.streams}
    return (
        [(e.name, e.id) for e in first.elements] == [(e.name, e.id) for e in second.elements]
        and slots(first) == slots(second)
        and [(p.name, p.kind, p.stored) for p in first.properties]
        == [(p.name, p.kind, p.stored) for p in second.properties]
        and first.params == second.params
        and all(streams.get(stream.name, stream) == stream for stream in second.streams)
        and [p.name for p in first.passes] == [p.name for p in second.passes]
    )


def _cells(ruleset: Ruleset) -> Cells:
    ids = tuple(element.id for element in ruleset.elements)
    domains: dict[str, tuple[int, ...]] = {}
    holders: dict[str, Holders] = {}
    for slot in slots(ruleset):
        if slot.is_real:
            continue
        (name,) = slot_names(slot)
        prop = ruleset.property(slot.name)
        if slot.kind.name == "element":
            domains[name] = ids
        if prop is not None and slot.kind.name in ("int", "flag"):
            holders[name] = Holders(
                prop.stored, tuple(int(value) if isinstance(value, int) else 0 for value in prop.values)
            )
        elif slot.of is not None and not slot.own:
            holders[name] = Holders(slot.of, (int(slot.default),) * (max(ids) + 1))
    return Cells(domains, holders)


def _same_pass(first: Ruleset, one: Pass, second: Ruleset, other: Pass, cells: Cells) -> bool:
    """Substep by substep, each from whatever the one before may have left; if that does not do, as a whole."""
    if one.scratch != other.scratch:
        return False
    numbers = range(len(one.moments))
    if len(one.moments) == len(other.moments) and all(
        _same_substep(first, one, second, other, number, cells) for number in numbers
    ):
        return True
    graph = Graph()
    return _same_writes(lower_pass(first, one, graph), lower_pass(second, other, graph), graph, cells)


def _same_substep(first: Ruleset, one: Pass, second: Ruleset, other: Pass, number: int, cells: Cells) -> bool:
    graph = Graph()
    return _same_writes(
        lower_substep(first, one, number, graph), lower_substep(second, other, number, graph), graph, cells
    )


def _same_writes(first: dict[str, Node], second: dict[str, Node], graph: Graph, cells: Cells) -> bool:
    """Whether both write the same; a slot that one of them does not write keeps its value."""
    compare = Comparison(cells)
    for name in dict.fromkeys([*first, *second]):
        one, other = first.get(name), second.get(name)
        written = one or other
        assert written is not None
        if name.startswith("let ") and (one is None or other is None):
            continue  # no other rule reads a value that the other does not have
        kept = graph.node("input", written.type, (), name)
        if not compare.equal(one or kept, other or kept):
            return False
    return True
