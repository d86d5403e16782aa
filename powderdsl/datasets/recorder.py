"""Recording episodes of a task. The recipe alone decides the data: see `Recipe`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from powderdsl.datasets.dataset import Dataset
from powderdsl.datasets.manifest import (
    FILE,
    KINDS,
    MAX_EPISODES,
    Manifest,
    Recipe,
    check_place,
    differences,
    episode_bytes,
    read_manifest,
    recipe_of,
    write_manifest,
)
from powderdsl.datasets.shards import DTYPES, is_whole, row_shape, write_shard
from powderdsl.envs.acting import FrameStack, Policy, action_keys, random_policy
from powderdsl.envs.observations import Observation, observation_of
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.experiments.runs import held
from powderdsl.system.settings import check_count
from powderdsl.system.writing import failure, not_writable
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.players import ExpertPlayer
from powderdsl.tasks.task import Task, still_action

Array = NDArray[Any]
Progress = Callable[[float, int], None]
"""Called with the number of episodes played, unfinished ones as fractions, and the number of all."""

PLAYING_BYTES = 1 << 30
"""Memory limit for the episodes that are being played."""


def nothing_policy(program: TaskProgram) -> Policy:
    """A policy that repeats `still_action`. Raises ValueError if the task has none."""
    action = torch.tensor(still_action(program.task), device=program.simulator.device)
    return lambda observed, keys: action.expand(len(observed), 5)


SCRIPTED: dict[str, Callable[[TaskProgram], Policy | ExpertPlayer]] = {
    "expert": ExpertPlayer,
    "random": lambda program: random_policy(program.action_nvec),
    "nothing": nothing_policy,
}
"""Policies that need no training, by name."""


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
    reserved = {"num_envs", "autoreset_mode", "actions", "action_mask"} & how.keys()
    if reserved:
        raise TypeError(f"record does not take {sorted(reserved)[0]}")
    env = TensorEnv(task, 1, observation=observation, autoreset_mode="disabled", **how)
    recipe = recipe_of(env, policy=name, episodes=episodes, seed=seed, compress=compress, shard=shard)
    sight = observation_of(sees or observation, env.simulator, env.task.size)
    act = SCRIPTED[policy](env.program) if isinstance(policy, str) else policy
    place = Path(folder)
    with held_place(place):
        recording = _Recording(env, act, sight, place, begun(place, recipe))
        recording.play(envs, progress or (lambda done, total: None))
    return Dataset.open(place)


# The folder


@contextmanager
def held_place(folder: Path) -> Iterator[None]:
    """Make the folder and lock it."""
    check_place(folder)
    try:
        folder.mkdir(exist_ok=True)
    except (OSError, ValueError) as error:
        raise not_writable(folder, error) from None
    with held(folder):
        yield


def begun(folder: Path, recipe: Recipe) -> Manifest:
    """The manifest to continue with: a new one, or the one of the same recipe with its intact shards."""
    if not (folder / FILE).exists():
        manifest = Manifest(recipe, datetime.now(UTC).isoformat(timespec="seconds"), ())
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


def add_shard(
    folder: Path, manifest: Manifest, number: int, parts: Mapping[str, Sequence[Array]]
) -> Manifest:
    """Write a shard from arrays in parts, and the manifest with it, which is returned."""
    row = write_shard(folder, number, parts, compress=manifest.recipe.compress)
    shards = sorted((*manifest.shards, row), key=lambda shard: shard.number)
    manifest = replace(manifest, shards=tuple(shards))
    write_manifest(folder, manifest)
    return manifest


# Playing


class _Recording:
    """Plays the episodes of all missing shards, in order, and writes each shard when its last episode ends.

    `env` has a number of slots. A slot whose episode is over takes the next one, so that all are busy until the end.
    """

    def __init__(
        self,
        one: TensorEnv,
        policy: Policy | ExpertPlayer,
        sight: Observation,
        folder: Path,
        manifest: Manifest,
    ):
        self.recipe, self.manifest, self.folder = manifest.recipe, manifest, folder
        self.one, self.policy, self.sight = one, policy, sight
        recorded = {row.number for row in manifest.shards}
        shards = [number for number in range(self.recipe.shards) if number not in recorded]
        self.unfinished = {number: len(self.recipe.episodes_of(number)) for number in shards}
        self.numbers = (episode for number in shards for episode in self.recipe.episodes_of(number))
        self.finished: dict[int, dict[str, Array]] = {}

    def play(self, envs: int, progress: Progress) -> None:
        """Play with at most `envs` slots until all shards are written."""
        recipe, left = self.recipe, sum(self.unfinished.values())
        done = recipe.episodes - left
        progress(done, recipe.episodes)
        if not left:
            return
        most = max(1, min(envs, PLAYING_BYTES // episode_bytes(recipe)))
        slots = -(-left // -(-left // most))  # the fewest that need no more rounds
        self.env = TensorEnv(
            self.one.program,
            slots,
            observation=recipe.observation,
            worlds=recipe.worlds,
            autoreset_mode="disabled",
            last_action=recipe.last_action,
            max_episode_steps=recipe.actions,
        )
        self.episode = np.array([next(self.numbers) for _ in range(slots)], np.int64)
        self.stack = FrameStack(getattr(self.policy, "frames", 1))
        self.playing, self.taken = np.ones(slots, bool), np.zeros(slots, np.int64)
        self.tape = {
            name: np.empty((slots, recipe.actions + 1, *row_shape(recipe, name)), dtype)
            for name, dtype in DTYPES.items()
            if name not in ("length", "world")
        }
        observed, _ = self.env.reset(seed=0, options={"worlds": _worlds(recipe, self.episode)})
        self.tape["observation"][:, 0] = observed.cpu().numpy()
        while self.playing.any():
            observed, ended = self.act(observed)
            done += int((ended & self.playing).sum())
            under_way = self.taken[self.playing & ~ended].sum()
            progress(done + float(under_way) / recipe.actions, recipe.episodes)
            if ended.any():
                observed = self.end(ended, observed)

    def act(self, observed: Tensor) -> tuple[Tensor, NDArray[np.bool_]]:
        """Take and record an action in every slot. Returns the next observations, and which episodes ended."""
        env, tape, every = self.env, self.tape, np.arange(len(self.taken))
        episode, taken = (torch.from_numpy(one.copy()).to(env.device) for one in (self.episode, self.taken))
        assert env.episodes is not None
        if isinstance(self.policy, ExpertPlayer):
            actions = self.policy(env.episodes)
        else:
            own = self.sight.kind == self.recipe.observation
            shown = observed if own else self.sight.of(env.episodes.world)
            with torch.no_grad():
                shown = self.stack.push(shown, taken == 0)
                actions = torch.as_tensor(self.policy(shown, action_keys(self.recipe.seed, episode, taken)))
        observed, reward, terminated, truncated, info = env.step(actions)
        given = {"action": actions, "reward": reward, "terminated": terminated, "truncated": truncated}
        for name, value in {**given, "success": info["success"]}.items():
            tape[name][every, self.taken] = value.cpu().numpy()
        self.taken += 1
        tape["observation"][every, self.taken] = observed.cpu().numpy()
        return observed, (terminated | truncated).cpu().numpy()

    def end(self, ended: NDArray[np.bool_], observed: Tensor) -> Tensor:
        """Keep the episodes that ended and begin the next ones. Returns the observations after that."""
        for slot in np.flatnonzero(ended & self.playing).tolist():
            episode, length = int(self.episode[slot]), int(self.taken[slot])
            self.finished[episode] = {
                name: rows[slot, : length + (name == "observation")].copy()
                for name, rows in self.tape.items()
            }
            shard = episode // self.recipe.shard
            self.unfinished[shard] -= 1
            if not self.unfinished[shard]:
                self.write(shard)
            following = next(self.numbers, None)
            # A slot without a next episode plays its last one again, for nothing.
            self.playing[slot] = following is not None
            self.episode[slot] = episode if following is None else following
        self.taken[ended] = 0
        if self.playing.any():
            worlds = _worlds(self.recipe, self.episode)
            options = {"worlds": worlds, "reset_mask": torch.from_numpy(ended.copy())}
            observed, _ = self.env.reset(options=options)
            self.tape["observation"][ended, 0] = observed.cpu().numpy()[ended]
        return observed

    def write(self, number: int) -> None:
        """Write a shard of finished episodes, and the manifest with it. The episodes leave memory."""
        numbers = self.recipe.episodes_of(number)
        episodes = [self.finished.pop(episode) for episode in numbers]
        parts = {name: [one[name] for one in episodes] for name in episodes[0]}
        parts["length"] = [np.array([len(one) for one in parts["action"]])]
        parts["world"] = [_worlds(self.recipe, np.array(numbers, np.int64))]
        self.manifest = add_shard(self.folder, self.manifest, number, parts)


def _worlds(recipe: Recipe, episode: Array) -> Array:
    return np.asarray((recipe.seed + episode) % recipe.worlds)
