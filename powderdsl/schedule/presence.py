"""The elements that must be present for a pass or a mask to do anything. Without them no cell is visited."""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass, replace
from functools import reduce
from itertools import product, starmap
from operator import or_

from powderdsl.ir.ops import FLAG, REAL, Node, ordered
from powderdsl.schedule.floats import match_slot_choices
from powderdsl.schedule.types import ANSWER, Compute, Forget, Guard, Schedule, Statement, combined, flat

MAX_PLANES = 6
"""A set of ids is a word of 64 bits."""

MAX_SETS = 4
"""Maximum number of sets to test."""

_ELEMENT = "element:"

Time = tuple[int, int]
ALWAYS: Time = (0, 1 << 30)
"""A half-open range of changes of the element."""

Sets = tuple[int, ...]
"""Sets of ids (bits of a word): at least one id of each must be present."""


def check_presence(schedule: Schedule) -> Schedule:
    """Make masks and the whole pass test which elements are present; writes of elements discard that knowledge.

    `m = is_a & b[0,1]`, where b is an element too → the loop of `m` runs only when `present(a) & present(b)`.
    """
    bits = _element_bits(schedule)
    planes = {name: slot for name, slot in schedule.input_slots.items() if name in bits}
    writes = [node.op == "load" for slot, node in schedule.outputs if slot.startswith(_ELEMENT)]
    # Unless all bits come from their own slots, constants or planes of other slots become the element.
    if not bits or any(slot != f"{_ELEMENT}{bits[name]}" for name, slot in planes.items()):
        return replace(schedule, body=(*schedule.body, Forget())) if writes else schedule
    body: list[Statement] = []
    needs = _Needs(schedule, bits, _times(schedule, bits))
    followers = (*schedule.body[1:], None)  # one too many if the body is empty
    for statement, after in zip(schedule.body, followers, strict=False):
        if isinstance(statement, Guard):
            swaps = _preserves_counts(statement, bits)
            body.append(statement if swaps else replace(statement, body=(Forget(), *statement.body)))
        elif isinstance(after, Guard):
            only_masks = statement.vars.keys() == {mask.attr for mask in after.when.args}
            body.append(replace(statement, when=needs.condition(statement.results) if only_masks else None))
        else:
            body += [statement] if bits.keys().isdisjoint(statement.vars) else [statement, Forget()]
    if not all(writes):
        body.append(Forget())
    return replace(schedule, body=tuple(body), when=_pass_condition(schedule, bits))


def _element_bits(schedule: Schedule) -> dict[str, int]:
    """The bit of the element that each variable holds. Empty if the element has more than MAX_PLANES bits."""
    if schedule.element_bits > MAX_PLANES:
        return {}
    bits: dict[str, int] = {}
    ends = [(node.attr, slot) for slot, node in schedule.outputs if node.op == "load"]
    for name, slot in (*schedule.input_slots.items(), *ends):
        if slot.startswith(_ELEMENT):
            bits[name] = int(slot.removeprefix(_ELEMENT))
    pairs = [pair for statement in flat(schedule.body) for pair in statement.olds.items()]
    for new, old in (*pairs, *reversed(pairs)):  # forward from the inputs, backward from the outputs
        if old.op == "load":
            for source, target in ((old.attr, new), (new, old.attr)):
                if source in bits:
                    bits.setdefault(target, bits[source])
    return bits


def _times(schedule: Schedule, bits: dict[str, int]) -> dict[str, Time]:
    """The period in which each variable of `bits` holds the current bit, counted in changes of the element.

    Consecutive changes of different bits count as one change.
    """
    change, changed = 0, set[int]()
    current: dict[int, str] = {}
    times: dict[str, Time] = {}
    for name in (*schedule.input_slots, *_values_of(flat(schedule.body))):
        if (bit := bits.get(name)) is not None:
            if bit in changed:
                change, changed = change + 1, set()
            changed.add(bit)
            if old := current.get(bit):
                times[old] = times[old][0], change
            times[name] = change, ALWAYS[1]
            current[bit] = name
    return times


def _values_of(body: Iterable[Statement]) -> dict[str, Node]:
    loops = [loop for loop in body if isinstance(loop, Compute)]
    return {out.var.name: out.value for loop in loops for out in loop.outs}


def _preserves_counts(guard: Guard, bits: Container[str]) -> bool:
    """True if a guard preserves the count of each element: it swaps cells, or writes no elements."""
    values = _values_of(guard.body)
    pairs = [(values[name], old) for name, old in guard.olds.items() if name in bits]
    return all(value.op == "swap" and value.args[0] is old is value.args[2] for value, old in pairs)


def _pass_condition(schedule: Schedule, bits: dict[str, int]) -> Node | None:
    """The condition under which the pass can change anything; None if none is known.

    Until something changes, slots hold their initial values, so every mask is treated as if it were the first.
    """
    values = _values_of(schedule.body)
    guards = {name: part for part in schedule.body if isinstance(part, Guard) for name in part.vars}
    slots = schedule.input_slots
    masks: list[Node] = []
    for slot, node in schedule.outputs:
        if node.type == REAL and node.op == "load":
            match = match_slot_choices(values[node.attr], slots) if node.attr in values else None
            if match is None:
                return None
            node, choices = match
            masks += choices
        while node.op == "load" and node.attr in guards:
            guard = guards[node.attr]
            masks += guard.when.args
            node = guard.olds[node.attr]
        if node.op != "load" or slots.get(node.attr) != slot:
            return None
    return _Needs(schedule, bits, {}).condition([values.get(mask.attr, mask) for mask in masks])


def tested_ids(schedule: Schedule) -> int:
    nodes = ordered(filter(None, [*schedule.values, schedule.when]))
    return reduce(or_, (node.attr for node in nodes if node.op == "present"), 0)


@dataclass(frozen=True)
class _Ids:
    """The ids that a cell can have where a flag holds, at some time.

    `exact`: the flag holds in all cells with these ids. `sets`: at least one id of each must be present somewhere for the
    flag to hold anywhere.
    """

    cell: int
    exact: bool
    time: Time
    sets: Sets


class _Needs:
    """The ids that flags imply. Bits from before and after a change of the element imply nothing together."""

    def __init__(self, schedule: Schedule, bits: dict[str, int], times: dict[str, Time]):
        self.graph, self.bits, self.times = schedule.graph, bits, times
        self.known: dict[Node, _Ids] = {}
        # Also of bits that the pass does not read: targets look for whole ids.
        self.codes = range(1 << schedule.element_bits)
        self.everything = (1 << len(self.codes)) - 1

    def condition(self, masks: list[Node]) -> Node | None:
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
        """The ids that a flag implies, from those of its arguments."""
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
        if time[0] >= time[1]:  # the arguments are never current at the same time
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
