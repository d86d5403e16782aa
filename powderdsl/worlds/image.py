"""Worlds from PNG pictures, one pixel per cell, by the elements' exact colors."""

from __future__ import annotations

import math
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path

from powderdsl.arrays import NDArray, np
from powderdsl.diagnostics import CompileError, Diagnostic, Label
from powderdsl.model.types import Element
from powderdsl.simulation.draw import ramps
from powderdsl.system.packages import require
from powderdsl.system.reading import open_regular
from powderdsl.system.writing import failure
from powderdsl.worlds.raster import MAX_CELLS

MAX_REPORTED = 8
"""Maximum number of wrong colors reported separately: a smoothed picture has thousands."""

_MODES = ("1", "L", "LA", "P", "RGB", "RGBA")
"""Pixel formats of at most eight bits; others have colors that no element can have."""


def read_image(path: str | Path, elements: Sequence[Element]) -> NDArray[np.uint8]:
    """The ids uint8 [H, W] of a PNG file, such as `worlds.media.write_png` writes from `simulation.draw.rgb`.

    Colors of a ramp are read as its element, without the value of its field. Raises CompileError: PD609 for pixel
    colors without an element, PD607 for too many pixels, PD602 for a file that is not a PNG, PD101 for a file that
    cannot be read; PD612 if Pillow or NumPy is missing.
    """
    path = Path(path)
    # The four bytes of a pixel as one number: red lowest, opacity highest.
    packed = _pixels(path).view("<u4")[..., 0]
    owners: dict[int, list[Element]] = {}
    for element in elements:
        owners.setdefault(_pack(bytes.fromhex(element.color[1:])), []).append(element)
    own, by_id = frozenset(owners), {element.id: element for element in elements}
    for ramp in ramps(elements):  # an element's own color wins over ramps
        for color in sorted({_pack(bytes(row[:3])) for row in ramp.colors} - own):
            owners.setdefault(color, []).append(by_id[ramp.id])
    colors = np.array(sorted(owners), dtype=np.uint32)
    ids = np.array([owners[color][0].id for color in sorted(owners)], dtype=np.uint8)
    unique = np.array([len(owners[color]) == 1 for color in sorted(owners)])
    place = np.searchsorted(colors, packed).clip(max=len(colors) - 1)
    known = (colors[place] == packed) & unique[place]
    if not known.all():
        raise CompileError(_wrong_colors(path, packed, known, owners))
    return ids[place]


def _wrong_colors(
    path: Path, packed: NDArray[np.uint32], known: NDArray[np.bool_], owners: dict[int, list[Element]]
) -> list[Diagnostic]:
    """Diagnostics of unknown colors, in the order of their first pixels."""
    wrong = np.flatnonzero(~known)
    colors, first, counts = np.unique(packed.reshape(-1)[wrong], return_index=True, return_counts=True)
    result = []
    for number in np.argsort(first)[:MAX_REPORTED].tolist():
        pixel = divmod(int(wrong[first[number]]), packed.shape[1])
        result.append(_wrong_color(path, int(colors[number]), pixel, int(counts[number]), owners))
    if len(colors) > MAX_REPORTED:
        fix = "draw with a hard brush in the elements' colors, one pixel a cell, and scale without smoothing"
        message = f"{len(colors):,} colors in {path} are not any element's"
        result.append(Diagnostic("PD609", message, Label(None), helps=(fix,)))
    return result


def _pack(color: bytes) -> int:
    return int.from_bytes(color + b"\xff", "little")


def _pixels(path: Path) -> NDArray[np.uint8]:
    """The picture as uint8 [H, W, 4]: red, green, blue, opacity."""
    require("numpy", "reading a picture", "pip install numpy")
    images = require("PIL.Image", "reading a picture", "pip install pillow")
    try:
        file = open_regular(path)
    except OSError as error:
        raise failure("PD101", f"cannot read {path}", notes=(error.strerror or str(error),)) from None
    with file:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", images.DecompressionBombWarning)
                image = images.open(file, formats=["PNG"])  # reads only the header
            width, height = image.size
            if height * width > MAX_CELLS:
                raise _too_large(path, f"{height}×{width}")
            if image.mode not in _MODES:
                note = f"pixel format {image.mode}; save it with 8 bits a channel"
                raise failure("PD602", f"{path} is not a picture of a world", notes=(note,))
            return np.array(image.convert("RGBA"))
        except (images.DecompressionBombWarning, images.DecompressionBombError):
            raise _too_large(path, "far too many") from None
        except _BROKEN as error:
            raise failure("PD602", f"{path} is not a readable PNG", notes=(str(error)[:200],)) from None


_BROKEN = (OSError, ValueError, SyntaxError, EOFError, IndexError, OverflowError, MemoryError, zlib.error)
"""Errors that Pillow raises for broken files."""


def _too_large(path: Path, size: str) -> CompileError:
    helps = (f"a world has at most {MAX_CELLS:,} cells",)
    return failure("PD607", f"{path}: a world of {size} cells", helps=helps)


def _wrong_color(
    path: Path, color: int, pixel: tuple[int, int], count: int, owners: dict[int, list[Element]]
) -> Diagnostic:
    *components, opacity = color.to_bytes(4, "little")
    name = "#" + bytes(components).hex().upper()
    where = f"the pixel at row {pixel[0]}, column {pixel[1]}"
    if color in owners:
        names = " and ".join(f"`{element.name}`" for element in owners[color])
        message, helps = f"{where} is {name}, the color of {names}", ("give one of them another color",)
    elif opacity < 255:
        message = f"{where} is {name} at {opacity * 100 // 255}% opacity"
        helps = ("save the picture without transparency",)
    else:
        message = f"{where} is {name}, which is not any element's color"
        candidates = [element for owned in owners.values() for element in owned]
        nearest = min(candidates, key=lambda element: math.dist(bytes.fromhex(element.color[1:]), components))
        helps = (f"the nearest is `{nearest.name}`, {nearest.color}",)
    notes = (f"{path}: {count:,} such pixels, this is the first",)
    return Diagnostic("PD609", message, Label(None), notes=notes, helps=helps)
