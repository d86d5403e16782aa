"""Pictures and text of the worlds of an environment, for `render`."""

from __future__ import annotations

from typing import Any

from gymnasium.error import ResetNeeded

from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.simulation.draw import scale

RENDER_MODES = ("rgb_array", "ansi")


def check_render_mode(mode: str | None) -> str | None:
    """A render mode that there is. Raises ValueError for another."""
    if mode is not None and mode not in RENDER_MODES:
        raise ValueError(f"render_mode is one of {', '.join(RENDER_MODES)}; found {mode!r}")
    return mode


def frames(env: TensorEnv, mode: str, factor: int) -> tuple[Any, ...]:
    """Of each world uint8 [H·factor, W·factor, 3], or its rows as glyphs."""
    if env.episodes is None:
        raise ResetNeeded("reset the environment before rendering it")
    world = env.episodes.world
    if mode == "rgb_array":
        return tuple(scale(world.rgb().cpu().numpy(), factor))
    glyphs = {element.id: element.glyph for element in env.simulator.ruleset.elements}
    return tuple(
        "".join("".join(glyphs.get(number, "?") for number in row) + "\n" for row in rows)
        for rows in world.ids.tolist()
    )
