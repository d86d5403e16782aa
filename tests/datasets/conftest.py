"""A small task on planes, and a dataset of it."""

from __future__ import annotations

import pytest
import torch

from powderdsl.datasets import Dataset, record
from powderdsl.tasks.episodes import TaskProgram, compile_task
from tests.envs.conftest import SMALL


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> TaskProgram:
    """16×16 cells, six actions; some episodes end early."""
    torch.set_num_threads(1)
    path = tmp_path_factory.mktemp("tasks") / "small.yaml"
    path.write_text(SMALL, encoding="utf-8")
    return compile_task(str(path), backend="wasm")


@pytest.fixture(scope="session")
def recorded(small: TaskProgram, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """20 random episodes in shards of eight, four and less at once. Not to be written to."""
    folder = tmp_path_factory.mktemp("data") / "recorded"
    return record(small, "random", folder, episodes=20, seed=3, shard=8, envs=4)
