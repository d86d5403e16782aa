"""What Gymnasium expects of environments: its vector wrappers, infos with constant keys, and specs that say how long
episodes are."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers import TimeLimit
from gymnasium.wrappers import vector as wrappers

from powderdsl.envs import env_id
from powderdsl.envs.gym import PowderEnv, PowderVectorEnv
from powderdsl.envs.sb3 import PowderVecEnv
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.shipped import shipped_tasks

Wrap = Callable[[VectorEnv[Any, Any, Any]], VectorEnv[Any, Any, Any]]

WRAPPERS: dict[str, Wrap] = {
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "NormalizeObservation": wrappers.NormalizeObservation,
    "NormalizeReward": wrappers.NormalizeReward,
    "ClipReward": lambda env: wrappers.ClipReward(env, -1, 1),
    "DictInfoToList": wrappers.DictInfoToList,
    "FlattenObservation": wrappers.FlattenObservation,
    "RescaleObservation": lambda env: wrappers.RescaleObservation(env, 0.0, 1.0),
    "DtypeObservation": lambda env: wrappers.DtypeObservation(env, np.float32),
    "TransformObservation": lambda env: wrappers.TransformObservation(env, lambda observed: observed),
}


@pytest.mark.parametrize("actions", ["multidiscrete", "discrete"])
@pytest.mark.parametrize("name", WRAPPERS)
def test_gymnasiums_vector_wrappers_take_it_as_it_is(small: TaskProgram, name: str, actions: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = WRAPPERS[name](PowderVectorEnv(small, 3, actions=actions))
        env.action_space.seed(0)
        observed, _ = env.reset(seed=0)
        assert observed in env.observation_space
        ended = 0
        for _ in range(16):
            observed, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            assert observed in env.observation_space
            assert np.isfinite(reward).all()
            ended += int((terminated | truncated).sum())
        assert ended > 0


MODES = list(AutoresetMode)


def kinds(info: dict[str, Any]) -> dict[str, Any]:
    """The keys of infos, with dtypes and how many environments they are of."""
    return {
        name: kinds(value) if isinstance(value, dict) else (value.dtype, len(value))
        for name, value in info.items()
    }


@pytest.mark.parametrize("mode", MODES)
def test_infos_have_the_same_keys_after_every_step(small: TaskProgram, mode: AutoresetMode) -> None:
    env = PowderVectorEnv(small, 4, autoreset_mode=mode, action_mask=True)
    env.action_space.seed(0)
    _, first = env.reset(seed=0)
    found, ended = [], 0
    for _ in range(16):
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        found.append(kinds(info))
        over = terminated | truncated
        for name in ("episode_return", "episode_length"):
            assert np.array_equal(info[f"_{name}"], over)
            assert not info[name][~over].any()
        if mode is AutoresetMode.SAME_STEP:
            assert np.array_equal(info["_final_obs"], over)
            assert [one is not None for one in info["final_obs"]] == over.tolist()
            assert np.array_equal(info["final_info"]["_success"], over)
        if mode is AutoresetMode.DISABLED and over.any():
            env.reset(options={"reset_mask": over})
        ended += int(over.sum())
    assert ended > 4
    assert all(one == found[0] for one in found)
    # Every value says of which environments it is.
    assert all(name.startswith("_") or f"_{name}" in first for name in first)
    assert all(name.startswith("_") or f"_{name}" in info for name in info)
    # Those of a reset are the same, but there is no final observation then.
    assert kinds(first) == {name: kind for name, kind in found[0].items() if "final" not in name}


def test_one_world_has_the_same_keys_in_reset_and_steps(small: TaskProgram) -> None:
    env = PowderEnv(small)
    env.action_space.seed(0)
    _, info = env.reset(seed=0)
    wanted = {name: type(value) for name, value in info.items()}
    assert info["episode_return"] == info["episode_length"] == 0
    total, over = 0.0, False
    for step in range(1, 7):
        assert not over
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        total, over = total + reward, terminated or truncated
        assert {name: type(value) for name, value in info.items()} == wanted
        assert info["episode_length"] == step
        assert info["episode_return"] == pytest.approx(total)
        if over:
            break
    assert over


def test_specs_say_how_many_actions_an_episode_has(small: TaskProgram) -> None:
    name, how = "powderdsl/Destroying-v0", {"backend": "torch"}
    made = gymnasium.make(name, **how)
    task = made.unwrapped.tensors.task
    assert made.spec.max_episode_steps == task.agent.actions
    assert made.spec.id == name
    env: Any = made
    while env is not env.unwrapped:  # a limit from outside would truncate what the last action terminates
        assert not isinstance(env, TimeLimit)
        env = env.env
    vector = gymnasium.make_vec(name, num_envs=2, observation="compact", **how)
    assert vector.spec.max_episode_steps == task.agent.actions
    assert isinstance(vector.unwrapped, PowderVectorEnv)
    assert vector.metadata["autoreset_mode"] is vector.unwrapped.autoreset_mode is AutoresetMode.NEXT_STEP
    assert vector.reset(seed=0)[0].shape == (2, 6, 64, 64)
    assert gymnasium.make(name, max_episode_steps=2, **how).spec.max_episode_steps == 2
    assert gymnasium.make_vec(name, num_envs=2, max_episode_steps=2, **how).spec.max_episode_steps == 2
    direct: Any
    for direct in (PowderEnv(small), PowderVectorEnv(small, 2), PowderVecEnv(small, 2)):
        assert direct.spec.max_episode_steps == 6
    assert PowderEnv(small, max_episode_steps=4).spec.max_episode_steps == 4
    assert all(env_id(task) in gymnasium.registry for task in shipped_tasks())


def test_specs_make_the_same_environment_again(small: TaskProgram) -> None:
    one = PowderEnv(small, observation="compact", actions="discrete").spec.make(disable_env_checker=True)
    assert one.unwrapped.tensors.program is small
    assert one.unwrapped.observation_space.shape[0] > 1
    assert one.spec.kwargs["actions"] == "discrete"
    spec = PowderVectorEnv(small, 3, autoreset_mode="disabled", actions="discrete").spec
    assert spec is not None
    batch = gymnasium.make_vec(spec)
    assert batch.num_envs == 3
    assert batch.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    assert batch.single_action_space == one.action_space
