"""Minibatches are transitions that were recorded, drawn uniformly; they never reach over an episode's end."""

from __future__ import annotations

import pickle
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from powderdsl.datasets import Dataset
from powderdsl.datasets.dataset import Batch, drawn, flat, write_shard
from powderdsl.datasets.manifest import Manifest, Recipe, write_manifest
from powderdsl.diagnostics import CompileError
from powderdsl.envs import TensorEnv
from powderdsl.tasks.episodes import TaskProgram
from tests.refusals import refusal


def numbered(
    folder: Path,
    recipe: Recipe,
    lengths: list[int],
    shard: int,
    *,
    compress: bool,
    observation: NDArray[np.uint8] | None = None,
) -> Dataset:
    """A dataset whose observations are (episode, number of the observation), or of one episode with the given ones."""
    recipe = replace(
        recipe,
        episodes=len(lengths),
        shard=shard,
        shape=(1, 1, 2) if observation is None else observation.shape[1:],
        actions=max(lengths),
        compress=compress,
    )
    rows = []
    for number in range(recipe.shards):
        parts = []
        for episode in recipe.episodes_of(number):
            length = lengths[episode]
            ended = np.arange(length) == length - 1
            parts.append(
                {
                    "observation": np.array([[[[episode, t]]] for t in range(length + 1)])
                    if observation is None
                    else observation,
                    "action": np.array([[episode % 4, t % 4, 0, 0, 0] for t in range(length)]),
                    "reward": np.arange(length) + 100 * episode,
                    "terminated": ended & (episode % 2 == 0),
                    "truncated": ended & (episode % 2 == 1),
                    "success": ended,
                    "length": np.array([length]),
                    "world": np.array([episode]),
                }
            )
        arrays = {name: [part[name] for part in parts] for name in parts[0]}
        rows.append(write_shard(folder, number, arrays, compress=compress))
    write_manifest(folder, Manifest(recipe, "2026-01-01T00:00:00+00:00", tuple(rows)))
    return Dataset.open(folder, memory=1)


def windows_of(batch: Batch, lengths: list[int]) -> list[tuple[int, int]]:
    """The (episode, first action) of each row of sequences [B, L], after checking that all its parts belong together."""
    episode, t = batch.observation[..., 0, 0, 0], batch.observation[..., 0, 0, 1]
    steps = torch.arange(t.shape[1])
    dtypes = [torch.uint8, torch.int16, torch.float32, torch.uint8, *[torch.bool] * 3]
    assert [part.dtype for part in batch] == dtypes
    assert (episode == episode[:, :1]).all(), "a sequence reaches over an episode's end"
    assert (t == t[:, :1] + steps).all()
    assert (batch.next_observation[..., 0, 0, 0] == episode).all()
    assert (batch.next_observation[..., 0, 0, 1] == t + 1).all()
    assert (batch.action[..., :2] == torch.stack([episode % 4, t % 4], -1)).all()
    assert (batch.reward == t + 100 * episode.float()).all()
    last = t + 1 == torch.tensor(lengths)[episode.long()]
    assert (batch.terminated == (last & (episode % 2 == 0))).all()
    assert (batch.truncated == (last & (episode % 2 == 1))).all()
    assert (batch.success == last).all()
    return [(int(a), int(b)) for a, b in zip(episode[:, 0], t[:, 0], strict=True)]


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=12),
    shard=st.integers(1, 5),
    length=st.integers(1, 9),
    seed=st.integers(0, (1 << 62) - 1),
    compress=st.booleans(),
)
def test_sequences_are_all_windows_and_no_others(
    lengths: list[int],
    shard: int,
    length: int,
    seed: int,
    compress: bool,
    recorded: Dataset,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    data = numbered(tmp_path_factory.mktemp("n"), recorded.recipe, lengths, shard, compress=compress)
    wanted = {(e, t) for e, n in enumerate(lengths) for t in range(n - length + 1)}
    if not wanted:
        with pytest.raises(ValueError, match=r"no episode has|length must be"):
            data.sequences(length, 4, seed=seed)
        return
    assert set(windows_of(next(data.sequences(length, 3000, seed=seed)), lengths)) == wanted
    if length == 1:
        one = next(data.transitions(3000, seed=seed))
        assert one.reward.shape == (3000,)
        assert set(windows_of(Batch(*(value[:, None] for value in one)), lengths)) == wanted


def test_draws_are_uniform() -> None:
    for below in (1, 7, 1000):
        counts = np.bincount(drawn(5, 2, 50_000, below), minlength=below)
        assert len(counts) == below
        assert (abs(counts - 50_000 / below) < 5.5 * np.sqrt(50_000 / below)).all()
    large = drawn(5, 2, 1000, 1 << 60)
    assert len(set(large.tolist())) == 1000
    assert large.max() > 1 << 59


def test_minibatches_follow_from_seed_and_number(recorded: Dataset) -> None:
    four = list(islice(recorded.transitions(16, seed=9), 4))
    (again,) = islice(recorded.transitions(16, seed=9, start=3), 1)
    assert all(torch.equal(a, b) for a, b in zip(four[3], again, strict=True))
    (other,) = islice(recorded.transitions(16, seed=10), 1)
    assert not torch.equal(four[0].observation, other.observation)
    assert not torch.equal(four[0].observation, four[1].observation)


def test_what_was_read_can_be_written_to_and_workers_get_the_folder(recorded: Dataset) -> None:
    before = recorded.episode(0).observation.clone()
    recorded.episode(0).observation.zero_()
    next(recorded.transitions(500)).observation.zero_()
    assert torch.equal(recorded.episode(0).observation, before)
    text = pickle.dumps(recorded)
    assert len(text) < 1000
    again = pickle.loads(text)
    assert torch.equal(again.episode(7).observation, recorded.episode(7).observation)


def test_indices_out_of_range_are_refused(recorded: Dataset) -> None:
    for number in (-1, 20):
        with pytest.raises(IndexError, match="there are 20"):
            recorded.episode(number)
    for call in (
        lambda: recorded.transitions(0),
        lambda: recorded.transitions(4, seed=-1),
        lambda: recorded.sequences(7, 4),
    ):
        with pytest.raises(ValueError, match="must be an integer"):
            call()


def test_data_of_another_meaning_is_refused(recorded: Dataset, small: TaskProgram, task_file: Path) -> None:
    recorded.require(TensorEnv(small, 1), same_rules=True)
    (found,) = refusal(recorded.require, TensorEnv("ice-bridge", 1, observation="compact", backend="torch"))
    assert found.code == "PD631"
    names = {note.split("`")[1].split(".")[0] for note in found.notes}
    assert {"observation", "channels", "shape", "palette", "action_nvec", "choices"} <= names
    melting = TensorEnv(str(task_file), 1, params={"water.melt": 1.0}, backend="torch")
    recorded.require(melting)
    with pytest.raises(CompileError, match="PD631"):
        recorded.require(melting, same_rules=True)


def test_the_flat_layouts(recorded: Dataset) -> None:
    rows = flat(recorded)
    raw = flat(recorded, "ogbench")
    assert {name: len(value) for name, value in rows.items()} == dict.fromkeys(rows, recorded.steps)
    assert (rows["terminals"] | rows["timeouts"]).sum() == len(recorded)
    # OGBench's reader drops the rows where `terminals` is 1; the next observation is that of the row behind.
    kept = raw["terminals"] == 0
    assert np.array_equal(raw["observations"][kept], rows["observations"])
    assert np.array_equal(raw["observations"][1:][kept[:-1]], rows["next_observations"])
    assert np.array_equal(raw["actions"][kept], rows["actions"])
    assert np.array_equal(raw["rewards"][kept], rows["rewards"])
    assert np.array_equal(raw["masks"][kept] == 0, rows["terminals"])
    with pytest.raises(ValueError, match="d4rl, ogbench"):
        flat(recorded, "minari")
