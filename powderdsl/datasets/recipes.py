"""The recipe of an environment's data: `Recipe` from a `TensorEnv`."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

from powderdsl.datasets.manifest import MAX_EPISODES, MAX_SHARD_BYTES, MAX_SHARDS, Recipe, episode_bytes
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.model.fingerprint import fingerprint
from powderdsl.tasks.task import BLOW, NO_CHANGE

KINDS = ("ids", "compact")
"""Observations that are recorded. The others follow from these."""
USUAL_SHARD = 256
USUAL_SHARD_BYTES = 1 << 28


def check_count(name: str, value: Any, most: int, *, least: int = 1) -> None:
    """Raises ValueError if a value is not an integer from `least` to `most`."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise ValueError(f"{name} must be an integer from {least} to {most}, found {value!r}")


def recipe_of(
    env: TensorEnv,
    *,
    policy: str = "random",
    episodes: int = 1,
    seed: int = 0,
    compress: bool = False,
    shard: int | None = None,
) -> Recipe:
    """What is recorded of an environment's task, split, rules and observations. `shard` as in `record`.

    Raises:
        ValueError: a shard may become too large.
    """
    task, ruleset = env.task, env.task.ruleset
    names = {element.id: element.qualified for element in ruleset.elements}
    names |= {BLOW: "blow", NO_CHANGE: "nothing"}
    recipe = Recipe(
        task=task.name,
        split=env.split,
        knobs={knob.name: knob.value for knob in task.knobs},
        params={param.name: float(param.default) for param in ruleset.params},
        task_fingerprint=fingerprint(task),
        ruleset=ruleset.name,
        ruleset_fingerprint=fingerprint(ruleset),
        powderdsl=sys.modules["powderdsl"].__version__,
        policy=policy,
        seed=seed,
        worlds=env.worlds,
        episodes=episodes,
        shard=1,
        compress=compress,
        observation=env.observation.kind,
        channels=tuple(env.observation.channels),
        shape=tuple(int(one) for one in env.observation.space.shape),
        palette={str(element.id): element.qualified for element in ruleset.elements},
        action_nvec=env.action_nvec,
        choices=tuple(names[choice] for choice in task.agent.choices),
        actions=env.actions,
        last_action="terminates" if env.last_action_terminates else "truncates",
    )
    return replace(recipe, shard=_shard_size(recipe, shard))


def _shard_size(recipe: Recipe, given: int | None) -> int:
    """Episodes a shard. Raises ValueError if they may not fit into one."""
    each = episode_bytes(recipe)
    if given is None:
        size = USUAL_SHARD
        while size > 1 and size * each > USUAL_SHARD_BYTES:
            size //= 2
        size = max(size, -(-recipe.episodes // MAX_SHARDS))
    else:
        check_count("shard", given, MAX_EPISODES)
        size = given
    if size * each > MAX_SHARD_BYTES:
        raise ValueError(
            f"a shard of {size} episodes may take {size * each:,} bytes, more than {MAX_SHARD_BYTES:,}: "
            "record fewer episodes a shard, or shorter ones with max_episode_steps"
        )
    if -(-recipe.episodes // size) > MAX_SHARDS:
        raise ValueError(
            f"{recipe.episodes:,} episodes in shards of {size} are more than {MAX_SHARDS:,} shards: "
            f"record at least {-(-recipe.episodes // MAX_SHARDS)} episodes a shard"
        )
    return size
