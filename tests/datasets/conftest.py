"""A dataset of the small task that environments are tested with."""

from __future__ import annotations

import pytest

from powderdsl.datasets import Dataset, record
from powderdsl.tasks.episodes import TaskProgram
from tests.envs.conftest import small, task_file  # noqa: F401


@pytest.fixture(scope="session")
def recorded(small: TaskProgram, tmp_path_factory: pytest.TempPathFactory) -> Dataset:  # noqa: F811
    """20 random episodes in shards of eight, four and less at once. Not to be written to."""
    folder = tmp_path_factory.mktemp("data") / "recorded"
    return record(small, "random", folder, episodes=20, seed=3, shard=8, envs=4)
