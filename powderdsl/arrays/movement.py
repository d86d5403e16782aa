"""Elements moved about in memory: memory is `bytes` in C order, of elements of some size."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from itertools import chain
from math import prod
from operator import itemgetter

Shape = tuple[int, ...]

_UNSIGNED = {1: "B", 2: "H", 4: "I", 8: "Q"}


def taken(raw: bytes, size: int, places: Sequence[int]) -> bytes:
    """The elements at some places, counted in elements."""
    if not len(places):
        return b""
    if len(places) == 1:
        return raw[places[0] * size : (places[0] + 1) * size]
    if size == 1:
        return bytes(itemgetter(*places)(raw))
    code = _UNSIGNED[size]
    return array(code, itemgetter(*places)(array(code, bytes(raw)))).tobytes()


def put(raw: bytes, size: int, places: Sequence[int], values: bytes) -> bytes:
    """The memory with other elements at some places; of several for one place the last one stays."""
    changed, given = typed(raw, size), typed(values, size)
    for place, value in zip(places, given, strict=True):
        changed[place] = value
    return changed.tobytes()


def typed(raw: bytes, size: int) -> array[int]:
    """A copy of the memory whose elements are numbers."""
    return array(_UNSIGNED[size], bytes(raw))


FEW = 6
"""Blocks from which on it pays to move the same element of all blocks at once."""


def shuffled(raw: bytes, size: int, block: int, places: Sequence[int]) -> bytes:
    """In each block of some elements those at `places`, in this order."""
    count = len(raw) // (size * block) if block else 0
    if not count or not len(places):
        return b""
    if count < FEW:
        return taken(
            raw, size, [start + place for start in range(0, count * block, block) for place in places]
        )
    source, found = typed(raw, size), typed(bytes(count * len(places) * size), size)
    for number, place in enumerate(places):
        found[number :: len(places)] = source[place::block]
    return found.tobytes()


def put_shuffled(raw: bytes, size: int, block: int, places: Sequence[int], values: bytes) -> bytes:
    """The memory with other elements at `places` of each block."""
    changed, given = typed(raw, size), typed(values, size)
    for number, place in enumerate(places):
        changed[place::block] = given[number :: len(places)]
    return changed.tobytes()


def looked_up(raw: bytes, row: int, numbers: bytes) -> bytes:
    """The rows of some bytes each that have these numbers."""
    found = bytearray(len(numbers) * row)
    for place in range(row):
        found[place::row] = numbers.translate(raw[place::row][:256].ljust(256, b"\0"))
    return bytes(found)


def steps_of(shape: Shape) -> Shape:
    """How many elements lie between neighbors along each axis."""
    found, step = [], 1
    for side in reversed(shape):
        found.append(step)
        step *= side
    return tuple(reversed(found))


def _runs(shape: Shape, parts: Sequence[range]) -> tuple[list[int], int]:
    """Where runs of elements that lie together begin, and how long they are; 0 if there are none."""
    steps = steps_of(shape)
    axis = len(shape)
    while axis and parts[axis - 1] == range(shape[axis - 1]):  # whole axes at the end lie together
        axis -= 1
    if axis == 0:
        return [0], prod(shape)
    if parts[axis - 1].step != 1 and len(parts[axis - 1]) > 1:
        return places_of(_offsets(parts[:axis], steps)), steps[axis - 1]
    starts = places_of(_offsets((*parts[: axis - 1], parts[axis - 1][:1]), steps))
    return starts, len(parts[axis - 1]) * steps[axis - 1]


def sliced(raw: bytes, size: int, shape: Shape, parts: Sequence[range]) -> bytes:
    """The elements at the places `parts` along the axes."""
    if any(not len(part) for part in parts):
        return b""
    inner = _in_blocks(shape, parts)
    if inner is not None:
        return shuffled(raw, size, prod(shape[1:]), inner)
    starts, length = _runs(shape, parts)
    if len(starts) == 1:
        return raw[starts[0] * size : (starts[0] + length) * size]
    if length == 1:
        return _every(raw, size, starts)
    return b"".join([raw[start * size : (start + length) * size] for start in starts])


def _in_blocks(shape: Shape, parts: Sequence[range]) -> list[int] | None:
    """The places in each world of a batch, if it pays to move them in all worlds at once."""
    if len(shape) < 2 or shape[0] < FEW or parts[0] != range(shape[0]):
        return None
    starts, length = _runs(shape[1:], parts[1:])
    if length == prod(shape[1:]) or len(starts) * length > 4 * shape[0]:
        return None
    return [start + place for start in starts for place in range(length)]


def put_sliced(raw: bytes, size: int, shape: Shape, parts: Sequence[range], values: bytes) -> bytes:
    """The memory with other elements at the places `parts` along the axes."""
    if any(not len(part) for part in parts):
        return raw
    inner = _in_blocks(shape, parts)
    if inner is not None:
        return put_shuffled(raw, size, prod(shape[1:]), inner, values)
    starts, length = _runs(shape, parts)
    if length == 1:
        return put(raw, size, starts, values)
    changed = bytearray(raw)
    for number, start in enumerate(starts):
        changed[start * size : (start + length) * size] = values[
            number * length * size : (number + 1) * length * size
        ]
    return bytes(changed)


def _offsets(parts: Sequence[range], steps: Shape) -> list[list[int]]:
    return [[place * step for place in part] for part, step in zip(parts, steps, strict=False)]


def _every(raw: bytes, size: int, places: list[int]) -> bytes:
    """Single elements; by a slice where they lie at equal distances."""
    step = places[1] - places[0]
    if step > 0 and places == [*range(places[0], places[-1] + 1, step)]:
        if size == 1:
            return raw[places[0] : places[-1] + 1 : step]
        return array(_UNSIGNED[size], bytes(raw))[places[0] : places[-1] + 1 : step].tobytes()
    return taken(raw, size, places)


def expanded(raw: bytes, size: int, shape: Shape, target: Shape) -> bytes:
    """Memory of `shape`, repeated along axes of length 1, as memory of `target`."""
    if shape == target:
        return raw
    shape = (1,) * (len(target) - len(shape)) + shape
    inner = size  # bytes below the axis
    axis = len(target)
    while axis:
        axis -= 1
        if shape[axis] == target[axis]:
            inner *= target[axis]
            continue
        repeats = 1
        while axis >= 0 and shape[axis] == 1:  # neighbors that are repeated together
            repeats *= target[axis]
            axis -= 1
        axis += 1
        raw = repeated(raw, inner, repeats)
        inner *= repeats
    return raw


def repeated(raw: bytes, length: int, times: int) -> bytes:
    """Each block of some bytes several times over."""
    if times == 1:
        return raw
    if len(raw) == length:
        return raw * times
    if length == 1 and times < 64:
        wide = bytearray(len(raw) * times)
        for place in range(times):
            wide[place::times] = raw
        return bytes(wide)
    return b"".join([raw[at : at + length] * times for at in range(0, len(raw), length)])


def permuted(raw: bytes, size: int, shape: Shape, axes: Sequence[int]) -> bytes:
    """Memory with the axes in another order."""
    kept = len(axes)
    while kept and axes[kept - 1] == kept - 1:
        kept -= 1
    if kept == 0 or not raw:
        return raw
    first = next(place for place in range(kept) if axes[place] != place)
    steps = steps_of(shape[:kept])
    block = prod(shape[kept:])
    if block > 1:
        length = block * size
        ranges = [range(0, shape[axis] * steps[axis], steps[axis]) for axis in axes[:kept]]
        return b"".join([raw[place * length : (place + 1) * length] for place in places_of(ranges)])
    count, inner = prod(shape[:first]), prod(shape[first:kept])
    turn = axes[first]
    if count < FEW and [*axes[first:kept]] == [*range(turn, kept), *range(first, turn)]:
        columns, length = prod(shape[turn:kept]), inner * size
        blocks = (raw[start : start + length] for start in range(0, len(raw), length))
        return b"".join([_turned(one, size, columns) for one in blocks])
    ranges = [range(0, shape[axis] * steps[axis], steps[axis]) for axis in axes[first:kept]]
    return shuffled(raw, size, inner, places_of(ranges))


def _turned(raw: bytes, size: int, columns: int) -> bytes:
    """Rows and columns exchanged."""
    source = typed(raw, size)
    rows = len(source) // columns
    if columns <= rows:
        return b"".join([source[column::columns] for column in range(columns)])
    found = typed(raw, size)
    for row in range(rows):
        found[row::rows] = source[row * columns : (row + 1) * columns]
    return found.tobytes()


def places_of(ranges: Sequence[Sequence[int]]) -> list[int]:
    """The sums of one number from each, the last one running fastest."""
    places = [0]
    for one in ranges:
        places = [place + offset for place in places for offset in one]
    return places


def joined(raws: Sequence[bytes], lengths: Sequence[int]) -> bytes:
    """Blocks of several memories in turn: one of each length in bytes from each, then the next ones."""
    count = len(raws[0]) // lengths[0] if lengths[0] else 0
    if count == 1:
        return b"".join(raws)
    blocks = [
        [raw[at : at + size] for at in range(0, len(raw), size)]
        for raw, size in zip(raws, lengths, strict=True)
    ]
    return b"".join(chain.from_iterable(zip(*blocks, strict=True)))


def rolled(raw: bytes, size: int, outer: int, count: int, inner: int, shift: int) -> bytes:
    """Memory [outer, count, inner] in which element i of the middle axis comes from i - shift; it wraps around."""
    shift %= count
    if shift == 0:
        return raw
    block, cut = count * inner * size, shift * inner * size
    if outer == 1:
        return raw[block - cut :] + raw[: block - cut]
    if outer <= 8 or cut > 16 or size > 1:
        return b"".join(
            [
                raw[a:b]
                for start in range(0, len(raw), block)
                for a, b in ((start + block - cut, start + block), (start, start + block - cut))
            ]
        )
    # All moves at once; then those that leave their block return at its other end.
    found = bytearray(raw[-cut:] + raw[:-cut])
    for place in range(cut):
        found[place::block] = raw[block - cut + place :: block]
    return bytes(found)
