"""The state of a ruleset's worlds: slots for the elements, stored properties and fields; and their sides."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from powderdsl.model.types import ELEMENT, Field, Kind, Pass, Property, Ruleset

SNAP = 2.0**-20
"""Smaller magnitudes of float fields are flushed to zero: motion stops, and backends never see denormal numbers."""


@dataclass(frozen=True)
class Slot:
    """One array of a world's state. `travels`: it moves with the element; `own`: defaults of elements, by id."""

    name: str
    kind: Kind
    default: Any
    travels: bool
    resets: bool = False
    of: frozenset[int] | None = None
    own: tuple[tuple[int, Any], ...] = ()

    @property
    def is_real(self) -> bool:
        return self.kind.name in ("real", "vec2")

    @property
    def planes(self) -> int:
        """The number of arrays of cells: 2 for vec2, else 1."""
        return 2 if self.kind.name == "vec2" else 1

    @cached_property
    def dtype(self) -> str:
        """The NumPy dtype of its storage."""
        return storage(self.kind)


def storage(kind: Kind) -> str:
    """The NumPy dtype in which values of a kind are stored: the smallest signed integer type that holds a range of
    integers, float32 for floats, uint8 for elements, flags and directions."""
    if kind.name in ("real", "vec2"):
        return "float32"
    if kind.name != "int":
        return "uint8"
    for dtype, bits in (("int8", 7), ("int16", 15)):
        if -(1 << bits) <= kind.lo and kind.hi < 1 << bits:
            return dtype
    return "int32"


def stored_range(kind: Kind) -> tuple[float, float]:
    """The smallest and largest number that values of a kind are stored or given as."""
    known = {"flag": (0, 1), "chance": (0, 1), "direction": (0, 7), "element": (0, 255)}
    return known.get(kind.name, (kind.lo, kind.hi))


def slots(ruleset: Ruleset) -> tuple[Slot, ...]:
    """All slots of a ruleset's worlds: the element, then stored properties and fields in the order of the ruleset."""
    stored = [Slot("element", ELEMENT, 0, travels=True)]
    stored += [Slot(prop.name, prop.kind, 0, travels=True) for prop in ruleset.properties if prop.stored]
    stored += [
        Slot(field.name, field.kind, field.default, field.at == "element", field.resets, field.of, field.own)
        for field in ruleset.fields
    ]
    place = {name: number for number, name in enumerate(ruleset.order)}
    return tuple(sorted(stored, key=lambda slot: place.get(slot.name, -1)))


def property_dtype(prop: Property) -> str:
    """The dtype of a property that is determined by the element."""
    if prop.kind.name == "chance":
        return "float32"
    if prop.kind.name == "int":
        return "int32" if storage(prop.kind) == "int32" else "int16"
    return "uint8"


def property_values(ruleset: Ruleset, name: str) -> list[float]:
    """The 256 values of a property by id, with parameters at their defaults; 0 for unused ids."""
    prop = ruleset.property(name)
    assert prop is not None
    defaults = {param.name: param.default for param in ruleset.params}
    values = [float(defaults[value]) if isinstance(value, str) else float(value) for value in prop.values]  # type: ignore[arg-type]
    return values + [0.0] * (256 - len(values))


def fresh_values(ruleset: Ruleset, slot: Slot) -> list[Any]:
    """The value of a slot in new cells of each element, by id: 256 numbers, or pairs."""
    if slot.name == "element":
        return [*range(256)]
    if ruleset.property(slot.name) is None:
        usual = [slot.default] * 256
        for identity, value in slot.own:
            usual[identity] = value
        return usual
    values = property_values(ruleset, slot.name)
    return values if slot.is_real else [*map(int, values)]


def holders(ruleset: Ruleset, slot: Slot) -> frozenset[int] | None:
    """The elements whose cells can have a value other than the default; None for all."""
    prop = ruleset.property(slot.name)
    return slot.of if prop is None else prop.stored


def scratch_slots(pass_: Pass) -> dict[str, Slot]:
    """The slots of a pass's scratch fields by name. They exist only during the pass and are not stored."""
    return {
        field.name: Slot(field.name, field.kind, field.default, travels=False, resets=True)
        for field in pass_.scratch
    }


def qualified_slots(ruleset: Ruleset) -> dict[str, str]:
    """The qualified name of each field and property, which does not depend on the other loaded packs."""
    symbols: list[Field | Property] = [*ruleset.fields, *ruleset.properties]
    return {symbol.name: f"{symbol.pack}.{symbol.word or symbol.name}" for symbol in symbols}


def slot_name(ruleset: Ruleset, name: str) -> str:
    """The name in `World.state` of a field or property by its plain or qualified name; other names unchanged."""
    return next((plain for plain, word in qualified_slots(ruleset).items() if word == name), name)


def fits(ruleset: Ruleset, size: tuple[int, ...]) -> bool:
    """True if the rules allow worlds of this size."""
    return all(side % ruleset.side_multiple == 0 for side in size[-2:])


def size_problem(ruleset: Ruleset, size: tuple[int, ...]) -> str:
    sides = f"rows and columns must be a multiple of {ruleset.side_multiple} each"
    return f"a world of {size[-2]}×{size[-1]} cells: with {ruleset.name}, {sides}"


def check_sides(ruleset: Ruleset, size: tuple[int, int]) -> None:
    """Raise ValueError for a size that the rules do not allow."""
    if not fits(ruleset, size):
        raise ValueError(size_problem(ruleset, size))


def fitting(ruleset: Ruleset, side: int) -> int:
    """The smallest allowed side that is at least this one."""
    return -(-side // ruleset.side_multiple) * ruleset.side_multiple
