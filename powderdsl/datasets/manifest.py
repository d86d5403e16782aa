"""A dataset's manifest: how it was recorded, the meaning of its numbers, and its shards. Does not need torch."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from powderdsl.diagnostics import CompileError, Diagnostic, Label
from powderdsl.system.reading import check_links, parse_json, read_bytes
from powderdsl.system.settings import Limits, check_settings, fingerprint, read_record
from powderdsl.system.writing import failure, write_text
from powderdsl.tasks.task import BLOW, NO_CHANGE, Task

if TYPE_CHECKING:
    from powderdsl.envs.tensor_env import TensorEnv

FORMAT = "powderdsl-dataset"
VERSION = 1
FILE = "dataset.json"
KINDS = ("ids", "compact", "laws")
"""Forms of observation that can be recorded. The others follow from these."""
USUAL_SHARD = 256
USUAL_SHARD_BYTES = 1 << 28
MAX_BYTES = 1 << 24
"""Size limit of a manifest."""
MAX_SHARD_BYTES = 1 << 32
"""Size limit of the unpacked arrays of one shard."""
MAX_EPISODES = 1 << 32
MAX_SHARDS = 1 << 16
MAX_SIDE = 1 << 20

Digest = Annotated[str, Limits(pattern=r"[0-9a-f]{64}", form="64 hexadecimal digits")]
Seed = Annotated[int, Limits(0, (1 << 61) - 1)]
Episodes = Annotated[int, Limits(1, MAX_EPISODES)]
Names = Annotated[tuple[str, ...], Limits(length=(1, 1000))]
Palette = Annotated[Mapping[str, str], Limits(keys=r"[0-9]|[1-9][0-9]|1[0-9]{2}|2[0-4][0-9]|25[0-5]")]


@dataclass(frozen=True)
class Recipe:
    """Everything that determines the arrays of a dataset, or is needed to read them.

    Datasets with equal recipes have equal shards, byte for byte. `palette` names ids; `choices` names the values of an
    action's third number: elements by qualified name, ``blow``, ``nothing``.
    """

    task: str
    split: str
    knobs: Mapping[str, Annotated[int, Limits(-(1 << 31), 1 << 31)]]
    params: Mapping[str, float]
    task_fingerprint: Digest
    ruleset: str
    ruleset_fingerprint: Digest
    powderdsl: str
    policy: str
    seed: Seed
    worlds: Annotated[int, Limits(1, (1 << 62) - 1)]
    episodes: Episodes
    shard: Episodes
    """Number of episodes per shard; the last one may have fewer."""
    compress: bool
    observation: Annotated[str, Limits(choices=KINDS)]
    channels: Names
    shape: Annotated[tuple[Annotated[int, Limits(1, MAX_SIDE)], ...], Limits(length=(3, 3))]
    """Shape of an observation of bytes: channels, rows, columns."""
    palette: Palette
    action_nvec: Annotated[tuple[Annotated[int, Limits(1, (1 << 15) - 1)], ...], Limits(length=(5, 5))]
    choices: Names
    actions: Annotated[int, Limits(1, 1_000_000)]
    """Maximum number of actions of an episode."""
    last_action: Annotated[str, Limits(choices=("truncates", "terminates"))]
    """How an episode ends after its last action."""

    @property
    def shards(self) -> int:
        """The number of shards of a complete dataset."""
        return -(-self.episodes // self.shard)

    def episodes_of(self, shard: int) -> range:
        """The numbers of a shard's episodes."""
        return range(shard * self.shard, min((shard + 1) * self.shard, self.episodes))


@dataclass(frozen=True)
class ShardRow:
    """A shard's row in the manifest. The file name follows from the number, so it cannot lead out of the folder."""

    number: Annotated[int, Limits(0, MAX_SHARDS - 1)]
    sha256: Digest
    bytes: Annotated[int, Limits(1, 2 * MAX_SHARD_BYTES)]
    transitions: Annotated[int, Limits(1, MAX_EPISODES)]

    @property
    def file(self) -> str:
        return shard_file(self.number)


@dataclass(frozen=True)
class Manifest:
    recipe: Recipe
    created: str
    """The time when recording began, in ISO 8601."""
    shards: Annotated[tuple[ShardRow, ...], Limits(length=(0, MAX_SHARDS))]
    """The recorded shards, ascending."""


def shard_file(number: int) -> str:
    return f"shard-{number:06d}.npz"


# Files


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write a manifest atomically. Raises CompileError (PD613)."""
    data = {"format": FORMAT, "version": VERSION, **asdict(manifest)}
    write_text(folder / FILE, json.dumps(data, indent=1, ensure_ascii=False) + "\n")


def read_manifest(folder: Path) -> Manifest:
    """Read and check the manifest of a folder. Raises CompileError (PD630) with all mistakes."""
    path = folder / FILE
    try:
        data = parse_json(read_bytes(path, MAX_BYTES))
        check_links(folder)
    except OSError as error:
        name = Path(error.filename or path).name
        raise damaged(f"{folder} is not a dataset", f"{name}: {error.strerror or error}") from None
    except ValueError as error:  # also of a NUL in the name
        raise damaged(f"{path} is not a manifest", " ".join(str(error).split())) from None
    if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
        raise damaged(f"{path} is not a manifest", f'it lacks "format": "{FORMAT}"')
    version = data.pop("version", None)
    if version != VERSION:
        raise damaged(f"{path} has the version {version!r:.80}", f"this powderdsl reads {VERSION}")
    manifest = _checked(path, data)
    return replace(manifest, shards=tuple(sorted(manifest.shards, key=lambda shard: shard.number)))


def read_recipe(path: Path, data: Any) -> Recipe:
    """The recipe in a file of another format. Raises CompileError (PD630)."""
    return _checked(path, {"recipe": data, "created": "unknown", "shards": []}).recipe


def _checked(path: Path, data: Any) -> Manifest:
    problems: list[str] = []
    manifest = read_record(Manifest, data, problems)
    if manifest is not None:
        problems += _contradictions(manifest.recipe, manifest.shards)
    if manifest is None or problems:
        message, place = f"{path} is damaged", Label(None)
        notes = [(problem,) for problem in problems[:20]]
        raise CompileError([Diagnostic("PD630", message, place, notes=note) for note in notes])
    return manifest


def check_place(folder: Path) -> None:
    """Check in advance that a dataset can be recorded in a folder.

    Raises CompileError: PD613 if its parent folder does not exist, PD630 if it contains something else.
    """
    if not folder.is_dir():
        reason = "it is a file" if folder.exists() else f"there is no folder {folder.parent}"
        if folder.exists() or not folder.parent.is_dir():
            raise failure("PD613", f"cannot write {folder}", notes=(reason,))
        return
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    if names and FILE not in names:
        reason = f"it contains {names[0]} but no {FILE}"
        raise damaged(f"{folder} is not a dataset", reason, "choose an empty folder")


def damaged(message: str, reason: str, *helps: str) -> CompileError:
    """PD630: a dataset that cannot be used."""
    return failure("PD630", message, notes=(reason,), helps=helps)


@contextmanager
def reporting_damage(message: str, *helps: str) -> Iterator[None]:
    """Turn any exception from reading damaged files into CompileError (PD630)."""
    try:
        yield
    except Exception as error:
        words = (error.strerror if isinstance(error, OSError) else None) or str(error)
        reason = " ".join(words.split())[:200] or type(error).__name__
        raise damaged(message, reason, *helps) from None


def choice_names(task: Task) -> tuple[str, ...]:
    """Return the names of the values of an action's third number."""
    names = {element.id: element.qualified for element in task.ruleset.elements}
    names |= {BLOW: "blow", NO_CHANGE: "nothing"}
    return tuple(names[choice] for choice in task.agent.choices)


def changed_params(recipe: Recipe, task: Task) -> dict[str, Any]:
    """The parameters of a recipe that differ from those of the task's rules."""
    own = {param.name: param.default for param in task.ruleset.params}
    return {
        name: int(value) if isinstance(own[name], int) else value
        for name, value in recipe.params.items()
        if name in own and float(own[name]) != value
    }


def recipe_of(
    env: TensorEnv,
    *,
    policy: str = "random",
    episodes: int = 1,
    seed: int = 0,
    compress: bool = False,
    shard: int | None = None,
) -> Recipe:
    """Describe an environment's task, split, rules and observations for a manifest. `shard` as in `record`.

    Raises ValueError for a value out of range, or if a shard may become too large.
    """
    task, ruleset = env.task, env.task.ruleset
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
        shape=tuple(int(side) for side in env.observation.space.shape),
        palette={str(element.id): element.qualified for element in ruleset.elements},
        action_nvec=env.program.action_nvec,  # data have all five numbers, whatever the environment's form of actions
        choices=choice_names(task),
        actions=env.max_episode_steps,
        last_action="terminates" if env.last_action_terminates else "truncates",
    )
    each = episode_bytes(recipe)
    if shard is None:
        shard = max(1, min(USUAL_SHARD, USUAL_SHARD_BYTES // each), -(-episodes // MAX_SHARDS))
    recipe = replace(recipe, shard=shard)
    check_settings(recipe)
    problems = _contradictions(recipe, ())
    if shard * each > MAX_SHARD_BYTES:
        problems.append(
            f"a shard of {shard} episodes may take {shard * each:,} bytes, more than {MAX_SHARD_BYTES:,}: "
            "record fewer episodes per shard, or shorter ones with max_episode_steps"
        )
    if problems:
        raise ValueError("; ".join(problems))
    return recipe


def episode_bytes(recipe: Recipe) -> int:
    """Maximum number of bytes of an episode's arrays."""
    return (recipe.actions + 1) * (prod(recipe.shape) + 32)


def _contradictions(recipe: Recipe, shards: Sequence[ShardRow]) -> list[str]:
    problems, numbers = [], set()
    if (channels := len(recipe.channels)) != recipe.shape[0]:
        problems.append(f"{channels} channels, but observations of the shape {list(recipe.shape)}")
    if (choices := len(recipe.choices)) != recipe.action_nvec[2]:
        problems.append(f"{choices} choices, but {recipe.action_nvec[2]} values of an action for them")
    if recipe.shards > MAX_SHARDS:
        problems.append(f"{recipe.shards:,} shards, more than {MAX_SHARDS:,}")
    for place, row in enumerate(shards):
        count = len(recipe.episodes_of(row.number))
        unpacked = (row.transitions + count) * prod(recipe.shape)
        if row.number in numbers or row.number >= recipe.shards:
            problems.append(f"`shards[{place}]`: shard {row.number} does not exist or is repeated")
        elif not count <= row.transitions <= count * recipe.actions:
            problems.append(f"`shards[{place}]`: {count} episodes cannot have {row.transitions} transitions")
        elif unpacked > MAX_SHARD_BYTES:
            problems.append(f"`shards[{place}]`: {unpacked:,} bytes, more than {MAX_SHARD_BYTES:,}")
        numbers.add(row.number)
    return problems
