"""The contract of the batched environment: autoreset by hand, copies, seeds, options, bad input, memory."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode

from powderdsl.diagnostics import CompileError
from powderdsl.envs.gym import PowderEnv, PowderVectorEnv
from powderdsl.envs.tensor_env import TensorEnv, world_seeds
from powderdsl.tasks.episodes import TaskProgram, compile_task, load_task
from tests.states import same

ENVS, STEPS = 5, 16
MODES = tuple(AutoresetMode)


def actions_of(program: TaskProgram, steps: int = STEPS, envs: int = ENVS) -> np.ndarray:
    """Random actions [steps, envs, 5]."""
    return np.random.default_rng(7).integers(0, program.action_nvec, (steps, envs, 5))


class ByHand:
    """One slot as a loop over the functional core, which never reuses memory."""

    def __init__(self, program: TaskProgram, seed: int):
        self.program, self.base, self.number = program, seed, -1
        self.begin()

    def begin(self) -> None:
        self.number += 1
        base, number = torch.tensor([self.base]), torch.tensor([self.number])
        self.episodes = self.program.start(world_seeds(base, number, 1_000_000))
        self.over, self.returned = False, 0.0

    def act(self, action: np.ndarray) -> tuple[float, bool, bool]:
        self.episodes, reward, success, over = self.program.act(self.episodes, torch.from_numpy(action)[None])
        terminated = bool(success[0]) or bool(self.episodes.failed[0])
        self.over = bool(over[0])
        self.returned += float(reward[0])
        return float(reward[0]), terminated, self.over and not terminated

    def ids(self) -> np.ndarray:
        return self.episodes.world.ids.clone().numpy()


@pytest.mark.parametrize("mode", MODES)
def test_autoreset_is_a_loop_by_hand(small: TaskProgram, mode: AutoresetMode) -> None:
    env = PowderVectorEnv(small, ENVS, autoreset_mode=mode)
    slots = [ByHand(small, 30 + i) for i in range(ENVS)]
    observed, info = env.reset(seed=30)
    assert info["world"].tolist() == [30, 31, 32, 33, 34]
    ended, early = 0, 0
    for actions in actions_of(small):
        observed, reward, terminated, truncated, info = env.step(actions)
        reset = np.zeros(ENVS, bool)
        for i, slot in enumerate(slots):
            if mode is AutoresetMode.NEXT_STEP and slot.over:
                slot.begin()
                wanted = (0.0, False, False)
            else:
                wanted = slot.act(actions[i])
            assert (reward[i], terminated[i], truncated[i]) == pytest.approx(wanted)
            if slot.over:
                ended, early = ended + 1, early + int(terminated[i])
                assert info["_episode_return"][i]
                assert info["episode_return"][i] == pytest.approx(slot.returned, abs=1e-5)
                assert info["episode_length"][i] == int(slot.episodes.acted[0])
                if mode is AutoresetMode.SAME_STEP:
                    assert info["_final_obs"][i]
                    assert np.array_equal(info["final_obs"][i], slot.ids())
                    assert info["final_info"]["episode_length"][i] == int(slot.episodes.acted[0])
                    slot.begin()
                reset[i] = slot.over
            elif "final_obs" in info:
                assert info["final_obs"][i] is None
            assert np.array_equal(observed[i], slot.ids())
            assert info["world"][i] == int(slot.episodes.seed[0])
        if mode is AutoresetMode.DISABLED and reset.any():
            with pytest.raises(ResetNeeded, match="are over"):
                env.step(actions)
            observed, _ = env.reset(options={"reset_mask": reset})
            for i in np.flatnonzero(reset):
                slots[i].begin()
            assert np.array_equal(observed, np.stack([slot.ids() for slot in slots]))
    assert ended > ENVS
    assert 0 < early < ended, "episodes end in one way only: this shows less than it should"


@pytest.mark.parametrize("kind", ["ids", "compact", "matrix", "rgb"])
def test_nothing_returned_is_written_to_later(small: TaskProgram, kind: str) -> None:
    """And writing to what was returned changes no world: a second environment, left alone, agrees."""
    spoiled, alone = (PowderVectorEnv(small, ENVS, observation=kind) for _ in range(2))
    kept: list[tuple[Any, Any]] = []
    found, wanted = spoiled.reset(seed=0)[0], alone.reset(seed=0)[0]
    for actions in actions_of(small):
        assert np.array_equal(found, wanted)
        assert wanted in alone.observation_space
        found[:] = 1
        result = alone.step(actions)
        kept.append((result, copy.deepcopy(result)))
        found, wanted = spoiled.step(actions)[0], result[0]
    for before, after in kept:
        assert data_equivalence(before, after, exact=True)


def test_seeds_are_those_of_slots(small: TaskProgram) -> None:
    env = PowderVectorEnv(small, 3, worlds=50)
    assert env.reset(seed=9)[1]["world"].tolist() == [9, 10, 11]
    second = env.reset()[1]["world"].tolist()
    assert all(0 <= world < 50 for world in second)
    assert len({*second}) > 1
    assert env.reset(seed=[None, 4, None])[1]["world"][1] == 4
    # What a slot plays depends on its own seed and the number of its episode.
    other = PowderVectorEnv(small, 1, worlds=50)
    other.reset(seed=10)
    assert other.reset()[1]["world"].tolist() == second[1:2]
    # Without a seed, two environments differ.
    worlds = [PowderVectorEnv(small, 1).reset()[1]["world"][0] for _ in range(4)]
    assert len({*worlds}) > 1
    drawn = world_seeds(torch.zeros(4000, dtype=torch.int64), torch.arange(1, 4001), 10)
    assert torch.bincount(drawn, minlength=10).float().sub(400).abs().max() < 100


def test_options_choose_worlds_and_parameters(small: TaskProgram) -> None:
    env, usual = (PowderVectorEnv(small, 4, autoreset_mode="disabled") for _ in range(2))
    still = np.tile([0, 0, 1, 1, 1], (4, 1))
    _, info = env.reset(options={"worlds": [5, 6, 5, 6], "params": {"water.melt": [0.0, 0.0, 1.0, 1.0]}})
    assert info["world"].tolist() == [5, 6, 5, 6]
    usual.reset(options={"worlds": [5, 6, 5, 6]})

    def ice() -> list[int]:
        number = small.simulator.ruleset.element("ice").id
        return (env.step(still)[0] == number).sum((1, 2, 3)).tolist()

    left = ice()
    assert left[0] > left[2]
    assert left[1] > left[3]
    # They stay, also where others are set for one slot, until they are given again.
    env.reset(options={"worlds": 5, "params": {"water.melt": 1}, "reset_mask": np.array([True, False] * 2)})
    assert env.tensors.params["water.melt"].tolist() == [1, 0, 1, 1]
    env.reset()
    assert env.tensors.params["water.melt"].tolist() == [1, 0, 1, 1]
    env.reset(options={"worlds": [5, 6, 5, 6], "params": {}})
    assert np.array_equal(env.step(still)[0], usual.step(still)[0])


def test_a_task_file_takes_splits_knobs_and_parameters(task_file: Path) -> None:
    env = TensorEnv(
        task_file, 2, split="test", knobs={"disks": 1}, params={"water.melt": 0.5}, backend="torch"
    )
    observed, _ = env.reset(seed=0)
    assert observed[:, 0, 1:-1, 1:-1].sum() == 0  # the test split is an empty box
    assert env.task.knobs[0].value == 1
    assert env.simulator.ruleset.params[0].default == 0.5
    for how in ({"split": "tset"}, {"params": {"water.mlet": 1}}, {"knobs": {"disk": 1}}):
        with pytest.raises(CompileError):
            TensorEnv(task_file, **how)  # type: ignore[arg-type]
    program = compile_task(load_task(task_file), backend="torch")
    assert TensorEnv(program).program is TensorEnv(program, 2).program is program
    with pytest.raises(ValueError, match="load_task"):
        TensorEnv(program.task, knobs={"disks": 1})


BAD_ACTIONS = [
    np.full((2, 5), 99),
    np.zeros((2, 5), np.float32),
    np.full((2, 5), np.nan),
    np.zeros((3, 5), np.int64),
    np.zeros((2, 4), np.int64),
    "up",
    None,
]
BAD_RESETS: list[dict[str, Any]] = [
    {"seed": -1},
    {"seed": 1 << 70},
    {"seed": 1.5},
    {"seed": "one"},
    {"seed": [1]},
    {"options": {"param": {}}},
    {"options": {"params": {"water.mlet": 1}}},
    {"options": {"params": {"water.melt": 2}}},
    {"options": {"params": {"water.melt": float("nan")}}},
    {"options": {"params": {"water.melt": [1, 1, 1]}}},
    {"options": {"worlds": -1}},
    {"options": {"worlds": [1, 2, 3]}},
    {"options": {"reset_mask": np.array([True])}},
    {"options": {"reset_mask": np.array([False, False])}},
]


def test_bad_input_is_refused_and_changes_nothing(small: TaskProgram) -> None:
    env, usual = PowderVectorEnv(small, 2), PowderVectorEnv(small, 2)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros((2, 5), np.int64))
    for one in (env, usual):
        one.reset(seed=1)
    for bad in BAD_ACTIONS:
        with pytest.raises((TypeError, ValueError)):
            env.step(bad)
    for how in BAD_RESETS:
        with pytest.raises((TypeError, ValueError, KeyError)):
            env.reset(**how)
    for actions in actions_of(small, 8, 2):
        for found, wanted in zip(env.step(actions)[:4], usual.step(actions)[:4], strict=True):
            assert np.array_equal(found, wanted)


@pytest.mark.parametrize(
    "how",
    [
        {"num_envs": 0},
        {"num_envs": True},
        {"worlds": 0},
        {"max_episode_steps": 0},
        {"observation": "idz"},
        {"autoreset_mode": "sometimes"},
        {"last_action": "end"},
        {"render_mode": "human"},
    ],
)
def test_bad_arguments_are_refused(small: TaskProgram, how: dict[str, Any]) -> None:
    (name,) = how
    with pytest.raises(ValueError, match=name):
        PowderVectorEnv(small, **how)


@pytest.mark.parametrize(
    ("reward", "last_action", "truncates"),
    [
        ("{each: count(sand)}", "auto", True),
        ("{final: count(sand)}", "auto", False),
        ("{each: count(sand)}", "terminates", False),
        ("{final: count(sand)}", "truncates", True),
    ],
)
def test_running_out_of_actions(tmp_path: Path, reward: str, last_action: str, truncates: bool) -> None:
    """A final reward is all there was to get, so the episode has come to its end; else more would have come."""
    path = tmp_path / "short.yaml"
    path.write_text(
        "task: short\nrules: core+sand\nsize: [8, 8]\nfill: sand\ngenerate: [frame wall]\n"
        f"agent: {{may: [sand], bins: 2, brush: 2, actions: 2}}\nreward: {reward}\n"
    )
    env = TensorEnv(path, 2, last_action=last_action, backend="torch")
    env.reset(seed=0)
    nothing = torch.zeros(2, 5, dtype=torch.int64)
    assert not torch.stack(env.step(nothing)[2:4]).any()
    terminated, truncated = env.step(nothing)[2:4]
    assert truncated.tolist() == [truncates] * 2
    assert terminated.tolist() == [not truncates] * 2


def test_episodes_can_be_cut_short(small: TaskProgram) -> None:
    env = PowderVectorEnv(small, 3, max_episode_steps=2)
    env.reset(seed=0)
    far = np.zeros((3, 5), np.int64)
    env.step(far)
    _, _, terminated, truncated, info = env.step(far)
    assert (terminated | truncated).all()
    assert truncated.any()
    assert info["episode_length"].tolist() == [2, 2, 2]


def test_it_renders(small: TaskProgram) -> None:
    env = PowderVectorEnv(small, 2, render_mode="rgb_array", render_scale=3)
    with pytest.raises(ResetNeeded):
        env.render()
    env.reset(seed=0)
    pictures = env.render()
    assert [one.shape for one in pictures] == [(48, 48, 3)] * 2
    assert pictures[0].dtype == np.uint8
    text = PowderEnv(small, render_mode="ansi")
    text.reset(seed=0)
    assert text.render().splitlines()[0] == "#" * 16
    assert PowderEnv(small).render() is None


@pytest.mark.parametrize("mode", MODES)
def test_a_saved_environment_goes_on_as_it_would_have(small: TaskProgram, mode: AutoresetMode) -> None:
    def made() -> TensorEnv:
        return TensorEnv(small, ENVS, observation="compact", autoreset_mode=mode)

    def stepped(env: TensorEnv, action: torch.Tensor, over: torch.Tensor) -> tuple[Any, ...]:
        if mode is AutoresetMode.DISABLED and bool(over.any()):
            env.reset(options={"reset_mask": over})
        return env.step(action)

    first, second, third = made(), made(), made()
    first.reset(seed=3, options={"params": {"water.melt": [0.1, 0.9, 0.5, 0.0, 1.0]}})
    actions, over = torch.from_numpy(actions_of(small)), torch.zeros(ENVS, dtype=torch.bool)
    for action in actions[:4]:
        over = torch.logical_or(*stepped(first, action, over)[2:4])
    saved = first.state()
    assert torch.equal(second.restore(copy.deepcopy(saved)), first.observation.of(first.episodes))
    third.restore(saved)
    for action in actions[4:]:
        found, expected = (stepped(env, action, over) for env in (second, first))
        assert same(found, expected)
        over = expected[2] | expected[3]
    fourth = made()
    fourth.restore(saved)  # what was saved has not been written to
    assert same(fourth.state(), third.state())


def test_what_was_saved_elsewhere_is_refused(small: TaskProgram, tmp_path: Path) -> None:
    env = TensorEnv(small, ENVS)
    with pytest.raises(ResetNeeded):
        env.state()
    env.reset(seed=0)
    before = env.state()
    other = TensorEnv(small, ENVS + 1)
    other.reset(seed=0)
    with pytest.raises(ValueError, match="6 worlds were saved"):
        env.restore(other.state())
    state = env.state()
    state["episodes"]["state"].pop("element")
    with pytest.raises(ValueError, match="their state or size differs"):
        env.restore(state)
    assert same(env.state(), before)
