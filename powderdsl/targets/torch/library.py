"""Functions that generated functions on bit planes call: neighbors, movements, draws, and floats where flags hold.

Words are int64, [..., H, B, K]: bit x % 64 of word x // 64 is column x. Bits beyond the last column are arbitrary. Planes of
parameters, which all cells share, are broadcast. There are two libraries with the same operations:

- `Portable`: for compilation and for any device. Cells are [H, W, B], so that neighbors lie along outer dimensions; masks of
  cells are planes.
- `Eager`: for CPUs without compilation. Cells are [H, B, W], so that the bytes of a word lie in order; masks of cells are
  int32 of all ones or zeros, since `torch.where` branches for each cell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from powderdsl.ir.ops import SNAP
from powderdsl.schedule.types import Leftover
from powderdsl.system.random import MASK
from powderdsl.targets.tensor_kind import WORD, word_count


class Portable:
    """The operations on words and cells of worlds of one size."""

    axes = (0, 1)
    """Axes of the rows and columns of cells."""

    def __init__(self, batch: int, height: int, width: int, device: torch.device):
        self.batch, self.height, self.width, self.device = batch, height, width, device
        self.across = word_count(width)
        self.shape = (height, batch, self.across)
        self.everywhere, self.nowhere = self._by_row([-1]), self._by_row([0])
        self.valid = self._by_row([(1 << width) - 1])
        self.fixed: dict[Any, Any] = {}
        """Constants for this size that were computed before, by key."""

    def whole(self, plane: Tensor) -> Tensor:
        """One or more planes [H, B, K]; those that all cells share are expanded."""
        return plane if plane.shape[-3:] == self.shape else plane.expand(*plane.shape[:-3], *self.shape)

    def stack(self, planes: Sequence[Tensor]) -> Tensor:
        """Planes as one tensor [planes, H, B, K]."""
        return torch.stack([self.whole(plane) for plane in planes])

    def replaced(self, words: Tensor, numbers: Sequence[int], planes: Sequence[Tensor]) -> Tensor:
        """The planes of all slots, some of them new."""
        new = dict(zip(numbers, planes, strict=True))
        parts, at = [], 0
        for i in (*sorted(new), len(words)):
            parts += [words[at:i]] if at < i else []
            parts += [self.whole(new[i])[None]] if i in new else []
            at = i + 1
        return torch.cat(parts)

    # Neighbors

    def rows(self, plane: Tensor, dy: int) -> Tensor:
        """The plane at the neighbor `dy` rows below, as a new tensor; rows wrap."""
        return torch.roll(self.whole(plane), -dy, -3)

    def columns(self, plane: Tensor, dx: int) -> Tensor:
        """The plane at the neighbor `dx` columns to the right, as a new tensor; columns wrap."""
        plane = self.whole(plane)
        if self.width % WORD:
            plane = plane & self.valid
        by = dx % self.width
        if self.across > 1 or not by:
            return self._right(plane, by) | self._right(plane, by - self.width)
        right = (plane >> by).bitwise_and_((1 << (WORD - by)) - 1)
        return right.bitwise_or_(plane << (self.width - by))

    def _right(self, plane: Tensor, by: int) -> Tensor:
        """The flags `by` columns to the right, and zeros."""
        words, bits = divmod(by, WORD)
        if not bits:
            return self._words(plane, words)
        low = (self._words(plane, words) >> bits) & ((1 << (WORD - bits)) - 1)
        return low | (self._words(plane, words + 1) << (WORD - bits))

    def _words(self, plane: Tensor, by: int) -> Tensor:
        """The words `by` places further in each row, and zeros."""
        if not by:
            return plane
        if abs(by) >= self.across:
            return torch.zeros_like(plane)
        return pad(plane[..., by:], (0, by)) if by > 0 else pad(plane[..., :by], (-by, 0))

    def shift(self, plane: Tensor, dy: int, dx: int) -> Tensor:
        """The plane at a neighbor; the grid wraps."""
        if dx:
            plane = self.columns(plane, dx)
        return self.rows(plane, dy) if dy or not dx else plane

    def inside(self, dy: int, dx: int) -> Tensor:
        """The cells whose neighbor lies inside the grid."""
        columns = self._columns_where(lambda x: 0 <= x + dx < self.width)
        return self._by_row([columns if 0 <= y + dy < self.height else 0 for y in range(self.height)])

    def inside_mask(self, dy: int, dx: int) -> Tensor:
        """The same as a mask."""
        return self.mask(self.inside(dy, dx))

    def row(self, modulus: int, bit: int) -> Tensor:
        """A bit of the number of each row, modulo a number."""
        return self._by_row([-(y % modulus >> bit & 1) for y in range(self.height)])

    def column(self, modulus: int, bit: int) -> Tensor:
        """A bit of the number of each column, modulo a number."""
        return self._by_row([self._columns_where(lambda x: bool(x % modulus >> bit & 1))])

    def _columns_where(self, holds: Callable[[int], bool]) -> int:
        """The columns for which a function holds, as the bits of a number."""
        return int("".join("01"[holds(x)] for x in reversed(range(self.width))), 2)

    def _by_row(self, rows: Sequence[int]) -> Tensor:
        """A plane of the columns of each row, or of all rows."""
        size = self.across * WORD
        words = [np.frombuffer((row % (1 << size)).to_bytes(size // 8, "little"), "<i8") for row in rows]
        return torch.from_numpy(np.stack(words).astype(np.int64))[:, None].to(self.device)

    # Movements of planes [P, H, B, K]. No cell is both a mover and a target of the same exchange.

    def swap(self, planes: Tensor, movers: Tensor, dy: int, dx: int) -> Tensor:
        """Planes whose movers and targets are exchanged."""
        change = self.shift(planes, dy, dx).bitwise_xor_(planes).bitwise_and_(movers)
        return self.shift(change, -dy, -dx).bitwise_xor_(change).bitwise_xor_(planes)

    def left(self, *kinds: Leftover) -> Any:
        """The content that movers leave behind in each plane, in the form that `leave` takes."""
        shown = [[[[-(kind == of)]]] for of in ("same", "everything") for kind in kinds]
        return torch.tensor(shown, device=self.device).view(2, -1, 1, 1, 1)

    def leave(self, planes: Tensor, movers: Tensor, dy: int, dx: int, left: Any) -> Tensor:
        """Planes whose targets get the content of the movers; other movers leave something behind."""
        targets = self.shift(movers, -dy, -dx)
        stays, fills = left
        rest = (planes & (~movers | stays)) | (movers & fills)
        return (rest & ~targets) | self.shift(planes & movers, -dy, -dx)

    def arrive(self, planes: Tensor, movers: Tensor, rest: Tensor, dy: int, dx: int) -> Tensor:
        """Other planes, whose targets get the content of the movers in these planes."""
        targets = self.shift(movers, -dy, -dx)
        return rest ^ (targets & (rest ^ self.shift(planes, -dy, -dx)))

    def exchange(self, planes: Tensor, movers: Tensor, rest: Tensor, dy: int, dx: int) -> Tensor:
        """Other planes, whose movers and targets get the content of their partners in these planes."""
        arrived = self.arrive(planes, movers, rest, dy, dx)
        return arrived ^ (movers & (arrived ^ self.shift(planes, dy, dx)))

    # Draws: planes [bits, H, B, K] of the inverted bits of a number of each cell, highest first

    def draws(self, keys: Tensor, bits: int) -> Tensor:
        """A stream's draws in a step, from its keys, int32 [2, B]."""
        lower, upper = (self._hashed(self._numbers(bits, slice(i, None, 2)), keys) for i in (0, 1))
        return (lower.to(torch.int64) & MASK) | (upper.to(torch.int64) << 32)

    def _numbers(self, bits: int, halves: slice) -> Tensor:
        """The input of the hash for each bit and some halves of words: int32 [bits, H, 1, halves]."""
        count = -(-self.width // 32)  # the last word may lack a half
        half = torch.arange(2 * self.across, dtype=torch.int32, device=self.device)[halves]
        half = half.clamp(max=count - 1)
        row = torch.arange(self.height, dtype=torch.int32, device=self.device)[:, None, None] * count
        plane = torch.arange(bits, dtype=torch.int32, device=self.device)[:, None, None, None]
        return ((row + half) * 32 + plane) * (0x9E3779B1 - (1 << 32))

    @staticmethod
    def _hashed(numbers: Tensor, keys: Tensor) -> Tensor:
        """As `program.words`, in int32, which wraps as the hash does; inverted."""
        h = numbers + keys[0][:, None]
        h.bitwise_xor_((h >> 16).bitwise_and_(0xFFFF)).mul_(0x7FEB352D)
        h.bitwise_xor_((h >> 15).bitwise_and_(0x1FFFF))
        h.add_(keys[1][:, None]).mul_(0x846CA68B - (1 << 32))
        return h.bitwise_xor_((h >> 16).bitwise_and_(0xFFFF)).bitwise_not_()

    def chance(self, draws: Sequence[Tensor], limit: int, bits: int) -> Tensor:
        """The cells whose number of some bits is below a limit."""
        if not 0 < limit < 1 << bits:
            return self.everywhere if limit > 0 else self.nowhere
        low = (limit & -limit).bit_length() - 1
        below = draws[bits - low - 1].clone()
        for i in range(low + 1, bits):
            draw = draws[bits - 1 - i]
            below = below.bitwise_or_(draw) if limit >> i & 1 else below.bitwise_and_(draw)
        return below

    def below(self, draws: Sequence[Tensor], limit: int | Sequence[Tensor]) -> Tensor:
        """The cells whose number is below a limit: one number, or planes of each world's number, highest bit first."""
        if isinstance(limit, int):
            return self.chance(draws, limit, len(draws))
        below = self.nowhere
        bits = len(limit) - 1
        for i in range(bits):
            draw, bit = draws[bits - 1 - i], limit[bits - i]
            below = (draw & (bit | below)) | (bit & below)
        return below | limit[0]

    def draw(self, draws: Sequence[Tensor], bits: int) -> Tensor:
        """A number of each cell in (0, 1), float32."""
        number = torch.zeros((), dtype=torch.int64, device=self.device)
        for i in range(bits):
            number = (number << 1) | (1 - self.bits(draws[i]).to(torch.int64))
        return ((number.double() + 0.5) / float(1 << bits)).float()

    # Cells

    def to_cells(self, array: Tensor) -> Tensor:
        """An array [..., B, H, W] in the order of cells."""
        return array.movedim(-3, -1)

    def from_cells(self, cells: Tensor) -> Tensor:
        """Cells as an array [..., B, H, W]."""
        return cells.movedim(-1, -3)

    def bits(self, plane: Tensor) -> Tensor:
        """The flags of each cell, as integers 0 and 1."""
        words = self.whole(plane).movedim(-1, -2)[..., None, :]  # [..., H, K, 1, B]: worlds are innermost
        return ((words >> self._columns()) & 1).flatten(-3, -2)[..., : self.width, :]

    def _columns(self) -> Tensor:
        # Computed again: kernels compute it where they would otherwise read a stored tensor.
        return torch.arange(WORD, device=self.device)[:, None]

    def mask(self, plane: Tensor) -> Tensor:
        """The flags of each cell, in the form that `choose` takes: the plane, so that no mask is ever stored."""
        return plane

    def pack(self, flags: Tensor) -> Tensor:
        """Flags of cells, bool, as a new plane."""
        bits = flags.expand(*flags.shape[:-3], self.height, self.width, self.batch).to(torch.int64)
        if self.across == 1:
            return (bits << self._columns()[: self.width]).sum(-2)[..., None]
        bits = pad(bits, (0, 0, 0, self.across * WORD - self.width)).unflatten(-2, (self.across, WORD))
        return (bits << self._columns()).sum(-2).movedim(-2, -1)

    def compare(self, op: str, a: Tensor | float, b: Tensor | float) -> Tensor:
        """The cells where a float equals another (`eq`), or is less (`lt`, `le`), as a new plane."""
        return self.pack(getattr(torch, op)(self.tensor(a), self.tensor(b)))

    def all_cells(self, value: Tensor | float) -> Tensor:
        """A float of each cell: values that cells share are expanded."""
        return self.tensor(value).expand(self.height, self.width, self.batch).contiguous()

    def tensor(self, value: Tensor | float) -> Tensor:
        """A constant as a tensor: some devices multiply by the reciprocal of a number, which rounds differently."""
        return torch.full((), value, device=self.device) if isinstance(value, float) else value

    def neighbor(self, value: Tensor | float, dy: int, dx: int) -> Tensor:
        """The float at a neighbor; the grid wraps."""
        return torch.roll(self.all_cells(value), (-dy, -dx), self.axes)

    def choose(self, mask: Tensor, yes: Tensor | float, no: Tensor | float) -> Tensor:
        """One float where a mask holds, the other elsewhere."""
        return torch.where(self.bits(mask) != 0, self.tensor(yes), self.tensor(no))

    def increase(self, value: Tensor | float, mask: Tensor, by: Tensor | float, sign: int = 1) -> Tensor:
        """A float, increased or decreased where a mask holds."""
        return self.choose(mask, value + by if sign > 0 else value - by, value)

    def carry(self, value: Tensor, mask: Tensor, amount: Tensor, dy: int, dx: int) -> Tensor:
        """A float from which an amount leaves where a mask holds, and arrives where the mask holds at a neighbor."""
        left = self.choose(mask, value - amount, value)
        arrived = left + self.neighbor(amount, dy, dx)
        return self.choose(self.shift(mask, dy, dx), arrived, left)

    increase_, carry_ = increase, carry
    """The same, which may overwrite the first argument."""

    def divide(self, a: Tensor | float, b: Tensor | float) -> Tensor:
        """The quotient; 0 where the divisor is 0."""
        a, b = self.tensor(a), self.tensor(b)
        return torch.where(b == 0, 0.0, a / b)

    def minimum(self, a: Tensor | float, b: Tensor | float) -> Tensor:
        """The smaller float; NaN if either is."""
        return torch.minimum(self.tensor(a), self.tensor(b))

    def maximum(self, a: Tensor | float, b: Tensor | float) -> Tensor:
        """The larger float; NaN if either is."""
        return torch.maximum(self.tensor(a), self.tensor(b))

    def square_root(self, value: Tensor) -> Tensor:
        """The square root, rounded correctly, which not every device does for float32."""
        return torch.sqrt(value.double()).float()

    def clamp(self, value: Tensor, low: float, high: float) -> Tensor:
        """No NaN, within bounds, nothing smaller than `SNAP`."""
        value = torch.where(value == value, value, 0.0).clamp(low, high)
        return torch.where(value.abs() < SNAP, 0.0, value)


_BITS = torch.tensor([[octet >> i & 1 for i in range(8)] for octet in range(256)], dtype=torch.uint8)
_MASKS = -_BITS.to(torch.int32)
_GATHER = 0x0102040810204080
"""Multiplying a word of eight bytes 0 or 1 by this collects them as the bits of its last byte."""
_BELOW_SNAP = float(np.nextafter(np.float32(SNAP), np.float32(0)))


def _pattern(value: float) -> int:
    """The bits of a float32."""
    return int(np.float32(value).view(np.int32))


class Eager(Portable):
    """The operations for CPUs, which are little endian."""

    axes = (0, 2)

    def replaced(self, words: Tensor, numbers: Sequence[int], planes: Sequence[Tensor]) -> Tensor:
        words = words.clone()
        for i, plane in zip(numbers, planes, strict=True):
            words[i] = plane
        return words

    def left(self, *kinds: Leftover) -> Any:
        return kinds

    def leave(self, planes: Tensor, movers: Tensor, dy: int, dx: int, left: Any) -> Tensor:
        targets = self.shift(movers, -dy, -dx)
        rest = planes & ~movers
        for i, kind in enumerate(left):
            if kind == "everything":
                rest[i].bitwise_or_(movers)
            elif kind == "same":
                rest[i].copy_(planes[i])
        arrived = self.shift(planes & movers, -dy, -dx)
        return rest.bitwise_and_(targets.bitwise_not_()).bitwise_or_(arrived)

    def draws(self, keys: Tensor, bits: int) -> Tensor:
        if ("numbers", bits) not in self.fixed:
            self.fixed["numbers", bits] = self._numbers(bits, slice(None))
        return self._hashed(self.fixed["numbers", bits], keys).view(torch.int64)

    def to_cells(self, array: Tensor) -> Tensor:
        return array.movedim(-3, -2)

    def from_cells(self, cells: Tensor) -> Tensor:
        return cells.movedim(-3, -2)

    def bits(self, plane: Tensor) -> Tensor:
        return self._expanded(plane, _BITS)

    def mask(self, plane: Tensor) -> Tensor:
        return self._expanded(plane, _MASKS)

    def _expanded(self, plane: Tensor, table: Tensor) -> Tensor:
        """The row of a table for each byte of a plane."""
        octets = self.whole(plane).contiguous().view(torch.uint8)
        return torch.embedding(table, octets.to(torch.int32)).flatten(-2)[..., : self.width]

    def compare(self, op: str, a: Tensor | float, b: Tensor | float) -> Tensor:
        # A comparison whose result is a float takes a sixth of the time.
        numbers = torch.empty(self.height, self.batch, self.width)
        return self.pack(getattr(torch, op)(self.all_cells(a), self.tensor(b), out=numbers).to(torch.bool))

    def pack(self, flags: Tensor) -> Tensor:
        flags = flags.expand(*flags.shape[:-3], self.height, self.batch, self.width).view(torch.uint8)
        flags = pad(flags, (0, -self.width % WORD)).contiguous().view(torch.int64)
        return (flags * _GATHER).view(torch.uint8)[..., 7::8].contiguous().view(torch.int64)

    def all_cells(self, value: Tensor | float) -> Tensor:
        return self.tensor(value).expand(self.height, self.batch, self.width).contiguous()

    def choose(self, mask: Tensor, yes: Tensor | float, no: Tensor | float) -> Tensor:
        if isinstance(no, float):
            if isinstance(yes, float):
                return (mask & (_pattern(yes) ^ _pattern(no))).bitwise_xor_(self._int(no)).view(torch.float32)
            if not no:
                return (mask & self._int(yes)).view(torch.float32)
        no = self._int(no)
        return (self._int(yes) ^ no).bitwise_and(mask).bitwise_xor(no).view(torch.float32)

    def _int(self, value: Tensor | float) -> Tensor:
        return self.tensor(value).view(torch.int32)

    def increase(self, value: Tensor | float, mask: Tensor, by: Tensor | float, sign: int = 1) -> Tensor:
        # x + 0 = x, except that -0 becomes 0, which rules cannot distinguish and fields never contain.
        return torch.add(self.tensor(value), self.choose(mask, by, 0.0), alpha=sign)

    def increase_(self, value: Any, mask: Tensor, by: Tensor | float, sign: int = 1) -> Tensor:
        return self.tensor(value).add_(self.choose(mask, by, 0.0), alpha=sign)

    def carry(self, value: Tensor, mask: Tensor, amount: Tensor, dy: int, dx: int) -> Tensor:
        return self.carry_(self.all_cells(value).clone(), mask, amount, dy, dx)

    def carry_(self, value: Tensor, mask: Tensor, amount: Tensor, dy: int, dx: int) -> Tensor:
        moved, neighbors, borders = self._framed(dy, dx)
        torch.bitwise_and(self._int(amount), mask, out=moved.view(torch.int32))
        for border, cells in borders:
            border.copy_(cells)
        return value.sub_(moved).add_(neighbors)

    def _framed(self, dy: int, dx: int) -> tuple[Tensor, Tensor, list[tuple[Tensor, Tensor]]]:
        """Memory for a float of each cell, the part of it at a neighbor, and the parts to copy around the edges."""
        if ("framed", dy, dx) not in self.fixed:
            height, ys, to_y, edge_y = _frame(dy, self.height)
            width, xs, to_x, edge_x = _frame(dx, self.width)
            frame = torch.empty(height, self.batch, width)
            borders = [(frame[ys, :, border], frame[ys, :, cells]) for border, cells in edge_x]
            borders += [(frame[border], frame[cells]) for border, cells in edge_y]
            self.fixed["framed", dy, dx] = (frame[ys, :, xs], frame[to_y, :, to_x], borders)
        framed: tuple[Tensor, Tensor, list[tuple[Tensor, Tensor]]] = self.fixed["framed", dy, dx]
        return framed

    def square_root(self, value: Tensor) -> Tensor:
        with np.errstate(invalid="ignore"):
            # Rounded correctly, as torch does only for float64.
            return torch.from_numpy(np.sqrt(value.numpy()))

    def clamp(self, value: Tensor, low: float, high: float) -> Tensor:
        value = value.clamp(low, high).nan_to_num_(nan=0.0, posinf=high, neginf=low)
        return torch.nn.functional.hardshrink(value, _BELOW_SNAP)


def _frame(by: int, size: int) -> tuple[int, slice, slice, list[tuple[slice, slice]]]:
    """An axis with room for neighbors around the edge: its size, cells, their neighbors, borders and their sources."""
    by = (by + size // 2) % size - size // 2
    before = max(-by, 0)
    cells, neighbors = slice(before, before + size), slice(before + by, before + by + size)
    if by > 0:
        return size + by, cells, neighbors, [(slice(size, size + by), slice(by))]
    return size - by, cells, neighbors, [(slice(-by), slice(size, size - by))] if by else []
