"""Batches of worlds as one picture, and the fields that pictures show."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from powderdsl.arrays import NDArray, np
from powderdsl.cli.exits import BadInput
from powderdsl.simulation.draw import contact_sheet, palette, ramps, rgb, scale, shown_fields, tints

if TYPE_CHECKING:
    from powderdsl.simulation.any_arrays import AnyWorld

USUAL_SIDE = 400
MAX_SIDE = 16_384
"""Pixels a side. More would take gigabytes before the first one is written."""


def pictures(world: AnyWorld, *, most: int, factor: int | None) -> NDArray[np.uint8]:
    """A batch as one picture, uint8 [H', W', 3]: up to `most` worlds side by side, cells of `factor` pixels.

    Colors follow fields, and vectors tint cells, as the rules declare. Without a factor a side has about USUAL_SIDE pixels. Raises
    BadInput for pictures of more than MAX_SIDE.
    """
    shown = min(len(world), most)
    columns = math.ceil(math.sqrt(shown))
    longest = max(world.shape[1:]) * columns
    factor = factor or max(1, min(8, USUAL_SIDE // longest))
    if longest * factor > MAX_SIDE:
        raise BadInput(f"a picture of {longest * factor:,} pixels a side: choose a smaller --scale or --size")
    few = world.select(slice(0, shown))
    rules = few.sim.ruleset
    colors, ramped, tinted = palette(rules.elements), ramps(rules.elements), tints(rules.fields)
    image = rgb(few.ids, colors, ramps=ramped, tints=tinted, fields=fields_of(few))
    images = scale(image, factor)
    return images[0] if shown == 1 else contact_sheet(images, columns=columns)


def first_world(world: AnyWorld) -> dict[str, Any]:
    """The first world of a batch, as `LiveView.show` takes it: `ids` [H, W] and `fields`."""
    return {"ids": world.ids[0], "fields": {name: values[0] for name, values in fields_of(world).items()}}


def fields_of(world: AnyWorld) -> dict[str, Any]:
    """The fields that pictures show, [B, H, W] or of vectors [B, 2, H, W], by name."""
    return {name: world[name] for name in shown_fields(world.sim.ruleset)}
