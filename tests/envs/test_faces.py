"""The faces of the batched environment: one world, Stable-Baselines3, goals, feature extractors; and both checkers."""

from __future__ import annotations

import pickle
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env as check_gymnasium
from gymnasium.wrappers import FlattenObservation
from stable_baselines3 import PPO, HerReplayBuffer
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

import powderdsl.envs  # noqa: F401
from powderdsl.envs.actions import KINDS as ACTIONS
from powderdsl.envs.features import Expand, paper_policy
from powderdsl.envs.gym import GoalEnv, PowderEnv, PowderVectorEnv
from powderdsl.envs.sb3 import PowderVecEnv
from powderdsl.envs.tensor_env import OBSERVATIONS, TensorEnv
from powderdsl.tasks.episodes import TaskProgram, compile_task
from powderdsl.tasks.shipped import shipped_tasks
from tests.tiers import tiered


@pytest.mark.parametrize("name", tiered(shipped_tasks(), ["destroying", "path-building", "sand-pushing"]))
def test_both_checkers_pass_without_a_warning(name: str) -> None:
    """With all kinds of observations and actions.

    Stable-Baselines3 takes 3-D floats for ill-made pictures, so its checker is shown `matrix` flattened.
    """
    program = compile_task(name, backend="wasm").under(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if min(program.task.size) < 36:  # true: the network of the policy "CnnPolicy" is for larger pictures
            warnings.filterwarnings("ignore", message="The minimal resolution for an image is 36x36")
        for kind, actions in zip(OBSERVATIONS[:4], [*ACTIONS, "discrete"], strict=True):
            env = PowderEnv(program, observation=kind, actions=actions, action_mask=kind == "ids")
            check_gymnasium(env, skip_render_check=True)
            check_sb3(FlattenObservation(env) if kind == "matrix" else env)


def test_the_checkers_look_at_rendering_and_specs_too() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make("powderdsl/SandPushing-v0", backend="wasm", render_mode="ansi")
        check_gymnasium(env.unwrapped)
        check_sb3(env.unwrapped, skip_render_check=False)


def test_one_world_a_slot_and_sb3_play_the_same(small: TaskProgram) -> None:
    steps, envs = 14, 3
    actions = np.random.default_rng(1).integers(0, small.action_nvec, (steps, envs, 5))
    batch = PowderVectorEnv(small, envs, autoreset_mode="same_step")
    sb3 = PowderVecEnv(small, envs)
    dummy = DummyVecEnv([lambda: PowderEnv(small)] * envs)
    sb3.seed(40)
    dummy.seed(40)
    first = sb3.reset()
    assert np.array_equal(first, batch.reset(seed=40)[0])
    assert np.array_equal(first, dummy.reset())
    assert [info["world"] for info in sb3.reset_infos] == [40, 41, 42]
    episodes = 0
    for action in actions:
        observed, reward, done, infos = sb3.step(action)
        others = dummy.step(action)
        wanted = batch.step(action)
        for found in (wanted[0], others[0]):
            assert np.array_equal(observed, found)
        assert np.allclose(reward, others[1])
        assert np.array_equal(reward, wanted[1])
        assert np.array_equal(done, others[2])
        reward += 1  # training writes to it
        for i in range(envs):
            if not done[i]:
                assert infos[i] == {}
                continue
            episodes += 1
            theirs = others[3][i]
            assert np.array_equal(infos[i]["terminal_observation"], theirs["terminal_observation"])
            assert infos[i]["TimeLimit.truncated"] == theirs["TimeLimit.truncated"]
            assert infos[i]["is_success"] == theirs["success"]
            assert infos[i]["episode"]["r"] == pytest.approx(theirs["episode_return"])
            assert infos[i]["episode"]["l"] == theirs["episode_length"]
    assert episodes > envs


def test_sb3_options_attributes_and_methods(small: TaskProgram) -> None:
    env = PowderVecEnv(small, 2, render_mode="rgb_array", render_scale=1)
    env.set_options({"params": {"water.melt": [0.0, 1.0]}})
    env.reset()
    assert env.tensors.params["water.melt"].tolist() == [0, 1]
    env.set_options({"worlds": 7})
    env.reset()
    assert [info["world"] for info in env.reset_infos] == [7, 7]
    env.reset()
    assert [info["world"] for info in env.reset_infos] != [7, 7], "options count once"
    assert env.get_attr("num_envs", 0) == [2]
    assert env.get_attr("worlds") == [1_000_000] * 2
    assert not env.has_attr("nonsense")
    env.set_attr("note", "here")
    assert env.get_attr("note", [0, 1]) == ["here"] * 2
    with pytest.raises(ValueError, match="share one"):
        env.set_attr("note", "there", indices=1)
    assert len(env.env_method("get_images", indices=[0])) == 1
    assert env.render().shape[2] == 3
    env.set_options([{"params": {}}, {"worlds": 1}])
    with pytest.raises(ValueError, match="same options"):
        env.reset()
    with pytest.raises(ValueError, match="actions"):
        env.step(np.full((2, 5), 99))
    env.close()


@pytest.mark.parametrize("kind", ["ids", "compact", "matrix"])
def test_ppo_learns_with_the_papers_network(small: TaskProgram, kind: str) -> None:
    env = PowderVecEnv(small, 4, observation=kind)
    policy = paper_policy(env.tensors, features_dim=16)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = PPO("CnnPolicy", env, n_steps=8, batch_size=16, n_epochs=1, policy_kwargs=policy, seed=0)
        model.learn(64)
        mean, _ = evaluate_policy(model, env, n_eval_episodes=4)  # warns where episodes are not monitored
    assert np.isfinite(mean)
    assert len(model.ep_info_buffer) > 0
    widths = {"ids": 5, "compact": len(env.tensors.simulator.observer.matrix_names)}
    first = next(one for one in model.policy.features_extractor.modules() if isinstance(one, torch.nn.Conv2d))
    assert first.in_channels >= widths.get(kind, 5)
    assert first.out_channels == 32


def test_compact_expands_to_the_matrix(small: TaskProgram) -> None:
    """Exactly, but for floats, which are off by a sixteenth at most."""
    env = TensorEnv(small, 4, observation="compact")
    actions = np.random.default_rng(2).integers(0, small.action_nvec, (5, 4, 5))
    env.reset(seed=0)
    for action in actions:
        observed = env.step(action)[0]
    wanted = env.episodes.world.matrix()
    expand = Expand(*env.simulator.observer.matrix_tables)
    for given in (observed, observed.float()):  # SB3 hands over floats
        found = expand(given)
        reals = [name.startswith("velocity") for name in env.simulator.observer.matrix_names]
        exact = torch.tensor([not real for real in reals])
        assert torch.equal(found[:, exact], wanted[:, exact])
        assert wanted[:, ~exact].abs().max() > 1
        assert ((found - wanted).abs() <= wanted.abs() / 16 + 2**-8).all()


def goals(program: TaskProgram) -> GoalEnv:
    return GoalEnv(PowderEnv(program), low=[0, 0], high=[9, 3], tolerance=[4, 2])


def test_goals_pass_both_checkers_and_hindsight_replay(small: TaskProgram) -> None:
    assert len(small.measures) == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*is different from the unwrapped version")
        warnings.filterwarnings("ignore", message="The minimal resolution for an image")  # 16×16 cells
        check_gymnasium(goals(small), skip_render_check=True)
        check_sb3(goals(small))
    env = DummyVecEnv([lambda: goals(small)])
    env.seed(0)
    buffer = HerReplayBuffer(
        200, env.observation_space, env.action_space, env, goal_selection_strategy="future"
    )
    rng, observed = np.random.default_rng(3), env.reset()
    for _ in range(60):
        actions = rng.integers(0, small.action_nvec, (1, 5))
        after, reward, done, infos = env.step(actions)
        # As Stable-Baselines3 stores it: behind an episode's last step stands its own last observation.
        last = infos[0].get("terminal_observation")
        stored = after if last is None else {name: value[None] for name, value in last.items()}
        buffer.add(observed, stored, actions, reward, done, infos)
        observed = after
    sample = buffer.sample(64)
    achieved = sample.next_observations["achieved_goal"].numpy()
    again = goals(small).compute_reward(achieved, sample.observations["desired_goal"].numpy(), None)
    assert np.array_equal(sample.rewards.numpy()[:, 0], again)
    assert {*again.tolist()} == {-1.0, 0.0}


def test_goals_are_drawn_by_the_seed_or_given(small: TaskProgram) -> None:
    env = goals(small)
    first = env.reset(seed=2)[0]["desired_goal"]
    second = env.reset()[0]["desired_goal"]
    assert not np.array_equal(first, second)
    assert np.array_equal(first, env.reset(seed=2)[0]["desired_goal"])
    assert env.reset(options={"goal": [1, 2]})[0]["desired_goal"].tolist() == [1, 2]
    with pytest.raises(ValueError, match="shape"):
        env.reset(options={"goal": [1]})
    with pytest.raises(ValueError, match="2 numbers"):
        GoalEnv(PowderEnv(small), [0], [1], 1)


def test_one_world_is_refused_a_batch(small: TaskProgram) -> None:
    env = PowderEnv(small)
    env.reset(seed=0)
    for bad in (np.zeros((1, 5), np.int64), 3, [0, 0, 9, 0, 0], [0.0] * 5):
        with pytest.raises((TypeError, ValueError)):
            env.step(bad)


def test_one_world_can_be_pickled(task_file: Path) -> None:
    env = pickle.loads(pickle.dumps(PowderEnv(str(task_file), observation="rgb", backend="torch")))
    assert env.reset(seed=0)[0].shape == (16, 16, 3)
