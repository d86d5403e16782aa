"""Checks of given values. Those of cells are checked in parts: a check takes many times the memory of what it checks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from powderdsl.diagnostics import suggest
from powderdsl.model.state import SNAP, Slot
from powderdsl.model.types import Ruleset

CHUNK = 1 << 20
"""Cells that are looked at together."""


def given_tensor(value: Any, name: str, device: torch.device) -> Tensor:
    """Values from outside as a tensor, which may share their memory. Raises TypeError."""
    flags = getattr(value, "flags", None)
    if getattr(flags, "writeable", True) is False:
        value = value.copy()  # torch warns of arrays that it could write to and may not
    try:
        return torch.as_tensor(value, device=device)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise TypeError(f"{name}: {' '.join(str(error).split())}") from None


def given_mapping(name: str, given: Any) -> Mapping[str, Any]:
    """A mapping from outside. Raises TypeError."""
    if not isinstance(given, Mapping):
        raise TypeError(f"{name} takes a mapping from names to values, found {type(given).__name__}")
    return given


def unknown_name(kind: str, name: str, known: Iterable[str], kinds: str = "") -> KeyError:
    """The error for a name that is not known, with the nearest ones."""
    return KeyError(f"no {kind} `{name}`; {'; '.join(suggest(name, known, kinds or f'{kind}s'))}")


def check_ids(ids: Tensor, name: str, ruleset: Ruleset) -> None:
    """Raises ValueError for ids that a ruleset does not have."""
    known = torch.zeros(256, dtype=torch.bool, device=ids.device)
    known[[element.id for element in ruleset.elements]] = True
    flat = ids.reshape(-1)
    for start in range(0, len(flat), CHUNK):
        values = flat[start : start + CHUNK].to(torch.int64)
        good = (values >= 0) & (values < 256) & known[values.clamp(0, 255)]
        if not bool(good.all()):
            at = int((~good).nonzero()[0])
            place = [int(one) for one in np.unravel_index(start + at, tuple(ids.shape))]
            raise ValueError(f"{name}{place} is {int(values[at])}: no element of {ruleset.name} has this id")


def looked_up(table: Tensor, ids: Tensor, dtype: torch.dtype) -> Tensor:
    """The entry of a table [256] or [256, 2] for each of the ids [B, H, W]: of `dtype`, [B, H, W] or [B, 2, H, W]."""
    vectors = table.ndim == 2
    shape = (len(ids), 2, *ids.shape[1:]) if vectors else ids.shape
    out = torch.empty(shape, dtype=dtype, device=ids.device)
    for rows in _rows(ids):
        found = table[ids[:, rows].int()]
        if vectors:
            out[:, :, rows] = found.movedim(-1, 1)
        else:
            out[:, rows] = found
    return out


def _rows(ids: Tensor) -> Iterator[slice]:
    """The rows of worlds [B, H, W] in parts."""
    batch, height, width = ids.shape
    step = max(1, CHUNK // max(1, batch * width))
    return (slice(start, start + step) for start in range(0, height, step))


def checked_floats(tensor: Tensor, slot: Slot) -> Tensor:
    """Values as a float32 slot holds them, in memory of their own. Raises ValueError."""
    if not bool(torch.isfinite(tensor).all()):
        raise ValueError(f"{slot.name} has values that are not finite")
    floats = tensor.to(torch.float32).clamp(slot.kind.lo, slot.kind.hi).contiguous()
    for part in floats.view(-1).split(CHUNK):
        part.masked_fill_(part.abs() < SNAP, 0)
    return floats


def checked_integers(
    tensor: Tensor, ids: Tensor, slot: Slot, usual: Tensor | None, ruleset: Ruleset
) -> Tensor:
    """Values [B, H, W] as a slot of integers holds them, in memory of their own.

    Args:
        ids: the elements of the cells.
        usual: the value in cells that cannot hold one of their own, [256] by id; None for the slot's default.

    Raises:
        TypeError, ValueError: values that the slot cannot hold, or not in these cells.
    """
    out = torch.empty(tensor.shape, dtype=getattr(torch, slot.dtype), device=ids.device)
    for rows in _rows(ids):
        out[:, rows] = _integers(tensor[:, rows], ids[:, rows], slot, usual, ruleset)
    return out


def _integers(tensor: Tensor, ids: Tensor, slot: Slot, usual: Tensor | None, ruleset: Ruleset) -> Tensor:
    kind = slot.kind
    if tensor.dtype.is_floating_point and not bool((tensor == tensor.round()).all()):
        raise TypeError(f"{slot.name} takes integers, found {tensor.dtype}")
    values = tensor.to(torch.int64)
    if kind.name == "element":
        check_ids(values, slot.name, ruleset)
    lo, hi = {"flag": (0, 1), "direction": (0, 7), "element": (0, 255)}.get(kind.name, (kind.lo, kind.hi))
    if bool(((values < lo) | (values > hi)).any()):
        raise ValueError(f"{slot.name} takes {lo:g}..{hi:g}, found {int(values.min())}..{int(values.max())}")
    prop = ruleset.property(slot.name)
    limited = prop.stored if prop is not None else slot.of
    if limited is not None:
        default = torch.full_like(values, int(slot.default)) if usual is None else usual[ids.int()].long()
        holders = torch.isin(ids.long(), torch.tensor(sorted(limited), device=ids.device))
        if bool(((values != default) & ~holders).any()):
            names = ", ".join(e.name for e in ruleset.elements if e.id in limited)
            raise ValueError(f"{slot.name} can only differ from its default in cells of: {names}")
    return values
