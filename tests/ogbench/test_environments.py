"""OGBench's environments: what they show and accept, and that batches play the same worlds as single ones."""

from __future__ import annotations

import json
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import powderdsl.ogbench
from powderdsl.ogbench.env import PowderworldEnv, PowderworldVectorEnv
from powderdsl.ogbench.episodes import LevelEpisodes, LevelProgram
from powderdsl.ogbench.levels import FOLDER, find_level, read_level, shipped_levels
from tests.compilers import skip_without_compiler


def actions(count: int, worlds: int = 0, seed: int = 0) -> np.ndarray:
    """Actions, some of them not valid: [count] or [count, worlds]."""
    shape = (count, worlds) if worlds else count
    return np.random.default_rng(seed).integers(-1, 9, shape)


def test_levels_are_those_of_ogbench() -> None:
    assert shipped_levels() == ["easy", "medium", "hard"]
    sizes = {name: [len(task.actions) for task in find_level(name).tasks] for name in shipped_levels()}
    assert sizes == {
        "easy": [64, 128, 84, 160, 96],
        "medium": [64, 92, 92, 68, 96],
        "hard": [96, 84, 70, 112, 184],
    }
    assert [len(find_level(name).elements) for name in shipped_levels()] == [2, 5, 8]
    assert all(find_level(name).actions == 8 for name in shipped_levels())


def test_gymnasium_accepts_the_environment(torch: Any) -> None:
    env = gymnasium.make("powderworld-easy-v0", render_mode="rgb_array", backend="wasm").unwrapped
    check_env(env)
    assert env.observation_space == gymnasium.spaces.Box(0, 255, (32, 32, 6), np.uint8)
    assert env.action_space == gymnasium.spaces.Discrete(8)
    assert env.render().shape == (192, 192, 3)
    observed, *_ = env.step(0)
    assert (env.render()[::6, ::6] == observed[..., :3]).all()


def test_an_action_is_given_in_three_stages(easy: LevelProgram) -> None:
    env = PowderworldEnv(easy, mode="data_collection")
    start, info = env.reset()
    assert info == {}
    assert not start[..., 3:].any()
    color = np.array([0x26, 0x43, 0x48])  # of the second element
    chosen, *_ = env.step(1)
    assert (chosen[..., 3:] == color).all()
    placed, *_ = env.step(6)
    assert (placed[:, 24:28, 3:] == color).all()
    assert placed[..., 3:].any(-1).sum() == 4 * 32
    assert (placed[..., :3] == start[..., :3]).all()
    painted, reward, terminated, truncated, info = env.step(7)
    assert (reward, terminated, truncated, info) == (0, False, False, {})
    assert not painted[..., 3:].any()
    changed = (painted[..., :3] != start[..., :3]).any(-1)
    assert changed.sum() == 4 * 3  # the frame stays
    assert changed[28:31, 24:28].all()


def test_a_batch_plays_the_worlds_of_single_environments(hard: LevelProgram) -> None:
    """Also where episodes end at different times, so that stages differ."""
    worlds, limit = 3, 20
    batch = PowderworldVectorEnv(hard, worlds, seed=5, max_episode_steps=limit)
    singles = [PowderworldEnv(hard, seed=5 + number) for number in range(worlds)]
    observed, infos = batch.reset(options={"task_id": [1, 2, 5]})
    over = [False] * worlds
    elapsed = [0] * worlds
    for number, env in enumerate(singles):
        alone, info = env.reset(options={"task_id": [1, 2, 5][number]})
        assert (alone == observed[number]).all()
        assert (info["goal"] == infos["goal"][number]).all()
    batch.max_episode_steps = limit
    begun = 0
    for row in actions(70, worlds):
        if begun == 1:
            batch.reset(options={"reset_mask": np.array([False, True, False])})
            over[1], elapsed[1] = False, 0
            singles[1].reset()
            begun = 2
        observed, reward, _, truncated, infos = batch.step(row)
        for number, env in enumerate(singles):
            if over[number]:
                alone, info = env.reset()
                assert infos["_goal"][number]
                assert infos["task_id"][number] == env.cur_task_id
                assert (infos["goal"][number] == info["goal"]).all()
                over[number], elapsed[number] = False, 0
                begun = max(begun, 1)
            else:
                alone, gain, *_ = env.step(row[number])
                elapsed[number] += 1
                over[number] = elapsed[number] == limit
                assert reward[number] == gain
                assert truncated[number] == over[number]
            assert (alone == observed[number]).all()
    assert begun == 2


@pytest.mark.parametrize(("level", "backend"), [("easy", "torch"), ("easy", "native"), ("hard", "native")])
def test_backends_play_the_same_episodes(request: Any, level: str, backend: str) -> None:
    """Also once stages differ."""
    skip_without_compiler(backend)
    on_wasm = request.getfixturevalue(level)
    rows = actions(60, 3)
    seen = []
    for program in (on_wasm, LevelProgram(on_wasm.level, backend=backend)):
        env = PowderworldVectorEnv(program, 3, seed=1)
        env.reset(options={"task_id": 3})
        frames = [env.step(row)[0] for row in rows[:20]]
        env.reset(options={"reset_mask": np.array([False, True, False])})
        frames += [env.step(row)[0] for row in rows[20:]]
        seen.append((np.stack(frames), env.episodes.errors))
    assert (seen[0][0] == seen[1][0]).all()
    assert (seen[0][1] == seen[1][1]).all()


def test_observations_that_somebody_holds_stay(easy: LevelProgram, torch: Any) -> None:
    skip_without_compiler("native")
    env = PowderworldVectorEnv(LevelProgram(easy.level, backend="native"), 2)
    env.reset()
    held, copies, addresses = [], [], set()
    for number, row in enumerate(actions(12, 2)):
        observed, *_ = env.step(row)
        views = (
            observed,
            observed[1, 3:],
            torch.from_numpy(observed)[..., 4],
            env.episodes.observations()[0],
        )
        held.append(views[number % 4])
        copies.append(held[-1].tolist())
        del observed, views
    assert [view.tolist() for view in held] == copies
    for row in actions(12, 2):
        addresses.add(env.step(row)[0].ctypes.data)
    assert len(addresses) <= 2


def test_a_goal_depends_on_the_seed_and_the_task_alone(hard: LevelProgram) -> None:
    def goal(env: PowderworldEnv, task: int, seed: int | None = None) -> Any:
        return env.reset(seed=seed, options={"task_id": task})[1]["goal"]

    env = PowderworldEnv(hard, seed=1)
    first, again = goal(env, 1), goal(env, 1)
    assert (first == again).all()
    assert (goal(PowderworldEnv(hard), 1, seed=1) == first).all()
    assert (goal(env, 1, seed=2) != first).any()
    assert (goal(env, 2, seed=1) != first).any()
    starts = [env.reset(seed=1)[0], env.reset()[0], env.reset(seed=1)[0]]
    assert (starts[0] == starts[2]).all()
    assert (starts[0] != starts[1]).any()


def test_drawn_tasks_and_replaced_actions_are_spread_evenly(easy: LevelProgram) -> None:
    count = 150
    episodes = LevelEpisodes(easy, np.arange(count))
    episodes.begin(np.arange(count), [None] * count)
    tasks = np.bincount(episodes.task_number, minlength=6)
    assert tasks[0] == 0
    assert (np.abs(tasks[1:] - count / 5) < 4.5 * np.sqrt(count * 0.16)).all()
    episodes.step(np.full(count, 7))
    chosen = episodes.observations()[:, 0, 0, 3:5].numpy()
    assert (chosen[:, 0] == 0x26).all()  # both colors begin with the same byte
    assert abs((chosen[:, 1] == 0x43).sum() - count / 2) < 4.5 * np.sqrt(count / 4)


def test_success_counts_errors_strictly_below_the_tolerance(easy: LevelProgram) -> None:
    """One painted block away from the goal, with matches in neighbors counted."""
    task = {"action_seq": [(easy.level.elements[1], 3, 7)], "tol": 0}
    env = PowderworldEnv(easy)
    env.reset(options={"task_info": task})
    assert env.cur_task_id is None
    assert env.cur_task_info == task
    episodes = env.episodes
    errors = int(episodes.errors[0])
    ids, goal = episodes.world.ids[0].numpy(), episodes.goal_ids[0].numpy()
    near = [np.roll(ids, by, axis) for axis, by in ((0, 0), (0, 1), (0, -1), (1, 1), (1, -1))]
    assert errors == (~(np.stack(near) == goal).any(0)).sum()
    for tolerance, success in ((errors, 0.0), (errors + 1, 1.0)):
        env.reset(seed=0, options={"task_info": {**task, "tol": tolerance}})
        *_, terminated, _, info = env.step(0)
        assert (terminated, info["success"]) == (bool(success), success)


def test_time_limits(torch: Any) -> None:
    env = gymnasium.make("powderdsl/powderworld-easy-v0", backend="wasm")
    env.reset(options={"task_id": 5})
    ends = [env.step(0)[3] for _ in range(500)]
    assert ends == [False] * 499 + [True]
    with pytest.raises(gymnasium.error.NameNotFound):
        gymnasium.make("powderdsl/powderworld-nothing-v0")


def test_autoreset_modes(easy: LevelProgram) -> None:
    same = PowderworldVectorEnv(easy, 2, max_episode_steps=4, autoreset_mode="same_step")
    off = PowderworldVectorEnv(easy, 2, max_episode_steps=4, autoreset_mode=AutoresetMode.DISABLED)
    for env in (same, off):
        env.reset(seed=0, options={"task_id": 2})
    for row in actions(4, 2):
        observed, _, _, truncated, infos = same.step(row)
        last, *_ = off.step(row)
    assert truncated.all()
    assert (np.stack(infos["final_obs"]) == last).all()
    assert infos["final_info"]["success"].tolist() == [0, 0]
    with pytest.raises(ResetNeeded, match="reset_mask"):
        off.step(row)
    begun, _ = off.reset()
    assert (begun == observed).all()


def test_mistakes_are_named(easy: LevelProgram) -> None:
    env, batch = PowderworldEnv(easy), PowderworldVectorEnv(easy, 2)
    with pytest.raises(ResetNeeded):
        env.step(0)
    with pytest.raises(ResetNeeded):
        batch.step([0, 0])
    for options, error in (
        ({"task_id": 0}, "1..5, found 0"),
        ({"task_id": 6}, "1..5, found 6"),
        ({"task_id": "one"}, "an integer"),
        ({"goal": 1}, "no option `goal`"),
        ({"task_info": {"tol": 3}}, "`task_info.action_seq` is missing"),
        ({"task_info": {"action_seq": [("lava", 0, 0)], "tol": 3}}, "no element 'lava' to paint"),
        ({"task_info": {"action_seq": [("plant", 0, 8)], "tol": 3}}, "not within 0..7"),
        ({"task_info": {"action_seq": [("plant", 0)], "tol": 3}}, "must be \\[element, x, y\\]"),
        ({"task_info": {"action_seq": [], "tol": 3}, "task_id": 1}, "not both"),
    ):
        for one in (env, batch):
            with pytest.raises((ValueError, KeyError, TypeError), match=error):
                one.reset(options=options)
    with pytest.raises(ValueError, match="2 environments"):
        batch.reset(options={"task_id": [1]})
    batch.reset()
    with pytest.raises(ValueError, match="actions must be"):
        batch.step([0.5, 0])
    for seed, error in ((-1, ValueError), (1 << 62, ValueError), ("x", TypeError)):
        with pytest.raises(error):
            env.reset(seed=seed)
    with pytest.raises(ValueError, match="did you mean `easy`"):
        PowderworldEnv("eazy")
    with pytest.raises(ValueError, match="randomness"):
        PowderworldEnv(easy, randomness="numpy")
    with pytest.raises(ValueError, match="mode"):
        PowderworldEnv(easy, mode="tasks")


def test_damaged_levels_are_refused(tmp_path: Any) -> None:
    whole = json.loads((FOLDER / "easy.json").read_text())
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({**whole, "name": "mine"}))
    assert read_level(path).tasks == find_level("easy").tasks
    for change, error in (
        ({"side": "big"}, "`side` must be an integer"),
        ({"side": 1 << 20}, "`side` must be an integer from 4 to 512"),
        ({"brush": 0}, "`brush`"),
        ({"colour": 1}, "unknown key `colour`"),
        ({"elements": []}, "`elements` must be a list of 1 to 256"),
        ({"brush": 64}, "must be at most 32"),
        ({"tasks": [{"name": "a", "tolerance": 1, "actions": [["plant", 8, 0]]}]}, "not within"),
        ({"play": {**whole["play"], "episodes": 0}}, "`play.episodes` must be an integer from 1"),
    ):
        path.write_text(json.dumps({**whole, **change}))
        with pytest.raises(ValueError, match=error):
            read_level(path)
    path.write_text("{")
    with pytest.raises(ValueError, match=r"mine\.json"):
        read_level(path)


def test_ids_are_registered(torch: Any) -> None:
    assert powderdsl.ogbench.PowderworldEnv is PowderworldEnv
    for name in shipped_levels():
        spec = gymnasium.spec(f"powderworld-{name}-v0")
        assert (spec.max_episode_steps, spec.kwargs) == (500, {"level": name})
    batch = gymnasium.make_vec("powderworld-easy-v0", num_envs=2, backend="wasm")
    observed, infos = batch.reset(seed=1)
    assert observed.shape == infos["goal"].shape == (2, 32, 32, 6)
