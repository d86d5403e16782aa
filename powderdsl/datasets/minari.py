"""Conversion of datasets to Minari datasets and back, without loss.

Minari stores uint8 images as JPEG by default, which changes ids. The export turns that off.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from powderdsl.datasets.dataset import DTYPES, Dataset, check_episodes, knows_ids, row_shape
from powderdsl.datasets.manifest import Recipe, changed_params, damaged, read_recipe, reporting_damage
from powderdsl.datasets.recorder import add_shard, begin_manifest, lock_place
from powderdsl.diagnostics import CompileError
from powderdsl.envs import env_id
from powderdsl.system.packages import require
from powderdsl.system.settings import fingerprint
from powderdsl.system.writing import failure, scratch_folder, writing
from powderdsl.tasks.shipped import load_task, shipped_tasks

if TYPE_CHECKING:
    import minari

Array = NDArray[Any]

KEY = "powderdsl"
"""The recipe's key in the metadata of a Minari dataset."""
DATA = "data"
"""Minari's subfolder of a dataset's folder."""


# Export


def to_minari(
    dataset: Dataset, dataset_id: str, *, author: str | None = None, description: str | None = None
) -> minari.MinariDataset:
    """Write a dataset to Minari's folder, episode by episode, and atomically.

    Actions are the five numbers, int64 [T, 5]; observations and rewards keep their dtypes. An episode's seed is its
    world; infos have `success` and `world`, [T + 1] each. If the task is a shipped one with the recorded rules,
    `recover_environment` recreates it.

    Args:
        dataset: the dataset to write.
        dataset_id: ``namespace/name-v0``.
        author: author of the dataset, for Minari's metadata.
        description: description of the dataset, for Minari's metadata.

    Raises:
        CompileError: PD612 if Minari is not installed; PD613 if the dataset exists or the folder cannot be written;
            PD630 if a shard is damaged.
        ValueError: Minari rejects the id.
    """
    place = _place(dataset_id)
    import minari
    from gymnasium.spaces import Box, MultiDiscrete
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.dataset.minari_storage import MinariStorage
    from minari.namespace import create_namespace, list_local_namespaces

    namespace, *_ = parse_dataset_id(dataset_id)
    if place.exists():
        raise failure(
            "PD613",
            f"the Minari dataset {dataset_id} already exists",
            notes=(str(place),),
            helps=(f"choose another version, or run `minari delete {dataset_id}`",),
        )
    recipe = dataset.recipe
    about = f"{recipe.episodes} episodes of the task {recipe.task} ({recipe.split}), policy: {recipe.policy}."
    metadata = {
        "dataset_id": dataset_id,
        "minari_version": minari.__version__,
        "algorithm_name": recipe.policy,
        "description": description or about,
        "requirements": [f"powderdsl=={recipe.powderdsl}"],
        KEY: {"recipe": asdict(recipe)},
        **({"author": {author}} if author else {}),
    }
    with writing(place):
        if namespace is not None and namespace not in list_local_namespaces():
            create_namespace(namespace)
        with scratch_folder(place.parent) as folder:
            whole = folder / "dataset"
            (whole / DATA).mkdir(parents=True)
            storage = MinariStorage.new(
                whole / DATA,
                observation_space=Box(0, 255, recipe.shape, np.uint8),
                action_space=MultiDiscrete(np.array(recipe.action_nvec)),
                env_spec=_spec(recipe),
                data_format="hdf5",
                jpeg_encoding=False,
            )
            storage.update_metadata(metadata)
            storage.update_episodes(_buffers(dataset))
            whole.rename(place)
    return minari.load_dataset(dataset_id)


def _buffers(dataset: Dataset) -> Iterator[Any]:
    from minari.data_collector.episode_buffer import EpisodeBuffer

    for number in range(len(dataset)):
        episode = dataset.episode(number)
        yield EpisodeBuffer(
            id=number,
            seed=episode.world,
            observations=episode.observation.numpy(),
            actions=episode.action.numpy().astype(np.int64),
            rewards=episode.reward.numpy(),
            terminations=episode.terminated.numpy(),
            truncations=episode.truncated.numpy(),
            infos={
                "success": np.append(False, episode.success.numpy()),
                "world": np.full(len(episode.action) + 1, episode.world),
            },
        )


def _spec(recipe: Recipe) -> Any:
    """The spec of the recorded environment; None unless its task is a shipped one with the same rules."""
    import gymnasium

    if recipe.task not in shipped_tasks():
        return None
    try:
        params = changed_params(recipe, load_task(recipe.task))
        task = load_task(recipe.task, knobs=recipe.knobs, params=params)
    except (CompileError, ValueError, KeyError):  # its knobs or parameters have changed
        return None
    recorded = recipe.task_fingerprint, recipe.ruleset_fingerprint
    if (fingerprint(task), fingerprint(task.ruleset)) != recorded:
        return None
    spec = copy.deepcopy(gymnasium.spec(env_id(recipe.task)))
    spec.kwargs |= {
        "split": recipe.split,
        "observation": recipe.observation,
        "knobs": dict(recipe.knobs),
        "params": params,
        "worlds": recipe.worlds,
        "last_action": recipe.last_action,
        "max_episode_steps": recipe.actions,
        "actions": "full",
    }
    return spec


# Import


def from_minari(dataset_id: str, folder: str | Path) -> Dataset:
    """Read a Minari dataset that `to_minari` wrote into a folder: the same shards, byte for byte.

    Args:
        dataset_id: ``namespace/name-v0``.
        folder: the folder to write, which is created, but not its parent. An interrupted import is completed.

    Raises:
        CompileError: PD612 if Minari is not installed; PD630 if the dataset does not exist, is damaged, or was not
            written by `to_minari`; PD631 if the folder has another dataset; PD613 if the folder cannot be written.
        ValueError: Minari rejects the id.
    """
    source = _opened(_place(dataset_id) / DATA)
    recipe, place = _exported_recipe(source), Path(folder)
    with lock_place(place):
        manifest = begin_manifest(place, recipe)
        recorded = {row.number for row in manifest.shards}
        for number in range(recipe.shards):
            if number not in recorded:
                parts: dict[str, list[Array]] = {name: [] for name in DTYPES}
                for episode in recipe.episodes_of(number):
                    what = f"episode_{episode}: {source.storage.data_path} cannot be imported"
                    with reporting_damage(what):
                        for name, value in _episode(source, episode, recipe).items():
                            parts[name].append(value)
                manifest = add_shard(place, manifest, number, parts)
    return Dataset.open(place)


def _opened(folder: Path) -> minari.MinariDataset:
    """The Minari dataset in a folder. Raises CompileError (PD630)."""
    from minari import MinariDataset
    from minari.dataset.minari_storage import MinariStorage

    with reporting_damage(f"{folder} cannot be imported"):
        # To get missing spaces, Minari would create an environment with any function that the file names.
        missing = {"observation_space", "action_space"} - MinariStorage.read_raw_metadata(folder).keys()
        if missing:
            raise ValueError(f"its metadata lack {min(missing)}")
        return MinariDataset(folder)


def _exported_recipe(source: minari.MinariDataset) -> Recipe:
    """The recipe stored by `to_minari`. Raises CompileError (PD630)."""
    folder, exported = source.storage.data_path, source.storage.metadata.get(KEY)
    if not isinstance(exported, dict) or not isinstance(exported.get("recipe"), dict):
        reason = "powderdsl did not write it, so its meaning is unknown"
        fix = "`record` plays any policy, including those of other libraries"
        raise damaged(f"{folder} cannot be imported", reason, fix)
    # Episodes may have been added later.
    return read_recipe(folder, exported["recipe"] | {"episodes": source.total_episodes})


def _episode(source: minari.MinariDataset, number: int, recipe: Recipe) -> dict[str, Array]:
    """The arrays of one episode, as in a shard. Raises ValueError."""
    (episode,) = source.iterate_episodes([number])
    length, infos = len(episode), episode.infos
    arrays = {
        "observation": episode.observations,
        "action": episode.actions,
        "reward": episode.rewards,
        "terminated": episode.terminations,
        "truncated": episode.truncations,
        "success": infos["success"][1:],
        "length": np.array([length]),
        "world": infos["world"][:1],
    }
    rows = {"observation": length + 1, "length": 1, "world": 1}
    for name, value in arrays.items():
        if value.shape != (rows.get(name, length), *row_shape(recipe, name)):
            raise ValueError(f"`{name}` has the shape {list(value.shape)}")
        if not np.can_cast(value.dtype, DTYPES[name], "same_kind"):
            raise ValueError(f"`{name}` has the dtype {value.dtype}")
    check_episodes(arrays, recipe)
    if not knows_ids(recipe, arrays["observation"]):
        raise ValueError("it has ids that the palette lacks")
    return arrays


def _place(dataset_id: str) -> Path:
    """The folder of a Minari dataset. Raises CompileError (PD612) without Minari, ValueError if it rejects the id."""
    for module in ("h5py", "minari"):
        require(module, "reading and writing Minari datasets", "pip install 'powderdsl[minari]'")
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.storage import get_dataset_path

    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError):
        raise ValueError(f"a Minari dataset is named namespace/name-v0; found {dataset_id!r}") from None
    return Path(get_dataset_path(dataset_id))
