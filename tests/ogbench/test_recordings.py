"""OGBench's own recordings, byte for byte: seeded episodes, given random planes, and goals."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import powderdsl
from powderdsl.ogbench.env import EnvOptions, PowderworldEnv
from powderdsl.ogbench.episodes import LegacyDraws, LevelEpisodes

EXCERPTS = Path(__file__).resolve().parents[1] / "data" / "second" / "ogbench"
WHOLE = "POWDERDSL_RECORDINGS"
"""The variable that names the folder of all recordings."""

LEVELS = ("easy", "medium", "hard")


def whole_recordings() -> Path:
    folder = Path(os.environ.get(WHOLE, "missing")) / "second" / "ogbench"
    if not folder.is_dir():
        pytest.skip(f"{WHOLE} names no folder of recordings")
    return folder


def sha256(array: Any) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def follow_seeded(folder: Path, level: str) -> None:
    """The seeded trace: every observation, the goal and success."""
    trace = json.loads((folder / "trace_seeded.json").read_text())
    recorded = trace[level]
    env = PowderworldEnv(level, randomness="ogbench", backend="torch")
    observed, info = env.reset(seed=7, options={"task_id": 1})
    assert sha256(info["goal"]) == recorded["goal_sha256"]
    assert sha256(observed) == recorded["reset_sha256"]
    for action, digest, success in zip(
        trace["actions"], recorded["step_sha256"], recorded["success"], strict=True
    ):
        observed, reward, terminated, truncated, info = env.step(action)
        assert sha256(observed) == digest
        assert info == {"success": success}
        assert (reward, terminated, truncated) == (success, bool(success), False)


class Planes:
    """Recorded random planes in place of draws."""

    fixes_goals = False

    def __init__(self, planes: np.ndarray):
        self._planes = iter((planes + 0.5) / 256)

    def integers(self, *of: Any) -> Any:
        raise AssertionError("nothing is drawn here")

    def planes(self, which: np.ndarray) -> np.ndarray:
        return next(self._planes)[:, None]


def follow_planes(folder: Path, level: str) -> int:
    """The trace with given planes: ids, fields and pictures. Returns its number of steps."""
    with np.load(folder / "trace_planes.npz") as file:
        recorded = {name.removeprefix(f"{level}_"): file[name] for name in file if name.startswith(level)}
    program = EnvOptions(randomness="ogbench", backend="torch").program(level)
    episodes = LevelEpisodes(program, [0], randomness=Planes(recorded["random"]), mode="data_collection")
    episodes.begin(np.zeros(1, dtype=np.int64), [None])
    steps = len(recorded["random"])
    velocities = dict(enumerate(recorded.get("velocity", ())))
    for step in range(steps + 1):
        if step:
            for stage, action in enumerate(recorded["actions"][3 * step - 3 : 3 * step]):
                at = 3 * step - 3 + stage
                if at < len(recorded.get("stage_observations", ())):
                    shown = episodes.observations()[0].numpy()
                    assert (shown == recorded["stage_observations"][at]).all()
                episodes.step(np.array([action], dtype=np.int64))
        world = episodes.world
        for name, field in (
            ("ids", "element"),
            ("gravity", "gravity"),
            ("custom1", "momentum"),
            ("custom3", "fell"),
        ):
            assert (world[field][0].numpy() == recorded[name][step]).all()
        if step in velocities:
            assert np.array_equal(world["velocity"][0].numpy(), velocities[step])
        assert (episodes.observations()[0, :, :, :3].numpy() == recorded["observations"][step]).all()
    return steps


def follow_goal(folder: Path, level: str, number: int) -> None:
    """A goal five times: cells of each element after each action, the finished world, errors between them."""
    with np.load(folder / "goal_worlds.npz") as file:
        names = [str(name) for name in file["elements"]]
        counts, ids, errors = (
            file[f"{kind}_{level}_task{number}"] for kind in ("counts", "goal_ids", "cross_error")
        )
    program = EnvOptions(randomness="ogbench", backend="torch").program(level)
    known = [program.simulator.ruleset.element(name) for name in names]
    seeds = np.arange(len(ids))
    draws = LegacyDraws(seeds, len(program.streams), program.level.side)
    world = program.start(seeds, np.zeros_like(seeds))
    actions = program.level.numbers(program.level.tasks[number - 1])
    for step in range(len(actions) + 1):
        if step:
            painted = np.repeat(np.array([actions[step - 1]]), len(seeds), 0)
            world = program.act(world, painted, draws.planes(seeds))
        found = np.stack([(world.ids == one.id).sum((1, 2)).numpy() for one in known if one], 1)
        assert (found == counts[:, step]).all()
    assert (world.ids.numpy() == ids).all()
    pairs = [(goal, other) for goal in seeds for other in seeds if goal != other]
    goals, others = zip(*pairs, strict=True)
    assert (program.errors(world.ids[list(others)], world.ids[list(goals)]) == errors).all()


REPLAYED = {
    "easy": (180, 372, 246, 474, 282),
    "medium": (186, 270, 160, 186, 270),
    "hard": (284, 240, 195, 110, 440),
}
"""The environment step at which replaying a goal's actions first succeeds in OGBench: exact at the first level."""


def first_successes(episodes: LevelEpisodes, number: int) -> np.ndarray:
    """The environment step of first success in each episode of a task, when its own actions are replayed; -1: never."""
    every = np.arange(episodes.count)
    episodes.begin(every, [number] * episodes.count)
    first = np.full(episodes.count, -1)
    level = episodes.level
    for step, action in enumerate(np.array(level.numbers(level.tasks[number - 1])).ravel(), 1):
        success = episodes.step(np.full(episodes.count, action))
        first[(first < 0) & success] = step
    return first


@pytest.mark.slow
@pytest.mark.parametrize("randomness", ["counter", "ogbench"])
@pytest.mark.parametrize("level", LEVELS)
def test_replayed_goals_succeed_when_ogbenchs_do(torch: Any, level: str, randomness: str) -> None:
    program = EnvOptions(randomness=randomness, backend="wasm").program(level)
    count = 5 if randomness == "ogbench" else 32
    for number, expected in enumerate(REPLAYED[level], 1):
        episodes = LevelEpisodes(program, np.arange(1000, 1000 + count), randomness=randomness)
        first = first_successes(episodes, number)
        assert (first < 0).mean() <= 0.25
        assert abs(np.median(first[first > 0]) - expected) <= (0 if level == "easy" else 16)


@pytest.mark.parametrize("level", LEVELS)
def test_seeded_episodes_are_ogbenchs(torch: Any, level: str) -> None:
    follow_seeded(EXCERPTS, level)


@pytest.mark.parametrize("level", ["medium", "hard"])
def test_worlds_with_given_random_planes_are_ogbenchs(torch: Any, level: str) -> None:
    assert follow_planes(EXCERPTS, level) == 24


@pytest.mark.parametrize(("level", "number"), [("easy", 3), ("medium", 4), ("hard", 4)])
def test_goals_are_ogbenchs(torch: Any, level: str, number: int) -> None:
    follow_goal(EXCERPTS, level, number)


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
def test_all_recordings_are_followed(torch: Any, level: str) -> None:
    folder = whole_recordings()
    follow_seeded(folder, level)
    assert follow_planes(folder, level) == 60
    for number in range(1, 6):
        follow_goal(folder, level, number)


def test_the_rounded_rules_differ_by_rounding_alone(torch: Any) -> None:
    """One step of random velocities, with and without OGBench's order of sums."""
    random = np.random.default_rng(0)
    ids = np.pad(random.choice([0, 0, 2, 3], (2, 12, 12)), ((0, 0), (1, 1), (1, 1)), constant_values=1)
    velocity = random.normal(0, 1, (2, 2, 14, 14)).astype(np.float32)
    found = []
    for rules in ("powderworld2_ogbench", "powderworld2_einsum"):
        sim = powderdsl.compile(rules, backend="torch")
        world = sim.step(sim.replace(sim.world(ids), velocity=velocity), passes=["wind"])
        found.append((world.ids.numpy(), world["velocity"].numpy()))
    (ids_0, velocity_0), (ids_1, velocity_1) = found
    assert (ids_0 == ids_1).all()
    assert (velocity_0 != velocity_1).any()
    assert np.allclose(velocity_0, velocity_1, rtol=1e-5, atol=1e-6)
