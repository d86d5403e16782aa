"""`CompiledEnv`, which steps by one native call, against `TensorEnv`, which says what a step means."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest

from powderdsl.diagnostics import Reporter, Source
from powderdsl.tasks.shipped import load_task, shipped_tasks
from tests.compilers import skip_without_compiler

pytestmark = pytest.mark.usefixtures("torch")

MODES = ("same_step", "next_step", "disabled")
OBSERVATIONS = ("ids", "compact", "matrix", "rgb")


def assert_same(first: Any, second: Any, place: str) -> None:
    """Assert that nested dicts and lists have tensors of the same types, shapes and bytes."""
    if isinstance(first, dict):
        assert first.keys() == second.keys(), place
        for name in first:
            assert_same(first[name], second[name], f"{place}, {name}")
    elif isinstance(first, list | tuple):
        for number, pair in enumerate(zip(first, second, strict=True)):
            assert_same(*pair, f"{place}[{number}]")
    else:
        assert (first.dtype, first.shape) == (second.dtype, second.shape), place
        assert first.numpy().tobytes() == second.numpy().tobytes(), place


def both(task: Any, worlds: int, split: str = "train", plain: str = "native", **how: Any) -> tuple[Any, Any]:
    """Return a `TensorEnv` and a `CompiledEnv` of a task, or two of the latter if `plain` is another backend."""
    skip_without_compiler()
    from powderdsl.envs.compiled import CompiledEnv
    from powderdsl.envs.tensor_env import TensorEnv
    from powderdsl.tasks.episodes import compile_task

    program = compile_task(task, backend="native", split=split).under(0)
    compiled = CompiledEnv(program, worlds, **how)
    if plain == "native":
        return TensorEnv(program, worlds, **how), compiled
    return CompiledEnv(compile_task(task, backend=plain, split=split).under(0), worlds, **how), compiled


def random_actions(env: Any, draws: random.Random) -> Any:
    import torch

    rows = [[draws.randrange(most) for most in env.action_nvec] for _ in range(env.num_envs)]
    actions = torch.tensor(rows)
    return actions[:, 0] if env.action_form.kind == "discrete" else actions


def assert_alike(plain: Any, compiled: Any, steps: int, seed: int) -> None:
    """Assert that two environments do the same for some random actions, and save the same state."""
    draws = random.Random(seed)
    assert_same(plain.reset(seed=seed), compiled.reset(seed=seed), "reset")
    for number in range(steps):
        actions = random_actions(plain, draws)
        result = plain.step(actions)
        assert_same(result, compiled.step(actions), f"step {number}")
        ended = result[2] | result[3]
        if plain.autoreset_mode.name == "DISABLED" and bool(ended.any()):
            options = {"reset_mask": ended}
            assert_same(plain.reset(options=options), compiled.reset(options=options), f"reset {number}")
    assert_same(plain.state(), compiled.state(), "state")


def assert_task_alike(name: str, seed: int, steps: int, plain: str = "native") -> None:
    """Assert it of a shipped task, with options that the seed draws."""
    draws, task = random.Random(seed), load_task(name)
    how = {
        "observation": draws.choice(OBSERVATIONS),
        "autoreset_mode": draws.choice(MODES),
        "actions": draws.choice(["full", "multidiscrete", "discrete"]),
        "max_episode_steps": draws.choice([None, 7]),
        "last_action": draws.choice(["auto", "truncates", "terminates"]),
        "action_mask": draws.choice([False, True]),
    }
    split = draws.choice([split.name for split in task.splits])
    assert_alike(*both(task, draws.choice([1, 2, 5, 9, 17]), split, plain, **how), steps, seed)


@pytest.mark.parametrize(
    ("name", "seed"),
    [("sand-pushing", 1), ("build-an-arch", 2), ("dig-a-channel", 3), ("destroying", 4), ("herd-gas", 5)],
)
def test_shipped_tasks_are_the_same(name, seed):
    """Speeds, regions of each world's own, painted cells, free steps, floats in observations."""
    assert_task_alike(name, seed, 40)


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_tasks())
def test_all_shipped_tasks_are_the_same(name):
    for seed in range(8):
        assert_task_alike(name, seed, 300)
        assert_task_alike(name, seed, 30, "wasm")


TASK = """task: measured
rules: powderworld
size: [17, 33]
fill: empty
regions:
  west: box columns :21
  drawn: box rows 4..6:9 columns :3..30
targets:
  aim:
    - disk sand at (10, 10..20) radius 5
generate:
  - repeat 9:
      - disk any at (0..16, 0..32) radius 1..4
agent: {may: [blow, sand, wall, nothing], actions: 9, steps_per_action: 2, free_steps: FREE, speed: 9}
reward:
  each: EACH
  final: highest(sand in drawn) / (count(wall) - 1)
end:
  success: SUCCESS
  failure: FAILURE
"""


def custom_task(
    each: str, success: str = "taken == 6", failure: str = "count(sand) < 3", free: int = 5
) -> Any:
    from powderdsl.tasks.file import read_task

    words = {"EACH": each, "SUCCESS": success, "FAILURE": failure, "FREE": str(free)}
    text = TASK
    for word, value in words.items():
        text = text.replace(word, value)
    reporter = Reporter()
    task = read_task(Source("measured.yaml", text), reporter)
    assert not reporter.has_errors
    return task


FORMULAS = (
    "change(match(aim)) * 3 - abs(left - taken) / 7 + painted",
    "start(share(sand in drawn)) - count(sand) div 3 mod 5 + placed - 2 * blown",
    "(1 if count(sand) > 20 and not count(wall) == 9 or left <= 2 else -share(water)) / (count(gas) - 1)",
    "min(count(sand), 30 - count(water), 4) mod (count(fire) - 2) + max(mean(density in west), 1.5)",
    "sum(velocity.column) + count(count(sand) > 2) + change(count(not empty in west))",
)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("each", FORMULAS)
def test_formulas_and_measures_are_the_same(each, mode):
    """The last formula has measures that bit planes do not show, besides some that they do."""
    assert_alike(*both(custom_task(each), 5, autoreset_mode=mode), 30, 3)


def test_conditions_end_episodes_alike():
    task = custom_task("change(count(sand))", "taken >= 3 and count(wall) mod 2 == 0", "count(sand) > 60")
    assert_alike(*both(task, 40), 40, 1)


def test_parameters_seeds_worlds_and_masks_are_the_same():
    import torch

    plain, compiled = both(load_task("keep-ice"), 4, max_episode_steps=5)
    draws = random.Random(0)
    mask = torch.tensor([False, True, True, False])
    resets: list[dict[str, Any]] = [
        {"seed": 5},
        {"options": {"params": {"water.melt": [0.0, 0.1, 0.5, 1.0]}}},
        {"options": {"worlds": [7, 8, 9, 10], "reset_mask": mask}},
        {"options": {"reset_mask": mask}},
        {"seed": [1, None, 3, None]},
        {"options": {"params": {}}},
        {},
    ]
    for number, reset in enumerate(resets):
        assert_same(plain.reset(**reset), compiled.reset(**reset), f"reset {number}")
        for step in range(13):
            actions = random_actions(plain, draws)
            assert_same(plain.step(actions), compiled.step(actions), f"step {step} after reset {number}")
    assert_same(plain.state(), compiled.state(), "state")


def test_a_saved_state_continues_on_either():
    plain, compiled = both(load_task("build-an-arch"), 3, max_episode_steps=9)
    draws = random.Random(0)
    plain.reset(seed=2), compiled.reset(seed=9)
    for _ in range(12):
        plain.step(random_actions(plain, draws))
    assert_same([plain.restore(plain.state())], [compiled.restore(plain.state())], "restored")
    for number in range(25):
        actions = random_actions(plain, draws)
        assert_same(plain.step(actions), compiled.step(actions), f"step {number}")
    saved = compiled.state()
    plain.restore(saved)
    actions = random_actions(plain, draws)
    assert_same(plain.step(actions), compiled.step(actions), "after saving")


@pytest.mark.parametrize(
    "actions",
    [
        [[0, 0, 0, 0, 3]] * 2,
        [[0, -1, 0, 0, 0]] * 2,
        [[0, 0, 0, 0]] * 2,
        [[0] * 5],
        [[0.0] * 5] * 2,
        "no",
        None,
    ],
)
def test_wrong_actions_change_nothing(actions):
    plain, compiled = both(load_task("sand-pushing"), 2)
    plain.reset(seed=1), compiled.reset(seed=1)
    compiled.step([[0] * 5] * 2), plain.step([[0] * 5] * 2)
    for given in (actions, np.array(actions) if isinstance(actions, list) else actions):
        with pytest.raises((TypeError, ValueError)) as wanted:
            plain.step(given)
        with pytest.raises(wanted.type) as shown:
            compiled.step(given)
        assert str(shown.value) == str(wanted.value)
    assert_same(plain.state(), compiled.state(), "state")


@pytest.mark.parametrize("mode", MODES)
def test_results_that_are_held_stay(mode):
    """Also views of them; what nobody holds is written again."""
    _, env = both(load_task("sand-pushing"), 3, autoreset_mode=mode, max_episode_steps=50)
    env.reset(seed=1)
    draws, held, memory = random.Random(1), [], set()
    for number in range(40):
        observed, reward, *_, info = env.step_arrays(random_actions(env, draws).numpy())
        memory.add(observed.ctypes.data)
        if number % 3 == 0:
            part = observed[1:2, 0]
            held += [
                (part, part.copy()),
                (info["world"], info["world"].copy()),
                (reward[:1], reward[:1].copy()),
            ]
        del observed, reward, info
    assert all((array == copy).all() for array, copy in held)
    assert len(memory) < 30


def test_results_without_references_are_reused():
    _, env = both(load_task("sand-pushing"), 2)
    env.reset(seed=1)
    for _ in range(3):
        env.step_arrays(np.zeros((2, 5), np.int64))
    results = env._results
    for _ in range(3):
        env.step_arrays(np.zeros((2, 5), np.int64))
    assert env._results is results


def test_an_array_is_free_without_references_to_it_or_a_view():
    from powderdsl.tasks.compiled import ReusedArray

    memory = ReusedArray((3,), np.uint8)
    assert memory.is_free()
    held = memory.rows[:1]
    assert not memory.is_free()
    del held
    assert memory.is_free()
