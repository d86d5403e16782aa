"""What a dataset says of itself: how it came about, what its numbers mean, and which shards there are. No torch."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from math import prod
from pathlib import Path
from typing import Any

from powderdsl.diagnostics import CompileError, Diagnostic, Label
from powderdsl.system.reading import check_links, parse_json, read_bytes
from powderdsl.system.writing import failure, replacing

FORMAT = "powderdsl-dataset"
VERSION = 2
"""Version 1 had other fingerprints, which say nothing any more: they are read as unknown."""
FILE = "dataset.json"
MAX_BYTES = 1 << 24
"""Of a manifest's text."""
MAX_VALUES = 1 << 19
"""In a manifest."""
MAX_SHARD_BYTES = 1 << 32
"""Of the arrays of one shard, unpacked."""
MAX_EPISODES = 1 << 32
MAX_SHARDS = 1 << 16
MAX_SIDE = 1 << 20


@dataclass(frozen=True)
class Recipe:
    """All that the arrays of a dataset follow from, and what is needed to read them.

    Two datasets of equal recipes have equal shards, byte for byte. `palette` names ids, `choices` the values of an
    action's third number: elements by qualified name, ``blow``, ``nothing``.
    """

    task: str
    split: str
    knobs: Mapping[str, int]
    params: Mapping[str, float]
    task_fingerprint: str
    ruleset: str
    ruleset_fingerprint: str
    powderdsl: str
    policy: str
    seed: int
    worlds: int
    episodes: int
    shard: int
    """Episodes of a shard; the last one may have fewer."""
    compress: bool
    observation: str
    channels: tuple[str, ...]
    shape: tuple[int, ...]
    """Of an observation: channels, rows, columns. Its numbers are bytes."""
    palette: Mapping[str, str]
    action_nvec: tuple[int, ...]
    choices: tuple[str, ...]
    actions: int
    """Of an episode, at most."""
    last_action: str
    """What running out of actions is: it ``truncates`` or ``terminates``."""

    @property
    def shards(self) -> int:
        """How many shards there are when all is recorded."""
        return -(-self.episodes // self.shard)

    def episodes_of(self, shard: int) -> range:
        """The numbers of a shard's episodes."""
        return range(shard * self.shard, min((shard + 1) * self.shard, self.episodes))


@dataclass(frozen=True)
class ShardRow:
    """What the manifest says of a shard's file. A file's name follows from its number, so none can lead elsewhere."""

    number: int
    sha256: str
    bytes: int
    transitions: int

    @property
    def file(self) -> str:
        return shard_file(self.number)


@dataclass(frozen=True)
class Manifest:
    recipe: Recipe
    created: str
    """When recording began, ISO 8601."""
    shards: tuple[ShardRow, ...]
    """Those that are there, ascending."""

    @property
    def transitions(self) -> int:
        return sum(row.transitions for row in self.shards)


def shard_file(number: int) -> str:
    return f"shard-{number:06d}.npz"


def new_manifest(recipe: Recipe) -> Manifest:
    """Of a dataset without shards."""
    return Manifest(recipe, datetime.now(UTC).isoformat(timespec="seconds"), ())


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write it whole or not at all. Raises CompileError (PD613)."""
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
    recipe = data["recipe"] if isinstance(data.get("recipe"), dict) else {}
    problems += [
        f"`recipe.{key}` must be {rule.says}, found {_short(recipe.get(key))}"
        for key, rule in _RECIPE.items()
        if recipe and not rule.holds(recipe.get(key))
    ]
    problems += [f"`recipe.{_short(key)}` is unknown" for key in recipe if key not in _RECIPE]
    if problems:
        raise many_damaged(path, problems)
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in recipe.items()}
    if data["version"] == 1:
        values |= dict.fromkeys(FINGERPRINTS, "")
    checked = Recipe(**values)
    problems = list(_misfits(checked))
    rows = [] if problems else _rows(checked, data["shards"], problems)
    if problems:
        raise many_damaged(path, problems)
    return Manifest(checked, data["created"], tuple(rows))


def check_place(folder: Path) -> None:
    """Fail before long work where no dataset can be recorded.

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
    """PD630, one for each problem; of very many the first ones."""
    return CompileError(
        [Diagnostic("PD630", f"{path} is damaged", Label(None), notes=(one,)) for one in problems[:20]]
    )


FINGERPRINTS = ("task_fingerprint", "ruleset_fingerprint")


def differences(old: Recipe, new: Recipe) -> list[str]:
    """Where two recipes differ, with both values. An unknown fingerprint differs from none.

    Rules that differ in their name alone are the same: names say what is loaded, which they once did not.
    """
    found = []
    for field in fields(Recipe):
        a, b = getattr(old, field.name), getattr(new, field.name)
        if field.name in FINGERPRINTS and not (a and b):
            continue
        if isinstance(a, Mapping):
            keys = [key for key in {**a, **b} if a.get(key) != b.get(key)]
            found += [f"{field.name}.{key}: {_short(a.get(key))}, not {_short(b.get(key))}" for key in keys]
        elif a != b:
            found.append(f"{field.name}: {_short(a)}, not {_short(b)}")
    return [] if len(found) == 1 and old.ruleset != new.ruleset else found


# What a manifest may say


@dataclass(frozen=True)
class _Rule:
    says: str
    holds: Callable[[Any], bool]


def _whole(low: int, high: int) -> _Rule:
    return _Rule(f"an integer from {low} to {high}", lambda value: _is_whole(value, low, high))


def _is_whole(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and 1 <= len(value) <= 500


def _list_of(inner: Callable[[Any], bool], low: int, high: int) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and low <= len(value) <= high and all(map(inner, value))


def _mapping_of(inner: Callable[[Any], bool], key: str = r".{1,500}") -> Callable[[Any], bool]:
    return lambda value: (
        isinstance(value, dict)
        and len(value) <= 10_000
        and all(re.fullmatch(key, name) and inner(one) for name, one in value.items())
    )


def _one_of(*words: str) -> _Rule:
    return _Rule(" or ".join(f"`{word}`" for word in words), lambda value: value in words)


_TEXT = _Rule("a text", _is_text)
_DIGEST = _Rule(
    "64 hexadecimal digits",
    lambda value: isinstance(value, str) and bool(re.fullmatch(r"[0-9a-f]{64}", value)),
)
_NUMBER = _Rule("a number", lambda value: isinstance(value, int | float) and not isinstance(value, bool))

_TOP = {
    "recipe": _Rule("a mapping", lambda value: isinstance(value, dict) and bool(value)),
    "created": _TEXT,
    "shards": _Rule("a list", lambda value: isinstance(value, list) and len(value) <= MAX_SHARDS),
}

_RECIPE: dict[str, _Rule] = {
    "task": _TEXT,
    "split": _TEXT,
    "knobs": _Rule("a mapping to integers", _mapping_of(lambda one: _is_whole(one, -(1 << 31), 1 << 31))),
    "params": _Rule("a mapping to numbers", _mapping_of(_NUMBER.holds)),
    "task_fingerprint": _DIGEST,
    "ruleset": _TEXT,
    "ruleset_fingerprint": _DIGEST,
    "powderdsl": _TEXT,
    "policy": _TEXT,
    "seed": _whole(0, (1 << 62) - 1),
    "worlds": _whole(1, (1 << 62) - 1),
    "episodes": _whole(1, MAX_EPISODES),
    "shard": _whole(1, MAX_EPISODES),
    "compress": _Rule("true or false", lambda value: isinstance(value, bool)),
    "observation": _one_of("ids", "compact"),
    "channels": _Rule("a list of texts", _list_of(_is_text, 1, 1000)),
    "shape": _Rule("three integers from 1", _list_of(lambda one: _is_whole(one, 1, MAX_SIDE), 3, 3)),
    "palette": _Rule(
        "names by id", _mapping_of(_is_text, key=r"[0-9]|[1-9][0-9]|1[0-9]{2}|2[0-4][0-9]|25[0-5]")
    ),
    "action_nvec": _Rule(
        "five integers from 1", _list_of(lambda one: _is_whole(one, 1, (1 << 15) - 1), 5, 5)
    ),
    "choices": _Rule("a list of texts", _list_of(_is_text, 1, 1000)),
    "actions": _whole(1, 1_000_000),
    "last_action": _one_of("truncates", "terminates"),
}

_ROW = {
    "number": _whole(0, MAX_SHARDS - 1),
    "sha256": _DIGEST,
    "bytes": _whole(1, 2 * MAX_SHARD_BYTES),
    "transitions": _whole(1, MAX_EPISODES),
}


def episode_bytes(recipe: Recipe) -> int:
    """Bytes that the arrays of an episode take, at most."""
    return (recipe.actions + 1) * (prod(recipe.shape) + 32)


def _misfits(recipe: Recipe) -> list[str]:
    """What does not fit together."""
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
    """The rows of shards, ascending; what is wrong is added to `problems`."""
    rows: dict[int, ShardRow] = {}
    for place, one in enumerate(data):
        wrong = not isinstance(one, dict) or one.keys() != _ROW.keys()
        wrong = wrong or not all(rule.holds(one[key]) for key, rule in _ROW.items())
        if wrong:
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
