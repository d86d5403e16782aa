"""Worlds as RGB pictures (NumPy arrays), one pixel per cell, from arrays or tensors."""

from __future__ import annotations

import math
import operator
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any

from powderdsl.arrays import NDArray, np
from powderdsl.model.types import ColorRamp, Element, Field, Ruleset
from powderdsl.targets.array_kind import Array, ArrayKind

OUTLINES = ((255, 0, 160), (0, 160, 255), (255, 160, 0), (0, 200, 80))
"""Colors of regions, in the order of the file; they repeat after the fourth."""


def palette(elements: Sequence[Element]) -> NDArray[np.uint8]:
    """The elements' colors by id, uint8 [256, 4]: red, green, blue, 0. Ids without an element are black."""
    table = np.zeros((256, 4), dtype=np.uint8)
    for element in elements:
        table[element.id] = _components(element.color)
    return table


@dataclass(frozen=True, eq=False)
class Ramp:
    """The colors of the element `id` by the value of a field: `colors[n]` if the value reaches n of `starts`.

    `starts` ascend, int32 [n] or float32 [n] like the field; `colors` is uint8 [n + 1, 4], as in `palette`. A picture
    only compares values, so it is the same on every machine.
    """

    id: int
    field: str
    starts: Array
    colors: Array


def ramps(elements: Sequence[Element]) -> tuple[Ramp, ...]:
    followed = sorted((element.id, element.ramp) for element in elements if element.ramp is not None)
    return tuple(Ramp(id, ramp.field, *_steps(ramp)) for id, ramp in followed)


@dataclass(frozen=True)
class CellTint:
    """A tint of cells by the vectors v of a field: toward `color`, float32 in 0..1, by |v| / `full`, at most `most`."""

    field: str
    color: tuple[float, float, float]
    full: float
    most: float


def tints(fields: Sequence[Field]) -> tuple[CellTint, ...]:
    tints = []
    for field in fields:
        if (tint := field.tint) is not None:
            parts = _components(tint.color)
            red, green, blue, _ = (float(np.float32(part) / np.float32(255)) for part in parts)
            most = float(np.float32(tint.most))
            tints.append(CellTint(field.name, (red, green, blue), float(tint.full), most))
    return tuple(tints)


def looks(elements: Sequence[Element], fields: Sequence[Field]) -> dict[str, Any]:
    """The arguments `colors`, `ramps` and `tints` of `rgb` for worlds of these elements and fields."""
    return {"colors": palette(elements), "ramps": ramps(elements), "tints": tints(fields)}


def shown_fields(ruleset: Ruleset) -> tuple[str, ...]:
    """The fields shown in pictures of the ruleset's worlds."""
    followed = {element.ramp.field for element in ruleset.elements if element.ramp is not None}
    return tuple(sorted(followed | {field.name for field in ruleset.fields if field.tint is not None}))


@lru_cache(maxsize=256)
def _steps(ramp: ColorRamp) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """The values at which the color of a ramp changes, and the colors before, between and after them."""
    dtype = np.float32 if ramp.real else np.int32
    ends = [_components(color) for color in (ramp.start, ramp.end)]
    parts = [np.array(_first_values(new - old, ramp), dtype) for old, new in zip(*ends, strict=True)]
    starts = np.unique(np.concatenate(parts)).astype(dtype)
    colors = np.zeros((len(starts) + 1, 4), dtype=np.uint8)
    for channel, (old, new) in enumerate(zip(*ends, strict=True)):
        reached = np.searchsorted(parts[channel], starts, side="right")
        colors[:, channel] = old + (1 if new > old else -1) * np.concatenate([[0], reached])
    return starts, colors


def _first_values(change: int, ramp: ColorRamp) -> list[int | float]:
    """The smallest stored values at which a channel has changed by 1, 2, … up to `change`.

    The j-th change is at the fraction (j - 1/2) / |change| of the range. A falling channel changes just after it.
    """
    values: list[int | float] = []
    reaches = operator.ge if change > 0 else operator.gt
    for j in range(1, abs(change) + 1):
        place = ramp.lo + Fraction((ramp.hi - ramp.lo) * (2 * j - 1), 2 * abs(change))
        if not ramp.real:
            values.append(math.ceil(place) if change > 0 else math.floor(place) + 1)
            continue
        value = float(np.float32(float(place)))
        values.append(value if reaches(value, place) else _above(value))
    return values


def _above(value: float) -> float:
    """The next float32 above a number."""
    if value == 0:
        return 2.0**-149
    (bits,) = struct.unpack("<i", struct.pack("<f", value))
    (above,) = struct.unpack("<f", struct.pack("<i", bits + (1 if value > 0 else -1)))
    return float(above)


def rgb(
    ids: Array,
    colors: Array,
    *,
    ramps: Sequence[Ramp] = (),
    tints: Sequence[CellTint] = (),
    fields: Mapping[str, Array] | None = None,
    kind: ArrayKind | None = None,
) -> Array:
    """Pictures uint8 [..., H, W, 3] of element ids, one pixel per cell.

    Args:
        ids: uint8 [..., H, W].
        colors: a `palette`; `looks` has it, the ramps and the tints of a ruleset.
        ramps: cells of their elements are colored by their value in `fields`.
        tints: cells are then tinted by vectors in `fields`, in order.
        fields: by name: [..., H, W], or float [..., 2, H, W].
        kind: the kind of all arrays. Without it, ids and fields may also be tensors, and pictures are NumPy arrays.

    Raises:
        KeyError: a ramp or a tint follows a field that `fields` lacks.
    """
    values = fields or {}
    if kind is None:
        kind, ids = ArrayKind(), to_numpy(ids)
        values = {name: to_numpy(value) for name, value in values.items()}
    xp = kind.xp
    image = kind.entries(colors[:, :3], ids)
    for ramp in ramps:
        field = kind.contiguous(xp.asarray(values[ramp.field], dtype=ramp.starts.dtype))
        reached = xp.searchsorted(ramp.starts, field, side="right")
        image = xp.where((ids == ramp.id)[..., None], kind.entries(ramp.colors[:, :3], reached), image)
    for tint in tints:
        tint_cells(kind, image, values[tint.field], tint)
    return image


def tint_cells(kind: ArrayKind, image: Array, vectors: Array, tint: CellTint) -> None:
    """Tint pictures uint8 [..., H, W, 3] in place by vectors [..., 2, H, W].

    All operations use float32, and bytes are truncated, so that all libraries and the page draw the same bytes.
    """
    xp = kind.xp
    vectors = xp.asarray(vectors, dtype=xp.float32)
    if kind.on_cpu and not bool((vectors != 0).any()):  # on a GPU, the test would synchronize
        return
    row, column = vectors[..., 0, :, :], vectors[..., 1, :, :]
    share = xp.clip(xp.sqrt(row * row + column * column) / tint.full, 0, tint.most)
    rest = 1 - share
    for channel, color in enumerate(tint.color):
        part = xp.asarray(image[..., channel], dtype=xp.float32)
        part = (part / 255 * rest + share * color) * 255
        image[..., channel] = xp.asarray(part, dtype=xp.uint8)


def scale(image: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Pictures uint8 [..., H, W, 3] with every pixel enlarged to a square of `factor` by `factor`."""
    return np.repeat(np.repeat(image, factor, axis=-2), factor, axis=-3)


def contact_sheet(
    images: Array | Sequence[Array], *, columns: int | None = None, gap: int = 2
) -> NDArray[np.uint8]:
    """One or more pictures of one size, uint8 [N, H, W, 3], arranged in rows on one picture, uint8 [H', W', 3].

    Args:
        columns: pictures per row; by default, the number of rows or one more.
        gap: white pixels between and around pictures.
    """
    pictures = [to_numpy(image) for image in images]
    height, width = pictures[0].shape[:2]
    columns = min(columns or math.ceil(math.sqrt(len(pictures))), len(pictures))
    rows = math.ceil(len(pictures) / columns)
    size = rows * (height + gap) + gap, columns * (width + gap) + gap, 3
    sheet = np.full(size, 255, dtype=np.uint8)
    for place, picture in enumerate(pictures):
        top, left = gap + place // columns * (height + gap), gap + place % columns * (width + gap)
        sheet[top : top + height, left : left + width] = picture
    return sheet


def outline(
    image: NDArray[np.uint8], cells: NDArray[np.bool_], factor: int, color: tuple[int, int, int]
) -> None:
    """Draw the edge of a set of cells into a picture uint8 [H·factor, W·factor, 3], one pixel wide, inside it."""
    pixels = np.repeat(np.repeat(cells, factor, 0), factor, 1)
    padded = np.pad(pixels, 1)
    inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    image[pixels & ~inner] = color


def to_numpy(image: Array) -> NDArray[Any]:
    """An array, or a tensor on any device, as a NumPy array."""
    # `isinstance` would import torch even for users of arrays.
    return image.detach().cpu().numpy() if hasattr(image, "detach") else np.asarray(image)


def _components(color: str) -> tuple[int, ...]:
    """Red, green, blue, and 0."""
    return (*bytes.fromhex(color[1:]), 0)
