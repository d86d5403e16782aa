"""Bit planes in NumPy: 64 columns per word, uint64 [..., H, B, ⌈W/64⌉]. Bits beyond the width are always zero.

Rows come first, so that shifting rows moves one piece of memory.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

WORD = 64

_BY = [np.array(i, np.uint64) for i in range(WORD)]
"""Shift amounts as arrays: a Python number would be converted each time."""


def pack(flags: Array) -> Array:
    """bool or integers [..., W], zero or not → uint64 [..., ⌈W/64⌉]."""
    width = flags.shape[-1]
    count = -(-width // WORD)
    if width % WORD == 0:
        octets = np.packbits(flags.reshape(-1), bitorder="little")
    else:
        octets = np.zeros((*flags.shape[:-1], count * 8), np.uint8)
        octets[..., : -(-width // 8)] = np.packbits(flags, axis=-1, bitorder="little")
    return octets.reshape(-1).view(np.uint64).reshape(*flags.shape[:-1], count)


def unpack(words: Array, width: int) -> Array:
    """uint64 [..., ⌈W/64⌉] → uint8 [..., W] of zeros and ones."""
    octets = np.ascontiguousarray(words).view(np.uint8)
    if width % WORD == 0:
        return np.unpackbits(octets.reshape(-1), bitorder="little").reshape(*words.shape[:-1], width)
    return np.unpackbits(octets, axis=-1, count=width, bitorder="little")


def shifted(x: Array, width: int, dx: int, wraps: bool) -> Array:
    """Cells [..., W] as seen `dx` columns to the left of them: a new array."""
    if wraps:
        dx %= width
    if not -width < dx < width:
        return np.zeros_like(x)
    result = np.empty(x.shape, x.dtype)
    # All rows at once, across their ends, which are then corrected.
    flat, cells = result.reshape(-1), x.reshape(-1)
    if dx >= 0:
        flat[: len(flat) - dx] = cells[dx:]
        if dx:
            result[..., width - dx :] = x[..., :dx] if wraps else 0
    else:
        flat[-dx:] = cells[:dx]
        result[..., :-dx] = 0
    return result


def rows(x: Array, dy: int, wraps: bool) -> Array:
    """Each row's value at the row `dy` below. Rows are the third last axis."""
    height = x.shape[-3]
    if wraps:
        dy %= height
        return np.concatenate((x[..., dy:, :, :], x[..., :dy, :, :]), -3) if dy else x
    result = np.zeros_like(x)
    if 0 < dy < height:
        result[..., : height - dy, :, :] = x[..., dy:, :, :]
    elif -height < dy < 0:
        result[..., -dy:, :, :] = x[..., :dy, :, :]
    return result


def columns(x: Array, dx: int, width: int, valid: Array, wraps: bool) -> Array:
    """Each column's value at the column `dx` to the right."""
    count = x.shape[-1]
    if count > 1:
        return _far_columns(x, dx, width, valid, wraps)
    if wraps:
        by = dx % width
        if by == 0:
            return x
        left = x << _BY[width - by]
        left |= x >> _BY[by]
    elif dx > 0:
        return x >> _BY[dx] if dx < WORD else np.zeros_like(x)
    else:
        left = x << _BY[-dx] if -dx < WORD else np.zeros_like(x)
    if width % WORD:
        left &= valid
    return left


def _far_columns(x: Array, dx: int, width: int, valid: Array, wraps: bool) -> Array:
    """The same for rows of several words: bits that leave a word enter the next one."""
    if not -WORD < dx < WORD:
        return pack(shifted(unpack(x, width), width, dx, wraps))
    rest = _BY[width % WORD]
    beside = np.zeros_like(x)
    if dx > 0:
        beside[..., :-1] = x[..., 1:]
        if wraps and width % WORD:  # the last columns are followed by the first within a word
            first = x[..., 0]
            x = x.copy()
            x[..., -1] |= first << rest
            beside[..., -2] = x[..., -1]
            beside[..., -1] = (first >> _BY[WORD - int(rest)]) | (x[..., 1] << rest)
        elif wraps:
            beside[..., -1] = x[..., 0]
        result = (x >> _BY[dx]) | (beside << _BY[WORD - dx])
    else:
        beside[..., 1:] = x[..., :-1]
        if wraps and width % WORD:
            beside[..., 0] = (x[..., -1] << _BY[WORD - int(rest)]) | (x[..., -2] >> rest)
        elif wraps:
            beside[..., 0] = x[..., -1]
        result = (x << _BY[-dx]) | (beside >> _BY[WORD + dx])
    if width % WORD:
        result &= valid
    return result
