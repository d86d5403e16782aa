"""A step of worlds in the middle of play, beside OGBench's own simulator: `python -m tests.bench.ogbench_worlds`.

Needs `pip install --no-deps ogbench tqdm`. Worlds are those after 150 whole actions of scripted play, one thread.
"""

from __future__ import annotations

import numpy as np
import torch

from powderdsl.ogbench.collect import play
from powderdsl.ogbench.env import EnvOptions
from powderdsl.simulation.simulator import World
from tests.bench.beside_ogbench import load
from tests.bench.rounds import Maker, microseconds

PLAYED = 150
"""Whole actions before the worlds are measured."""
STEPS, ROUNDS = {"wasm": 16, "native": 32}, 7
"""Steps of a call, and rounds in which all run one after the other."""


def played(level: str, worlds: int, backend: str) -> World:
    program = EnvOptions(backend=backend).program(level)
    actions = play(program.level, 0, np.arange(worlds), PLAYED).astype(np.int64)
    world = program.start(np.zeros(worlds, dtype=np.int64), np.arange(worlds))
    for number in range(PLAYED):
        world = program.act(world, actions[:, number])
    return world


def main() -> None:
    torch.set_num_threads(1)
    for level in ("easy", "medium", "hard"):
        for worlds in (32, 256):
            makers: dict[str, Maker] = {}
            for backend in STEPS:
                world = played(level, worlds, backend)
                makers[backend] = lambda world=world: lambda steps: world.sim.step(world, steps)
            state = {name: value.numpy().copy() for name, value in world.state.items()}
            makers["OGBench"] = lambda state=state: load(state)
            spent = microseconds(makers, worlds, {**STEPS, "OGBench": 2}, ROUNDS)
            theirs = spent.pop("OGBench")
            moving = (np.abs(state["velocity"]).max(1) > 0).mean()
            shown = ", ".join(f"{name} {us:.1f} µs ({theirs / us:.0f}×)" for name, us in spent.items())
            print(
                f"{level}, {worlds} worlds, {moving:.0%} of cells in motion: OGBench {theirs:.0f} µs, {shown}",
                flush=True,
            )


if __name__ == "__main__":
    main()
