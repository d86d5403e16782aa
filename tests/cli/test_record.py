"""`powderdsl record`."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from powderdsl.datasets import Dataset, record
from powderdsl.envs import TensorEnv
from powderdsl.rl.policies import load_policy
from powderdsl.system.random import action_keys
from tests.cli.commands import powderdsl
from tests.envs.conftest import SMALL


@pytest.fixture
def task(tmp_path: Path) -> Path:
    path = tmp_path / "small.yaml"
    path.write_text(SMALL, encoding="utf-8")
    return path


def test_a_dataset_is_recorded_and_verified(task: Path, tmp_path: Path) -> None:
    out = tmp_path / "data"
    few = ("--episodes", 10, "--shard", 4, "--seed", 2, "--backend", "wasm")
    command = ("record", task, "--out", out, *few)
    more = ("--knob", "disks=2", "--set", "water.melt=50%", "--split", "test", "--worlds", 5)
    done = powderdsl(
        *command, *more, "--policy", "nothing", "--observation", "compact", "--compress", exits=0
    )
    assert done.stderr.startswith(f"{out}: 10 episodes of small (test, nothing), ")
    recipe = Dataset.open(out).recipe
    assert (recipe.knobs["disks"], recipe.params["water.melt"]) == (2, 0.5)
    assert (recipe.split, recipe.worlds, recipe.policy, recipe.seed) == ("test", 5, "nothing", 2)
    assert (recipe.observation, recipe.compress, recipe.shard) == ("compact", True, 4)
    assert ", all as recorded" in powderdsl("record", "--verify", out, exits=0).stderr
    refused = powderdsl(*command, *more, exits=2)
    for line in (
        '`policy` is "nothing" there, "random" here',
        '`observation` is "compact" there, "ids" here',
        "`compress` is true there, false here",
    ):
        assert line in refused.stderr
    (out / "shard-000001.npz").write_bytes(b"no shard")
    assert "shard-000001.npz is damaged" in powderdsl("record", "--verify", out, exits=2).stderr


def test_a_trained_agent_is_recorded(task: Path, tmp_path: Path) -> None:
    """It acts as it does elsewhere: on what it was trained to see, by the keys of the episode."""
    run, out = tmp_path / "dunes", tmp_path / "data"
    few = ("--preset", "small", "--observation", "compact", "--envs", 2, "--rollout", 4, "--batch", 8)
    powderdsl("train", task, "--run", run, *few, "--steps", 8, "--epochs", 1, "--backend", "wasm", exits=0)
    command = ("record", task, "--out", out, "--episodes", 3, "--backend", "wasm", "--policy", run)
    powderdsl(*command, exits=0)
    data = Dataset.open(out)
    assert data.recipe.policy.startswith("dunes, checkpoint 000000000008-")
    env = TensorEnv(str(task), 1, observation="compact", backend="wasm", autoreset_mode="disabled")
    policy = load_policy(run, env)
    for number in range(3):
        observed, _ = env.reset(seed=number)
        for step, action in enumerate(data.episode(number).action):
            acted = policy(observed, action_keys(0, torch.tensor([number]), step))
            assert acted[0].tolist() == action.tolist()
            observed = env.step(acted)[0]


def test_a_dataset_goes_to_minari_and_back(
    task: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    out, again = tmp_path / "data", tmp_path / "again"
    data = record(str(task), "random", out, episodes=3, backend="wasm")
    written = powderdsl("record", "--out", out, "--to-minari", "me/small-v0", exits=0)
    assert f"me/small-v0: 3 episodes of small (train, random), {data.steps} transitions" in written.stderr
    powderdsl("record", "--out", again, "--from-minari", "me/small-v0", exits=0)
    assert (again / "shard-000000.npz").read_bytes() == (out / "shard-000000.npz").read_bytes()
    refused = powderdsl("record", "--out", out, "--to-minari", "small", exits=2)
    assert "a Minari dataset is named namespace/name-v0" in refused.stderr
