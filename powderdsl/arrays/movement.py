"""Elements moved about in memory: memory is `bytes` in C order, of elements of some size."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from itertools import chain, product
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
    code = _UNSIGNED[size]
    changed, given = array(code, bytes(raw)), array(code, bytes(values))
    for place, value in zip(places, given, strict=True):
        changed[place] = value
    return changed.tobytes()


def steps_of(shape: Shape) -> Shape:
    """How many elements lie between neighbors along each axis."""
    found, step = [], 1
    for side in reversed(shape):
        found.append(step)
        step *= side
    return tuple(reversed(found))


def sliced(raw: bytes, size: int, shape: Shape, parts: Sequence[range]) -> bytes:
    """The elements at the places `parts` along the axes."""
    steps = steps_of(shape)
    axis = len(shape)
    while axis and parts[axis - 1] == range(shape[axis - 1]):  # whole axes at the end lie together
        axis -= 1
    if axis == 0:
        return raw
    if any(not len(part) for part in parts):
        return b""
    outer, part, step = parts[: axis - 1], parts[axis - 1], steps[axis - 1]
    starts = [sum(place) for place in product(*_offsets(outer, steps))]
    first, count = part[0] * step, len(part)
    if part.step == 1 or count == 1:
        length = count * step
        if count == 1 and step == 1 and len(starts) > 1:
            return _every(raw, size, [start + first for start in starts])
        pieces = [raw[(start + first) * size : (start + first + length) * size] for start in starts]
        return b"".join(pieces) if len(pieces) > 1 else pieces[0]
    return taken(raw, size, [s + p * step + i for s in starts for p in part for i in range(step)])


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
    if kept == 0:
        return raw
    block = prod(shape[kept:])
    steps = steps_of(shape[:kept])
    ranges = [range(0, shape[axis] * steps[axis], steps[axis]) for axis in axes[:kept]]
    if block == 1:
        return taken(raw, size, places_of(ranges))
    length = block * size
    return b"".join([raw[place * length : (place + 1) * length] for place in places_of(ranges)])


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
