"""What is recorded is what was played, and follows from the recipe alone."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from filelock import FileLock
from torch import Tensor

from powderdsl.datasets import Dataset, record
from powderdsl.datasets.manifest import MAX_SHARDS, read_manifest, recipe_of
from powderdsl.diagnostics import CompileError
from powderdsl.envs import TensorEnv
from powderdsl.envs.actions import random_policy
from powderdsl.system.archives import write_archive
from powderdsl.system.random import action_keys
from powderdsl.system.writing import MARK
from powderdsl.tasks.episodes import TaskProgram
from tests.refusals import refusal


def files(folder: Path) -> dict[str, bytes]:
    """The shards of a folder."""
    return {path.name: path.read_bytes() for path in sorted(folder.glob("shard-*.npz"))}


@pytest.mark.parametrize("observation", ["ids", "compact"])
def test_episodes_are_what_stepping_gives(observation: str, small: TaskProgram, tmp_path: Path) -> None:
    """Each recorded episode, played again by hand with its actions, in an environment of its own."""
    data = record(
        small, "random", tmp_path / "data", episodes=12, seed=5, observation=observation, shard=5, envs=3
    )
    env = TensorEnv(small, 1, observation=observation, autoreset_mode="disabled")
    ends = set()
    for number in range(12):
        one = data.episode(number)
        observed, info = env.reset(seed=5 + number)
        assert one.world == int(info["world"]) == 5 + number
        assert torch.equal(one.observation[0], observed[0])
        for step, action in enumerate(one.action):
            observed, reward, terminated, truncated, info = env.step(action[None])
            assert torch.equal(one.observation[step + 1], observed[0])
            assert float(one.reward[step]) == float(reward)
            assert bool(one.terminated[step]) == bool(terminated)
            assert bool(one.truncated[step]) == bool(truncated)
            assert bool(one.success[step]) == bool(info["success"])
        assert terminated or truncated
        ends.add((bool(terminated), bool(truncated), len(one.action) < 6))
    assert {(True, False, True), (False, True, False)} <= ends, (
        "all episodes end alike: the task tests nothing"
    )
    assert data.steps == sum(len(data.episode(number).action) for number in range(12))


@pytest.mark.parametrize("envs", [1, 1000])
def test_shards_do_not_depend_on_the_batch_size(
    envs: int, small: TaskProgram, recorded: Dataset, tmp_path: Path
) -> None:
    record(small, "random", tmp_path / "data", episodes=20, seed=3, shard=8, envs=envs)
    assert files(tmp_path / "data") == files(recorded.folder)
    assert read_manifest(tmp_path / "data").shards == recorded.manifest.shards
    assert recipe_of(TensorEnv(small, 1), episodes=600 * MAX_SHARDS).shards <= MAX_SHARDS


@pytest.mark.parametrize("moment", [0, 1, 5, 9, 16])
def test_recording_goes_on_where_it_stopped(
    moment: int, small: TaskProgram, recorded: Dataset, tmp_path: Path
) -> None:
    acts, calls = random_policy(small.action_nvec), 0

    def failing(observed: Tensor, keys: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        if calls > moment:
            raise KeyboardInterrupt
        return acts(observed, keys)

    folder, how = tmp_path / "data", {"episodes": 20, "seed": 3, "shard": 8}
    with pytest.raises(KeyboardInterrupt):
        record(small, failing, folder, envs=3, policy_name="random", **how)  # type: ignore[arg-type]
    with pytest.raises(CompileError, match="not complete"):
        Dataset.open(folder)
    before = {path.name: path.stat().st_mtime_ns for path in folder.glob("shard-*.npz")}
    played: list[float] = []
    record(small, "random", folder, progress=lambda done, total: played.append(done), **how)  # type: ignore[arg-type]
    assert files(folder) == files(recorded.folder)
    assert played[0] == 8 * len(before)
    assert played[-1] == 20
    assert all((folder / name).stat().st_mtime_ns == when for name, when in before.items())
    assert {path.name for path in folder.iterdir()} <= {*files(folder), "dataset.json", ".lock"}


@pytest.mark.parametrize(("shards", "left"), [(0, []), (1, ["dataset.json", "shard-000000.npz"])])
def test_a_full_disk_is_told_with_its_path(
    shards: int, left: list[str], small: TaskProgram, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a single shard, nothing is left; otherwise what a further call completes."""
    written = 0

    def write(*arguments: Any) -> None:
        nonlocal written
        if written == shards:
            raise OSError(28, "No space left on device")
        written += 1
        write_archive(*arguments)

    monkeypatch.setattr("powderdsl.datasets.dataset.write_archive", write)
    folder = tmp_path / "data"
    with pytest.raises(CompileError, match=rf"PD613.* cannot write {folder}/shard-00000{shards}.npz"):
        record(small, "random", folder, episodes=20, shard=8)
    assert sorted(path.name for path in tmp_path.rglob("[!.]*.*")) == left
    assert folder.exists() == bool(shards)
    folder.mkdir(exist_ok=True)  # somebody else's
    with pytest.raises(CompileError):
        record(small, "random", folder, episodes=20, shard=8)
    assert folder.exists()


def test_damaged_shards_are_recorded_anew(small: TaskProgram, recorded: Dataset, tmp_path: Path) -> None:
    folder = tmp_path / "data"
    shutil.copytree(recorded.folder, folder)
    (folder / "shard-000000.npz").unlink()
    damaged = bytearray((folder / "shard-000002.npz").read_bytes())
    damaged[-500] ^= 1
    (folder / "shard-000002.npz").write_bytes(damaged)
    (folder / f".shard-000000{MARK}killed.npz").write_bytes(damaged[:100])  # of a process that was killed
    record(small, "random", folder, episodes=20, seed=3, shard=8)
    assert files(folder) == files(recorded.folder)


def test_worlds_begin_at_the_seed_and_repeat(small: TaskProgram, tmp_path: Path) -> None:
    data = record(small, "random", tmp_path / "data", episodes=9, seed=2, worlds=4, shard=4)
    episodes = [data.episode(number) for number in range(9)]
    assert [one.world for one in episodes] == [2, 3, 0, 1, 2, 3, 0, 1, 2]
    assert torch.equal(episodes[0].observation[0], episodes[4].observation[0])
    assert not torch.equal(episodes[0].action[:2], episodes[4].action[:2]), (
        "a world is played differently each time"
    )


def test_a_policy_is_told_what_it_acts_on(small: TaskProgram, tmp_path: Path) -> None:
    """Its observations are of the kind it asked for, its keys those of the episode and action."""
    seen: dict[int, Tensor] = {}

    def policy(observed: Tensor, keys: Tensor) -> Tensor:
        seen.update(zip(keys.tolist(), observed, strict=True))
        return (keys[:, None] >> torch.arange(5)) % torch.tensor(small.action_nvec)

    folder = tmp_path / "data"
    data = record(
        small, policy, folder, episodes=7, seed=9, shard=3, envs=2, policy_name="bits", sees="compact"
    )
    assert data.recipe.policy == "bits"
    assert data.recipe.observation == "ids"
    for number in range(7):
        one = data.episode(number)
        for step, action in enumerate(one.action.tolist()):
            key = int(action_keys(9, torch.tensor([number]), step))
            assert torch.equal(seen[key][:1], one.observation[step])
            assert action == [(key >> bit) % most for bit, most in enumerate(small.action_nvec)]


def test_random_actions_are_uniform(small: TaskProgram) -> None:
    """Every value of every part within five standard deviations, and parts independent of each other."""
    number = torch.arange(8000)
    keys = action_keys(1 << 40, number, number % 7)
    actions = random_policy(small.action_nvec)(number, keys).numpy()
    for column, most in enumerate(small.action_nvec):
        counts = np.bincount(actions[:, column], minlength=most)
        assert len(counts) == most
        assert (abs(counts - 8000 / most) < 5 * np.sqrt(8000 / most)).all()
    pairs = np.bincount(actions[:, 3] * 3 + actions[:, 4], minlength=9)
    assert (abs(pairs - 8000 / 9) < 5 * np.sqrt(8000 / 9)).all()
    later = random_policy(small.action_nvec)(number, action_keys(1 << 40, number, number % 7 + 1)).numpy()
    assert (later == actions).all(1).mean() < 0.05
    one_by_one = torch.cat([action_keys(1 << 40, number[i : i + 1], int(i % 7)) for i in range(20)])
    assert torch.equal(one_by_one, keys[:20])


def test_doing_nothing_is_one_action(small: TaskProgram, tmp_path: Path) -> None:
    data = record(small, "nothing", tmp_path / "data", episodes=3)
    assert {tuple(row) for number in range(3) for row in data.episode(number).action.tolist()} == {
        (0, 0, 1, 1, 1)
    }
    assert data.recipe.choices == ("sand.sand", "blow")
    with pytest.raises(ValueError, match="may neither `blow` nor do `nothing`"):
        record("destroying", "nothing", tmp_path / "other", episodes=1, backend="torch")


def test_another_recipe_and_a_second_process_are_refused(small: TaskProgram, recorded: Dataset) -> None:
    (found,) = refusal(
        record, small, "random", recorded.folder, episodes=21, seed=4, shard=8, observation="compact"
    )
    assert found.code == "PD631"
    names = "seed episodes observation channels shape"
    assert {note.split("`")[1] for note in found.notes} == set(names.split())
    with FileLock(recorded.folder / ".lock"), pytest.raises(CompileError, match="PD622"):
        record(small, "random", recorded.folder, episodes=20, seed=3, shard=8)


def test_folders_of_others_are_left_alone(small: TaskProgram, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    for folder, code in (
        (tmp_path, "PD630"),
        (tmp_path / "thesis.tex", "PD613"),
        (tmp_path / "a" / "b", "PD613"),
    ):
        with pytest.raises(CompileError, match=code):
            record(small, "random", folder, episodes=1)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"episodes": 0}, "`episodes` must be an integer from 1"),
        ({"episodes": True}, "`episodes` must be an integer"),
        ({"seed": -1}, "`seed` must be an integer from 0"),
        ({"envs": 0}, "envs must be"),
        ({"shard": 0}, "`shard` must be"),
        ({"shard": 1, "episodes": MAX_SHARDS + 1}, "65,537 shards, more than 65,536"),
        ({"shard": 1 << 30}, "a shard of 1073741824 episodes may take"),
        ({"observation": "matrix"}, "`observation` must be `ids` or `compact`"),
        ({"policy": "clever"}, "one of expert, random, nothing"),
        ({"policy": lambda observed, keys: None}, "needs a policy_name"),
        (
            {"policy": lambda observed, keys: [[9] * 5] * 2, "policy_name": "bad"},
            r"actions\[0, 0\] \(x\) is 9",
        ),
        ({"num_envs": 3}, "multiple values for argument 'num_envs'"),
    ],
)
def test_bad_arguments_are_refused(
    changed: dict[str, Any], words: str, small: TaskProgram, tmp_path: Path
) -> None:
    given = {"policy": "random", "episodes": 2, "folder": tmp_path / "data", **changed}
    with pytest.raises((ValueError, TypeError), match=words):
        record(small, **given)
    assert "policy_name" in changed or not (tmp_path / "data").exists()
