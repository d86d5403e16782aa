"""Counter-based random numbers in NumPy, as bit planes: the same numbers as `targets.random`, computed where they matter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from powderdsl.targets.arrays.words import Array, pack, unpack

START = (0x243F6A88, 0x85A308D3)

FEW, SPARSE = 512, 8
"""If there are at least `FEW` words and at most one in `SPARSE` needs draws, only those are drawn; otherwise all, once a step."""


def mix(x: Array) -> Array:
    """A 32-bit finalizer of uint32, as in `targets.random.mix`."""
    x = (x ^ (x >> np.uint32(16))) * np.uint32(0x7FEB352D)
    x = (x ^ (x >> np.uint32(15))) * np.uint32(0x846CA68B)
    return x ^ (x >> np.uint32(16))


def low(x: Array) -> Array:
    """The low 32 bits of int64."""
    return (x & 0xFFFFFFFF).astype(np.uint32)


def base_keys(seed: Array, index: Array) -> Array:
    """The part of the keys that stays the same for a whole run: uint32 [2, B]."""
    keys = np.broadcast_to(np.array(START, np.uint32)[:, None], (2, len(seed)))
    for part in (low(seed), low(seed >> 32), low(index)):
        keys = mix(keys + part)
    return keys


def _hash(number: Array, key_0: Array, key_1: Array) -> Array:
    """The hash of `targets.random.words`, inverted: uint32."""
    h = number + key_0
    h ^= h >> np.uint32(16)
    h *= np.uint32(0x7FEB352D)
    h ^= h >> np.uint32(15)
    h += key_1
    h *= np.uint32(0x846CA68B)
    h ^= h >> np.uint32(16)
    return np.invert(h, out=h)


def _below(planes: Array, limit: int) -> Array:
    """Draws below an odd limit, from their inverted planes: from the lowest bit up, one gate per plane."""
    result: Array = planes[-1].copy()
    for i in range(1, len(planes)):
        if limit >> i & 1:
            result |= planes[-1 - i]
        else:
            result &= planes[-1 - i]
    return result


@dataclass
class Draws:
    """The draws of one step of some worlds of one size."""

    shape: tuple[int, int, int]
    """Rows, worlds, columns."""
    valid: Array
    streams: Mapping[str, tuple[int, int]]
    """Position in `keys`, and bits."""
    given: Mapping[str, Array]
    """Draws that replace a stream's own: int64 [H, B, W]."""
    base: Array
    idents: Array
    lasting: dict[object, Array]
    """Values that depend only on the shape."""
    keys: Array = field(init=False)
    """uint32 [S, 2, B]."""
    _planes: dict[str, Array] = field(default_factory=dict)

    def begin(self, step: Array) -> None:
        """Start a step: new keys, no draws yet."""
        keys = mix(self.base + low(step))
        self.keys = mix(keys[None] + self.idents[:, None, None])
        self._planes.clear()

    def inverted(self, stream: str, bits: int) -> Array:
        """The inverted bit planes of a stream, most significant first: uint64 [n ≥ bits, H, B, Ww]."""
        found = self._planes.get(stream)
        if found is None or len(found) < bits:
            position, resolution = self.streams[stream]
            if stream in self.given:
                given = self.given[stream]
                found = np.stack([pack((given >> (resolution - 1 - j)) & 1 == 0) for j in range(bits)])
            else:
                found = self._hashed(self.keys[position], bits)
            self._planes[stream] = found
        return found

    def _hashed(self, keys: Array, bits: int) -> Array:
        """Hashes of the first `bits` bit planes, inverted, as in `targets.random.words`."""
        rows, _, width = self.shape
        across = -(-width // 32)
        number = self.lasting.get(("number", bits))
        if number is None:
            word = np.arange(rows * across, dtype=np.uint32).reshape(rows, 1, across) * np.uint32(32)
            plane = np.arange(bits, dtype=np.uint32)[:, None, None, None]
            number = self.lasting["number", bits] = (word + plane) * np.uint32(0x9E3779B1)
        h = _hash(number, keys[0][:, None], keys[1][:, None])
        if across % 2:
            h = np.concatenate((h, np.zeros_like(h[..., :1])), -1)
        return h.view(np.uint64)

    def _numbers_of_words(self) -> tuple[Array, Array]:
        """For each word of a plane the hash's number of its first half (times the odd constant), and its world."""
        if "words" not in self.lasting:
            rows, worlds, count = self.valid.shape
            across = -(-self.shape[2] // 32)
            y, b, w = np.ogrid[:rows, :worlds, :count]
            number = (y * across + 2 * w + 0 * b).astype(np.uint32) * np.uint32(32) * np.uint32(0x9E3779B1)
            self.lasting["words"] = number.reshape(-1)
            self.lasting["worlds"] = np.broadcast_to(b, self.valid.shape).reshape(-1)
        return self.lasting["words"], self.lasting["worlds"]

    def _few(self, stream: str, bits: int, words: Array) -> Array:
        """The inverted bit planes at some words only: uint64 [bits, n]."""
        numbers, worlds = self._numbers_of_words()
        keys = self.keys[self.streams[stream][0]][:, worlds[words]]
        half = np.arange(bits, dtype=np.uint32)[:, None, None] + np.array([0, 32], np.uint32)
        h = numbers[words][:, None] + half * np.uint32(0x9E3779B1)
        return _hash(h, keys[0][:, None], keys[1][:, None]).view(np.uint64)[..., 0]

    def chance(self, stream: str, bits: int, limit: int, where: Array | None = None) -> Array:
        """Whether draws lie below a constant. Cells outside `where` may hold anything."""
        lowest = (limit & -limit).bit_length() - 1
        count = bits - lowest
        known = self._planes.get(stream, ())
        if where is not None and stream not in self.given and len(known) < count and where.size >= FEW:
            words = np.flatnonzero(where)
            if SPARSE * len(words) <= where.size:
                result = np.zeros_like(self.valid)
                some = _below(self._few(stream, count, words), limit >> lowest)
                result.reshape(-1)[words] = some & self.valid.reshape(-1)[words]
                return result
        result = _below(self.inverted(stream, count)[:count], limit >> lowest)
        result &= self.valid
        return result

    def below(self, stream: str, bits: int, limit: tuple[Array, ...], where: Array | None = None) -> Array:
        """Whether draws lie below a limit given plane by plane, most significant first: the borrow of a subtraction."""
        result = np.zeros_like(self.valid)
        planes = self.inverted(stream, bits)[:bits]
        for plane, bound in zip(planes[::-1], reversed(limit[1:]), strict=True):
            result = (plane & (bound | result)) | (bound & result)
        return (result | limit[0]) & self.valid

    def real(self, stream: str, bits: int) -> Array:
        """A stream's draws in (0, 1), float32."""
        total = np.zeros(self.shape)
        for i, plane in enumerate(self.inverted(stream, bits)[:bits]):
            total += (1 - unpack(plane & self.valid, self.shape[2])) * 2.0 ** (bits - 1 - i)
        return ((total + 0.5) / float(1 << bits)).astype(np.float32)
