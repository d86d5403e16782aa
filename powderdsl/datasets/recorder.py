"""Recording episodes of a task. What is recorded follows from the recipe alone: see `Recipe`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from powderdsl.datasets.dataset import Dataset
from powderdsl.datasets.manifest import (
    FILE,
    MAX_EPISODES,
    Manifest,
    Recipe,
    check_place,
    differences,
    episode_bytes,
    new_manifest,
    read_manifest,
    write_manifest,
)
from powderdsl.datasets.recipes import KINDS, check_count, recipe_of
from powderdsl.datasets.scripted import SCRIPTED
from powderdsl.datasets.shards import is_whole, write_shard
from powderdsl.envs.acting import Policy, action_keys
from powderdsl.envs.observations import Observation, observation_of
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.experiments.runs.folder import held
from powderdsl.system.writing import failure
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.task import Task

Array = NDArray[Any]
Progress = Callable[[float, int], None]
"""Is told how many episodes have been played, those under way as fractions, and how many there will be."""

PLAYING_BYTES = 1 << 30
"""Of the episodes that are being played, at most."""


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

    Episode e plays world (`seed` + e) mod `worlds` of the split. A folder that has some of the shards already is
    completed; a shard that is damaged is recorded again.

    Args:
        policy: a name of `SCRIPTED`, or a function from observations and keys to actions: see `envs.acting.Policy`.
            Keys follow from the seed, the episode and the action's number; a stochastic policy draws by them.
        folder: it is made, but not the folder around it.
        observation: ``ids`` or ``compact``.
        shard: episodes a shard; by default 256, fewer where they take more than 256 MiB.
        compress: a seventh of the disk space for ``ids``, a quarter for ``compact``, and slower to read.
        envs: episodes that are played at once, at most; it changes nothing in what is recorded.
        policy_name: what the manifest calls a function: other functions, other names.
        sees: the kind of observation that the policy is given, where that is another than what is recorded.
        progress: is called after every action.
        how: split, knobs, params, worlds, last_action, max_episode_steps, backend, device, threads: of `TensorEnv`.

    Raises:
        CompileError: a task, split, knob or parameter that there is not; PD630: the folder has something else; PD631:
            it has another dataset; PD613: it cannot be written; PD622: another process records there. ValueError: another
            argument that is wrong.
    """
    check_count("episodes", episodes, MAX_EPISODES)
    check_count("envs", envs, 1 << 20)
    check_count("seed", seed, (1 << 61) - 1, least=0)
    if observation not in KINDS:
        raise ValueError(f"observation is one of {', '.join(KINDS)}; found {observation!r}")
    if isinstance(policy, str) and policy not in SCRIPTED:
        raise ValueError(f"policy is a function, or one of {', '.join(SCRIPTED)}; found {policy!r}")
    name = policy if isinstance(policy, str) else policy_name
    if not name:
        raise ValueError("a policy that is a function needs a policy_name, by which its data are known")
    reserved = {"num_envs", "autoreset_mode"} & how.keys()
    if reserved:
        raise TypeError(f"record does not take {sorted(reserved)[0]}")
    env = TensorEnv(task, 1, observation=observation, autoreset_mode="disabled", **how)
    recipe = recipe_of(env, policy=name, episodes=episodes, seed=seed, compress=compress, shard=shard)
    sight = observation_of(sees or observation, env.simulator, env.task.size)
    act = SCRIPTED[policy](env.program) if isinstance(policy, str) else policy
    place = Path(folder)
    with _held(place):
        manifest = _begun(place, recipe)
        _play(env, act, sight, place, manifest, envs, progress or (lambda done, total: None))
    return Dataset.open(place)


# The folder


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """The folder, there and ours alone."""
    check_place(folder)
    try:
        folder.mkdir(exist_ok=True)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise failure("PD613", f"cannot write {folder}", notes=(reason,)) from None
    with held(folder):
        yield


def _begun(folder: Path, recipe: Recipe) -> Manifest:
    """The manifest to continue with: a new one, or that of the same recipe with the shards that are whole."""
    for left in sorted([*folder.glob(".shard-*.npz"), *folder.glob(".dataset-*.json")]):
        left.unlink(missing_ok=True)  # of a process that was killed
    if not (folder / FILE).exists():
        manifest = new_manifest(recipe)
    else:
        manifest = read_manifest(folder)
        differ = differences(manifest.recipe, recipe)
        if differ:
            helps = ("take another folder, or the values that it was begun with",)
            raise failure("PD631", f"{folder} has another dataset", notes=tuple(differ[:20]), helps=helps)
        manifest = replace(
            manifest, recipe=recipe, shards=tuple(row for row in manifest.shards if is_whole(folder, row))
        )
    write_manifest(folder, manifest)
    return manifest


# Playing


@dataclass(frozen=True)
class _Tape:
    """The episodes that are being played, a row each: arrays [slots, T, …], `observation` [slots, T + 1, …]."""

    observation: Array
    action: Array
    reward: Array
    terminated: Array
    truncated: Array
    success: Array

    def cut(self, slot: int, length: int) -> dict[str, Array]:
        """A finished episode, in memory of its own."""
        rows = {name: value[slot, :length].copy() for name, value in vars(self).items()}
        rows["observation"] = self.observation[slot, : length + 1].copy()
        return rows


def _tape(slots: int, recipe: Recipe) -> _Tape:
    size = (slots, recipe.actions)
    flags = [np.zeros(size, bool) for _ in range(3)]
    observation = np.empty((slots, recipe.actions + 1, *recipe.shape), np.uint8)
    return _Tape(observation, np.empty((*size, 5), np.int16), np.empty(size, np.float32), *flags)


def _play(
    one: TensorEnv,
    policy: Policy,
    sight: Observation,
    folder: Path,
    manifest: Manifest,
    envs: int,
    progress: Progress,
) -> None:
    """Play the episodes of all shards that are missing, in order; each shard is written when its last one ends.

    A slot whose episode is over takes the next one, so that all slots are busy until the end.
    """
    recipe = manifest.recipe
    there = {row.number for row in manifest.shards}
    missing = [number for number in range(recipe.shards) if number not in there]
    left = sum(len(recipe.episodes_of(number)) for number in missing)
    done = recipe.episodes - left
    progress(done, recipe.episodes)
    if not left:
        return
    most = max(1, min(envs, PLAYING_BYTES // episode_bytes(recipe)))
    slots = -(-left // -(-left // most))  # so few that the last round has as many as the first
    env = TensorEnv(
        one.program,
        slots,
        observation=recipe.observation,
        worlds=recipe.worlds,
        autoreset_mode="disabled",
        last_action=recipe.last_action,
        max_episode_steps=recipe.actions,
    )
    numbers = (episode for number in missing for episode in recipe.episodes_of(number))
    unfinished = {number: len(recipe.episodes_of(number)) for number in missing}
    episode = np.array([next(numbers) for _ in range(slots)], np.int64)
    playing, taken = np.ones(slots, bool), np.zeros(slots, np.int64)
    tape, device = _tape(slots, recipe), env.device
    finished: dict[int, dict[str, Array]] = {}
    observed, _ = env.reset(seed=0, options={"worlds": _worlds(recipe, episode)})
    every = np.arange(slots)
    tape.observation[every, 0] = observed.cpu().numpy()
    while playing.any():
        keys = action_keys(
            recipe.seed,
            torch.from_numpy(episode.copy()).to(device),
            torch.from_numpy(taken.copy()).to(device),
        )
        assert env.episodes is not None
        shown = observed if sight.kind == recipe.observation else sight.of(env.episodes.world)
        with torch.no_grad():
            actions = torch.as_tensor(policy(shown, keys))
        observed, reward, terminated, truncated, info = env.step(actions)
        tape.action[every, taken] = actions.cpu().numpy()
        given = {
            "reward": reward,
            "terminated": terminated,
            "truncated": truncated,
            "success": info["success"],
        }
        for name, value in given.items():
            getattr(tape, name)[every, taken] = value.cpu().numpy()
        taken += 1
        tape.observation[every, taken] = observed.cpu().numpy()
        ended = (terminated | truncated).cpu().numpy()
        done += int((ended & playing).sum())
        progress(done + float(taken[playing & ~ended].sum()) / recipe.actions, recipe.episodes)
        if not ended.any():
            continue
        for slot in np.flatnonzero(ended & playing).tolist():
            number = int(episode[slot]) // recipe.shard
            finished[int(episode[slot])] = tape.cut(slot, int(taken[slot]))
            unfinished[number] -= 1
            if not unfinished[number]:
                manifest = _write(folder, manifest, number, finished)
            following = next(numbers, None)
            # A slot without a next episode plays its last one again, for nothing.
            playing[slot] = following is not None
            episode[slot] = episode[slot] if following is None else following
        taken[ended] = 0
        if playing.any():
            options = {"worlds": _worlds(recipe, episode), "reset_mask": torch.from_numpy(ended.copy())}
            observed, _ = env.reset(options=options)
            tape.observation[ended, 0] = observed.cpu().numpy()[ended]


def _worlds(recipe: Recipe, episode: Array) -> Array:
    return np.asarray((recipe.seed + episode) % recipe.worlds)


def _write(folder: Path, manifest: Manifest, number: int, finished: dict[int, dict[str, Array]]) -> Manifest:
    """Write a shard of finished episodes, which are dropped, and the manifest that has it."""
    recipe = manifest.recipe
    numbers = recipe.episodes_of(number)
    episodes = [finished.pop(episode) for episode in numbers]
    parts = {name: [one[name] for one in episodes] for name in episodes[0]}
    parts["length"] = [np.array([len(one) for one in parts["action"]])]
    parts["world"] = [_worlds(recipe, np.array(numbers, np.int64))]
    row = write_shard(folder, number, parts, compress=recipe.compress)
    rows = sorted((*manifest.shards, row), key=lambda one: one.number)
    manifest = replace(manifest, shards=tuple(rows))
    write_manifest(folder, manifest)
    return manifest
