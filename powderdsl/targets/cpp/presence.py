"""Which elements a pass asks for: where none of them is in any world of a group, the pass is skipped whole."""

from __future__ import annotations

from collections.abc import Iterable
from functools import reduce
from operator import or_

from powderdsl.ir.ops import REAL, Node, PassGraph, Step, nodes_of, walk
from powderdsl.targets.cpp.moves import movement_of
from powderdsl.targets.cpp.sweeps import unchanged
from powderdsl.targets.layout import Layout

MAX_PLANES = 6
"""A set of ids is a word of 64 bits."""

MAX_SETS = 4
"""More are not worth asking."""

_ELEMENT = "element:"


def element_planes(layout: Layout) -> int:
    """How many planes hold the elements; 0 if they are too many to count ids."""
    count = sum(name.startswith(_ELEMENT) for name in layout.planes)
    return count if count <= MAX_PLANES else 0


Asked = tuple[frozenset[int], ...]
"""What a pass asks for: one of these, each of which is sets of ids (bits of a word) that all have one that is there."""


def asked_ids(pass_: PassGraph, planes: int) -> Asked | None:
    """What must be there for the pass to change anything; None if nothing can be said.

    As long as no moment has changed anything, slots hold what they held when the pass began. So every mask is asked
    as if it came first.
    """
    if not planes or not all(step.guards for step in pass_.moments):
        return None
    bits = {
        id(node): int(slot.removeprefix(_ELEMENT))
        for node in nodes_of(pass_)
        if node.op == "input" and (slot := str(node.attr)).startswith(_ELEMENT)
    }
    for step in pass_.moments:
        for slot, node in step.writes:
            if slot.startswith(_ELEMENT):
                bits[id(node)] = int(slot.removeprefix(_ELEMENT))
    masks = [guard for step in pass_.moments for guard in step.guards]
    for slot, node in pass_.outputs:
        if node.type == REAL:
            kept = unchanged(node)
            if kept is None or kept[0].attr != slot:
                return None
            masks += kept[1]
    return _asked(masks, planes, bits)


def asked_now(guards: list[Node], planes: int, elements: dict[int, int]) -> Asked | None:
    """The same for one moment; `elements` are the bits of the element as it is now, by node."""
    return _asked(guards, planes, elements) if planes else None


def _asked(masks: list[Node], planes: int, elements: dict[int, int]) -> Asked | None:
    found = _Needs(planes, elements)
    asked = dict.fromkeys(found.asked(mask) for mask in masks)
    return None if frozenset() in asked else tuple(sorted(asked, key=sorted))


def asked_word(asked: Asked | None) -> int:
    """All ids in it."""
    return reduce(or_, (ids for sets in asked or () for ids in sets), 0)


def there(asked: Asked) -> str:
    """C++ that asks whether enough is there."""
    ways = (" && ".join(f"(c.present & {ids:#x}ull)" for ids in sorted(sets)) for sets in asked)
    return " || ".join(f"({way})" for way in ways) or "false"


class _Needs:
    """Of each flag: the ids it holds for, if it hangs on the cell's element alone; ids that the cell has where it holds;
    and sets of ids of which one each must be somewhere."""

    def __init__(self, planes: int, elements: dict[int, int]):
        self.elements = elements
        self.everything = (1 << (1 << planes)) - 1
        self.columns = [
            sum(1 << code for code in range(1 << planes) if code >> bit & 1) for bit in range(planes)
        ]
        self.exact: dict[int, int | None] = {}
        self.cell: dict[int, int] = {}
        self.sets: dict[int, frozenset[int]] = {}

    def asked(self, mask: Node) -> frozenset[int]:
        """Sets of ids of which one each must be there for the mask to hold anywhere."""
        for node in sorted(walk(mask), key=lambda node: node.index):  # arguments come first
            if id(node) not in self.exact:
                exact = self.exact[id(node)] = self._exact(node)
                self.cell[id(node)] = self._cell(node) if exact is None else exact
                self.sets[id(node)] = frozenset() if exact is not None else self._sets(node)
        return self._all(mask)

    def _all(self, node: Node) -> frozenset[int]:
        cell = self.cell[id(node)]
        return _least(self.sets[id(node)] | ({cell} if cell != self.everything else set()))

    def _exact(self, node: Node) -> int | None:
        if id(node) in self.elements:
            return self.columns[self.elements[id(node)]]
        if node.op == "const" and node.type != REAL:
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

    def _sets(self, node: Node) -> frozenset[int]:
        match node.op:
            case "shift":
                return self._all(node.args[0])
            case "and":
                return _least(self._all(node.args[0]) | self._all(node.args[1]))
            case "or" | "xor":
                return _either(self._all(node.args[0]), self._all(node.args[1]))
            case "select":
                chosen = _least(self._all(node.args[0]) | self._all(node.args[1]))
                return _either(chosen, self._all(node.args[2]))
        return frozenset()


def _either(a: frozenset[int], b: frozenset[int]) -> frozenset[int]:
    return _least(frozenset(one | other for one in a for other in b))


def _least(sets: Iterable[int]) -> frozenset[int]:
    """The smallest sets; those that contain another say nothing new, and a few are enough."""
    kept: list[int] = []
    for ids in sorted(sets, key=lambda ids: (ids.bit_count(), ids)):
        if not any(one & ids == one for one in kept):
            kept.append(ids)
    return frozenset(kept[:MAX_SETS])


def element_nodes(planes_now: dict[str, Node | None]) -> dict[int, int]:
    """The bit of the element that each node holds, if slots hold these."""
    return {
        id(node): int(slot.removeprefix(_ELEMENT))
        for slot, node in planes_now.items()
        if slot.startswith(_ELEMENT) and node is not None
    }


def only_moves(step: Step, planes_before: dict[str, Node | None]) -> bool:
    """Whether a moment leaves each element as often as it was: it swaps cells, or writes no elements."""
    for slot, node in step.writes:
        if slot.startswith(_ELEMENT):
            movement = movement_of(node)
            if movement is None or movement.op != "swap" or movement.content is not planes_before[slot]:
                return False
    return True


def look(layout: Layout, asked: int) -> str:
    """The function that finds which of the ids asked for are there. A word is known by its low and high bits."""
    count = element_planes(layout)
    ids = [code for code in range(1 << count) if asked >> code & 1]
    if not ids:
        return "static void look(Context&) {}"
    low = count // 2
    planes = [layout.planes[f"{_ELEMENT}{bit}"] for bit in range(count)]

    def products(name: str, bits: range) -> list[str]:
        return [
            f"const V {name}{code} = "
            + (
                " & ".join(f"{'' if code >> i & 1 else '~'}b{bit}" for i, bit in enumerate(bits))
                or "~splat(0)"
            )
            + ";"
            for code in range(1 << len(bits))
        ]

    return "\n".join([
        "static void look(Context& c) {",
        *(f"const V* e{bit} = c.slot[{plane}]->data;" for bit, plane in enumerate(planes)),
        *(f"V id{code} = splat(0);" for code in ids),
        "for (size_t i = 0; i < c.g.cells(); i++) {",
        *(f"const V b{bit} = e{bit}[i];" for bit in range(count)),
        *products("low", range(low)),
        *products("high", range(low, count)),
        *(f"id{code} |= low{code & (1 << low) - 1} & high{code >> low};" for code in ids),
        "}",
        "c.present = " + " | ".join(f"(any(id{code}) ? 1ull << {code} : 0)" for code in ids) + ";",
        "}",
    ])  # fmt: skip
