"""Damaged and hostile datasets are refused with a reason, and nothing else comes of them."""

from __future__ import annotations

import hashlib
import json
import pickle
import shutil
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from powderdsl.datasets import Dataset, Transitions
from powderdsl.datasets.dataset import write_shard
from powderdsl.diagnostics import CompileError
from tests.hostile.damage_kinds import npy
from tests.refusals import refusal

Arrays = dict[str, NDArray[Any]]


@pytest.fixture
def folder(recorded: Dataset, tmp_path: Path) -> Path:
    """A copy of the dataset, to be damaged."""
    return Path(shutil.copytree(recorded.folder, tmp_path / "data"))


def reasons(folder: Path) -> list[str]:
    """What is said of a dataset that must not pass: the notes of its diagnostics, all PD630."""
    errors = refusal(lambda: Dataset.open(folder).check())
    assert {one.code for one in errors} == {"PD630"}
    return [f"{one.message}: {note}" for one in errors for note in one.notes]


def said_of(folder: Path) -> set[str]:
    """The codes of what is said of a dataset that may pass; nothing else is raised."""
    codes: set[str] = set()
    for read in (Dataset.check, lambda data: Transitions(data)[:]):
        try:
            read(Dataset.open(folder))
        except CompileError as error:
            codes |= {one.code for one in error.diagnostics}
    return codes


def manifest(folder: Path, change: Callable[[Any], Any]) -> None:
    """Change the manifest; what `change` returns, if anything, takes its place."""
    path = folder / "dataset.json"
    data = json.loads(path.read_text("utf-8"))
    path.write_text(json.dumps(change(data) or data), "utf-8")


def sealed(folder: Path, number: int = 1) -> None:
    """Let the manifest agree with a shard's file: someone means harm, and knows how."""
    data = (folder / f"shard-{number:06d}.npz").read_bytes()
    row = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    manifest(folder, lambda whole: whole["shards"][number].update(row))


def arrays_of(folder: Path) -> Arrays:
    with np.load(folder / "shard-000001.npz", allow_pickle=False) as data:
        return {name: data[name] for name in data.files}


# Manifests

RECIPE: list[tuple[str, Any]] = [
    ("seed", -1),
    ("seed", 1 << 80),
    ("shard", 0),
    ("shape", [1, 16]),
    ("channels", ["element", "more"]),
    ("palette", {"256": "core.wall"}),
    ("choices", ["sand.sand"]),
    ("action_nvec", [4, 4, 2, 3]),
    ("observation", "matrix"),
    ("task_fingerprint", "abc"),
    ("policy", None),
    ("knobs", {"disks": 1e99}),
    ("last_action", "explodes"),
]


@pytest.mark.parametrize(("key", "value"), RECIPE)
def test_invalid_values_of_a_recipe_are_refused(key: str, value: Any, folder: Path) -> None:
    manifest(folder, lambda data: data["recipe"].update({key: value}))
    assert any(key in reason or "channels" in reason or "choices" in reason for reason in reasons(folder))


ROWS: list[tuple[Callable[[Any], Any], str]] = [
    (lambda rows: rows[0].update(file="/etc/passwd"), "unknown key `shards[0].file`"),
    (lambda rows: rows[0].update(number="../secret"), "`shards[0].number` must be an integer"),
    (lambda rows: rows[0].update(number=7), "shard 7 does not exist"),
    (lambda rows: rows[0].update(number=1), "is repeated"),
    (lambda rows: rows[0].update(transitions=10**9), "cannot have 1000000000 transitions"),
    (lambda rows: rows[0].update(bytes=10**15), "`shards[0].bytes` must be an integer"),
    (lambda rows: rows[0].update(bytes=5), "its size or its SHA-256"),
    (lambda rows: rows[0].update(sha256="0" * 64), "SHA-256"),
    (lambda rows: rows.pop(), "1 of 3 shards are missing"),
    (lambda rows: rows.extend([[]] * 30), "`shards[3]` must be a mapping"),
]


@pytest.mark.parametrize(("change", "words"), ROWS)
def test_invalid_rows_of_a_manifest_are_refused(
    change: Callable[[Any], Any], words: str, folder: Path
) -> None:
    manifest(folder, lambda data: change(data["shards"]) and None)
    assert any(words in reason for reason in reasons(folder))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "Expecting value"),
        (b"\xff\xfe", "decode"),
        (b"[" * 100_000, "deep"),
        (b"[]", "it lacks"),
        (b'{"format": "powderdsl-dataset", "version": 2}', "this powderdsl reads 1"),
        (b'{"format": "powderdsl-dataset", "version": 1}', "`recipe` is missing"),
        (b'{"format": "powderdsl-dataset", "version": 1, "recipe": {"seed": 1}}', "`recipe.task` is missing"),
    ],
)
def test_texts_that_are_not_manifests_are_refused(text: bytes, words: str, folder: Path) -> None:
    (folder / "dataset.json").write_bytes(text)
    assert words in "\n".join(reasons(folder))


def test_all_mistakes_of_a_manifest_are_told(folder: Path) -> None:
    assert said_of(folder) == set()  # before it is damaged
    manifest(folder, lambda data: data["recipe"].update(seed=-1, episodes=0, task=5))
    assert len(reasons(folder)) == 3


def test_a_folder_without_a_manifest(tmp_path: Path) -> None:
    assert "dataset.json" in reasons(tmp_path)[0]
    assert "dataset.json" in reasons(tmp_path / "gone")[0]
    assert "NUL" in reasons(Path("a\0b"))[0]


# Shards


def test_shards_that_are_gone_or_cut_are_told_at_once(folder: Path) -> None:
    (folder / "shard-000000.npz").unlink()
    whole = (folder / "shard-000001.npz").read_bytes()
    (folder / "shard-000001.npz").write_bytes(whole[:-100])
    messages = [one.message for one in refusal(lambda: Dataset.open(folder).check())]
    assert [message.split("/")[-1].split()[0] for message in messages] == [
        "shard-000000.npz",
        "shard-000001.npz",
    ]


@pytest.mark.parametrize("place", [0, 40, 3000, -2000, -30])
def test_a_flipped_bit_is_seen_before_anything_is_read(place: int, folder: Path) -> None:
    path = folder / "shard-000001.npz"
    data = bytearray(path.read_bytes())
    data[place] ^= 4
    path.write_bytes(data)
    dataset = Dataset.open(folder)
    dataset.episode(0)
    with pytest.raises(CompileError, match=r"shard-000001\.npz is damaged"):
        dataset.episode(8)
    with pytest.raises(CompileError, match=r"shard-000001\.npz is damaged"):
        next(dataset.transitions(500))
    with pytest.raises(CompileError, match="PD630"):
        Transitions(dataset)[:]
    # A flipped bit that the manifest vouches for is either seen or changes nothing but numbers.
    sealed(folder)
    assert said_of(folder) <= {"PD630"}


def first(arrays: Arrays, name: str, value: Any) -> None:
    arrays[name].flat[0] = value


CONTENTS: list[tuple[Callable[[Arrays], Any], str]] = [
    (lambda a: first(a, "observation", 200), "ids that its palette lacks"),
    (lambda a: first(a, "action", 30), "actions out of range"),
    (lambda a: first(a, "action", -1), "actions out of range"),
    (lambda a: first(a, "world", -1), "worlds out of range"),
    (lambda a: first(a, "length", 0), "lengths of its episodes"),
    (lambda a: first(a, "length", 1 << 30), "lengths of its episodes"),
    (lambda a: first(a, "terminated", True), "recorded lengths"),
    (lambda a: a["truncated"].fill(True), "recorded lengths"),
    (lambda a: a.update(observation=a["observation"][:-1]), "`observation` is"),
    (lambda a: a.update(reward=a["reward"][:-1]), "`reward` is"),
]


@pytest.mark.parametrize(("change", "words"), CONTENTS)
def test_arrays_of_wrong_shapes_or_values_are_refused(
    change: Callable[[Arrays], Any], words: str, folder: Path
) -> None:
    arrays = arrays_of(folder)
    change(arrays)
    write_shard(folder, 1, {name: [value] for name, value in arrays.items()}, compress=False)
    sealed(folder)
    assert any(words in reason and "shard-000001" in reason for reason in reasons(folder))


EIGHT = npy("'<i8'", (8,), bytes(64))
MEMBERS: list[tuple[str, bytes, str]] = [
    ("world.npy", npy("'|O'", (8,), pickle.dumps([{"a": 1}] * 8)), "`world` is not an array of numbers"),
    ("world.npy", npy("'<f8'", (8,), bytes(64)), "`world` is float64"),
    ("world.npy", npy("'<i8'", (10**15,), bytes(64)), "`world` has 64 bytes, not 8,000,000,000,000,000"),
    ("world.npy", npy("'<i8'", "__import__('os').abort()", bytes(64)), "`world` is not an array of numbers"),
    ("world.npy", EIGHT[:-8], "56 bytes, not 64"),
    ("world.npy", b"not numpy", "`world` is not an array"),
    ("../world.npy", EIGHT, "must contain exactly"),
    ("extra.npy", EIGHT, "must contain exactly"),
]


@pytest.mark.parametrize("kind", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
@pytest.mark.parametrize(("name", "data", "words"), MEMBERS)
def test_invalid_members_of_a_shard_are_refused(
    name: str, data: bytes, words: str, kind: int, folder: Path
) -> None:
    path = folder / "shard-000001.npz"
    with zipfile.ZipFile(path) as archive:
        members = {entry: archive.read(entry) for entry in archive.namelist()}
    members.pop("world.npy")
    members[name] = data
    with zipfile.ZipFile(path, "w", kind) as archive:
        for entry, text in members.items():
            archive.writestr(entry, text)
    sealed(folder)
    assert any(words in reason for reason in reasons(folder))


def test_a_bomb_is_not_unpacked(folder: Path) -> None:
    """A gigabyte of zeros in a small file: its header is read, and no more."""
    path = folder / "shard-000001.npz"
    with zipfile.ZipFile(path) as archive:
        members = {entry: archive.read(entry) for entry in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for entry, text in members.items():
            with archive.open(entry, "w", force_zip64=True) as member:
                member.write(text)
                for _ in range(1024 if entry == "reward.npy" else 0):
                    member.write(bytes(1 << 20))
    sealed(folder)
    tracemalloc.start()
    assert "`reward` has 1,073," in reasons(folder)[0]
    assert tracemalloc.get_traced_memory()[1] < 50_000_000
    tracemalloc.stop()


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_damage_to_a_manifest_ends_in_a_diagnostic(data: st.DataObject, folder: Path) -> None:
    path = folder / "dataset.json"
    original = path.read_bytes()
    text = bytearray(original)
    for _ in range(data.draw(st.integers(1, 3))):
        text[data.draw(st.integers(0, len(text) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(text)
    try:
        assert said_of(folder) <= {"PD630"}
    finally:
        path.write_bytes(original)
