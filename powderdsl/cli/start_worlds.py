"""Where a run starts: a saved world, a picture, a drawing, a scene, or shapes strewn at random."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from powderdsl.cli.exits import BadInput, user_values
from powderdsl.model.types import Ruleset
from powderdsl.worlds.files import failure
from powderdsl.worlds.raster import Size
from powderdsl.worlds.strewn import check_cells, strew

if TYPE_CHECKING:
    from powderdsl.simulator import Simulator, World

DEFAULT_SIZE: Size = (64, 64)

KINDS = "worlds are .npz, .png, .txt and .yaml files, FILE.yaml#NAME, or a shipped scene's name"


def start_ids(
    ruleset: Ruleset, name: str | None, size: Size | None, batch: int | None, seed: int | None
) -> NDArray[np.uint8] | None:
    """The ids uint8 [B, H, W] that a run starts from, or None for a saved world, which has more than ids.

    A saved world goes on as it was saved, random future included, so `size`, `batch` and `seed` do not go
    with it. A drawn world stands `batch` times. Without a name every world is strewn by itself.

    Raises CompileError for files and names that cannot be used, BadInput for options that do not go together.
    """
    if name is None:
        return strew(ruleset, size or DEFAULT_SIZE, batch or 1, seed or 0)
    if name.lower().endswith(".npz"):
        _refuse_options("a saved world has its own", size=size, batch=batch, seed=seed)
        return None
    ids = drawn_ids(name, ruleset, size)
    check_cells(batch or 1, ids.shape)
    return np.repeat(ids[None], batch or 1, axis=0)


def start_world(sim: Simulator, ids: NDArray[np.uint8] | None, name: str | None, seed: int | None) -> World:
    """The worlds of what `start_ids` gave for the same name; each has random numbers of its own."""
    with user_values():
        if ids is not None:
            return sim.world(ids, seed=seed or 0)
        from powderdsl.worlds.store import load_world

        assert name is not None
        return load_world(name, sim)


def drawn_ids(name: str, ruleset: Ruleset, size: Size | None) -> NDArray[np.uint8]:
    """The ids uint8 [H, W] of a picture, an ASCII drawing or a scene; only scenes can have another `size`."""
    suffix = Path(name).suffix.lower()
    if suffix == ".png":
        _refuse_options("a picture has its own", size=size)
        from powderdsl.worlds.image import read_image

        return read_image(name, ruleset.elements)
    if suffix == ".txt":
        _refuse_options("a drawing has its own", size=size)
        from powderdsl.worlds.ascii import load_ascii

        return load_ascii(name, ruleset.elements)
    if Path(name).is_file() and suffix not in (".yaml", ".yml"):
        raise failure("PD602", f"cannot tell what {name} is", helps=(KINDS,))
    if re.search(r"\.[A-Za-z0-9]{1,5}\Z", name) and suffix not in (".yaml", ".yml"):
        raise failure("PD601", f"no world {name}", helps=(KINDS,))
    from powderdsl.worlds.scene import load_scene

    return load_scene(name, ruleset, size=size)


def _refuse_options(reason: str, **options: object) -> None:
    for option, value in options.items():
        if value is not None:
            raise BadInput(f"--{option} does not go with this world: {reason}")
