"""Worlds and environments beside OGBench's own, in one thread: `python -m tests.bench.ogbench_worlds`.

Needs `pip install --no-deps ogbench tqdm`. Worlds are those after 150 whole actions of scripted play. Environments play
60 whole actions of it, with observations, in data-collection mode.
"""

from __future__ import annotations

from collections.abc import Callable

import gymnasium
import numpy as np
import ogbench  # noqa: F401  registers its environments
import torch

from powderdsl.ogbench.collect import play
from powderdsl.ogbench.env import EnvOptions, PowderworldVectorEnv
from powderdsl.ogbench.levels import find_level
from powderdsl.simulation.simulator import World
from tests.bench.beside_ogbench import load
from tests.bench.rounds import Maker, microseconds

PLAYED, ACTIONS = 150, 60
"""Whole actions before worlds are measured, and those that environments play."""
STEPS, ROUNDS = {"wasm": 16, "native": 32}, 7
"""Steps of a call, and rounds in which all run one after the other."""


def played(level: str, worlds: int, backend: str) -> World:
    program = EnvOptions(backend=backend).program(level)
    actions = play(program.level, 0, np.arange(worlds), PLAYED).astype(np.int64)
    world = program.start(np.zeros(worlds, dtype=np.int64), np.arange(worlds))
    for number in range(PLAYED):
        world = program.act(world, actions[:, number])
    return world


def playing(level: str, worlds: int, backend: str) -> Callable[[int], None]:
    """Plays steps of an environment: OGBench's own, which has one world, or ours with a batch of them."""
    actions = play(find_level(level), 0, np.arange(worlds), ACTIONS).reshape(worlds, -1).astype(np.int64)
    if backend == "OGBench":
        env = gymnasium.make(f"powderworld-{level}-v0", mode="data_collection").unwrapped
        rows = [int(action) for action in actions[0]]
    else:
        program = EnvOptions(backend=backend).program(level)
        env, rows = PowderworldVectorEnv(program, worlds, mode="data_collection"), actions.T

    def run(steps: int) -> None:
        env.reset()
        for row in rows[:steps]:
            env.step(row)

    return run


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
                f"{level}, {worlds} worlds, {moving:.0%} in motion: OGBench {theirs:.0f} µs, {shown}",
                flush=True,
            )
    for worlds in (1, 32, 256):
        names = [*STEPS, "OGBench"] if worlds == 1 else STEPS
        runs = {name: playing("hard", worlds, name) for name in names}
        makers = {name: lambda run=run: run for name, run in runs.items()}
        for name, us in microseconds(makers, worlds, 3 * ACTIONS, 3).items():
            print(f"{name}, {worlds} worlds: {us:.1f} µs per environment step", flush=True)


if __name__ == "__main__":
    main()
