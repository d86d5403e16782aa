"""Evaluating and watching: the same numbers as a loop by hand, in the worlds that were asked for."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium.spaces import MultiDiscrete
from PIL import Image
from torch import nn

from powderdsl.diagnostics import CompileError
from powderdsl.envs.actions import random_policy
from powderdsl.envs.features import Patches
from powderdsl.envs.tensor_env import TensorEnv, observation_of
from powderdsl.experiments.runs import RunFolder
from powderdsl.rl import evaluate, load_policy, train
from powderdsl.rl.evaluation import HAND, Film, film, play
from powderdsl.rl.policies import Residual, policy_of
from powderdsl.simulation.draw import OUTLINES
from powderdsl.simulation.simulator import World
from powderdsl.system.random import action_keys
from powderdsl.tasks.episodes import TaskProgram, compile_task
from powderdsl.tasks.shipped import load_task
from tests.cli.commands import powderdsl
from tests.refusals import refusal
from tests.rl.tiny_tasks import quick, write_task


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = tmp_path_factory.mktemp("runs")
    return train(quick(write_task(folder), steps=32), folder / "run")


@pytest.fixture(scope="module")
def program(run: RunFolder) -> TaskProgram:
    return compile_task(str(run.config["task"]), backend="wasm")


@pytest.mark.slow
def test_a_policy_that_only_acts_imports_no_compiler(run: RunFolder) -> None:
    """The first optimizer of a process imports `torch._dynamo`, which takes a second."""
    program = f"""
import sys
from powderdsl.envs.features import Patches
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.rl import load_policy
from powderdsl.tasks.episodes import compile_task
load_policy({str(run.path)!r}, TensorEnv(compile_task({str(run.config["task"])!r}, backend="wasm"), 1))
print("torch._dynamo" in sys.modules)
"""
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=120
    )
    assert found.stdout == "False\n", found.stderr


def test_a_residual_is_the_sum_of_its_parts() -> None:
    torch.manual_seed(0)
    block, mean = nn.Conv2d(4, 4, 3, padding=2, dilation=2).double(), nn.Linear(4, 4).double()
    x = torch.rand(2, 4, 5, 6, dtype=torch.double, requires_grad=True)
    parts = (*block.parameters(), *mean.parameters())
    expected = x + (block(x) + mean(x.mean((2, 3)))[:, :, None, None]).relu()
    assert torch.allclose(Residual.apply(x, *parts, (2, 2)), expected, rtol=1e-12)
    assert torch.autograd.gradcheck(lambda *given: Residual.apply(*given, (2, 2)), (x, *parts))


@pytest.mark.parametrize("network", ["small", "fcn"])
def test_observations_are_counted_once_for_all_epochs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, network: str
) -> None:
    config, count, counted = quick(write_task(tmp_path), steps=32, network=network), Patches.count, []
    env = TensorEnv(compile_task(config.task, backend="wasm"), 4)
    kind, how = policy_of(config, env)
    policy = kind(env.observation.space, MultiDiscrete(np.array(env.action_nvec)), lambda _: 1e-3, **how)
    observed, actions = env.reset(seed=0)[0], torch.tensor([[1, 0, 1, 0, 0]] * 4)
    counts = next(one for one in policy.modules() if isinstance(one, Patches)).count(observed).byte()
    pairs = zip(
        policy.evaluate_actions(counts, actions), policy.evaluate_actions(observed, actions), strict=True
    )
    assert all(torch.equal(one, other) for one, other in pairs)

    def counting(see: Patches, observed: torch.Tensor) -> torch.Tensor:
        counted.append(len(observed))
        return count(see, observed)

    monkeypatch.setattr(Patches, "count", counting)
    train(config, tmp_path / "run")
    # For the action and for the epochs; at ends of episodes, and once to build the network.
    assert sum(counted) - counted.count(1) <= 2 * 32 + 4


@pytest.mark.parametrize("deterministic", [True, False])
def test_scores_are_those_of_a_loop_by_hand(
    run: RunFolder, program: TaskProgram, deterministic: bool
) -> None:
    found = evaluate(run, episodes=6, splits=["train"], deterministic=deterministic, seed=9)
    policy = load_policy(run, TensorEnv(program, 1), deterministic=deterministic)
    sight = observation_of("ids", program)
    acts = {"trained": policy, "random": random_policy(program.action_nvec), "nothing": None}
    by_hand = {}
    for name, act in acts.items():
        returns = []
        for world in range(6):  # one at a time: no policy's draws depend on the batch
            episodes, total = program.start(torch.tensor([world])), 0.0
            for step in range(4):
                key = action_keys(9, torch.tensor([world]), step)
                actions = None if act is None else act(sight.of(episodes), key)
                episodes, reward, _, over = program.act(episodes, actions)
                total += float(reward[0])
                if over[0]:
                    break
            returns.append(total)
        by_hand[name] = np.array(returns)
    for score in found.scores:
        returns = by_hand[score.policy]
        assert score.mean == pytest.approx(returns.mean(), abs=1e-6)
        assert score.interval == pytest.approx(2.571 * returns.std(ddof=1) / 6**0.5, abs=1e-6)
        assert set(score.above) == {"random", "nothing"} - {score.policy}
        for other, (mean, half) in score.above.items():
            above = returns - by_hand[other]
            assert mean == pytest.approx(above.mean(), abs=1e-6)
            assert half == pytest.approx(2.571 * above.std(ddof=1) / 6**0.5, abs=1e-6)
    assert by_hand["random"].std() > 0
    assert json.loads((run.path / "evaluation.json").read_text()) == json.loads(json.dumps(found.as_json()))


def test_all_splits_are_played_unless_some_are_asked_for(run: RunFolder) -> None:
    found = evaluate(run, episodes=2, policies=["nothing"])
    assert [(one.split, one.policy) for one in found.scores] == [("train", "nothing"), ("test", "nothing")]
    assert found.step is None
    task = load_task(str(run.config["task"]), knobs={"size": 3})
    assert [one.policy for one in evaluate(task, episodes=2, splits=["test"]).scores] == ["random", "nothing"]
    with pytest.raises(ValueError, match="trained"):
        evaluate(task, policies=["trained"])
    with pytest.raises(CompileError, match="no split"):
        evaluate(run, splits=["tset"])


def test_the_training_split_has_the_worlds_that_were_trained_on(tmp_path: Path) -> None:
    run = train(quick(write_task(tmp_path), steps=32, worlds=2), tmp_path / "run")
    score = evaluate(run, episodes=6, splits=["train"], policies=["nothing"]).scores[0]
    program = compile_task(str(run.config["task"]), backend="wasm")
    assert score.mean == pytest.approx(float(play(program, None, torch.arange(2)).returns.mean()))


def test_doing_nothing_is_what_the_rules_do_alone(program: TaskProgram) -> None:
    worlds = torch.arange(3)
    episodes = program.start(worlds)
    alone = program.simulator.step(episodes.world, 4 * 2 + 3)
    last = []

    class Seen(Film):
        def see(self, world: World) -> None:
            last.append(world)
            super().see(world)

    play(program, None, worlds, recorder=Seen(program.task, len(worlds), 1))
    assert torch.equal(last[-1].ids, alone.ids)
    assert torch.equal(last[-1]["velocity"], alone["velocity"])


def test_sampled_actions_follow_the_policy(run: RunFolder, program: TaskProgram) -> None:
    env = TensorEnv(program, 1)
    policy = load_policy(run, env)
    observed = env.reset(seed=0)[0].expand(4000, -1, -1, -1)
    actions = policy(observed, action_keys(0, torch.arange(4000), 0))
    assert actions.shape == (4000, 5)
    wanted = policy.network.get_distribution(observed[:1].float()).distribution
    for column, one in enumerate(wanted):  # type: ignore[arg-type]  # a list: one of each number of an action
        found = torch.bincount(actions[:, column], minlength=env.action_nvec[column]) / 4000
        assert torch.allclose(found, one.probs[0], atol=0.04)
    likeliest = load_policy(run, env, deterministic=True)(observed[:1], torch.zeros(1, dtype=torch.int64))
    assert likeliest[0].tolist() == [int(one.probs.argmax()) for one in wanted]  # type: ignore[union-attr]


def test_a_policy_of_another_environment_is_refused(run: RunFolder, program: TaskProgram) -> None:
    assert refusal(load_policy, run, TensorEnv(program, 1, observation="compact"))[0].code == "PD623"
    assert refusal(load_policy, run, TensorEnv("keep-ice", 1, backend="wasm"))[0].code == "PD623"


def test_a_film_has_each_action_and_each_step(program: TaskProgram) -> None:
    policy = random_policy(program.action_nvec)
    played, pictures = film(program, policy, torch.arange(3), factor=4)
    frames = list(pictures)
    assert len(frames) == 1 + 4 * (1 + 2) + 3
    assert {frame.shape for frame in frames} == {(2 + 64 + 14 + 2, 3 * (64 + 2) + 2, 3)}
    assert torch.equal(played.returns, play(program, policy, torch.arange(3)).returns)
    assert not (frames[0] == HAND).all(-1).any()
    assert (frames[1] == HAND).all(-1).sum() >= 3 * (4 * 15 // 2)  # a corner's block has two edges at least
    ids = program.start(torch.arange(3)).world.ids
    colors = {element.id: element.color for element in program.task.ruleset.elements}
    for world in range(3):
        corner = frames[0][2 + 4 * 9, 2 + world * 66 + 4 * 7]
        assert "#" + bytes(corner).hex().upper() == colors[int(ids[world, 9, 7])].upper()


def test_films_show_regions(tmp_path: Path) -> None:
    text = write_task(tmp_path).read_text()
    path = write_task(
        tmp_path, text.replace("generate:", "regions: {pit: box rows 4:8 columns 4:8}\ngenerate:", 1)
    )
    _, pictures = film(compile_task(str(path), backend="wasm"), None, torch.arange(1), factor=3)
    assert (next(pictures) == OUTLINES[0]).all(-1).sum() == 4 * (12 - 1)


def test_a_film_is_written(run: RunFolder, tmp_path: Path) -> None:
    powderdsl("watch", str(run.path), "--worlds", "2", "--backend", "wasm", "--scale", "2", exits=0)
    with Image.open(run.path / "watch.gif") as image:
        assert image.n_frames == 1 + 4 * (1 + 2) + 3  # type: ignore[attr-defined]


def test_films_and_start_worlds_show_fields(tmp_path: Path) -> None:
    """Where the color of an element follows a field, films show it after each step: these cells heat up."""
    (tmp_path / "stove.yaml").write_text(
        "pack: stove\nneeds: core\nfields: {heat: {type: 0..9, at: element, stove: 3}}\n"
        'elements: {stove: {density: 5, color: "#303030", color_by: {field: heat, to: "#FF3000"}}}\n'
        "passes: {burn: {do: heat += 1 where stove}}\n"
    )
    task = tmp_path / "task.yaml"
    task.write_text(
        "task: warm\nrules: core+stove.yaml\nsize: [8, 8]\nfill: stove\n"
        "agent: {may: [wall, nothing], bins: 2, brush: 4, actions: 1, steps_per_action: 2}\nreward: {each: placed}\n"
    )
    _, pictures = film(compile_task(str(task), backend="wasm"), None, torch.arange(1), factor=1)
    reds = [int(frame[4, 4, 0]) for frame in pictures]
    assert reds == [117, 117, 140, 163]  # the start, the action, two steps
    powderdsl("show", task, "--worlds", "1", "--out", tmp_path / "sheet.png", exits=0)
    with Image.open(tmp_path / "sheet.png") as image:
        assert image.convert("RGB").getpixel((9, 9)) == (117, 48, 32)
