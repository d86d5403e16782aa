"""The functions that generated code calls (`targets.arrays.source`), on NumPy arrays. They skip work where they can.

An operation on a small array takes NumPy half a microsecond and torch several times as long; a step has thousands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from powderdsl.ir.ops import SNAP
from powderdsl.targets.arrays.draws import Draws
from powderdsl.targets.arrays.words import WORD, Array, columns, pack, rows, shifted, unpack

PIECE = 1 << 14
"""The number of floats that stay in the first-level cache between operations."""

FEW, SPARSE = 512, 2
"""If there are at least `FEW` words and at most one in `SPARSE` has movers, movements touch only those words."""

GLANCE = 61
"""A sample of one float in this many is tested before all are."""

_CHANGES: dict[str, Any] = {"add": np.add, "sub": np.subtract, "mul": np.multiply}


@dataclass
class ArrayKernels:
    """Words are uint64 [H, B, Ww], blocks of planes [P, H, B, Ww], floats float32 [H, B, W]; places are indices of cells."""

    shape: tuple[int, int, int]
    """Rows, worlds, columns."""
    params: Callable[[str], Array]
    """Values [B] of a parameter, float64."""
    kinds: Mapping[str, str]
    draws: Draws
    lasting: dict[object, Array]
    """Values that depend only on the shape, kept from run to run."""
    valid: Array
    zero: Array = field(init=False)
    step: Array = field(init=False)
    _params: dict[object, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.width = self.shape[2]
        self.partial = self.width % WORD != 0
        if "zero" not in self.lasting:
            self.lasting["zero"] = np.zeros_like(self.valid)
        self.zero = self.lasting["zero"]
        self.chance, self.below, self.draw_real = self.draws.chance, self.draws.below, self.draws.real

    def begin(self, step: Array) -> None:
        """Start a step; `step` has its number in each world, [B]."""
        self.step = step
        self.draws.begin(step)

    @staticmethod
    def some(*flags: Array) -> bool:
        """Whether one of some flags holds anywhere."""
        return any(map(np.count_nonzero, flags))

    @staticmethod
    def all_zero(*fields: Array) -> bool:
        """Whether some fields are zero everywhere."""
        bits = [field.reshape(-1).view(np.int32) for field in fields]
        return not any(np.count_nonzero(one[::GLANCE]) or np.count_nonzero(one) for one in bits)

    # Words

    def shift(self, x: Array, dy: int, dx: int, wraps: bool) -> Array:
        if dx:
            x = columns(x, dx, self.width, self.valid, wraps)
        return rows(x, dy, wraps) if dy else x

    stack = staticmethod(np.stack)

    def swap(self, block: Array, movers: Array, over: bool, dy: int, dx: int) -> Array:
        """All planes with movers and targets exchanged, by their xor. `over`: in the block itself."""
        block = block if over else block.copy()
        few = self._few_words(movers, dy, dx)
        if few is None:
            difference = block ^ self.shift(block, dy, dx, True)
            difference &= movers
            block ^= difference
            block ^= self.shift(difference, -dy, -dx, True)
            return block
        words, targets = few
        flat = block.reshape(len(block), -1)
        difference = flat.take(words, 1) ^ self._turned(flat.take(targets, 1), dx)
        difference &= movers.reshape(-1)[words]
        flat[:, words] ^= difference
        flat[:, targets] ^= self._turned(difference, -dx)
        return block

    def leave(
        self, block: Array, movers: Array, over: bool, dy: int, dx: int, left: tuple[int, ...]
    ) -> Array:
        """All planes with the movers' values at their targets; where movers were, planes in `left` are set, the others cleared."""
        block = block if over else block.copy()
        few = self._few_words(movers, dy, dx)
        if few is None:
            carried = block & movers
            block ^= carried
            for plane in left:
                block[plane] |= movers
            block &= self.shift(movers, -dy, -dx, True) ^ self.valid
            block |= self.shift(carried, -dy, -dx, True)
            return block
        words, targets = few
        flat, leaving = block.reshape(len(block), -1), movers.reshape(-1)[words]
        held = flat.take(words, 1)
        carried = held & leaving
        held ^= carried
        for plane in left:
            held[plane] |= leaving
        flat[:, words] = held
        found = flat.take(targets, 1)
        found &= ~self._turned(leaving[None], -dx)
        found |= self._turned(carried, -dx)
        flat[:, targets] = found
        return block

    def _few_words(self, movers: Array, dy: int, dx: int) -> tuple[Array, Array] | None:
        """The words that hold movers and those that hold their targets; None if processing all words is faster."""
        rows, worlds, count = self.valid.shape
        if movers.size < FEW or (dx and count > 1):
            return None
        words = np.flatnonzero(movers)
        if SPARSE * len(words) > movers.size:
            return None
        targets = words + dy % rows * (worlds * count)
        np.subtract(targets, movers.size, out=targets, where=targets >= movers.size)
        return words, targets

    def _turned(self, words: Array, dx: int) -> Array:
        """Rows of one word [P, n] as seen `dx` columns to the left of them."""
        if not dx:
            return words
        return columns(words[..., None], dx, self.width, self.valid[0, 0], True)[..., 0]

    def swap_onto(self, block: Array, movers: Array, rest: Array, dy: int, dx: int) -> Array:
        """As `swap`, where other cells changed too: `rest` has the cells that do not move."""
        result = self.arrive(block, movers, rest, dy, dx)
        there = result ^ self.shift(block, dy, dx, True)
        there &= movers
        result ^= there
        return result

    def arrive(self, block: Array, movers: Array, rest: Array, dy: int, dx: int) -> Array:
        """Targets get what the movers held."""
        back = rest ^ self.shift(block, -dy, -dx, True)
        back &= self.shift(movers, -dy, -dx, True)
        back ^= rest
        return back

    def pack(self, flags: Array) -> Array:
        return pack(flags if flags.shape == self.shape else np.broadcast_to(flags, self.shape))

    def cells(self, words: Array) -> Array:
        """A flag as bool cells."""
        return unpack(words, self.width).view(bool)

    def places(self, words: Array) -> Array:
        """The cells where a flag holds: int64 [n], indices into arrays of floats."""
        flat = words.reshape(-1)
        busy = np.flatnonzero(flat)
        bits = np.unpackbits(flat[busy].view(np.uint8), bitorder="little")
        found = np.flatnonzero(bits.view(bool))
        count = words.shape[-1]
        start = busy * WORD
        if self.partial:
            start -= busy // count * (count * WORD - self.width)
        return start[found >> 6] + (found & (WORD - 1))

    def moved(self, places: Array, dy: int, dx: int) -> Array:
        """The cells whose neighbors (dy, dx) are these, in the same order."""
        height, worlds, width = self.shape
        dy, dx = -dy % height, -dx % width
        result = places
        if dx:
            result = places + dx
            np.subtract(result, width, out=result, where=places % width >= width - dx)
        if dy:
            result = result + dy * (worlds * width)
            np.subtract(result, height * worlds * width, out=result, where=result >= height * worlds * width)
        return result

    # The same everywhere

    def below_param(
        self, stream: str, bits: int, name: str, strict: bool, where: Array | None = None
    ) -> Array:
        """Whether draws lie below a parameter, which is usually the same for all worlds."""
        limits = self._limits(name, bits, strict)
        limit = int(limits[0])
        if (limits != limit).any():
            planes = tuple(self.limit(name, bits, strict, i) for i in range(bits, -1, -1))
            return self.below(stream, bits, planes)
        if limit <= 0:
            return self.zero
        return self.valid if limit >> bits else self.chance(stream, bits, limit, where)

    def _limits(self, name: str, bits: int, strict: bool) -> Array:
        """A parameter as a chance: how many of the possible draws lie below it, or not above it: int64 [B]."""
        key = (name, bits, strict)
        if key not in self._params:
            count = 1 << bits
            scaled = self.params(name) * count - 0.5
            limit = np.ceil(scaled) if strict else np.floor(scaled) + 1
            self._params[key] = limit.clip(0, count).astype(np.int64)
        return self._params[key]

    def limit(self, name: str, bits: int, strict: bool, bit: int) -> Array:
        """A bit of such a number as words that are all ones or all zeros in each world."""
        key = (name, bits, strict, bit)
        if key not in self._params:
            self._params[key] = self._everywhere((self._limits(name, bits, strict) >> bit & 1)[:, None])
        return self._params[key]

    def param(self, name: str, bit: int | None = None) -> Array:
        """A parameter: float32 [B, 1], or as a flag or one of its bits words that are all ones or all zeros."""
        key = (name, bit)
        if key not in self._params:
            if self.kinds[name] in ("real", "chance") and bit is None:
                self._params[key] = self.params(name).astype(np.float32)[:, None]
            else:
                numbers = self.params(name).astype(np.int64)
                self._params[key] = self._everywhere((numbers >> (bit or 0) & 1)[:, None])
        return self._params[key]

    def _everywhere(self, flags: Array) -> Array:
        """Flags [H, B, 1] or broadcastable to it as words."""
        return np.where(flags != 0, self.valid, self.zero)

    def coordinate(self, axis: str, modulus: int, bit: int) -> Array:
        rows, _, columns = self.shape
        if axis == "step":
            return self._everywhere((self.step % modulus >> bit & 1)[:, None])
        key = (axis, modulus, bit)
        if key not in self.lasting:
            count = np.arange(rows)[:, None, None] if axis == "row" else np.arange(columns)
            self.lasting[key] = self.pack(count % modulus >> bit & 1 != 0)
        return self.lasting[key]

    def inside(self, dy: int, dx: int) -> Array:
        key = ("inside", dy, dx)
        if key not in self.lasting:
            self.lasting[key] = self.shift(self.valid, dy, dx, False)
        return self.lasting[key]

    # Reals

    def full(self, x: Array) -> Array:
        return x if x.shape == self.shape else np.broadcast_to(x, self.shape)

    def copy(self, x: Array) -> Array:
        """A copy with one number per cell."""
        result = np.empty(self.shape, np.float32)
        result[...] = x
        return result

    def shift_cells(self, x: Array, dy: int, dx: int, wraps: bool) -> Array:
        """The value at a neighbor, as a new array."""
        if x.shape != self.shape:
            x = self.copy(x)  # NumPy would lay out what it makes of a broadcast array in another order
        height, _, width = self.shape
        if not wraps:
            x = rows(x, dy, False) if dy else x
            return shifted(x, width, dx, False) if dx or not dy else x
        if dy % height:
            x = np.concatenate((x[dy % height :], x[: dy % height]))
        return shifted(x, width, dx, True) if dx or not dy % height else x

    def choose(self, cells: Array, yes: Array, no: Array, over: bool) -> Array:
        """`yes` where the cells hold, else `no`; `over`: in `no` itself."""
        result = no if over else self.copy(no)
        np.copyto(result, yes, where=cells)
        return result

    def update(self, places: Array, no: Array, other: Array, over: bool, change: str) -> Array:
        """`no`, changed by `other` (added, subtracted or multiplied) at some places."""
        return self.carry(places, places, no, other, over, change)

    def carry(
        self,
        source: Array,
        target: Array,
        no: Array,
        other: Array,
        over: bool,
        change: str,
        dy: int = 0,
        dx: int = 0,
    ) -> Array:
        """`no`, changed at the target places by the values of `other` at the source places."""
        result = no if over else self.copy(no)
        flat = result.reshape(-1)
        given = self.full(other).reshape(-1)[source] if other.ndim else other
        flat[target] = _CHANGES[change](flat[target], given)
        return result

    sqrt = staticmethod(np.sqrt)
    min = staticmethod(np.minimum)
    max = staticmethod(np.maximum)

    @staticmethod
    def div(a: Array, b: Array) -> Array:
        """a / b, 0 where b is 0."""
        result = np.asarray(np.divide(a, b))
        nothing = np.asarray(b == 0)
        if nothing.any():
            result = np.where(nothing, np.float32(0), result)
        return result

    def settle(self, x: Array, over: bool, low: float, high: float) -> Array:
        """No NaN, within bounds, nothing smaller than SNAP."""
        result = x if over else self.copy(x)
        flat = result.reshape(-1)
        for start in range(0, len(flat), PIECE):
            piece = flat[start : start + PIECE]
            size = np.abs(piece)
            if not size.max() <= min(-low, high):  # NaN counts as large
                np.clip(piece, np.float32(low), np.float32(high), out=piece)
                np.copyto(piece, np.float32(0), where=piece != piece)
                size = np.abs(piece)
            np.copyto(piece, np.float32(0), where=size < np.float32(SNAP))
        return result
