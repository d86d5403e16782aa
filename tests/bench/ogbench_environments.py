"""Environment steps per second of processor time, beside OGBench's own environment: `python tests/bench/ogbench_environments.py`.

Needs `pip install --no-deps ogbench tqdm`. Both play data of the level in data-collection mode, in the same process,
one after the other in several rounds; medians are shown.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable

import gymnasium
import numpy as np
import ogbench  # noqa: F401  registers its environments
import torch

from powderdsl.ogbench.collect import play
from powderdsl.ogbench.env import EnvOptions, PowderworldVectorEnv
from powderdsl.ogbench.levels import find_level

ROUNDS, ACTIONS = 3, 60
"""Rounds, and whole actions of an episode that are played in each."""


def single(level: str) -> Callable[[np.ndarray], None]:
    env = gymnasium.make(f"powderworld-{level}-v0", mode="data_collection").unwrapped

    def run(actions: np.ndarray) -> None:
        env.reset()
        for action in actions[0]:
            env.step(int(action))

    return run


def batched(level: str, worlds: int, backend: str) -> Callable[[np.ndarray], None]:
    program = EnvOptions(backend=backend).program(level)
    env = PowderworldVectorEnv(program, worlds, mode="data_collection")

    def run(actions: np.ndarray) -> None:
        env.reset()
        for row in actions.T:
            env.step(row)

    return run


def main() -> None:
    level = sys.argv[1] if len(sys.argv) > 1 else "hard"
    torch.set_num_threads(1)
    cases = {("ogbench", 1): single(level)}
    for backend in ("wasm", "native"):
        cases |= {(backend, worlds): batched(level, worlds, backend) for worlds in (1, 32, 256)}
    spent: dict[tuple[str, int], list[float]] = {case: [] for case in cases}
    for number in range(ROUNDS + 1):  # the first round compiles
        for (name, worlds), run in cases.items():
            episodes = np.arange(worlds) + 1000 * number
            actions = play(find_level(level), 0, episodes, ACTIONS).reshape(worlds, -1).astype(np.int64)
            begun = time.process_time()
            run(actions)
            if number:
                spent[name, worlds].append((time.process_time() - begun) / actions.size)
    base = statistics.median(spent["ogbench", 1])
    for (name, worlds), seconds in spent.items():
        found = statistics.median(seconds)
        print(f"{name:8} {worlds:4} worlds: {1e6 * found:8.1f} µs per environment step, {base / found:6.0f}×")


if __name__ == "__main__":
    main()
