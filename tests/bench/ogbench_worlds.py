"""A step of worlds in the middle of play, beside OGBench's own simulator: `python tests/bench/ogbench_worlds.py`.

Needs `pip install --no-deps ogbench tqdm`. Worlds are those after 150 whole actions of scripted play, one thread.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from powderdsl.ogbench.env import made_program
from powderdsl.ogbench.play import play
from powderdsl.simulation.simulator import World

sys.path.insert(0, str(Path(__file__).parent))
from beside_ogbench import load

PLAYED = 150
"""Whole actions before the worlds are measured."""


def played(level: str, worlds: int, backend: str) -> World:
    program = made_program(level, "counter", backend, "cpu", 1)
    actions = play(program.level, 0, np.arange(worlds), PLAYED).astype(np.int64)
    world = program.start(np.zeros(worlds, dtype=np.int64), np.arange(worlds))
    for number in range(PLAYED):
        world = program.act(world, actions[:, number])
    return world


def microseconds(run: Callable[[int], object], steps: int, worlds: int, rounds: int = 5) -> float:
    """Processor time of a step of one world: the median of some rounds."""
    run(1)
    found = []
    for _ in range(rounds):
        begun = time.process_time()
        run(steps)
        found.append((time.process_time() - begun) / steps / worlds)
    return 1e6 * statistics.median(found)


def main() -> None:
    torch.set_num_threads(1)
    for level in ("easy", "medium", "hard"):
        for worlds in (32, 256):
            spent, state = {}, {}
            for backend in ("wasm", "native"):
                world = played(level, worlds, backend)
                state = {name: value.numpy().copy() for name, value in world.state.items()}
                spent[backend] = microseconds(
                    lambda steps, world=world: world.sim.step(world, steps), 16, worlds
                )
            theirs = microseconds(load(state), 2, worlds, rounds=3)
            moving = (np.abs(state["velocity"]).max(1) > 0).mean()
            shown = ", ".join(f"{name} {us:.1f} µs ({theirs / us:.0f}×)" for name, us in spent.items())
            print(
                f"{level}, {worlds} worlds, {moving:.0%} of cells in motion: OGBench {theirs:.0f} µs, {shown}"
            )


if __name__ == "__main__":
    main()
