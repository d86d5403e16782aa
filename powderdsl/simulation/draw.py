"""Worlds -> RGB pictures, one pixel a cell. NumPy in, NumPy out; tensors in, tensors on their device out."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from powderdsl.arrays import NDArray, np
from powderdsl.model.types import ColorRamp, Element, Field, Ruleset

Array = Any
"""A NumPy array or a torch tensor. Torch is imported only once a tensor is given."""

OUTLINES = ((255, 0, 160), (0, 160, 255), (255, 160, 0), (0, 200, 80))
"""Colors of regions, in their order in the file; they repeat after the fourth."""

Colors = Sequence[str] | NDArray[np.uint8]
"""Colors by element id: ``#RRGGBB`` each, or uint8 [n, 3]."""


def palette(elements: Sequence[Element]) -> NDArray[np.uint8]:
    """The elements' colors by id, uint8 [highest id + 1, 3]; ids that no element has are black."""
    table = np.zeros((max((element.id for element in elements), default=-1) + 1, 3), dtype=np.uint8)
    for element in elements:
        table[element.id] = _components(element.color)
    return table


@dataclass(frozen=True, eq=False)
class Ramp:
    """The colors of the element `id` by the values of a field: `colors[n]` where n of `starts` are reached.

    `starts` ascend, int32 [n] or float32 [n] as the field; `colors` is uint8 [n + 1, 3]. A picture only compares
    values, so it is the same on every machine.
    """

    id: int
    field: str
    starts: Array
    colors: Array


def ramps(elements: Sequence[Element]) -> tuple[Ramp, ...]:
    """The ramps of the elements that have a ramp, by id."""
    found = [(element.id, element.ramp) for element in elements if element.ramp is not None]
    return tuple(
        Ramp(number, ramp.field, *_steps(ramp)) for number, ramp in sorted(found, key=lambda one: one[0])
    )


@dataclass(frozen=True)
class CellTint:
    """Cells are tinted by the vectors of a field: toward `color`, float32 in 0..1, by |v| / `full`, at most by `most`."""

    field: str
    color: tuple[float, float, float]
    full: float
    most: float


def tints(fields: Sequence[Field]) -> tuple[CellTint, ...]:
    """The tints of the fields that have one, in their order."""
    return tuple(
        CellTint(one.name, _shares(one.tint.color), float(one.tint.full), float(np.float32(one.tint.most)))
        for one in fields
        if one.tint is not None
    )


def _shares(color: str) -> tuple[float, float, float]:
    red, green, blue = (float(np.float32(part) / np.float32(255)) for part in _components(color))
    return red, green, blue


def tint_cells(image: Array, vectors: Array, tint: CellTint) -> None:
    """Tint pictures uint8 [..., H, W, 3] in place by vectors float32 [..., 2, H, W], NumPy arrays or tensors.

    Each operation is one of float32, and bytes are cut off, so that all libraries and the page draw the same bytes.
    """
    here = not _is_tensor(vectors) or vectors.device.type == "cpu"  # asking a GPU would mean waiting for it
    if here and not bool((vectors != 0).any()):
        return
    row, column = vectors[..., 0, :, :], vectors[..., 1, :, :]
    share = row * row
    share += column * column
    share = share.sqrt() if _is_tensor(share) else np.sqrt(share)
    share /= tint.full
    share = share.clip(max=tint.most) if _is_tensor(share) else np.minimum(share, np.float32(tint.most))
    rest = 1 - share
    for channel, color in enumerate(tint.color):
        part = image[..., channel]
        part = part.float() if _is_tensor(part) else part.astype(np.float32)
        part /= 255
        part *= rest
        part += share * color
        part *= 255
        image[..., channel] = part if _is_tensor(part) else part.astype(np.uint8)


def shown_fields(ruleset: Ruleset) -> tuple[str, ...]:
    """The fields that pictures of its worlds show."""
    followed = {ramp.field for ramp in ramps(ruleset.elements)}
    return tuple(sorted(followed | {tint.field for tint in tints(ruleset.fields)}))


@lru_cache(maxsize=256)
def _steps(ramp: ColorRamp) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """The values at which the color of a ramp changes, and the colors before, between and behind them."""
    dtype = np.float32 if ramp.real else np.int32
    ends = [_components(color) for color in (ramp.start, ramp.end)]
    parts = [np.array(_first_values(new - old, ramp), dtype) for old, new in zip(*ends, strict=True)]
    starts = np.unique(np.concatenate(parts)).astype(dtype)
    colors = np.empty((len(starts) + 1, 3), dtype=np.uint8)
    for channel, (old, new) in enumerate(zip(*ends, strict=True)):
        reached = np.searchsorted(parts[channel], starts, side="right")
        colors[:, channel] = old + (1 if new > old else -1) * np.concatenate([[0], reached])
    return starts, colors


def _first_values(change: int, ramp: ColorRamp) -> list[int | np.float32]:
    """The first values, as the field stores them, at which a channel has changed by 1, 2, … to `change`.

    In proportion that is so far along the range: (j - 1/2) / |change|. What falls by more than a half is rounded down.
    """
    found: list[int | np.float32] = []
    for j in range(1, abs(change) + 1):
        whole = 2 * abs(change)
        place = ramp.lo * whole + (ramp.hi - ramp.lo) * (2 * j - 1)  # of `whole` parts
        if not ramp.real:
            found.append(-(-place // whole) if change > 0 else place // whole + 1)
            continue
        value = np.float32(place / whole)
        while not _reached(value, place, whole, change > 0):
            value = np.float32(np.nextafter(value, np.float32(np.inf)))
        while _reached(
            before := np.float32(np.nextafter(value, -np.float32(np.inf))), place, whole, change > 0
        ):
            value = before
        found.append(value)
    return found


def _reached(value: np.float32, place: int, whole: int, rises: bool) -> bool:
    above, below = float(value).as_integer_ratio()
    return above * whole >= place * below if rises else above * whole > place * below


def rgb(
    ids: Array,
    colors: Colors,
    *,
    ramps: Sequence[Ramp] = (),
    tints: Sequence[CellTint] = (),
    fields: Mapping[str, Array] | None = None,
) -> Any:
    """Pictures uint8 [..., H, W, 3] of ids [..., H, W] (any integers), of the same kind, on the same device.

    With `ramps`, cells of their elements have the color of their value in `fields`, arrays [..., H, W] by name. With
    `tints`, cells are tinted by vectors in `fields`, float [..., 2, H, W], after that and in order.
    Raises ValueError for ids without a color, fields that are missing and shapes that do not fit, TypeError for ids
    of another type.
    """
    table, cells = _table(colors), to_numpy(ids)
    _check(cells, len(table))
    image = table[cells]
    for ramp in ramps:
        if ramp.field not in (fields or {}):
            raise ValueError(
                f"the color of element {ramp.id} follows the field {ramp.field}, which is missing"
            )
        values = to_numpy((fields or {})[ramp.field]).astype(ramp.starts.dtype)
        _check_shape(ramp.field, values, cells.shape)
        ramped = cells == ramp.id
        image[ramped] = ramp.colors[np.searchsorted(ramp.starts, values[ramped], side="right")]
    for tint in tints:
        if tint.field not in (fields or {}):
            raise ValueError(f"cells are tinted by the field {tint.field}, which is missing")
        vectors = to_numpy((fields or {})[tint.field]).astype(np.float32)
        _check_shape(tint.field, vectors, (*cells.shape[:-2], 2, *cells.shape[-2:]))
        tint_cells(image, vectors, tint)
    if not _is_tensor(ids):
        return image
    import torch

    return torch.from_numpy(image).to(ids.device)


def scale(image: Array, factor: int) -> Any:
    """Every pixel of [..., H, W, 3] as a square of `factor` by `factor`. Raises ValueError below 1."""
    if factor < 1:
        raise ValueError(f"a picture cannot be scaled by {factor}: the factor is an integer from 1")
    if factor == 1:
        return image
    if _is_tensor(image):
        return image.repeat_interleave(factor, dim=-3).repeat_interleave(factor, dim=-2)
    return np.repeat(np.repeat(image, factor, axis=-3), factor, axis=-2)


def contact_sheet(
    images: Array | Sequence[Array],
    *,
    columns: int | None = None,
    gap: int = 2,
    background: tuple[int, int, int] = (255, 255, 255),
) -> NDArray[np.uint8]:
    """Pictures of one size, uint8 [N, H, W, 3], side by side on one, uint8 [H', W', 3], row by row.

    `columns` defaults to a square of pictures; `gap` pixels of background stand between and around them.
    Raises ValueError for no pictures, for pictures of different sizes, and for bad numbers.
    """
    pictures = [to_numpy(image) for image in images]
    if not pictures:
        raise ValueError("a contact sheet needs at least one picture")
    height, width = pictures[0].shape[:2]
    if any(picture.shape != (height, width, 3) for picture in pictures):
        raise ValueError(f"pictures of different shapes: {sorted({picture.shape for picture in pictures})}")
    columns = math.ceil(math.sqrt(len(pictures))) if columns is None else columns
    if columns < 1 or gap < 0:
        raise ValueError(f"columns={columns} must be at least 1, gap={gap} at least 0")
    columns = min(columns, len(pictures))
    rows = math.ceil(len(pictures) / columns)
    sheet = np.empty((rows * (height + gap) + gap, columns * (width + gap) + gap, 3), dtype=np.uint8)
    sheet[:] = background
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
    return image.detach().cpu().numpy() if _is_tensor(image) else np.asarray(image)


def _is_tensor(value: object) -> bool:
    # By its class' module: asking torch itself would import it for people who only use arrays.
    return any(base.__module__.partition(".")[0] == "torch" for base in type(value).__mro__)


def _check(ids: NDArray[Any], colors: int) -> None:
    if ids.dtype.kind not in "iu":
        raise TypeError(f"ids must be integers, not {ids.dtype}")
    if ids.ndim < 2:
        raise ValueError(f"ids must have shape [..., H, W], not {ids.shape}")
    if ids.size and not 0 <= int(ids.min()) <= int(ids.max()) < colors:
        raise ValueError(
            f"ids reach from {int(ids.min())} to {int(ids.max())}, but there are {colors} colors"
        )


def _check_shape(name: str, values: NDArray[Any], expected: tuple[int, ...]) -> None:
    if values.shape != expected:
        raise ValueError(f"{name} must have shape {expected}, not {values.shape}")


def _table(colors: Colors) -> NDArray[np.uint8]:
    if isinstance(colors, np.ndarray):
        if colors.ndim != 2 or colors.shape[1] != 3 or colors.dtype != np.uint8:
            raise ValueError(f"colors must be uint8 [n, 3], not {colors.dtype} {colors.shape}")
        return colors
    return np.array([_components(color) for color in colors], dtype=np.uint8).reshape(-1, 3)


def _components(color: str) -> tuple[int, int, int]:
    if not re.fullmatch(r"#[0-9A-Fa-f]{6}", color):
        raise ValueError(f"{color!r} is not a color: write '#RRGGBB'")
    red, green, blue = bytes.fromhex(color[1:])
    return red, green, blue
