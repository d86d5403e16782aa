"""Start worlds of a run: a saved world, a picture, a drawing, a scene, or shapes scattered at random."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from powderdsl.arrays import np
from powderdsl.cli.exits import BadInput, user_values
from powderdsl.compiler import segments_of
from powderdsl.model.state import fitting
from powderdsl.model.types import Ruleset
from powderdsl.system.cache import Memo
from powderdsl.system.writing import failure
from powderdsl.worlds.raster import Size
from powderdsl.worlds.scene import Start
from powderdsl.worlds.strewn import check_cells, strew

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import World

DEFAULT_SIDE = 64

FEW = 1 << 27
"""Cells times steps that WebAssembly runs in about a second, the time that importing torch takes. Also 100 times the
number of cells that surely fit into the memory of WebAssembly."""


def start(
    ruleset: Ruleset,
    name: str | None,
    size: Size | None,
    batch: int | None,
    seed: int | None,
    *,
    backend: str = "auto",
    steps: int = 0,
    **how: Any,
) -> World:
    """The worlds that a run starts from, each with its own random numbers.

    `auto` imports torch, and may compile native code, only if many steps follow; `how` is passed to
    `simulator.compile`. Raises CompileError for an invalid file or name, BadInput for incompatible options.
    """
    # Draw the world first, so that a mistyped name fails before torch is imported.
    drawn = start_drawn(ruleset, name, size, batch, seed)
    from powderdsl.simulation.simulator import LAST_STEP, compile

    memo = Memo()  # so that it is lowered only once
    many = drawn is None or drawn.ids.size * max(steps, 100) > FEW
    # WebAssembly runs only passes on bit planes; without torch, the slow oracle runs the rest.
    tensors = backend == "auto" and (many or any(part.planes is None for part in segments_of(ruleset, memo)))
    sim = compile(ruleset, backend, tensors=tensors, memo=memo, **how)
    from powderdsl.worlds.store import fresh_world, load_world

    with user_values():
        if drawn is None:
            world = load_world(str(name), sim)
            if world.since + steps > LAST_STEP:
                more = f"{LAST_STEP - world.since:,} more steps: the last one is {LAST_STEP:,}"
                raise failure("PD602", f"`{name}` can make {more}")
            return world
        return fresh_world(sim, drawn, seed or 0)


def start_drawn(
    ruleset: Ruleset, name: str | None, size: Size | None, batch: int | None, seed: int | None
) -> Start | None:
    """Fresh worlds, ids uint8 [B, H, W]; None for a saved world, which is complete.

    A saved world continues with its own random numbers, so `size`, `batch` and `seed` are not allowed with it. A drawn
    world is repeated `batch` times. Without a name, each world is scattered independently.
    """
    if name is None:
        side = fitting(ruleset, DEFAULT_SIDE)
        return Start(strew(ruleset, size or (side, side), batch or 1, seed or 0), {})
    if name.lower().endswith(".npz"):
        for option, value in {"size": size, "batch": batch, "seed": seed}.items():
            if value is not None:
                raise BadInput(f"--{option} cannot be used with this world: a saved world has its own")
        return None
    from powderdsl.worlds.store import drawn_world

    with user_values():
        world = drawn_world(name, ruleset, size)
    check_cells(batch or 1, world.ids.shape)
    return Start(np.repeat(world.ids[None], batch or 1, axis=0), world.fields)
