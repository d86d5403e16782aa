"""Checks of callers' values. Cells are checked in chunks, since a check takes many times their memory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from powderdsl.diagnostics import with_suggestion
from powderdsl.model.state import SNAP, Slot, holders, slots, stored_range
from powderdsl.model.types import Param, Ruleset
from powderdsl.targets.array_kind import Array, ArrayKind

CHUNK = 1 << 20
"""Number of cells checked at a time."""


def check_mapping(name: str, value: Any) -> Mapping[str, Any]:
    """The value, if it is a mapping. Raises TypeError."""
    if not isinstance(value, Mapping):
        raise TypeError(f"{name} takes a mapping from names to values, found {type(value).__name__}")
    return value


def unknown_name(kind: str, name: str, known: Iterable[str], kinds: str = "") -> KeyError:
    """The error for an unknown name, with the nearest names."""
    return KeyError(with_suggestion(f"no {kind} `{name}`", name, known, kinds or f"{kind}s"))


def unknown_slot(ruleset: Ruleset, name: str) -> KeyError:
    """The error for a name that is neither a field nor a property."""
    if ruleset.element(name) is not None:
        return KeyError(f"`{name}` is an element, not a field: world.count({name!r}) counts its cells")
    known = [*(slot.name for slot in slots(ruleset)), *(prop.name for prop in ruleset.properties)]
    message = f"{ruleset.name} has no field or property `{name}`"
    return KeyError(with_suggestion(message, name, known, "it has"))


def check_ids(kind: ArrayKind, ids: Array, name: str, ruleset: Ruleset) -> None:
    """Raise ValueError for ids that a ruleset does not have."""
    xp, known = kind.xp, _flags_by_id(kind, (element.id for element in ruleset.elements))
    flat = ids.reshape(-1)
    for start in range(0, len(flat), CHUNK):
        values = xp.asarray(flat[start : start + CHUNK], dtype=xp.int64)
        good = (values >= 0) & (values < 256) & known[xp.clip(values, 0, 255)]
        if not bool(good.all()):
            at = good.tolist().index(False)
            index, place = start + at, list[int]()
            for side in reversed(ids.shape):
                index, rest = divmod(index, side)
                place.insert(0, rest)
            raise ValueError(f"{name}{place} is {int(values[at])}: no element of {ruleset.name} has this id")


def _flags_by_id(kind: ArrayKind, ids: Iterable[int]) -> Array:
    """Flags by id: bool [256]."""
    members = set(ids)
    return kind.put([number in members for number in range(256)])


def checked_values(
    kind: ArrayKind, array: Array, ids: Array, fresh: Array, slot: Slot, ruleset: Ruleset
) -> Array:
    """A new array of values [B, H, W] or [B, 2, H, W] in a slot's dtype.

    `ids` are the elements of the cells, some of which may lack the field or property; `fresh` are the values in new
    cells of these elements. Raises TypeError or ValueError for values that the slot, or these cells, cannot have.
    """
    if kind.sort(array) == "complex":
        raise TypeError(f"{slot.name} takes floats, found {array.dtype}")
    if slot.is_real and not bool(kind.xp.isfinite(array).all()):
        raise ValueError(f"{slot.name} has values that are not finite")
    xp = kind.xp
    limited = holders(ruleset, slot)
    out = kind.zeros(slot.dtype, tuple(array.shape))
    step = max(1, CHUNK // max(1, out.shape[0] * out.shape[-1]))
    for start in range(0, out.shape[-2], step):
        rows = slice(start, start + step)
        if slot.is_real:
            values = xp.clip(xp.asarray(array[..., rows, :], dtype=xp.float32), slot.kind.lo, slot.kind.hi)
            values = xp.where(xp.abs(values) < SNAP, 0, values)
        else:
            values = _integers(kind, array[..., rows, :], slot, ruleset)
        out[..., rows, :] = values
        if limited is None:
            continue
        without = ~kind.entries(_flags_by_id(kind, limited), ids[:, rows])
        differs = values != fresh[..., rows, :]
        if bool((differs & (without[:, None] if slot.planes == 2 else without)).any()):
            names = ", ".join(element.name for element in ruleset.elements if element.id in limited)
            raise ValueError(f"{slot.name} can only differ from its default in cells of: {names}")
    return out


def _integers(kind: ArrayKind, array: Array, slot: Slot, ruleset: Ruleset) -> Array:
    xp = kind.xp
    if kind.sort(array) == "float" and not bool((array == xp.floor(array)).all()):
        raise TypeError(f"{slot.name} takes integers, found {array.dtype}")
    values = xp.asarray(array, dtype=xp.int64)
    if slot.kind.name == "element":
        check_ids(kind, values, slot.name, ruleset)
    lo, hi = stored_range(slot.kind)
    least, most = int(values.min()), int(values.max())
    if least < lo or most > hi:
        raise ValueError(f"{slot.name} takes {lo:g}..{hi:g}, found {least}..{most}")
    return values


def checked_parameter(kind: ArrayKind, value: Any, param: Param, batch: int) -> Array:
    """Values of a parameter as a new array float64 [B]. Raises TypeError, ValueError."""
    xp, name = kind.xp, param.name
    lo, hi = stored_range(param.kind)
    array = xp.asarray(kind.convert(value, name), dtype=xp.float64)
    if array.ndim > 1 or (array.ndim == 1 and len(array) != batch):
        raise ValueError(f"{name} takes one value or {batch}, found shape {list(array.shape)}")
    if not bool(((array >= lo) & (array <= hi)).all()):
        raise ValueError(f"{name} takes {lo:g}..{hi:g}")
    if param.kind.name in ("int", "flag") and not bool((array == xp.floor(array)).all()):
        raise ValueError(f"{name} takes integers")
    return kind.copied(xp.broadcast_to(array, (batch,)))
