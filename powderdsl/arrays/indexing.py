"""What an index selects: ranges along axes, or a list of places."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from math import prod
from typing import Any, NamedTuple

from powderdsl.arrays.movement import FEW, Shape, expanded, places_of, steps_of

_WIDE = 8


class Picks(NamedTuple):
    """An array of integers that is used as an index."""

    shape: Shape
    values: Sequence[int]


class Mask(NamedTuple):
    """An array of flags that is used as an index: a byte for each cell."""

    shape: Shape
    flags: bytes


class Ranges(NamedTuple):
    """Places along each axis, and the shape of the result."""

    parts: list[range]
    shape: Shape


class Places(NamedTuple):
    """Places in elements of each block, and the shape of the result."""

    places: list[int]
    shape: Shape
    block: int


def selected(key: tuple[Any, ...], shape: Shape) -> Ranges | Places:
    """What a key selects: integers, slices, None, Ellipsis, Picks and Masks. Raises IndexError."""
    items = _complete(key, shape)
    arrays = sum(isinstance(one, (Picks, Mask)) for one in items)
    if arrays:
        others = sum(isinstance(one, int) for one in items)
        if (
            arrays == 1 and not others and items[0] == slice(None) and shape[0] >= FEW
        ):  # the same in each block
            inner = _places(items[1:], shape[1:])
            return Places(inner.places, (shape[0], *inner.shape), prod(shape[1:]))
        return _places(items, shape)
    parts: list[range] = []
    found: list[int] = []
    for one in items:
        if one is None:
            found.append(1)
        elif isinstance(one, slice):
            parts.append(range(*one.indices(shape[len(parts)])))
            found.append(len(parts[-1]))
        else:
            place = _within(one, shape[len(parts)], len(parts))
            parts.append(range(place, place + 1))
    return Ranges(parts, tuple(found))


def _complete(key: tuple[Any, ...], shape: Shape) -> list[Any]:
    """One item for each axis, or for the axes that a mask takes, and None for new ones."""
    axes = sum(
        0 if one is None or one is ... else len(one.shape) if isinstance(one, Mask) else 1 for one in key
    )
    if axes > len(shape):
        raise IndexError(f"too many indices: the array has {len(shape)} axes, found {axes}")
    rest = [slice(None)] * (len(shape) - axes)
    items = list(key)
    dots = [place for place, one in enumerate(items) if one is ...]
    if len(dots) > 1:
        raise IndexError("an index can only have a single ellipsis ('...')")
    return items[: dots[0]] + rest + items[dots[0] + 1 :] if dots else items + rest


def _within(place: int, side: int, axis: int) -> int:
    if not -side <= place < side:
        raise IndexError(f"index {place} is out of bounds for axis {axis} with size {side}")
    return place % side


def _places(items: list[Any], shape: Shape) -> Places:
    steps = steps_of(shape)
    axis = 0
    chosen: list[tuple[Shape, list[int]]] = []
    """Arrays and integers, as places to be added up."""
    where: list[int] = []
    sides: list[list[int] | None] = []
    """The places along each axis of the result; None for a new one, and where the first array stands."""
    for number, one in enumerate(items):
        if one is None:
            sides.append([0])
        elif isinstance(one, slice):
            sides.append([place * steps[axis] for place in range(*one.indices(shape[axis]))])
            axis += 1
        else:
            if not where:
                sides.append(None)
            where.append(number)
            if isinstance(one, Mask):
                chosen.append(_of_mask(one, shape, axis, steps))
                axis += len(one.shape)
            else:
                picks = one if isinstance(one, Picks) else Picks((), [one])
                values = _scaled(picks.values, shape[axis], axis, steps[axis])
                chosen.append((picks.shape, values))
                axis += 1
    together, offsets = _added(chosen)
    first = sides.index(None)
    if where != [*range(where[0], where[-1] + 1)]:  # arrays that are apart come first
        sides.insert(0, sides.pop(first))
        first = 0
    lists = [offsets if side is None else side for side in sides]
    lengths: list[Shape] = [together if side is None else (len(side),) for side in sides]
    return Places(places_of(lists), tuple(length for part in lengths for length in part), prod(shape))


def _scaled(values: Sequence[int], side: int, axis: int, step: int) -> list[int]:
    if values and not (min(values) >= 0 and max(values) < side):
        values = [_within(value, side, axis) for value in values]
    return [value * step for value in values] if step != 1 else [*values]


def _of_mask(mask: Mask, shape: Shape, axis: int, steps: Shape) -> tuple[Shape, list[int]]:
    covered = shape[axis : axis + len(mask.shape)]
    if mask.shape != covered:
        raise IndexError(f"boolean index of shape {mask.shape} does not match {covered}")
    step = steps[axis + len(mask.shape) - 1] if mask.shape else 1
    found = [*compress(range(0, prod(covered) * step, step), mask.flags)]
    return (len(found),), found


def _added(chosen: list[tuple[Shape, list[int]]]) -> tuple[Shape, list[int]]:
    """The shape of arrays together, and the sums of their places."""
    if len(chosen) == 1:
        return chosen[0]
    try:
        shape = broadcast([one for one, _ in chosen])
    except ValueError:
        raise IndexError("arrays in an index do not fit together") from None
    total = [0] * prod(shape)
    for one, values in chosen:
        raw = b"".join(value.to_bytes(_WIDE, "little") for value in values)
        wide = memoryview(expanded(raw, _WIDE, one, shape)).cast("Q").tolist()
        total = [*map(int.__add__, total, wide)]
    return shape, total


def broadcast(shapes: Sequence[Shape]) -> Shape:
    """The shape of arrays together. Raises ValueError if they do not fit."""
    first, last = shapes[0], shapes[-1]
    if first == last and (len(shapes) <= 2 or all(shape == first for shape in shapes)):
        return first
    if len(shapes) == 2 and not (first and last):  # a scalar
        return first or last
    found = [1] * max(map(len, shapes))
    for shape in shapes:
        for place, side in enumerate(shape, len(found) - len(shape)):
            if side != found[place] and side != 1:
                if found[place] != 1:
                    words = " ".join(map(str, shapes)).replace(" ", "")
                    raise ValueError(f"operands could not be broadcast together with shapes {words}")
                found[place] = side
    return tuple(found)
