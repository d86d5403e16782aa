"""Batches of worlds as one picture, and the fields that pictures show."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from powderdsl.arrays import NDArray, np
from powderdsl.cli.exits import BadInput
from powderdsl.simulation.draw import contact_sheet, palette, ramps, rgb, scale, to_numpy

if TYPE_CHECKING:
    from powderdsl.simulation.any_arrays import AnyWorld

USUAL_SIDE = 400
MAX_SIDE = 16_384
"""Pixels a side. More would take gigabytes before the first one is written."""


def pictures(world: AnyWorld, *, most: int, factor: int | None) -> NDArray[np.uint8]:
    """A batch as one picture, uint8 [H', W', 3]: up to `most` worlds side by side, cells of `factor` pixels.

    Cells that a vector field moves are tinted. Without a factor a side has about USUAL_SIDE pixels. Raises
    BadInput for pictures of more than MAX_SIDE.
    """
    shown = min(len(world), most)
    columns = math.ceil(math.sqrt(shown))
    longest = max(world.shape[1:]) * columns
    factor = factor or max(1, min(8, USUAL_SIDE // longest))
    if longest * factor > MAX_SIDE:
        raise BadInput(f"a picture of {longest * factor:,} pixels a side: choose a smaller --scale or --size")
    few = world.select(slice(0, shown))
    elements = few.sim.ruleset.elements
    image = rgb(few.ids, palette(elements), motion_of(few), ramps=ramps(elements), fields=shown_fields(few))
    images = to_numpy(scale(image, factor))
    return images[0] if shown == 1 else contact_sheet(images, columns=columns)


def first_world(world: AnyWorld) -> dict[str, Any]:
    """The first world of a batch, as `LiveView.show` takes it: `ids` [H, W], `motion` [2, H, W] or None, `fields`."""
    motion = motion_of(world)
    fields = {name: values[0] for name, values in shown_fields(world).items()}
    return {"ids": world.ids[0], "motion": None if motion is None else motion[0], "fields": fields}


def shown_fields(world: AnyWorld) -> dict[str, Any]:
    """The fields that colors follow, [B, H, W] each, by name."""
    return {ramp.field: world[ramp.field] for ramp in ramps(world.sim.ruleset.elements)}


def motion_of(world: AnyWorld) -> Any:
    """The first vector field, float32 [B, 2, H, W], which pictures show as a tint; None if there is none."""
    names = [item.name for item in world.sim.ruleset.fields if item.kind.name == "vec2"]
    return world[names[0]] if names else None
