"""Which elements must be present for a pass or a mask to do anything. Without them no cell is looked at."""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass, replace
from functools import reduce
from itertools import product, starmap
from operator import or_

from powderdsl.ir.ops import FLAG, REAL, Node, ordered
from powderdsl.schedule.floats import unchanged
from powderdsl.schedule.types import (
    ANSWER,
    Compute,
    Forget,
    Guard,
    Schedule,
    Statement,
    combined,
    flat,
)

MAX_PLANES = 6
"""A set of ids is a word of 64 bits."""

MAX_SETS = 4
"""More sets than this are not worth testing."""

_ELEMENT = "element:"

Time = tuple[int, int]
ALWAYS: Time = (0, 1 << 30)
"""A half-open range of changes of the element."""

Sets = tuple[int, ...]
"""Sets of ids (bits of a word): at least one id of each must be present."""


def presence(schedule: Schedule) -> Schedule:
    """Masks and the whole pass test which elements are present; writes of elements discard that knowledge.

    `m = is_a & b[0,1]`, where b is an element too → the loop of `m` runs only when `present(a) & present(b)`. Comes
    before `cut`, which takes masks apart.
    """
    bits = _element_bits(schedule)
    planes = {name: slot for name, slot in schedule.found.items() if name in bits}
    writes = [node.op == "load" for slot, node in schedule.leaves if slot.startswith(_ELEMENT)]
    # Else constants, or planes of other slots, become the element.
    if not bits or any(slot != f"{_ELEMENT}{bits[name]}" for name, slot in planes.items()):
        return replace(schedule, body=(*schedule.body, Forget())) if writes else schedule
    body: list[Statement] = []
    needs = _Needs(schedule, bits, _times(schedule, bits))
    for statement, after in zip(
        schedule.body, (*schedule.body[1:], None), strict=False
    ):  # a body may be empty
        if isinstance(statement, Guard):
            swaps = _only_swaps(statement, bits)
            body.append(statement if swaps else replace(statement, body=(Forget(), *statement.body)))
        elif isinstance(after, Guard):
            asked = statement.vars.keys() == {mask.attr for mask in after.when.args}
            body.append(replace(statement, when=needs.asked(statement.results) if asked else None))
        else:
            body += [statement] if bits.keys().isdisjoint(statement.vars) else [statement, Forget()]
    if not all(writes):
        body.append(Forget())
    return replace(schedule, body=tuple(body), when=_pass_asks(schedule, bits))


def _element_bits(schedule: Schedule) -> dict[str, int]:
    """For each variable that holds a bit of the element: which bit. Empty if there are more than MAX_PLANES."""
    bits: dict[str, int] = {}
    ends = [(node.attr, slot) for slot, node in schedule.leaves if node.op == "load"]
    for name, slot in (*schedule.found.items(), *ends):
        if slot.startswith(_ELEMENT):
            bits[name] = int(slot.removeprefix(_ELEMENT))
    pairs = [pair for statement in flat(schedule.body) for pair in statement.olds.items()]
    for new, old in (*pairs, *reversed(pairs)):  # forward from the inputs, backward from the outputs
        if old.op == "load":
            for known, other in ((old.attr, new), (new, old.attr)):
                if known in bits:
                    bits.setdefault(other, bits[known])
    return bits if max(bits.values(), default=MAX_PLANES) < MAX_PLANES else {}


def _times(schedule: Schedule, bits: dict[str, int]) -> dict[str, Time]:
    """From when until when each variable of `bits` holds the current bit, counted in changes of the element.

    Bits that change one after the other are one change, until one of them changes again.
    """
    change, changed = 0, set[int]()
    current: dict[int, str] = {}
    times: dict[str, Time] = {}
    for name in (*schedule.found, *_computed(flat(schedule.body))):
        if (bit := bits.get(name)) is not None:
            if bit in changed:
                change, changed = change + 1, set()
            changed.add(bit)
            if old := current.get(bit):
                times[old] = times[old][0], change
            times[name] = change, ALWAYS[1]
            current[bit] = name
    return times


def _computed(body: Iterable[Statement]) -> dict[str, Node]:
    """The values of variables that loops compute."""
    loops = [loop for loop in body if isinstance(loop, Compute)]
    return {out.var.name: out.value for loop in loops for out in loop.outs}


def _only_swaps(guard: Guard, bits: Container[str]) -> bool:
    """Whether a guard preserves the count of each element: it swaps cells, or writes no elements."""
    values = _computed(guard.body)
    return all(
        values[name].op == "swap" and values[name].args[0] is old is values[name].args[2]
        for name, old in guard.olds.items()
        if name in bits
    )


def _pass_asks(schedule: Schedule, bits: dict[str, int]) -> Node | None:
    """The condition under which the pass can change anything; None if none is known.

    Until something changes, slots hold their values from the beginning of the pass, so every mask is judged as if it
    were the first.
    """
    values = _computed(schedule.body)
    guards = {name: part for part in schedule.body if isinstance(part, Guard) for name in part.vars}
    slots = schedule.found
    masks: list[Node] = []
    for slot, node in schedule.leaves:
        if node.type == REAL and node.op == "load":
            kept = unchanged(values[node.attr], slots) if node.attr in values else None
            if kept is None:
                return None
            node, choices = kept
            masks += choices
        while node.op == "load" and node.attr in guards:
            guard = guards[node.attr]
            masks += guard.when.args
            node = guard.olds[node.attr]
        if node.op != "load" or slots.get(node.attr) != slot:
            return None
    return _Needs(schedule, bits, {}).asked([values.get(mask.attr, mask) for mask in masks])


def asked_ids(schedule: Schedule) -> int:
    """All ids whose presence a schedule tests."""
    nodes = ordered(filter(None, [*schedule.values, schedule.when]))
    return reduce(or_, (node.attr for node in nodes if node.op == "present"), 0)


@dataclass(frozen=True)
class _Ids:
    """The ids that a cell can have where a flag holds, at some time; `exact`, if it holds in all cells with these ids.

    Of each of `sets` one id must be present somewhere for the flag to hold anywhere.
    """

    cell: int
    exact: bool
    time: Time
    sets: Sets


class _Needs:
    """What flags say about ids. A cell has an id at a time: bits from before and after a change say nothing together."""

    def __init__(self, schedule: Schedule, bits: dict[str, int], times: dict[str, Time]):
        self.graph, self.bits, self.times = schedule.graph, bits, times
        self.known: dict[Node, _Ids] = {}
        self.codes = range(1 << 1 + max(bits.values()))
        self.everything = (1 << len(self.codes)) - 1

    def asked(self, masks: list[Node]) -> Node | None:
        """An answer that is true whenever one of some masks holds anywhere; None if none is known."""
        for node in ordered(masks):
            if node not in self.known:
                self.known[node] = self.ids(node, [self.known[arg] for arg in node.args])
        ways = sorted({tuple(sorted(self.known[mask].sets)) for mask in masks})
        if not ways or not ways[0]:
            return None
        present = [[self.graph.node("present", ANSWER, (), ids) for ids in sets] for sets in ways]
        return combined("or", [combined("and", nodes, self.graph) for nodes in present], self.graph)

    def ids(self, node: Node, args: list[_Ids]) -> _Ids:
        """What a flag says, from what its arguments say."""
        cells, sets = [arg.cell for arg in args], [arg.sets for arg in args]
        together = node.op in ("and", "or", "xor", "not", "select")
        exact = together and all(arg.exact for arg in args)
        times = [ALWAYS, *(arg.time for arg in args if together and arg.cell != self.everything)]
        cell: int = self.everything
        needs: Sets = ()
        match node.op:
            case "load" if node.attr in self.bits:
                bit = self.bits[node.attr]
                cell, exact = sum(1 << code for code in self.codes if code >> bit & 1), True
                times.append(self.times.get(node.attr, ALWAYS))
            case "const" if node.type == FLAG:
                cell, exact = self.everything if node.attr else 0, True
            case "not" if exact:
                cell = self.everything ^ cells[0]
            case "and":
                cell, needs = cells[0] & cells[1], _least(sets[0] + sets[1])
            case "or" | "xor":
                both = cells[0] & cells[1] if exact and node.op == "xor" else 0
                cell, needs = (cells[0] | cells[1]) ^ both, _either(*sets)
            case "select":
                chosen = cells[0] if exact else 0
                cell = cells[0] & cells[1] | cells[2] & ~chosen
                needs = _either(_least(sets[0] + sets[1]), sets[2])
            case "shift":
                needs = sets[0]
        begins, ends = zip(*times, strict=True)
        time = max(begins), min(ends)
        if time[0] >= time[1]:  # they never are together
            cell, exact, time = self.everything, False, ALWAYS
        own = () if cell == self.everything else (cell,)
        return _Ids(cell, exact, time, own if exact else _least(needs + own))


def _either(a: Sets, b: Sets) -> Sets:
    return _least(starmap(or_, product(a, b)))


def _least(sets: Iterable[int]) -> Sets:
    """The smallest sets, at most MAX_SETS. A set that contains another adds nothing."""
    least: list[int] = []
    for ids in sorted(sets, key=lambda ids: (ids.bit_count(), ids)):
        if not any(smaller & ids == smaller for smaller in least):
            least.append(ids)
    return tuple(least[:MAX_SETS])
