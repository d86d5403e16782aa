"""Datasets go to Minari and come back bit for bit, and those of others come in with every value checked."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from powderdsl.datasets import Dataset, from_minari, record, to_minari
from powderdsl.diagnostics import CompileError
from powderdsl.tasks.episodes import TaskProgram
from tests.datasets.test_reading import numbered
from tests.refusals import refusal

pytest.importorskip("minari")
h5py = pytest.importorskip("h5py")

ID = "powderdsl/small-v0"


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder of Minari's."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


def shards(data: Dataset) -> list[tuple[int, str]]:
    return [(row.number, row.sha256) for row in data.manifest.shards]


@pytest.mark.parametrize("observation", ["ids", "compact"])
@pytest.mark.parametrize("compress", [False, True])
def test_a_dataset_comes_back_byte_for_byte(
    small: TaskProgram, observation: str, compress: bool, tmp_path: Path
) -> None:
    data = record(
        small, "random", tmp_path / "a", episodes=7, shard=3, observation=observation, compress=compress
    )
    to_minari(data, ID)
    again = from_minari(ID, tmp_path / "b")
    assert shards(again) == shards(data)
    assert again.recipe == data.recipe


def test_minari_shows_what_was_recorded(recorded: Dataset) -> None:
    found = to_minari(recorded, ID, author="somebody", description="a test")
    assert found.total_episodes == len(recorded)
    assert found.total_steps == recorded.steps
    assert found.env_spec is None, "the task is in a file of the user's"
    assert found.storage.metadata["author"] == {"somebody"}
    for one in found.iterate_episodes():
        wanted = recorded.episode(int(one.id))
        assert one.observations.dtype == np.uint8
        assert one.rewards.dtype == np.float32
        assert np.array_equal(one.observations, wanted.observation)
        assert np.array_equal(one.actions, wanted.action)
        assert np.array_equal(one.rewards, wanted.reward)
        assert np.array_equal(one.terminations, wanted.terminated)
        assert np.array_equal(one.truncations, wanted.truncated)
        assert np.array_equal(one.infos["success"][1:], wanted.success)
        assert set(one.infos["world"].tolist()) == {wanted.world}
        assert all(found.action_space.contains(action) for action in one.actions)
        assert all(found.observation_space.contains(shown) for shown in one.observations)


def test_images_are_not_stored_as_jpeg(recorded: Dataset, tmp_path: Path) -> None:
    """An observation that Minari takes for a picture: 40 channels of 40×40 bytes."""
    channels = tuple(f"c{i}" for i in range(40))
    palette = {str(i): f"e.{i}" for i in range(256)}
    recipe = replace(recorded.recipe, channels=channels, palette=palette)
    noise = np.random.default_rng(0).integers(0, 256, (3, 40, 40, 40), np.uint8)
    (tmp_path / "a").mkdir()
    data = numbered(tmp_path / "a", recipe, [2], 1, compress=False, observation=noise)
    found = to_minari(data, ID)
    assert np.array_equal(found[0].observations, noise)
    assert shards(from_minari(ID, tmp_path / "b")) == shards(data)


@pytest.mark.parametrize("params", [{}, {"water.melt": 0.75}])
def test_a_shipped_task_is_recovered(tmp_path: Path, params: dict[str, float]) -> None:
    data = record(
        "sand-pushing",
        "random",
        tmp_path / "a",
        episodes=1,
        max_episode_steps=3,
        seed=(1 << 40) + 11,
        backend="wasm",
        knobs={"complexity": 2},
        params=params,
    )
    found = to_minari(data, ID)
    env = found.recover_environment(backend="wasm")
    assert found.env_spec.kwargs["params"] == params
    one = found[0]
    assert env.action_space == found.action_space
    assert env.observation_space == found.observation_space
    observed, info = env.reset(seed=data.episode(0).world)
    assert np.array_equal(observed, one.observations[0])
    for step, action in enumerate(one.actions):
        observed, reward, terminated, truncated, info = env.step(action)
        assert np.array_equal(observed, one.observations[step + 1])
        assert reward == one.rewards[step]
        assert (terminated, truncated) == (one.terminations[step], one.truncations[step])
        assert info["success"] == one.infos["success"][step + 1]


def test_an_id_is_taken_once(recorded: Dataset, root: Path) -> None:
    to_minari(recorded, ID)
    assert refusal(to_minari, recorded, ID)[0].code == "PD613"
    for wrong in ("small", "../small-v0", "a b-v0", ""):
        with pytest.raises(ValueError, match="namespace/name-v0"):
            to_minari(recorded, wrong)
    assert sorted(path.name for path in (root / "powderdsl").iterdir() if path.is_dir()) == ["small-v0"]


def test_a_failed_export_leaves_nothing(
    recorded: Dataset, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(number: int) -> Any:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recorded, "episode", broken)
    with pytest.raises(CompileError, match="PD613"):
        to_minari(recorded, ID)
    assert not (root / "powderdsl" / "small-v0").exists()
    assert [path for path in (root / "powderdsl").iterdir() if path.is_dir()] == []


# Imports


def test_what_to_minari_did_not_write_is_refused(recorded: Dataset, tmp_path: Path) -> None:
    written = to_minari(recorded, ID)
    written.storage.update_metadata({"powderdsl": None})
    (found,) = refusal(from_minari, ID, tmp_path / "a")
    assert (found.code, found.notes) == ("PD630", ("powderdsl did not write it, so its meaning is unknown",))
    with pytest.raises(CompileError, match="PD630"):
        from_minari("powderdsl/none-v0", tmp_path / "a")


def broken_metadata(change: Any) -> Any:
    def damage(folder: Path) -> None:
        path = folder / "metadata.json"
        data = json.loads(path.read_text())
        change(data)
        path.write_text(json.dumps(data))

    return damage


def broken_file(change: Any) -> Any:
    def damage(folder: Path) -> None:
        with h5py.File(folder / "main_data.hdf5", "a") as file:
            change(file, file["episode_1"])

    return damage


def swapped(name: str, make: Any) -> Any:
    def change(file: Any, group: Any) -> None:
        old = group[name][()]
        del group[name]
        make(file, group, old)

    return broken_file(change)


def value(name: str, new: Any) -> Any:
    def change(file: Any, group: Any) -> None:
        group[name][0] = new

    return broken_file(change)


STRANGER = {"id": "any-v0", "entry_point": "pathlib:Path.touch", "kwargs": {"self": "bad"}}
"""Minari makes the environment of a dataset that lacks a space, with whatever function it names."""


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (broken_metadata(lambda data: data.pop("action_space") and data.update(env_spec=json.dumps(STRANGER))), "its metadata lack action_space"),
        (lambda folder: (folder / "metadata.json").write_text("{"), "cannot be imported"),
        (lambda folder: (folder / "metadata.json").write_text("[]"), "cannot be imported"),
        (lambda folder: (folder / "main_data.hdf5").write_bytes(b"no"), "episode_0: "),
        (lambda folder: (folder / "main_data.hdf5").unlink(), "cannot be imported"),
        (broken_metadata(lambda data: data.update(total_episodes="7")), "cannot be imported"),
        (broken_metadata(lambda data: data.update(total_episodes=21)), "episode_20"),
        (broken_metadata(lambda data: data.update(data_format="arrow")), "cannot be imported"),
        (broken_metadata(lambda data: data["powderdsl"].update(recipe=3)), "powderdsl did not write it"),
        (broken_metadata(lambda data: data["powderdsl"]["recipe"].update(seed=-1)), "recipe.seed"),
        (swapped("rewards", lambda file, group, old: group.create_dataset("rewards", data=old[:-1])), "`observation` has the shape"),
        (swapped("rewards", lambda file, group, old: group.create_group("rewards")), "episode_1: "),
        (swapped("actions", lambda file, group, old: group.create_dataset("actions", data=old * 1.0)), "dtype float64"),
        (swapped("infos/world", lambda file, group, old: group.attrs.pop("seed")), "episode_1: "),
        (value("actions", 99), "actions out of range"),
        (value("observations", 200), "ids that the palette lacks"),
        (value("terminations", True), "do not have the recorded lengths"),
    ],
)  # fmt: skip
def test_damaged_minari_datasets_are_refused(
    recorded: Dataset, root: Path, damage: Any, says: str, tmp_path: Path
) -> None:
    to_minari(recorded, ID)
    damage(root / ID / "data")
    with pytest.raises(CompileError) as caught:
        from_minari(ID, tmp_path / "a")
    assert {one.code for one in caught.value.diagnostics} == {"PD630"}
    assert says in str(caught.value)


def test_flipped_bytes_are_seen_or_change_numbers(recorded: Dataset, root: Path, tmp_path: Path) -> None:
    """Whatever HDF5 makes of a damaged file, the import raises nothing but diagnostics."""
    to_minari(recorded, ID)
    path = root / ID / "data" / "main_data.hdf5"
    whole = path.read_bytes()
    generator = np.random.default_rng(5)
    codes: list[str] = []
    for number in range(40):
        data = np.frombuffer(whole, np.uint8).copy()
        places = generator.integers(0, 2000 if number % 2 else len(data), generator.choice([1, 8, 64]))
        data[places] = generator.integers(0, 256, len(places))
        path.write_bytes(data.tobytes())
        try:
            from_minari(ID, tmp_path / f"a{number}")
        except CompileError as error:
            codes += [one.code for one in error.diagnostics]
    assert set(codes) == {"PD630"}
    assert len(codes) > 5


def test_an_interrupted_import_is_completed(recorded: Dataset, root: Path, tmp_path: Path) -> None:
    to_minari(recorded, ID)
    whole = (root / ID / "data" / "main_data.hdf5").read_bytes()
    value("actions", 99)(root / ID / "data")  # of episode 1, in the first shard
    with h5py.File(root / ID / "data" / "main_data.hdf5", "a") as file:
        file.move("episode_1", "spare")
        file.move("episode_9", "episode_1")  # so that the second shard is the damaged one
    with pytest.raises(CompileError, match="PD630"):
        from_minari(ID, tmp_path / "a")
    assert not (tmp_path / "a" / "shard-000002.npz").exists()
    (root / ID / "data" / "main_data.hdf5").write_bytes(whole)
    (tmp_path / "a" / "shard-000000.npz").unlink()  # it has episode 9 in the place of 1
    assert shards(from_minari(ID, tmp_path / "a")) == shards(recorded)


def test_without_minari_there_is_a_plain_error(
    recorded: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "minari", None)
    for call in (lambda: to_minari(recorded, ID), lambda: from_minari(ID, tmp_path / "a")):
        (found,) = refusal(call)
        assert found.code == "PD612"
        assert found.helps == ("pip install 'powderdsl[minari]'",)
