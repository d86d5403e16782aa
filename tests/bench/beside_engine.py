"""The torch engine of 2023, for `powderdsl bench powderworld2 --beside`.

    git clone https://github.com/kvfrans/powderworld ../powderworld-2023 && git -C ../powderworld-2023 checkout 1007709
    export POWDERWORLD_2023=../powderworld-2023

It needs torch only. For worlds of `powderworld2_ogbench`, it runs the nine passes of these rules.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

NINE = (
    "BehaviorStone", "BehaviorGravity", "BehaviorSand", "BehaviorFluidFlow", "BehaviorIce", "BehaviorWater",
    "BehaviorFire", "BehaviorPlant", "BehaviorVelocity",
)  # fmt: skip
WARM = 4
"""Steps until its compiled passes run at full speed: torch specializes them in the first ones."""

State = dict[str, Any]


@cache
def sim_module() -> Any:
    """Its module `sim`, alone: the package also imports an old `gym`."""
    path = Path(os.environ["POWDERWORLD_2023"]) / "powderworld" / "sim.py"
    spec = spec_from_file_location("powderworld_2023_sim", path)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def engine(passes: int, shape: tuple[int, ...]) -> Any:
    """Its simulator with 18 or 9 passes, compiled for ids of this shape, as it compiles itself."""
    module = sim_module()

    class Nine(module.PWSim):  # type: ignore[misc, name-defined]
        def register_update_rules(self) -> None:
            self.update_rules = [getattr(module, name)(self) for name in NINE]
            self.update_rules_jit = None

    sim = module.PWSim("cpu") if passes == 18 else Nine("cpu")
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        world = sim.np_to_pw(np.zeros(shape, dtype=int)).clone()
        for _ in range(WARM):
            world = sim.forward(world)
    return sim


def numbers(state: State) -> State:
    """The engine's gravity, velocity and three custom numbers, which are fields of their own here, by channel."""
    zero = np.zeros_like(state["element"], dtype=np.float32)
    field = {name: state.get(name, zero) for name in ("clone", "digging", "crawling", "energy", "leap")}
    flying = state.get("flying", np.stack([zero, zero], 1))
    return {
        "gravity": state["gravity"],
        "velocity": state["velocity"],
        # eighths of a turn are quarters there
        "custom1": state["momentum"]
        + field["clone"]
        + (field["digging"] + field["crawling"]) / 2
        + flying[:, 0],
        "custom2": field["energy"] + field["leap"] + flying[:, 1],
        "custom3": state["fell"],
    }


def tensor_of(sim: Any, state: State) -> Tensor:
    """The same worlds in its channels: id, density, gravity, velocity, color, custom1, custom2, custom3."""
    found = {name: torch.from_numpy(np.asarray(value)) for name, value in numbers(state).items()}
    world: Tensor = sim.np_to_pw(state["element"].astype(int)).clone()
    world[:, 2], world[:, 3:5] = found["gravity"], found["velocity"]
    world[:, 6], world[:, 7], world[:, 8] = found["custom1"], found["custom2"], found["custom3"]
    return world


def engine_for(state: State) -> Any:
    return engine(18 if "clone" in state else 9, state["element"].shape)


def load(state: State) -> Callable[[int], None]:
    sim = engine_for(state)
    world = tensor_of(sim, state)

    def run(steps: int) -> None:
        nonlocal world
        for _ in range(steps):
            world = sim.forward(world)

    return run


def stepped(state: State, draws: dict[str, np.ndarray]) -> Tensor:
    """Its worlds after a step with these random numbers, float32 [N, H, W] by stream, instead of its own."""
    sim = engine_for(state)
    world = tensor_of(sim, state)
    planes = tuple(torch.from_numpy(draws[name])[:, None] for name in ("movement", "interact", "element"))
    with torch.no_grad():
        for one in sim.update_rules_jit:
            world = one(world, planes)
    return world
