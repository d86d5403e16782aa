"""Recording episodes of a task. The data depend only on the recipe: see `Recipe`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from powderdsl.datasets.dataset import DTYPES, Dataset, is_whole, row_shape, write_shard
from powderdsl.datasets.manifest import (
    FILE,
    Manifest,
    Recipe,
    check_place,
    episode_bytes,
    read_manifest,
    recipe_of,
    write_manifest,
)
from powderdsl.diagnostics import CompileError
from powderdsl.envs.actions import FrameStack, Policy, random_policy
from powderdsl.envs.mixed import environment
from powderdsl.envs.tensor_env import Observation, observation_of
from powderdsl.experiments.runs import differences, lock_folder
from powderdsl.system.random import action_keys
from powderdsl.system.settings import check_count
from powderdsl.system.writing import failure, writing
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.players import ExpertPlayer
from powderdsl.tasks.task import Task, still_action

Array = NDArray[Any]
Progress = Callable[[float, int], None]
"""Called with the number of episodes played, including fractions of unfinished ones, and the total number."""

PLAYING_BYTES = 1 << 30
"""Memory limit for episodes in progress."""


def idle_policy(program: TaskProgram) -> Policy:
    """A policy that repeats `still_action`. Raises ValueError if the task has none."""
    action = torch.tensor(still_action(program.task), device=program.simulator.device)
    return lambda observed, keys: action.expand(len(observed), 5)


SCRIPTED: dict[str, Callable[[TaskProgram], Policy | ExpertPlayer]] = {
    "expert": ExpertPlayer,
    "random": lambda program: random_policy(program.action_nvec),
    "nothing": idle_policy,
}
"""Untrained policies, by name."""


def record(
    task: str | Path | Task | TaskProgram,
    policy: str | Policy,
    folder: str | Path,
    *,
    episodes: int,
    seed: int = 0,
    observation: str = "ids",
    shard: int | None = None,
    compress: bool = False,
    envs: int = 256,
    policy_name: str | None = None,
    sees: str | None = None,
    progress: Progress | None = None,
    **how: Any,
) -> Dataset:
    """Play whole episodes and write them to a folder.

    Episode e plays world (`seed` + e) mod `worlds` of the split. A folder that already has some of the shards is
    completed; damaged shards are recorded again.

    Args:
        task: as in `TensorEnv`.
        policy: ``random``, ``nothing`` or ``expert``, or a function from observations and keys to actions: see
            `envs.actions.Policy`. Keys follow from the seed, the episode and the action's number; stochastic policies
            should depend on them.
        folder: the folder to write, which is created, but not its parent.
        episodes: the number of episodes.
        seed: the world of the first episode; keys of actions also depend on it.
        observation: ``ids``, ``compact`` or ``laws``.
        shard: episodes in a shard; by default 256, or fewer if these take more than 256 MiB.
        compress: use a seventh of the disk space for ``ids``, and a quarter for ``compact``; reading is slower.
        envs: maximum number of episodes to play at once, which does not affect the recording.
        policy_name: the name of a policy function in the manifest; use a different name for each function.
        sees: the form of observations for the policy, if it differs from the recorded form.
        progress: called after every action.
        how: split, knobs, params, worlds, last_action, max_episode_steps, backend, device, threads: of `TensorEnv`.

    Raises:
        CompileError: an unknown task, split, knob or parameter; PD630 if the folder has other files; PD631 if it has
            another dataset; PD613 if it cannot be written; PD622 if another process records there.
        ValueError: another argument is wrong.
    """
    check_count("envs", envs, 1 << 20)
    if isinstance(policy, str) and policy not in SCRIPTED:
        raise ValueError(f"policy is a function, or one of {', '.join(SCRIPTED)}; found {policy!r}")
    name = policy if isinstance(policy, str) else policy_name
    if not name:
        raise ValueError("a policy function needs a policy_name, which identifies its data")
    env = environment(task, 1, observation=observation, autoreset_mode="disabled", **how)
    recipe = recipe_of(env, policy=name, episodes=episodes, seed=seed, compress=compress, shard=shard)
    sight = observation_of(sees or observation, env.program)
    act = SCRIPTED[policy](env.program) if isinstance(policy, str) else policy
    place = Path(folder)
    with lock_place(place):
        recording = _Recording(env.program, act, sight, place, begin_manifest(place, recipe))
        recording.play(envs, progress or (lambda done, total: None))
    return Dataset.open(place)


# The folder


@contextmanager
def lock_place(folder: Path) -> Iterator[None]:
    """Create the folder and lock it. If a CompileError ends the block, a new folder without a shard is removed."""
    check_place(folder)
    is_new = not folder.is_dir()
    with writing(folder):
        folder.mkdir(exist_ok=not is_new)
    with lock_folder(folder):
        try:
            yield
        except CompileError:
            if is_new and not any(folder.glob("*.npz")):
                rmtree(folder, ignore_errors=True)
            raise


def begin_manifest(folder: Path, recipe: Recipe) -> Manifest:
    """The manifest to continue: a new one, or that of the same recipe with its intact shards."""
    if not (folder / FILE).exists():
        manifest = Manifest(recipe, datetime.now(UTC).isoformat(timespec="seconds"), ())
    else:
        manifest = read_manifest(folder)
        notes = differences(asdict(manifest.recipe), asdict(recipe))
        if notes:
            helps = ("choose another folder, or use the values that the dataset was begun with",)
            raise failure("PD631", f"{folder} has another dataset", notes=notes, helps=helps)
        intact = tuple(row for row in manifest.shards if is_whole(folder, row))
        manifest = replace(manifest, recipe=recipe, shards=intact)
    write_manifest(folder, manifest)
    return manifest


def add_shard(
    folder: Path, manifest: Manifest, number: int, parts: Mapping[str, Sequence[Array]]
) -> Manifest:
    """Write a shard from arrays in parts, and return the manifest with it."""
    row = write_shard(folder, number, parts, compress=manifest.recipe.compress)
    shards = sorted((*manifest.shards, row), key=lambda shard: shard.number)
    manifest = replace(manifest, shards=tuple(shards))
    write_manifest(folder, manifest)
    return manifest


# Playing


@dataclass
class _Recording:
    """Plays the episodes of all missing shards in order, and writes each shard when its last episode ends."""

    program: TaskProgram
    policy: Policy | ExpertPlayer
    sight: Observation
    folder: Path
    manifest: Manifest

    def play(self, envs: int, progress: Progress) -> None:
        """Play at most `envs` episodes at once until all shards are written."""
        recipe, recorded = self.manifest.recipe, {row.number for row in self.manifest.shards}
        shards = [number for number in range(recipe.shards) if number not in recorded]
        numbers = np.array([episode for number in shards for episode in recipe.episodes_of(number)], np.int64)
        batch = max(1, min(envs, PLAYING_BYTES // episode_bytes(recipe)))
        progress(recipe.episodes - len(numbers), recipe.episodes)
        episodes: list[dict[str, Array]] = []
        for first in range(0, len(numbers), batch):
            done = recipe.episodes - len(numbers) + first
            episodes += self.played(numbers[first : first + batch], done, progress)
            while shards and len(episodes) >= len(recipe.episodes_of(shards[0])):
                count = len(recipe.episodes_of(shards[0]))
                parts = {name: [episode[name] for episode in episodes[:count]] for name in DTYPES}
                self.manifest = add_shard(self.folder, self.manifest, shards.pop(0), parts)
                episodes = episodes[count:]

    def played(self, numbers: Array, done: int, progress: Progress) -> list[dict[str, Array]]:
        """The arrays of some episodes, played at once. Finished episodes continue to run, but are ignored."""
        recipe, count = self.manifest.recipe, len(numbers)
        env = environment(
            self.program,
            count,
            observation=recipe.observation,
            worlds=recipe.worlds,
            autoreset_mode="next_step",
            last_action=recipe.last_action,
            max_episode_steps=recipe.actions,
        )
        tape = {
            name: np.empty((count, recipe.actions + 1, *row_shape(recipe, name)), dtype)
            for name, dtype in DTYPES.items()
            if name not in ("length", "world")
        }
        worlds, length = (recipe.seed + numbers) % recipe.worlds, np.zeros(count, np.int64)
        stack = FrameStack(getattr(self.policy, "frames", 1))
        episodes = torch.from_numpy(numbers).to(env.device)
        observed, _ = env.reset(seed=0, options={"worlds": worlds})
        tape["observation"][:, 0] = observed.cpu().numpy()
        for step in range(recipe.actions):
            assert env.episodes is not None
            if isinstance(self.policy, ExpertPlayer):
                actions = self.policy(env.episodes)
            else:
                own = self.sight.kind == recipe.observation
                shown = stack.push(observed if own else self.sight.of(env.episodes))
                with torch.no_grad():
                    actions = torch.as_tensor(self.policy(shown, action_keys(recipe.seed, episodes, step)))
            observed, reward, terminated, truncated, info = env.step(actions)
            values = {"action": actions, "reward": reward, "terminated": terminated, "truncated": truncated}
            for name, value in {**values, "success": info["success"]}.items():
                tape[name][:, step] = value.cpu().numpy()
            tape["observation"][:, step + 1] = observed.cpu().numpy()
            length[(terminated | truncated).cpu().numpy() & (length == 0)] = step + 1
            going = int((length == 0).sum())
            progress(done + count - going + going * (step + 1) / recipe.actions, recipe.episodes)
            if not going:
                break
        return [
            {name: rows[slot, : steps + (name == "observation")].copy() for name, rows in tape.items()}
            | {"length": np.array([steps]), "world": np.array([world])}
            for slot, (steps, world) in enumerate(zip(length, worlds, strict=True))
        ]
