"""Checks of given values. Those of cells are checked in parts: a check takes many times the memory of what it checks."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Any

from powderdsl.diagnostics import suggest
from powderdsl.model.state import SNAP, Slot, slots, stored_range
from powderdsl.model.types import Ruleset
from powderdsl.targets.array_kind import Array, ArrayKind

CHUNK = 1 << 20
"""Cells that are looked at together."""


def given_mapping(name: str, given: Any) -> Mapping[str, Any]:
    """A mapping from outside. Raises TypeError."""
    if not isinstance(given, Mapping):
        raise TypeError(f"{name} takes a mapping from names to values, found {type(given).__name__}")
    return given


def unknown_name(kind: str, name: str, known: Iterable[str], kinds: str = "") -> KeyError:
    """The error for a name that is not known, with the nearest ones."""
    return KeyError(f"no {kind} `{name}`; {'; '.join(suggest(name, known, kinds or f'{kind}s'))}")


def unknown_slot(ruleset: Ruleset, name: str) -> KeyError:
    """The error for a name that is neither a field nor a property."""
    known = [*(slot.name for slot in slots(ruleset)), *(prop.name for prop in ruleset.properties)]
    return KeyError(
        f"{ruleset.name} has no field or property `{name}`; {'; '.join(suggest(name, known, 'it has'))}"
    )


def check_ids(kind: ArrayKind, ids: Array, name: str, ruleset: Ruleset) -> None:
    """Raises ValueError for ids that a ruleset does not have."""
    xp, known = kind.xp, _holders(kind, (element.id for element in ruleset.elements))
    flat = ids.reshape(-1)
    for start in range(0, len(flat), CHUNK):
        values = flat[start : start + CHUNK]
        if values.dtype == xp.uint8:
            good = known[kind.as_index(values)]
        else:
            values = xp.asarray(values, dtype=xp.int64)
            good = (values >= 0) & (values < 256) & known[xp.clip(values, 0, 255)]
        if not bool(good.all()):
            at = good.tolist().index(False)
            place = _place(start + at, tuple(ids.shape))
            raise ValueError(f"{name}{place} is {int(values[at])}: no element of {ruleset.name} has this id")


def _holders(kind: ArrayKind, ids: Iterable[int]) -> Array:
    """Flags by id: bool [256]."""
    some = set(ids)
    return kind.put([number in some for number in range(256)])


def _place(index: int, shape: tuple[int, ...]) -> list[int]:
    """The place of the n-th cell in C order."""
    found = []
    for side in reversed(shape):
        index, rest = divmod(index, side)
        found.append(rest)
    return found[::-1]


def looked_up(kind: ArrayKind, table: Array, ids: Array, dtype: Any) -> Array:
    """The entry of a table [256] or [256, 2] for each of the ids [B, H, W]: of `dtype`, [B, H, W] or [B, 2, H, W]."""
    vectors = table.ndim == 2
    shape = tuple(ids.shape)
    out = kind.empty(dtype, (shape[0], 2, *shape[1:]) if vectors else shape)
    for rows in _rows(shape):
        found = table[kind.as_index(ids[:, rows])]
        out[..., rows, :] = kind.xp.moveaxis(found, -1, 1) if vectors else found
    return out


def _rows(shape: tuple[int, ...]) -> Iterator[slice]:
    """The rows of worlds [B, H, W] or [B, 2, H, W] in parts."""
    step = max(1, CHUNK // max(1, shape[0] * shape[-1]))
    return (slice(start, start + step) for start in range(0, shape[-2], step))


def checked_floats(kind: ArrayKind, array: Array, ids: Array, slot: Slot, ruleset: Ruleset) -> Array:
    """Values as a float32 slot holds them, in memory of their own. Raises ValueError.

    `ids` are the elements of the cells, of which some may not have the field.
    """
    xp = kind.xp
    if not bool(xp.isfinite(array).all()):
        raise ValueError(f"{slot.name} has values that are not finite")
    floats = kind.empty(xp.float32, tuple(array.shape))
    for rows in _rows(floats.shape):
        part = xp.clip(xp.asarray(array[..., rows, :], dtype=xp.float32), slot.kind.lo, slot.kind.hi)
        floats[..., rows, :] = xp.where(xp.abs(part) < SNAP, 0, part)
        if slot.of is not None:
            without = ~_holders(kind, slot.of)[kind.as_index(ids[:, rows])]
            defaults = slot.default if isinstance(slot.default, tuple) else (slot.default,)
            parts = [floats[:, i, rows, :] for i in range(2)] if slot.planes == 2 else [floats[:, rows, :]]
            for values, default in zip(parts, defaults, strict=True):
                if bool(((values != default) & without).any()):
                    raise _misplaced(slot, slot.of, ruleset)
    return floats


def _misplaced(slot: Slot, limited: Collection[int], ruleset: Ruleset) -> ValueError:
    names = ", ".join(e.name for e in ruleset.elements if e.id in limited)
    return ValueError(f"{slot.name} can only differ from its default in cells of: {names}")


def checked_integers(
    kind: ArrayKind, array: Array, ids: Array, slot: Slot, usual: Array | None, ruleset: Ruleset
) -> Array:
    """Values [B, H, W] as a slot of integers holds them, in memory of their own.

    Args:
        ids: the elements of the cells.
        usual: the value in cells that cannot hold one of their own, [256] by id; None for the slot's default.

    Raises:
        TypeError, ValueError: values that the slot cannot hold, or not in these cells.
    """
    out = kind.empty(getattr(kind.xp, slot.dtype), tuple(array.shape))
    for rows in _rows(out.shape):
        out[:, rows] = _integers(kind, array[:, rows], ids[:, rows], slot, usual, ruleset)
    return out


def _integers(
    arrays: ArrayKind, array: Array, ids: Array, slot: Slot, usual: Array | None, ruleset: Ruleset
) -> Array:
    xp, kind = arrays.xp, slot.kind
    if arrays.sort(array) == "float" and not bool((array == xp.floor(array)).all()):
        raise TypeError(f"{slot.name} takes integers, found {array.dtype}")
    values = xp.asarray(array, dtype=xp.int64)
    if kind.name == "element":
        check_ids(arrays, array if array.dtype == xp.uint8 else values, slot.name, ruleset)
    lo, hi = stored_range(kind)
    least, most = int(values.min()), int(values.max())
    if least < lo or most > hi:
        raise ValueError(f"{slot.name} takes {lo:g}..{hi:g}, found {least}..{most}")
    prop = ruleset.property(slot.name)
    limited = prop.stored if prop is not None else slot.of
    if limited is not None:
        places = arrays.as_index(ids)
        default = int(slot.default) if usual is None else xp.asarray(usual[places], dtype=xp.int64)
        if bool(((values != default) & ~_holders(arrays, limited)[places]).any()):
            raise _misplaced(slot, limited, ruleset)
    return values


# Parameters

BATCH_SIZES = 16
"""How many batch sizes the defaults are kept for."""


class Parameters:
    """Parameters of one ruleset as float64 [B]."""

    def __init__(self, ruleset: Ruleset, kind: ArrayKind):
        self._known = {param.name: param for param in ruleset.params}
        self._kind = kind
        self.defaults = lru_cache(BATCH_SIZES)(self._defaults)
        """The defaults for a batch: the same mapping for the same size, which programs recognize. Nobody writes to it."""

    def _defaults(self, batch: int) -> Mapping[str, Array]:
        values = {name: [float(param.default)] * batch for name, param in self._known.items()}
        return {name: self._kind.put(value, "float64") for name, value in values.items()}

    def checked(self, params: Mapping[str, Any], batch: int) -> Mapping[str, Array]:
        """All parameters: copies of given values, and defaults. Raises KeyError, TypeError, ValueError."""
        values = self.defaults(batch)
        if not params:
            return values
        values, xp = dict(values), self._kind.xp
        for name, value in params.items():
            if name not in self._known:
                raise unknown_name("parameter", name, self._known)
            kind = self._known[name].kind
            lo, hi = (0.0, 1.0) if kind.name in ("chance", "flag") else (kind.lo, kind.hi)
            array = xp.asarray(self._kind.given(value, name), dtype=xp.float64)
            if array.ndim > 1 or (array.ndim == 1 and len(array) != batch):
                raise ValueError(f"{name} takes one value or {batch}, found shape {list(array.shape)}")
            if not bool(((array >= lo) & (array <= hi)).all()):
                raise ValueError(f"{name} takes {lo:g}..{hi:g}")
            if kind.name in ("int", "flag") and not bool((array == xp.floor(array)).all()):
                raise ValueError(f"{name} takes integers")
            values[name] = self._kind.copied(xp.broadcast_to(array, (batch,)))
        return values
