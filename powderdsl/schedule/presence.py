"""Which elements must be present for a pass or a mask to do anything. Without them no cell is looked at."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import or_

from powderdsl.ir.ops import FLAG, REAL, Graph, Node, ordered
from powderdsl.schedule.join import unchanged
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
    found = {var.name: slot for slot, var in schedule.finds}
    leaves = [node for slot, node in schedule.leaves if slot.startswith(_ELEMENT)]
    if not bits or any(
        found.get(name, f"{_ELEMENT}{bit}") != f"{_ELEMENT}{bit}" for name, bit in bits.items()
    ):
        # Constants, or planes of other slots, become the element.
        return replace(schedule, body=(*schedule.body, Forget())) if leaves else schedule
    body: list[Statement] = []
    times = _times(schedule, bits)
    for i, statement in enumerate(schedule.body):
        after = schedule.body[i + 1] if i + 1 < len(schedule.body) else None
        match statement:
            case Compute(outs) if isinstance(after, Guard):
                asked = {node.attr for node in after.when if node.op == "load"}
                if asked == {out.var.name for out in outs}:
                    when = _asked([out.value for out in outs], bits, times, schedule.graph)
                    statement = replace(statement, when=when)
                body.append(statement)
            case Guard(_, inner, keeps):
                changed = [(var, old) for var, old in keeps if var.name in bits]
                if changed and not _only_swaps(statement, {var.name: old for var, old in changed}):
                    statement = replace(statement, body=(Forget(), *inner))
                body.append(statement)
            case Compute(outs) if any(out.var.name in bits for out in outs):
                body += [statement, Forget()]
            case _:
                body.append(statement)
    if any(node.op != "load" for node in leaves):
        body.append(Forget())
    return replace(schedule, body=tuple(body), when=_pass_asks(schedule, bits))


def _element_bits(schedule: Schedule) -> dict[str, int]:
    """For each variable that holds a bit of the element: which bit. Empty if there are more than MAX_PLANES."""
    bits: dict[str, int] = {}
    for slot, var in schedule.finds:
        if slot.startswith(_ELEMENT):
            bits[var.name] = int(slot.removeprefix(_ELEMENT))
    for slot, node in schedule.leaves:
        if slot.startswith(_ELEMENT) and node.op == "load":
            bits[node.attr] = int(slot.removeprefix(_ELEMENT))
    pairs = [
        (var.name, str(value.attr))
        for statement in flat(schedule.body)
        if isinstance(statement, Guard)
        for var, value in statement.keeps
        if value.op == "load"
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
    assigned = [var.name for _, var in schedule.finds]
    for statement in flat(schedule.body):
        if isinstance(statement, Compute):
            assigned += [out.var.name for out in statement.outs]
    for name in assigned:
        if name not in bits:
            continue
        bit = bits[name]
        if bit in changed:
            change, changed = change + 1, set()
        changed.add(bit)
        begins[name] = change
        if bit in current:
            ends[current[bit]] = change
        current[bit] = name
    return {name: (begins[name], ends.get(name, change + 1)) for name in begins}


def _only_swaps(guard: Guard, olds: dict[str, Node]) -> bool:
    """Whether a guard preserves the count of each element: it swaps cells, or writes no elements."""
    values = {out.var.name: out.value for one in guard.body if isinstance(one, Compute) for out in one.outs}
    for name, old in olds.items():
        value = values[name]
        if value.op != "swap" or value.args[0] is not old or value.args[2] is not old:
            return False
    return True


def _pass_asks(schedule: Schedule, bits: dict[str, int]) -> Node | None:
    """The condition under which the pass can change anything; None if none is known.

    Until something changes, slots hold their values from the beginning of the pass, so every mask is judged as if it
    were the first.
    """
    masks: dict[str, Node] = {}
    chains: dict[str, Guard] = {}
    for statement in schedule.body:
        if isinstance(statement, Compute):
            masks |= {out.var.name: out.value for out in statement.outs}
        elif isinstance(statement, Guard):
            chains |= {var.name: statement for var, _ in statement.keeps}
    found = {var.name: slot for slot, var in schedule.finds}
    asked: list[Node] = []
    for slot, node in schedule.leaves:
        if node.op != "load":
            return None
        name = str(node.attr)
        if node.type == REAL:
            kept = unchanged(masks[name], set(found)) if name in masks else None
            if kept is None or found[str(kept[0].attr)] != slot:
                return None
            asked += [masks.get(str(mask.attr), mask) for mask in kept[1]]
            continue
        while name in chains:
            guard = chains[name]
            asked += [masks.get(str(mask.attr), mask) for mask in guard.when]
            old = next(value for var, value in guard.keeps if var.name == name)
            name = str(old.attr)
        if found.get(name) != slot:
            return None
    return _asked(asked, bits, {}, schedule.graph)


def when_present(masks: list[Node], schedule: Schedule) -> Node | None:
    """An answer without which none of some masks holds anywhere; None if none is known."""
    bits = _element_bits(schedule)
    return _asked(masks, bits, _times(schedule, bits), schedule.graph) if bits else None


def _asked(masks: list[Node], bits: dict[str, int], times: dict[str, Time], graph: Graph) -> Node | None:
    """An answer that is true whenever one of some masks holds anywhere; None if none is known."""
    needs = _Needs(1 + max(bits.values()), bits, times)
    ways = dict.fromkeys(needs.of(mask) for mask in masks)
    if not ways or frozenset() in ways:
        return None
    present = [
        [graph.node("present", ANSWER, (), ids) for ids in sorted(sets)] for sets in sorted(ways, key=sorted)
    ]
    return combined("or", [combined("and", nodes, graph) for nodes in present], graph)


def asked_ids(schedule: Schedule) -> int:
    """All ids whose presence a schedule tests."""
    roots = [] if schedule.when is None else [schedule.when]
    roots += [node for statement in flat(schedule.body) for node in statement.values()]
    return reduce(or_, (node.attr for node in ordered(roots) if node.op == "present"), 0)


@dataclass
class _Needs:
    """For each flag: the ids for which it holds, if it depends on the cell's element alone; the ids that a cell
    can have where it holds; and sets of ids of each of which one must be present somewhere.

    A cell has an id at a time: bits from before and after a change say nothing together.
    """

    planes: int
    bits: dict[str, int]
    times: dict[str, Time]
    time: dict[int, Time] = field(default_factory=dict)
    exact: dict[int, int | None] = field(default_factory=dict)
    cell: dict[int, int] = field(default_factory=dict)
    sets: dict[int, Sets] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.everything = (1 << (1 << self.planes)) - 1
        self.columns = [
            sum(1 << code for code in range(1 << self.planes) if code >> bit & 1)
            for bit in range(self.planes)
        ]

    def of(self, mask: Node) -> Sets:
        """Sets of ids of each of which one must be present for the mask to hold anywhere."""
        for node in ordered([mask]):
            key = id(node)
            if key in self.exact:
                continue
            begin, end = self.time[key] = self._time(node)
            exact = self.exact[key] = self._exact(node) if begin < end else None
            if begin >= end:
                self.cell[key], self.time[key] = self.everything, ALWAYS
            else:
                self.cell[key] = self._cell(node) if exact is None else exact
            self.sets[key] = frozenset() if exact is not None else self._sets(node)
        return self._all(mask)

    def _time(self, node: Node) -> Time:
        """When the cell's ids are those that `exact` and `cell` know; empty if they never are together."""
        if node.op == "load":
            return self.times.get(str(node.attr), ALWAYS)
        if node.op not in ("and", "or", "xor", "not", "select"):
            return ALWAYS
        times = [self.time[id(arg)] for arg in node.args if self.cell[id(arg)] != self.everything]
        return max([begin for begin, _ in times], default=0), min(
            [end for _, end in times], default=ALWAYS[1]
        )

    def _all(self, node: Node) -> Sets:
        cell = self.cell[id(node)]
        return _least(self.sets[id(node)] | ({cell} if cell != self.everything else set()))

    def _exact(self, node: Node) -> int | None:
        if node.op == "load" and node.attr in self.bits:
            return self.columns[self.bits[node.attr]]
        if node.op == "const" and node.type == FLAG:
            return self.everything if node.attr else 0
        if node.op not in ("and", "or", "xor", "not", "select"):
            return None
        match node.op, [self.exact[id(arg)] for arg in node.args]:
            case "and", [int(a), int(b)]:
                return a & b
            case "or", [int(a), int(b)]:
                return a | b
            case "xor", [int(a), int(b)]:
                return a ^ b
            case "not", [int(a)]:
                return self.everything ^ a
            case "select", [int(asked), int(yes), int(no)]:
                return asked & yes | ~asked & no
        return None

    def _cell(self, node: Node) -> int:
        cells = [self.cell[id(arg)] for arg in node.args]
        match node.op:
            case "and":
                return cells[0] & cells[1]
            case "or" | "xor":
                return cells[0] | cells[1]
            case "select":
                return cells[0] & cells[1] | cells[2]
        return self.everything

    def _sets(self, node: Node) -> Sets:
        match node.op:
            case "and":
                return _least(self._all(node.args[0]) | self._all(node.args[1]))
            case "or" | "xor":
                return _either(self._all(node.args[0]), self._all(node.args[1]))
            case "shift":
                return self._all(node.args[0])
            case "select":
                chosen = _least(self._all(node.args[0]) | self._all(node.args[1]))
                return _either(chosen, self._all(node.args[2]))
        return frozenset()


def _either(a: Sets, b: Sets) -> Sets:
    return _least(frozenset(one | other for one in a for other in b))


def _least(sets: Iterable[int]) -> Sets:
    """The smallest sets, at most MAX_SETS. A set that contains another adds nothing."""
    kept: list[int] = []
    for ids in sorted(sets, key=lambda ids: (ids.bit_count(), ids)):
        if not any(one & ids == one for one in kept):
            kept.append(ids)
    return frozenset(kept[:MAX_SETS])
