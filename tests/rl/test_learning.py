"""What helps agents learn, and what it must not change: cloning, shaped rewards, stacked frames, held-out evaluation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import VecFrameStack

from powderdsl.datasets import Dataset, record
from powderdsl.envs.actions import FrameStack
from powderdsl.envs.sb3 import PowderVecEnv
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.experiments.runs import read_metrics
from powderdsl.rl import evaluate, load_policy, train
from powderdsl.rl.policies import BinPolicy, fcn_policy
from powderdsl.syntax.sources import shipped
from powderdsl.system.settings import fingerprint
from powderdsl.tasks.episodes import compile_task
from powderdsl.tasks.shipped import load_task, shipped_tasks
from tests.refusals import refusal, refused_codes
from tests.rl.tiny_tasks import DIG, PLACE, quick, write_task
from tests.states import same

AIM = """
task: aim
rules: core+sand
size: [16, 16]
fill: empty
generate:
  - square wall at (2..13, 2..13) half 1
agent: {may: [sand, empty], bins: 4, brush: 4, actions: 3}
reward: {each: change(0 - count(wall)), shaped: change(0 - count(wall)) + placed}
expert:
  - {choose: empty, at: most(wall)}
"""
"""Only one block in sixteen is right, and where it is differs from world to world."""


@torch.no_grad()
def test_a_score_for_each_bin_and_deed(tmp_path: Path) -> None:
    idle = DIG.replace("[empty, blow]", "[empty, blow, nothing]")
    for text, count in ((DIG, 160), (idle, 161)):  # 16 bins: empty, and nine ways to blow
        env = TensorEnv(str(write_task(tmp_path, text)), 1, observation="ids", backend="wasm")
        how = fcn_policy(env, 8)
        policy = BinPolicy(env.observation.space, env.single_action_space, lambda _: 1e-3, **how)
        observed, _ = env.reset(seed=0)
        joint = policy.get_distribution(observed)
        every = how["form"].table
        assert len(every) == count
        assert torch.equal(joint.form.encode(every), torch.arange(count))
        likely = torch.cat([policy.get_distribution(observed).log_prob(one[None]) for one in every]).exp()
        assert float(likely.sum()) == pytest.approx(1, abs=1e-4)
        assert float(likely.max()) < 3 / count  # none is preferred before it has learned
        values, again, entropy = policy.evaluate_actions(observed.expand(count, -1, -1, -1), every)
        assert values.shape == (count, 1)
        assert torch.allclose(again.exp(), likely, atol=1e-6)
        assert float(entropy[0]) == pytest.approx(-float((likely * likely.log()).sum()), abs=1e-4)


@pytest.mark.slow
def test_a_policy_takes_the_expert_from_a_dataset(tmp_path: Path) -> None:
    task = write_task(tmp_path, AIM)
    record(load_task(task), "expert", tmp_path / "data", episodes=200, backend="wasm")
    how = {"network": "fcn", "features": 16, "init_from": str(tmp_path / "data"), "init_epochs": 160}
    run = train(quick(task, steps=1, learning_rate=1e-9, **how), tmp_path / "run")
    trained, expert, at_random, nothing = evaluate(
        run, splits=["train"], episodes=64, deterministic=True
    ).scores
    assert [one.policy for one in (trained, expert, nothing)] == ["trained", "expert", "nothing"]
    assert trained.normalized.mean > 0.8
    assert at_random.normalized.mean < 0.4
    assert [line["step"] for line in read_metrics(run.path) if "clone/loss" in line] == [0]
    # The dataset is not needed again.
    (tmp_path / "data").rename(tmp_path / "elsewhere")
    assert train(quick(task, steps=40, learning_rate=1e-9, **how), tmp_path / "run").checkpoint().step == 64


def test_a_run_records_the_expert_that_it_imitates(tmp_path: Path) -> None:
    task = write_task(tmp_path, AIM)
    how = {"network": "fcn", "features": 16, "init_expert": 20, "steps": 1, "learning_rate": 1e-9, "seed": 3}
    run = train(quick(task, **how), tmp_path / "run")
    assert "clone/loss" in (run.path / "metrics.jsonl").read_text()
    found = Dataset.open(run.path / "demonstrations")
    assert [int(found.episode(number).world) for number in (0, 19)] == [60, 79]  # other seeds, other worlds
    record(load_task(task), "expert", tmp_path / "data", episodes=20, seed=60, backend="wasm")
    by_hand = quick(task, **how | {"init_expert": 0, "init_from": str(tmp_path / "data")})
    assert same(
        run.checkpoint().state["policy"], train(by_hand, tmp_path / "run2").checkpoint().state["policy"]
    )


def test_what_cannot_be_imitated_is_refused(tmp_path: Path) -> None:
    def why(folder: str, **how: object) -> str:
        errors = refusal(lambda: train(quick(write_task(tmp_path), **how), tmp_path / folder))
        assert [one.code for one in errors] == ["PD640"]
        return errors[0].message

    assert "no expert" in why("a", init_expert=2)
    assert "cannot be combined" in why("b", init_expert=2, init_from="data")
    assert "`frames`" in why("c", init_expert=2, frames=2)
    assert "`matrix`" in why("d", init_expert=2, observation="matrix")
    assert not list(tmp_path.glob("?"))


def test_a_dataset_of_another_task_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    record(load_task(write_task(other, PLACE)), "random", tmp_path / "data", episodes=4, backend="wasm")
    config = quick(write_task(tmp_path), init_from=str(tmp_path / "data"))
    assert refused_codes(train, config, tmp_path / "run") == ["PD631"]
    config = replace(config, init_from=str(tmp_path / "nothing"))
    assert refused_codes(train, config, tmp_path / "run2") == ["PD630"]


def test_shaped_rewards_change_training_alone(tmp_path: Path) -> None:
    task = write_task(tmp_path, AIM)
    plain, shaped = (train(quick(task, steps=32, reward=how), tmp_path / how) for how in ("task", "shaped"))
    assert "shaped_fingerprint" not in plain.config
    assert plain.config["task_fingerprint"] == shaped.config["task_fingerprint"]
    returns = [run.checkpoint().state["episodes"][0][0] for run in (plain, shaped)]
    assert returns[0] != returns[1]
    scores = [evaluate(run, policies=["nothing"], episodes=8).scores for run in (plain, shaped)]
    assert scores[0] == scores[1]  # of the task's own reward
    unshaped = quick(write_task(tmp_path, PLACE), reward="shaped")
    assert refused_codes(train, unshaped, tmp_path / "none") == ["PD640"]


SHAPED = [
    name for name in shipped_tasks() if "shaped:" in (shipped("tasks") / f"{name}.yaml").read_text("utf-8")
]


@pytest.mark.parametrize("name", SHAPED)
def test_shaped_tasks_are_the_same_worlds(name: str) -> None:
    """A task with its shaped reward has the same worlds, actions, ends and length; only rewards differ."""
    task = load_task(name)
    other = task.with_shaped_reward()
    assert fingerprint(replace(task, goal=replace(task.goal, shaped=None))) == fingerprint(task)
    assert replace(other, goal=task.goal) == task
    programs = [compile_task(one, backend="wasm") for one in (task, other)]
    seeds = torch.arange(4)
    episodes = [program.start(seeds) for program in programs]
    generator = torch.Generator().manual_seed(1)
    total = [torch.zeros(4), torch.zeros(4)]
    for _ in range(12):
        actions = torch.stack(
            [torch.randint(0, count, (4,), generator=generator) for count in programs[0].action_nvec], 1
        )
        for number, program in enumerate(programs):
            episodes[number], reward, _, _ = program.act(episodes[number], actions)
            total[number] += reward
        assert torch.equal(*(one.world.ids for one in episodes))
        assert torch.equal(*(one.failed for one in episodes))
    assert not torch.equal(*total)


def test_frames_are_those_of_stable_baselines(tmp_path: Path) -> None:
    env = PowderVecEnv(str(write_task(tmp_path, DIG)), 3, backend="wasm", actions="full")
    stacked, own = VecFrameStack(env, 3, channels_order="first"), FrameStack(3)
    env.seed(5)
    expected = stacked.reset()
    found = own.push(torch.from_numpy(expected[:, -1:].copy()))
    generator = np.random.default_rng(0)
    for _ in range(3):  # episodes end after four
        assert np.array_equal(found.numpy(), expected)
        expected, *_ = stacked.step(generator.integers(0, env.action_space.nvec, (3, 5)))
        found = own.push(torch.from_numpy(expected[:, -1:].copy()))
    assert np.array_equal(found.numpy(), expected)


def test_a_policy_sees_the_frames_that_it_learned_from(tmp_path: Path) -> None:
    run = train(quick(write_task(tmp_path), frames=2, steps=32), tmp_path / "run")
    env = TensorEnv(str(tmp_path / "task.yaml"), 2, backend="wasm")
    policy = load_policy(run, env, deterministic=True)
    assert policy.frames == 2
    observed, _ = env.reset(seed=1)
    assert policy(FrameStack(2).push(observed), torch.zeros(2, dtype=torch.int64)).shape == (2, 5)
    assert len(evaluate(run, policies=["trained"], episodes=4).scores) == 2
    task = load_task(tmp_path / "task.yaml")
    record(task, policy, tmp_path / "data", episodes=4, policy_name="two frames", backend="wasm")


@pytest.mark.parametrize("network", ["small", "fcn"])
def test_held_out_evaluation_changes_no_weights(tmp_path: Path, network: str) -> None:
    task = write_task(tmp_path)
    how = {"network": network, "steps": 64}
    without = train(quick(task, **how), tmp_path / "without")
    evaluated = train(quick(task, eval_every=32, eval_episodes=5, **how), tmp_path / "with")
    states = [run.checkpoint().state for run in (without, evaluated)]
    assert same(states[0]["policy"], states[1]["policy"])
    assert same(states[0]["random"], states[1]["random"])


@pytest.mark.parametrize(("steps", "rollouts"), [(1, 1), (33, 2), (64, 2), (65, 3)])
def test_a_falling_rate_is_positive_in_the_last_rollout(steps: int, rollouts: int, tmp_path: Path) -> None:
    config = quick(write_task(tmp_path), schedule="linear", steps=steps)
    assert config.envs * config.rollout == 32
    run = train(config, tmp_path / "run")
    (group,) = run.checkpoint().state["optimizer"]["param_groups"]
    assert group["lr"] == pytest.approx(config.learning_rate / rollouts)
    # That of an update is written by the next rollout.
    assert (run.path / "metrics.jsonl").read_text().count("learning_rate") == rollouts - 1
    # It belongs to the run.
    assert "`steps`" in refusal(train, replace(config, steps=128), tmp_path / "run")[0].notes[0]
