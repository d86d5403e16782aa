"""Datasets as Minari datasets, and Minari datasets as datasets. Both directions keep every value.

Minari stores uint8 images as JPEG unless it is told otherwise, which changes ids. It is told otherwise here, and images
that were stored so are refused.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from powderdsl.datasets.dataset import Dataset
from powderdsl.datasets.manifest import (
    MAX_BYTES,
    MAX_EPISODES,
    MAX_VALUES,
    Recipe,
    check_count,
    checked_recipe,
    damaged,
    many_damaged,
    recipe_of,
    write_manifest,
)
from powderdsl.datasets.recorder import begun, held_place
from powderdsl.datasets.shards import Defect, check_episodes, knows_ids, write_shard
from powderdsl.diagnostics import CompileError
from powderdsl.envs import env_id
from powderdsl.envs.actions import KINDS, ActionForm, action_form
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.model.fingerprint import fingerprint
from powderdsl.system.reading import check_links, parse_json, read_bytes
from powderdsl.system.writing import failure, not_writable, scratch_folder
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.shipped import load_task, shipped_tasks
from powderdsl.tasks.task import Task

if TYPE_CHECKING:
    import minari

Array = NDArray[Any]

KEY = "powderdsl"
"""The recipe's key in the metadata of a Minari dataset."""
DATA, METADATA, HDF5 = "data", "metadata.json", "main_data.hdf5"
"""The names that Minari gives."""


def require_minari() -> None:
    """Raises CompileError (PD612) if Minari or h5py is not installed."""
    try:
        import h5py  # noqa: F401  only whether it can be imported
        import minari  # noqa: F401  likewise
    except ModuleNotFoundError as error:
        helps = ("pip install 'powderdsl[minari]'",)
        raise failure("PD612", f"Minari datasets need the package {error.name}", helps=helps) from None


# Export


def to_minari(
    dataset: Dataset,
    dataset_id: str,
    *,
    author: str | None = None,
    author_email: str | None = None,
    code_permalink: str | None = None,
    description: str | None = None,
) -> minari.MinariDataset:
    """Write a dataset to Minari's folder, episode by episode, whole or not at all.

    Actions are the five numbers, int64 [T, 5]; observations and rewards keep their dtypes. An episode's seed is its
    world; infos have `success` and `world`, [T + 1] each. If the task is a shipped one with the recorded rules,
    `recover_environment` makes it.

    Args:
        dataset_id: ``namespace/name-v0``.

    Raises:
        CompileError: PD612: Minari is not installed; PD613: there is such a dataset, or the folder cannot be written;
            PD630: a shard is damaged. ValueError: Minari does not take the id.
    """
    require_minari()
    import minari
    from gymnasium.spaces import Box, MultiDiscrete
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.dataset.minari_storage import MinariStorage
    from minari.namespace import create_namespace, list_local_namespaces

    namespace, *_ = parse_dataset_id(_checked_id(dataset_id))
    place = _place(dataset_id)
    if place.exists():
        raise failure(
            "PD613",
            f"there is a Minari dataset {dataset_id}",
            notes=(str(place),),
            helps=(f"take another version, or `minari delete {dataset_id}`",),
        )
    recipe = dataset.recipe
    about = f"{recipe.episodes} episodes of the task {recipe.task} ({recipe.split}), policy: {recipe.policy}."
    given = {"author": author and {author}, "author_email": author_email and {author_email}}
    metadata = {
        "dataset_id": dataset_id,
        "minari_version": minari.__version__,
        "algorithm_name": recipe.policy,
        "description": description or about,
        "requirements": [f"powderdsl=={recipe.powderdsl}"],
        KEY: {"recipe": asdict(recipe)},
        **{key: value for key, value in given.items() if value},
        **({"code_permalink": code_permalink} if code_permalink else {}),
    }
    try:
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
    except OSError as error:
        raise not_writable(place, error) from None
    return minari.load_dataset(dataset_id)


def _buffers(dataset: Dataset) -> Iterator[Any]:
    from minari.data_collector.episode_buffer import EpisodeBuffer

    for number in range(len(dataset)):
        one = dataset.episode(number)
        yield EpisodeBuffer(
            id=number,
            seed=one.world,
            observations=one.observation.numpy(),
            actions=one.action.numpy().astype(np.int64),
            rewards=one.reward.numpy(),
            terminations=one.terminated.numpy(),
            truncations=one.truncated.numpy(),
            infos={
                "success": np.append(False, one.success.numpy()),
                "world": np.full(len(one.action) + 1, one.world),
            },
        )


def _spec(recipe: Recipe) -> Any:
    """The spec of the environment that was recorded; None unless its task is a shipped one with the same rules."""
    import gymnasium

    if recipe.task not in shipped_tasks():
        return None
    try:
        usual = {one.name: float(one.default) for one in load_task(recipe.task).ruleset.params}
        params = {name: value for name, value in recipe.params.items() if usual.get(name) != value}
        task = load_task(recipe.task, knobs=recipe.knobs, params=params)
    except (CompileError, ValueError, KeyError):  # its knobs or parameters have changed
        return None
    if (fingerprint(task), fingerprint(task.ruleset)) != (
        recipe.task_fingerprint,
        recipe.ruleset_fingerprint,
    ):
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


def from_minari(
    dataset_id: str,
    folder: str | Path,
    *,
    task: str | Path | Task | TaskProgram | None = None,
    shard: int | None = None,
    compress: bool = False,
    **how: Any,
) -> Dataset:
    """Read a Minari dataset into a folder. What `to_minari` wrote gives the same shards, byte for byte.

    Other Minari datasets need `task`, in whose environment they must have been collected; its actions may be in any
    form of `envs.actions`. An episode's world is `world` of its infos, or its seed; `success` of the infos is kept.

    Args:
        folder: it is made, but not the folder around it. An interrupted import is completed.
        shard, compress: as in `record`; only with `task`.
        how: split, observation, knobs, params, last_action and others of `TensorEnv`, with `task`.

    Raises:
        CompileError: PD612: Minari is not installed; PD630: there is no such dataset, it is damaged, or its images are
            JPEG; PD631: the folder has another one; PD613: the folder cannot be written. ValueError: another argument is wrong.
    """
    require_minari()
    if task is None and (shard is not None or compress or how):
        raise TypeError("from_minari takes shard, compress and arguments of the environment only with a task")
    source = _Source(_place(_checked_id(dataset_id)) / DATA)
    form: ActionForm | None = None
    if task is None:
        recipe = source.recipe()
    else:
        env = TensorEnv(task, 1, **{"autoreset_mode": "disabled", "observation": "ids"} | how)
        form = source.form(env)
        policy = str(source.metadata.get("algorithm_name") or f"Minari {dataset_id}")[:500]
        recipe = recipe_of(env, policy=policy, episodes=source.episodes, shard=shard, compress=compress)
    place = Path(folder)
    with held_place(place), source.opened():
        manifest = begun(place, recipe)
        have = {row.number for row in manifest.shards}
        for number in range(recipe.shards):
            if number in have:
                continue
            parts = source.shard(recipe, number, form)
            row = write_shard(place, number, parts, compress=recipe.compress)
            rows = sorted((*manifest.shards, row), key=lambda one: one.number)
            manifest = replace(manifest, shards=tuple(rows))
            write_manifest(place, manifest)
    return Dataset.open(place)


class _Source:
    """The files of a Minari dataset. They may come from a stranger: nothing is read before its size is known."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.file: Any = None
        try:
            self.metadata = parse_json(read_bytes(folder / METADATA, MAX_BYTES), MAX_VALUES)
            check_links(folder)
        except OSError as error:
            raise self._damaged(f"{Path(error.filename or folder).name}: {error.strerror or error}") from None
        except ValueError as error:
            raise self._damaged(f"{METADATA}: {error}") from None
        if not isinstance(self.metadata, dict):
            raise self._damaged(f"{METADATA} is not a mapping")
        self.episodes: int = self.metadata.get("total_episodes", 0)
        try:
            check_count("total_episodes", self.episodes, MAX_EPISODES)
        except ValueError as error:
            raise self._damaged(str(error)) from None
        if self.metadata.get("data_format", "hdf5") != "hdf5":
            raise self._damaged("its data_format is not hdf5, the only one that can be imported")

    def _damaged(self, reason: str, *helps: str) -> CompileError:
        return damaged(f"{self.folder} cannot be imported", reason, *helps)

    def recipe(self) -> Recipe:
        """The recipe that `to_minari` left. Raises CompileError (PD630)."""
        own = self.metadata.get(KEY)
        if not isinstance(own, dict):
            helps = ("name the task that it was collected in: `task=`",)
            raise self._damaged("powderdsl did not write it, so its meaning is unknown", *helps)
        problems: list[str] = []
        recipe = checked_recipe(own.get("recipe"), problems)
        if problems or recipe is None:
            raise many_damaged(self.folder / METADATA, problems or ["`powderdsl` has no recipe"])
        return replace(recipe, episodes=self.episodes)  # some may have been added since

    def form(self, env: TensorEnv) -> ActionForm:
        """The form of the actions, after checking that these and the observations are an environment's."""
        shown, space = self._space("observation_space"), env.observation.space
        wanted = {"type": "Box", "dtype": space.dtype.name, "shape": list(space.shape)}
        if {key: shown.get(key) for key in wanted} != wanted:
            raise self._damaged(f"its observations are not {space.dtype.name} {list(space.shape)}")
        if self.metadata.get("jpeg_encoding", True) and space.shape[0] >= 32 and space.shape[1] >= 32:
            raise self._damaged("its observations are stored as JPEG, which does not keep their values")
        taken = self._space("action_space")
        for kind in KINDS:
            form = action_form(kind, env.task.agent, env.device)
            if kind == "discrete":
                fits = taken.get("type") == "Discrete" and taken.get("n") == form.nvec[0]
            else:
                fits = taken.get("type") == "MultiDiscrete" and taken.get("nvec") == list(form.nvec)
            if fits and not np.any(taken.get("start", 0)):
                return form
        raise self._damaged(f"its actions are not those of {env.task.name}")

    def _space(self, name: str) -> dict[str, Any]:
        text = self.metadata.get(name)
        try:
            found = parse_json(text.encode(), MAX_VALUES) if isinstance(text, str) else None
        except ValueError:
            found = None
        if not isinstance(found, dict):
            raise self._damaged(f"{METADATA} has no {name}")
        return found

    def opened(self) -> Any:
        """The file of the episodes, open while the block runs."""
        import h5py

        try:
            self.file = h5py.File(self.folder / HDF5, "r")
        except OSError as error:
            raise self._damaged(f"{HDF5}: {' '.join(str(error).split())[:200]}") from None
        return self.file

    def shard(self, recipe: Recipe, number: int, form: ActionForm | None) -> dict[str, list[Array]]:
        """The arrays of a shard, in parts, all checked. Raises CompileError (PD630)."""
        parts: dict[str, list[Array]] = {}
        for episode in recipe.episodes_of(number):
            name = f"episode_{episode}"
            try:
                found = _episode(self.file, name, recipe, form)
                check_episodes(found, recipe)
                if not knows_ids(recipe, found["observation"]):
                    raise Defect("it has ids that the palette lacks")
            except (Defect, ValueError, TypeError) as error:
                raise self._damaged(f"{name}: {error}") from None
            except (OSError, RuntimeError, KeyError) as error:  # h5py raises what HDF5 reports
                raise self._damaged(f"{name}: {' '.join(str(error).split())[:200]}") from None
            for key, value in found.items():
                parts.setdefault(key, []).append(value)
        return parts


def _episode(file: Any, name: str, recipe: Recipe, form: ActionForm | None) -> dict[str, Array]:
    """The arrays of one episode, as a shard holds them."""
    group = _node(file, name)
    shape: tuple[int, ...] = getattr(_node(group, "rewards"), "shape", ())
    length = shape[0] if len(shape) == 1 else 0
    if not 1 <= length <= recipe.actions:
        raise Defect(f"its rewards must be 1 to {recipe.actions:,} numbers, found the shape {list(shape)}")
    columns = (form.space.shape or ()) if form else (5,)
    action = _array(group, "actions", (length, *columns), "iu")
    if form is not None:
        action = form.decode(action.astype(np.int64)).cpu().numpy()
    if (action < 0).any() or (action >= np.array(recipe.action_nvec)).any():
        raise Defect("it has actions out of range")
    terminated = _array(group, "terminations", (length,), "b")
    infos = _node(group, "infos") if "infos" in group else {}
    success, world = np.zeros(length + 1, bool), group.attrs.get("seed")
    if "success" in infos:
        success = _array(infos, "success", (length + 1,), "b")
    if "world" in infos:
        world = _array(infos, "world", (length + 1,), "iu")[0]
    if not isinstance(world, int | np.integer):
        raise Defect("it has neither a seed nor `world` in its infos")
    return {
        "observation": _array(group, "observations", (length + 1, *recipe.shape), "u", 1),
        "action": action.astype(np.int16),
        "reward": _array(group, "rewards", (length,), "f").astype(np.float32),
        "terminated": terminated,
        "truncated": _array(group, "truncations", (length,), "b") & ~terminated,
        "success": success[1:],
        "length": np.array([length]),
        "world": np.array([world]),
    }


def _node(group: Any, name: str) -> Any:
    """A member of a group of an HDF5 file, which lies in that file."""
    import h5py

    if not isinstance(group, h5py.Group) or name not in group:
        raise Defect(f"there is no {name}")
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise Defect(f"{name} is a link")
    return group[name]


def _array(group: Any, name: str, shape: tuple[int, ...], kinds: str, size: int = 8) -> Array:
    """An array of a group, of an expected shape, kind of dtype and size of a value in bytes."""
    import h5py

    node = _node(group, name)
    if not isinstance(node, h5py.Dataset) or node.shape != shape:
        raise Defect(f"{name} has the shape {list(getattr(node, 'shape', ()))}, not {list(shape)}")
    if node.external or node.is_virtual:
        raise Defect(f"{name} lies in other files")
    if node.dtype.kind not in kinds or node.dtype.itemsize > size:
        raise Defect(f"{name} has the dtype {node.dtype}")
    found: Array = node[()]
    return found


def _checked_id(dataset_id: str) -> str:
    """The same id. Raises ValueError if Minari does not take it."""
    from minari.dataset.minari_dataset import parse_dataset_id

    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError):
        raise ValueError(f"a Minari dataset is named namespace/name-v0; found {dataset_id!r}") from None
    return dataset_id


def _place(dataset_id: str) -> Path:
    from minari.storage import get_dataset_path

    return Path(get_dataset_path(dataset_id))
