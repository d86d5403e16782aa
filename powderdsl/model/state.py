"""What a world of a ruleset holds: one slot for the elements, each stored property, and each field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from powderdsl.model.types import ELEMENT, Field, Kind, Pass, Property, Ruleset

SNAP = 2.0**-20
"""Real fields are kept to multiples of nothing, but what is smaller than this is zero: motion dies out, and no
backend ever meets denormal numbers."""


@dataclass(frozen=True)
class Slot:
    """One array of a world's state.

    `dtype` is the NumPy name of its storage: uint8 for elements, flags and directions, the smallest signed
    integer type that holds the range of integers, float32 for floats. `planes` is 2 for vec2, else 1.
    """

    name: str
    kind: Kind
    default: Any
    travels: bool
    resets: bool
    of: frozenset[int] | None
    dtype: str
    planes: int
    own: tuple[tuple[int, Any], ...] = ()
    """Defaults of single elements, by id."""

    def fresh(self, identity: int) -> Any:
        """The value of a fresh cell of an element, of a field."""
        return dict(self.own).get(identity, self.default)

    @property
    def is_real(self) -> bool:
        return self.kind.name in ("real", "vec2")


def storage(kind: Kind) -> str:
    """The NumPy dtype in which values of a kind are stored."""
    if kind.name in ("real", "vec2"):
        return "float32"
    if kind.name != "int":
        return "uint8"
    for dtype, bits in (("int8", 7), ("int16", 15)):
        if -(1 << bits) <= kind.lo and kind.hi < 1 << bits:
            return dtype
    return "int32"


def qualified_slots(ruleset: Ruleset) -> dict[str, str]:
    """The name of each field and property that it has whatever else is loaded."""
    held: list[Field | Property] = [*ruleset.fields, *ruleset.properties]
    return {one.name: f"{one.pack}.{one.word or one.name}" for one in held}


def slot_name(ruleset: Ruleset, name: str) -> str:
    """The name in `World.state` of a field or property by its plain or qualified name; others as they are."""
    return next((plain for plain, word in qualified_slots(ruleset).items() if word == name), name)


def slots(ruleset: Ruleset) -> tuple[Slot, ...]:
    """All slots of a ruleset's worlds: the element, then stored properties and fields in the order of the ruleset."""
    found = [Slot("element", ELEMENT, 0, True, False, None, "uint8", 1)]
    for prop in ruleset.properties:
        if prop.stored:
            found.append(Slot(prop.name, prop.kind, 0, True, False, None, storage(prop.kind), 1))
    for item in ruleset.fields:
        planes = 2 if item.kind.name == "vec2" else 1
        found.append(
            Slot(
                item.name,
                item.kind,
                item.default,
                item.at == "element",
                item.resets,
                item.of,
                storage(item.kind),
                planes,
                item.own,
            )
        )
    place = {name: number for number, name in enumerate(ruleset.order)}
    return tuple(sorted(found, key=lambda slot: place.get(slot.name, -1)))


def scratch_slots(pass_: Pass) -> dict[str, Slot]:
    """The slots of a pass's scratch fields by name. They live in the pass and are not stored."""
    return {
        item.name: Slot(
            item.name, item.kind, item.default, False, True, None, "", 2 if item.kind.name == "vec2" else 1
        )
        for item in pass_.scratch
    }
