"""OGBench's own simulator, for `powderdsl bench powderworld2_ogbench --beside`. Needs `pip install --no-deps ogbench`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from ogbench.powderworld.sim import PWSim


def load(state: dict[str, Any]) -> Callable[[int], None]:
    """The same worlds in its channels: id, density, gravity, velocity, color, momentum, nothing, fell."""
    sim = PWSim()
    world = sim.np_to_pw(state["element"].astype(int)).copy()
    world[:, 2], world[:, 3:5] = state["gravity"], state["velocity"]
    world[:, 6], world[:, 8] = state["momentum"], state["fell"]

    def run(steps: int) -> None:
        nonlocal world
        for _ in range(steps):
            world = sim.forward(world)

    assert world.dtype == np.float32
    return run
