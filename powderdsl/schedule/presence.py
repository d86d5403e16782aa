"""Which elements must be present for a pass or a mask to do anything. Without them no cell is looked at."""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass, replace
from functools import reduce
from operator import or_

from powderdsl.ir.ops import FLAG, REAL, Graph, Node, ordered
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

Sets = frozenset[int]
"""Sets of ids (bits of a word): at least one id of each must be present."""


def presence(schedule: Schedule) -> Schedule:
    """Masks and the whole pass test which elements are present; writes of elements discard that knowledge.

    `m = is_a & b[0,1]`, where b is an element too → the loop of `m` runs only when `present(a) & present(b)`. Comes
    before `cut`, which takes masks apart.
    """
    bits = _element_bits(schedule)
    leaves = [node for slot, node in schedule.leaves if slot.startswith(_ELEMENT)]
    slots = [(slot, bits[var.name]) for slot, var in schedule.finds if var.name in bits]
    if not bits or any(
        slot != f"{_ELEMENT}{bit}" for slot, bit in slots
    ):  # constants, or planes of other slots, become the element
        return replace(schedule, body=(*schedule.body, Forget())) if leaves else schedule
    body: list[Statement] = []
    times = _times(schedule, bits)
    for statement, after in zip(schedule.body, (*schedule.body[1:], None), strict=True):
        if isinstance(statement, Guard):
            if not _only_swaps(statement, bits):
                statement = replace(statement, body=(Forget(), *statement.body))
            body.append(statement)
        elif isinstance(statement, Compute) and isinstance(after, Guard):
            asked = statement.vars.keys() == {mask.attr for mask in after.when.args}
            when = _asked(statement.results, bits, times, schedule.graph) if asked else None
            body.append(replace(statement, when=when))
        else:
            body += [statement] if bits.keys().isdisjoint(statement.vars) else [statement, Forget()]
    if any(node.op != "load" for node in leaves):
        body.append(Forget())
    return replace(schedule, body=tuple(body), when=_pass_asks(schedule, bits))


def _element_bits(schedule: Schedule) -> dict[str, int]:
    """For each variable that holds a bit of the element: which bit. Empty if there are more than MAX_PLANES."""
    bits: dict[str, int] = {}
    slots = [(slot, var.name) for slot, var in schedule.finds]
    slots += [(slot, node.attr) for slot, node in schedule.leaves if node.op == "load"]
    for slot, name in slots:
        if slot.startswith(_ELEMENT):
            bits[name] = int(slot.removeprefix(_ELEMENT))
    pairs = [
        (name, old.attr)
        for statement in flat(schedule.body)
        for name, old in statement.olds.items()
        if old.op == "load"
    ]
    for new, old in (*pairs, *reversed(pairs)):  # forward from the inputs, backward from the outputs
        for known, other in ((old, new), (new, old)):
            if known in bits:
                bits.setdefault(other, bits[known])
    return bits if max(bits.values(), default=MAX_PLANES) < MAX_PLANES else {}


def _times(schedule: Schedule, bits: dict[str, int]) -> dict[str, Time]:
    """From when until when each variable of `bits` holds the current bit, counted in changes of the element.

    Bits that change one after the other are one change, until one of them changes again.
    """
    change, changed = 0, set[int]()
    current: dict[int, str] = {}
    begins: dict[str, int] = {}
    ends: dict[str, int] = {}
    loops = [statement for statement in flat(schedule.body) if isinstance(statement, Compute)]
    for var in (*dict(schedule.finds).values(), *(out.var for loop in loops for out in loop.outs)):
        if (bit := bits.get(var.name)) is not None:
            if bit in changed:
                change, changed = change + 1, set()
            changed.add(bit)
            begins[var.name] = change
            ends[current.get(bit, "")] = change
            current[bit] = var.name
    return {name: (begin, ends.get(name, change + 1)) for name, begin in begins.items()}


def _only_swaps(guard: Guard, bits: Container[str]) -> bool:
    """Whether a guard preserves the count of each element: it swaps cells, or writes no elements."""
    loops = [statement for statement in guard.body if isinstance(statement, Compute)]
    values = {out.var.name: out.value for loop in loops for out in loop.outs}
    changed = [(values[name], old) for name, old in guard.olds.items() if name in bits]
    return all(value.op == "swap" and value.args[0] is old is value.args[2] for value, old in changed)


def _pass_asks(schedule: Schedule, bits: dict[str, int]) -> Node | None:
    """The condition under which the pass can change anything; None if none is known.

    Until something changes, slots hold their values from the beginning of the pass, so every mask is judged as if it
    were the first.
    """
    loops = [statement for statement in schedule.body if isinstance(statement, Compute)]
    values = {out.var.name: out.value for loop in loops for out in loop.outs}
    guards = {name: one for one in schedule.body if isinstance(one, Guard) for name in one.vars}
    slots = {var.name: slot for slot, var in schedule.finds}
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
    return _asked([values.get(mask.attr, mask) for mask in masks], bits, {}, schedule.graph)


def when_present(masks: list[Node], schedule: Schedule) -> Node | None:
    """An answer without which none of some masks holds anywhere; None if none is known."""
    bits = _element_bits(schedule)
    return _asked(masks, bits, _times(schedule, bits), schedule.graph) if bits else None


def _asked(masks: list[Node], bits: dict[str, int], times: dict[str, Time], graph: Graph) -> Node | None:
    """An answer that is true whenever one of some masks holds anywhere; None if none is known."""
    needs = _Needs(bits, times)
    ways = dict.fromkeys(needs.of(mask) for mask in masks)
    if not ways or frozenset() in ways:
        return None
    present = [
        [graph.node("present", ANSWER, (), ids) for ids in sorted(sets)] for sets in sorted(ways, key=sorted)
    ]
    return combined("or", [combined("and", nodes, graph) for nodes in present], graph)


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

    def __init__(self, bits: dict[str, int], times: dict[str, Time]):
        self.bits, self.times = bits, times
        self.known: dict[Node, _Ids] = {}
        codes = 1 << 1 + max(bits.values())
        self.everything = (1 << codes) - 1
        self.columns = {
            bit: sum(1 << code for code in range(codes) if code >> bit & 1) for bit in bits.values()
        }

    def of(self, mask: Node) -> Sets:
        """Sets of ids of each of which one must be present for the mask to hold anywhere."""
        for node in ordered([mask]):
            if node not in self.known:
                self.known[node] = self._ids(node, [self.known[arg] for arg in node.args])
        return self.known[mask].sets

    def _ids(self, node: Node, args: list[_Ids]) -> _Ids:
        cells, sets = [arg.cell for arg in args], [arg.sets for arg in args]
        together = node.op in ("and", "or", "xor", "not", "select")
        exact = together and all(arg.exact for arg in args)
        times = [arg.time for arg in args if together and arg.cell != self.everything]
        cell, needs = self.everything, Sets()
        match node.op:
            case "load" if node.attr in self.bits:
                cell, exact = self.columns[self.bits[node.attr]], True
                times = [self.times.get(node.attr, ALWAYS)]
            case "const" if node.type == FLAG:
                cell, exact = self.everything if node.attr else 0, True
            case "not" if exact:
                cell = self.everything ^ cells[0]
            case "and":
                cell, needs = cells[0] & cells[1], _least(sets[0] | sets[1])
            case "or" | "xor":
                both = cells[0] & cells[1] if exact and node.op == "xor" else 0
                cell, needs = (cells[0] | cells[1]) ^ both, _either(*sets)
            case "select":
                chosen = cells[0] if exact else 0
                cell = cells[0] & cells[1] | cells[2] & ~chosen
                needs = _either(_least(sets[0] | sets[1]), sets[2])
            case "shift":
                needs = sets[0]
        begin, end = (
            max([begin for begin, _ in times], default=0),
            min([end for _, end in times], default=ALWAYS[1]),
        )
        if begin >= end:  # they never are together
            cell, exact, begin, end = self.everything, False, *ALWAYS
        needs = Sets() if exact else needs
        return _Ids(cell, exact, (begin, end), _least(needs | {cell} - {self.everything}))


def _either(a: Sets, b: Sets) -> Sets:
    return _least(one | other for one in sorted(a) for other in sorted(b))


def _least(sets: Iterable[int]) -> Sets:
    """The smallest sets, at most MAX_SETS. A set that contains another adds nothing."""
    least: list[int] = []
    for ids in sorted(sets, key=lambda ids: (ids.bit_count(), ids)):
        if not any(smaller & ids == smaller for smaller in least):
            least.append(ids)
    return frozenset(least[:MAX_SETS])
