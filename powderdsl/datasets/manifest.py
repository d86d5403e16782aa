"""A dataset's manifest: how it was recorded, what its numbers mean, and which shards it has. No torch."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import UTC, datetime
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

from powderdsl.diagnostics import CompileError, Diagnostic, Label
from powderdsl.model.fingerprint import fingerprint
from powderdsl.system.reading import check_links, parse_json, read_bytes
from powderdsl.system.writing import failure, replacing
from powderdsl.tasks.task import BLOW, NO_CHANGE

if TYPE_CHECKING:
    from powderdsl.envs.tensor_env import TensorEnv

FORMAT = "powderdsl-dataset"
VERSION = 2
"""Version 1 had other fingerprints, which are read as unknown."""
FILE = "dataset.json"
KINDS = ("ids", "compact")
"""Observations that are recorded. The others follow from these."""
USUAL_SHARD = 256
USUAL_SHARD_BYTES = 1 << 28
MAX_BYTES = 1 << 24
"""Size limit of a manifest."""
MAX_VALUES = 1 << 19
"""Limit of values in a manifest."""
MAX_SHARD_BYTES = 1 << 32
"""Size limit of the unpacked arrays of one shard."""
MAX_EPISODES = 1 << 32
MAX_SHARDS = 1 << 16
MAX_SIDE = 1 << 20


# What a manifest may say


@dataclass(frozen=True)
class _Rule:
    says: str
    holds: Callable[[Any], bool]


def _ruled(rule: _Rule) -> Any:
    """A field whose value in a manifest obeys a rule."""
    return field(metadata={"rule": rule})


def _rules_of(kind: type) -> dict[str, _Rule]:
    """The rules of a dataclass, by field."""
    return {one.name: one.metadata["rule"] for one in fields(kind)}


def _is_integer(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and 1 <= len(value) <= 500


def _integer(low: int, high: int) -> _Rule:
    return _Rule(f"an integer from {low} to {high}", lambda value: _is_integer(value, low, high))


def _list(says: str, holds: Callable[[Any], bool], low: int, high: int) -> _Rule:
    """Lists of `low` to `high` values that hold."""
    return _Rule(
        says, lambda value: isinstance(value, list) and low <= len(value) <= high and all(map(holds, value))
    )


def _mapping(says: str, holds: Callable[[Any], bool], key: str = r".{1,500}") -> _Rule:
    """Mappings to values that hold, from keys that match a regular expression."""
    return _Rule(
        says,
        lambda value: (
            isinstance(value, dict)
            and len(value) <= 10_000
            and all(re.fullmatch(key, name) and holds(one) for name, one in value.items())
        ),
    )


def _one_of(*words: str) -> _Rule:
    return _Rule(" or ".join(f"`{word}`" for word in words), lambda value: value in words)


_TEXT = _Rule("a text", _is_text)
_TEXTS = _list("a list of texts", _is_text, 1, 1000)
_DIGEST = _Rule(
    "64 hexadecimal digits",
    lambda value: isinstance(value, str) and bool(re.fullmatch(r"[0-9a-f]{64}", value)),
)
_ID = r"[0-9]|[1-9][0-9]|1[0-9]{2}|2[0-4][0-9]|25[0-5]"


@dataclass(frozen=True)
class Recipe:
    """Everything that decides the arrays of a dataset, and what is needed to read them.

    Two datasets of equal recipes have equal shards, byte for byte. `palette` names ids, `choices` the values of an
    action's third number: elements by qualified name, ``blow``, ``nothing``.
    """

    task: str = _ruled(_TEXT)
    split: str = _ruled(_TEXT)
    knobs: Mapping[str, int] = _ruled(
        _mapping("a mapping to integers", lambda one: _is_integer(one, -(1 << 31), 1 << 31))
    )
    params: Mapping[str, float] = _ruled(_mapping("a mapping to numbers", _is_number))
    task_fingerprint: str = _ruled(_DIGEST)
    ruleset: str = _ruled(_TEXT)
    ruleset_fingerprint: str = _ruled(_DIGEST)
    powderdsl: str = _ruled(_TEXT)
    policy: str = _ruled(_TEXT)
    seed: int = _ruled(_integer(0, (1 << 62) - 1))
    worlds: int = _ruled(_integer(1, (1 << 62) - 1))
    episodes: int = _ruled(_integer(1, MAX_EPISODES))
    shard: int = _ruled(_integer(1, MAX_EPISODES))
    """Episodes of a shard; the last one may have fewer."""
    compress: bool = _ruled(_Rule("true or false", lambda value: isinstance(value, bool)))
    observation: str = _ruled(_one_of("ids", "compact"))
    channels: tuple[str, ...] = _ruled(_TEXTS)
    shape: tuple[int, ...] = _ruled(
        _list("three integers from 1", lambda one: _is_integer(one, 1, MAX_SIDE), 3, 3)
    )
    """Of an observation: channels, rows, columns. Its numbers are bytes."""
    palette: Mapping[str, str] = _ruled(_mapping("names by id", _is_text, _ID))
    action_nvec: tuple[int, ...] = _ruled(
        _list("five integers from 1", lambda one: _is_integer(one, 1, (1 << 15) - 1), 5, 5)
    )
    choices: tuple[str, ...] = _ruled(_TEXTS)
    actions: int = _ruled(_integer(1, 1_000_000))
    """The most actions of an episode."""
    last_action: str = _ruled(_one_of("truncates", "terminates"))
    """How an episode ends when it runs out of actions."""

    @property
    def shards(self) -> int:
        """How many shards a complete dataset has."""
        return -(-self.episodes // self.shard)

    def episodes_of(self, shard: int) -> range:
        """The numbers of a shard's episodes."""
        return range(shard * self.shard, min((shard + 1) * self.shard, self.episodes))


@dataclass(frozen=True)
class ShardRow:
    """What the manifest says of a shard's file. The number decides the file's name, so none can lead elsewhere."""

    number: int = _ruled(_integer(0, MAX_SHARDS - 1))
    sha256: str = _ruled(_DIGEST)
    bytes: int = _ruled(_integer(1, 2 * MAX_SHARD_BYTES))
    transitions: int = _ruled(_integer(1, MAX_EPISODES))

    @property
    def file(self) -> str:
        return shard_file(self.number)


@dataclass(frozen=True)
class Manifest:
    recipe: Recipe
    created: str
    """When recording began, ISO 8601."""
    shards: tuple[ShardRow, ...]
    """The recorded shards, ascending."""

    @property
    def transitions(self) -> int:
        return sum(row.transitions for row in self.shards)


def shard_file(number: int) -> str:
    return f"shard-{number:06d}.npz"


# Files


def new_manifest(recipe: Recipe) -> Manifest:
    """The manifest of a dataset without shards."""
    return Manifest(recipe, datetime.now(UTC).isoformat(timespec="seconds"), ())


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write a manifest whole or not at all. Raises CompileError (PD613)."""
    data = {"format": FORMAT, "version": VERSION, **asdict(manifest)}
    with replacing(folder / FILE) as temporary:
        temporary.write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a folder, every value checked.

    Raises:
        CompileError: PD630, with all that is wrong.
    """
    path = folder / FILE
    try:
        data = parse_json(read_bytes(path, MAX_BYTES), MAX_VALUES)
        check_links(folder)
    except OSError as error:
        name = Path(error.filename or path).name
        raise damaged(f"{folder} is not a dataset", f"{name}: {error.strerror or error}") from None
    except ValueError as error:  # also of a NUL in the name
        raise damaged(f"{path} is not a manifest", " ".join(str(error).split())) from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise damaged(f"{path} is not a manifest", f'it lacks "format": "{FORMAT}"')
    if data.get("version") not in (1, VERSION):
        raise damaged(
            f"{path} has the version {_short(data.get('version'))}", f"this powderdsl reads {VERSION}"
        )
    problems = [f"`{key}` must be {rule.says}" for key, rule in _TOP.items() if not rule.holds(data.get(key))]
    checked = checked_recipe(data.get("recipe"), problems)
    rows = [] if problems or checked is None else _rows(checked, data["shards"], problems)
    if problems or checked is None:
        raise many_damaged(path, problems)
    if data["version"] == 1:
        checked = replace(checked, task_fingerprint="", ruleset_fingerprint="")
    return Manifest(checked, data["created"], tuple(rows))


def checked_recipe(data: Any, problems: list[str]) -> Recipe | None:
    """A recipe as a file has it, every value checked; what is wrong with it is added to `problems`."""
    recipe, rules = data if isinstance(data, dict) else {}, _rules_of(Recipe)
    found = [
        f"`recipe.{key}` must be {rule.says}, found {_short(recipe.get(key))}"
        for key, rule in rules.items()
        if recipe and not rule.holds(recipe.get(key))
    ]
    found += [f"`recipe.{_short(key)}` is unknown" for key in recipe if key not in rules]
    problems += found
    if found or not recipe:
        return None
    values: dict[str, Any] = {
        key: tuple(one) if isinstance(one, list) else one for key, one in recipe.items()
    }
    checked = Recipe(**values)
    problems += _misfits(checked)
    return checked


def check_place(folder: Path) -> None:
    """Check, before long work, that a dataset can be recorded in a folder.

    Raises:
        CompileError: PD613: the folder around it is not there; PD630: it holds something else.
    """
    if not folder.is_dir():
        reason = "it is a file" if folder.exists() else f"there is no folder {folder.parent}"
        if folder.exists() or not folder.parent.is_dir():
            raise failure("PD613", f"cannot write {folder}", notes=(reason,))
        return
    found = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    if found and FILE not in found:
        raise damaged(
            f"{folder} is not a dataset", f"it holds {found[0]} and no {FILE}", "take an empty folder"
        )


def damaged(message: str, reason: str, *helps: str) -> CompileError:
    """PD630: a dataset that cannot be used."""
    return failure("PD630", message, notes=(reason,), helps=helps)


def many_damaged(path: Path, problems: list[str]) -> CompileError:
    """PD630, one for each problem, 20 at most."""
    return CompileError(
        [Diagnostic("PD630", f"{path} is damaged", Label(None), notes=(one,)) for one in problems[:20]]
    )


FINGERPRINTS = ("task_fingerprint", "ruleset_fingerprint")


def differences(old: Recipe, new: Recipe) -> list[str]:
    """The differences of two recipes, with both values. An unknown fingerprint differs from none.

    Rules that differ in their name alone are the same: older names did not list all loaded packs.
    """
    found = []
    for one in fields(Recipe):
        a, b = getattr(old, one.name), getattr(new, one.name)
        if one.name in FINGERPRINTS and not (a and b):
            continue
        if isinstance(a, Mapping):
            keys = [key for key in {**a, **b} if a.get(key) != b.get(key)]
            found += [f"{one.name}.{key}: {_short(a.get(key))}, not {_short(b.get(key))}" for key in keys]
        elif a != b:
            found.append(f"{one.name}: {_short(a)}, not {_short(b)}")
    return [] if len(found) == 1 and old.ruleset != new.ruleset else found


_TOP = {
    "recipe": _Rule("a mapping", lambda value: isinstance(value, dict) and bool(value)),
    "created": _TEXT,
    "shards": _Rule("a list", lambda value: isinstance(value, list) and len(value) <= MAX_SHARDS),
}


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
        action_nvec=env.program.action_nvec,  # data have all five numbers, whatever form the environment takes
        choices=tuple(names[choice] for choice in task.agent.choices),
        actions=env.max_episode_steps,
        last_action="terminates" if env.last_action_terminates else "truncates",
    )
    return replace(recipe, shard=_shard_size(recipe, shard))


def _shard_size(recipe: Recipe, given: int | None) -> int:
    """The number of episodes per shard. Raises ValueError if they may not fit into one."""
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


def episode_bytes(recipe: Recipe) -> int:
    """The most bytes that the arrays of an episode take."""
    return (recipe.actions + 1) * (prod(recipe.shape) + 32)


def _misfits(recipe: Recipe) -> list[str]:
    """Contradictions between the values of a recipe."""
    found = []
    if len(recipe.channels) != recipe.shape[0]:
        found.append(f"{len(recipe.channels)} channels, but observations of the shape {list(recipe.shape)}")
    if len(recipe.choices) != recipe.action_nvec[2]:
        found.append(
            f"{len(recipe.choices)} choices, but {recipe.action_nvec[2]} values of an action for them"
        )
    if recipe.shards > MAX_SHARDS:
        found.append(f"{recipe.shards:,} shards, more than {MAX_SHARDS:,}")
    return found


def _rows(recipe: Recipe, data: list[Any], problems: list[str]) -> list[ShardRow]:
    """The rows of shards, ascending; problems are added to `problems`."""
    rows: dict[int, ShardRow] = {}
    rules = _rules_of(ShardRow)
    for place, one in enumerate(data):
        fits = isinstance(one, dict) and one.keys() == rules.keys()
        if not fits or not all(rule.holds(one[key]) for key, rule in rules.items()):
            problems.append(f"`shards[{place}]` needs number, sha256, bytes, transitions, and nothing else")
            continue
        row = ShardRow(**one)
        count = len(recipe.episodes_of(row.number))
        unpacked = (row.transitions + count) * prod(recipe.shape)
        if row.number in rows or row.number >= recipe.shards:
            problems.append(f"`shards[{place}]`: there is no shard {row.number}, or it comes twice")
        elif not count <= row.transitions <= count * recipe.actions:
            problems.append(f"`shards[{place}]`: {count} episodes cannot have {row.transitions} transitions")
        elif unpacked > MAX_SHARD_BYTES:
            problems.append(f"`shards[{place}]`: {unpacked:,} bytes, more than {MAX_SHARD_BYTES:,}")
        rows[row.number] = row
    return [rows[number] for number in sorted(rows)]


def _short(value: Any) -> str:
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 80 else f"{text[:77]}…"
