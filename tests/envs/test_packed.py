"""Worlds that stay packed in native memory through actions, steps and restarts are those of the backend `wasm`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.simulation.simulator import Simulator
from powderdsl.simulation.simulator import compile as compile_rules
from powderdsl.targets.cpp.build import Building, building
from powderdsl.targets.cpp.program import PackedState
from powderdsl.tasks.episodes import TaskProgram, load_task
from tests.compilers import skip_without_compiler


@pytest.fixture(scope="module")
def native(small: TaskProgram, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Simulator]:
    skip_without_compiler("native")
    with building(Building("-O0", tmp_path_factory.mktemp("native"))):
        yield compile_rules(small.task.ruleset, "native")


@pytest.mark.parametrize(("size", "envs"), [((16, 16), 3), ((16, 70), 11), ((16, 130), 2)])
@pytest.mark.parametrize("kind", ["ids", "compact"])
def test_packed_episodes_are_the_same(
    native: Simulator,
    small: TaskProgram,
    task_file: Path,
    tmp_path: Path,
    size: tuple[int, int],
    envs: int,
    kind: str,
) -> None:
    """In lanes and in strips, with words that are full and not."""
    path = tmp_path / "sized.yaml"
    path.write_text(task_file.read_text().replace("[16, 16]", str(list(size))))
    task = load_task(path)
    packed = TensorEnv(TaskProgram(task, "train", native), envs, observation=kind)
    plain = TensorEnv(TaskProgram(task, "train", small.simulator), envs, observation=kind)
    rng = np.random.default_rng(4)
    assert torch.equal(packed.reset(seed=1)[0], plain.reset(seed=1)[0])
    restarts = 0
    for step in range(14):
        actions = rng.integers(0, packed.action_nvec, (envs, 5))
        found, wanted = packed.step(actions), plain.step(actions)
        for one, other in zip(found[:4], wanted[:4], strict=True):
            assert torch.equal(one, other), step
        state = packed.episodes.world.state
        restarts += isinstance(state, PackedState) and "final_obs" in found[4]
        for name, value in plain.episodes.world.state.items():
            assert torch.equal(state[name], value), (step, name)
    assert restarts > 0, "all episodes ended together: no world was replaced in a batch"


def test_spent_worlds_are_refused(native: Simulator) -> None:
    world = native.step(native.world(torch.zeros(2, 16, 16, dtype=torch.uint8)), 1)
    after = native.step(world, 1, reuse=True)
    assert torch.equal(after.ids, torch.zeros(2, 16, 16, dtype=torch.uint8))
    for read in (lambda: world.ids, lambda: native.step(world), world.rgb):
        with pytest.raises(RuntimeError, match="reuse"):
            read()
