"""Data sets: what the scripts play, the files, interruptions, and both ways to load them."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from powderdsl.ogbench import collect as collecting
from powderdsl.ogbench.collect import collect, play
from powderdsl.ogbench.env import PowderworldEnv
from powderdsl.ogbench.episodes import LevelProgram
from powderdsl.ogbench.levels import find_level, load_dataset, make_env_and_datasets
from tests.cli.commands import powderdsl

ROWS = 20
NAME = "powderworld-easy-play-v0"


@pytest.fixture(scope="session")
def short(easy: LevelProgram) -> LevelProgram:
    """The easy level with short episodes."""
    program = object.__new__(LevelProgram)
    program.__dict__.update(
        easy.__dict__, level=replace(easy.level, play=replace(easy.level.play, steps=ROWS))
    )
    return program


@pytest.fixture(scope="session")
def data(short: LevelProgram, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five training episodes and one for validation."""
    folder = tmp_path_factory.mktemp("data")
    collect(short, folder, episodes=5, seed=3)
    return folder


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.npz"))}


def test_scripts_and_random_actions_take_turns() -> None:
    """As in OGBench's own scripts: shares of values, and how often an action lies beside the one before."""
    level = find_level("hard")
    found = play(level, 1, np.arange(200), 334).astype(int)
    assert found.min() == 0
    assert found.max((0, 1)).tolist() == [7, 7, 7]
    for part in range(3):
        shares = np.bincount(found[..., part].ravel(), minlength=8) / found[..., part].size
        assert (np.abs(shares - 0.125) < 0.015).all()
    steps = np.abs(np.diff(found[..., 1:], axis=1)).sum(-1)
    # 300 episodes of OGBench's own scripts have 25.25 %, and 21.62 % with the same element.
    same = np.diff(found[..., 0], axis=1) == 0
    assert abs((steps == 1).mean() - 0.2525) < 0.01
    assert abs(((steps == 1) & same).mean() - 0.2162) < 0.01


def test_the_file_is_what_an_environment_shows(data: Path, short: LevelProgram) -> None:
    with np.load(data / f"{NAME}.npz") as file:
        arrays = {name: file[name] for name in file}
    rows = 5 * ROWS
    kinds = {name: (array.dtype.name, array.shape) for name, array in arrays.items()}
    assert kinds == {
        "observations": ("uint8", (rows, 32, 32, 6)),
        "actions": ("int32", (rows,)),
        "terminals": ("int32", (rows,)),
    }
    assert np.flatnonzero(arrays["terminals"]).tolist() == list(range(ROWS - 1, rows, ROWS))
    env = PowderworldEnv(short, mode="data_collection", seed=3)
    for row in range(rows):
        if row % ROWS == 0:
            observed, _ = env.reset()
        assert (arrays["observations"][row] == observed).all()
        observed, *_ = env.step(arrays["actions"][row])


def test_an_interrupted_collection_continues(
    data: Path, short: LevelProgram, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In parts of another size, interrupted, with a part damaged: the same bytes."""
    monkeypatch.setattr(collecting, "PART", 2)
    calls = 0

    def interrupt(done: float, total: int) -> None:
        nonlocal calls
        assert 0 <= done <= total == 6
        calls += 1
        if calls == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect(short, tmp_path, episodes=5, seed=3, progress=interrupt)
    parts = sorted((tmp_path / f"{NAME}.parts").glob("*.npz"))
    assert len(parts) == 3
    assert not list(tmp_path.glob("*.npz"))
    parts[1].write_bytes(parts[1].read_bytes()[:100])
    collect(short, tmp_path, episodes=5, seed=3)
    assert bytes_of(tmp_path) == bytes_of(data)
    assert not list(tmp_path.glob("*.parts"))


def test_other_data_are_not_overwritten(data: Path, short: LevelProgram) -> None:
    before = bytes_of(data)
    collect(short, data, episodes=5, seed=3)
    with pytest.raises(ValueError, match="another seed"):
        collect(short, data, episodes=5, seed=4)
    with pytest.raises(ValueError, match="another number of episodes"):
        collect(short, data, episodes=6, seed=3)
    assert bytes_of(data) == before
    other = data / "strange"
    other.mkdir()
    (other / f"{NAME}.npz").write_bytes(b"mine")
    with pytest.raises(ValueError, match="exists, but"):
        collect(short, other, episodes=5)


def test_two_ways_to_load(data: Path) -> None:
    env, train, validation = make_env_and_datasets(NAME, dataset_dir=data, backend="torch")
    assert env.spec.max_episode_steps == 500
    whole, _ = make_env_and_datasets(NAME, dataset_dir=data, compact_dataset=True, dataset_only=True)
    assert len(validation["actions"]) == ROWS - 1
    assert {name: (one.dtype.name, len(one)) for name, one in train.items()} == {
        "observations": ("uint8", 5 * (ROWS - 1)),
        "actions": ("int32", 5 * (ROWS - 1)),
        "terminals": ("float32", 5 * (ROWS - 1)),
        "next_observations": ("uint8", 5 * (ROWS - 1)),
    }
    assert np.flatnonzero(train["terminals"]).tolist() == list(range(ROWS - 2, 5 * (ROWS - 1), ROWS - 1))
    rows = whole["observations"].reshape(5, ROWS, 32, 32, 6)
    assert (train["observations"].reshape(5, -1, 32, 32, 6) == rows[:, :-1]).all()
    assert (train["next_observations"].reshape(5, -1, 32, 32, 6) == rows[:, 1:]).all()
    ends = whole["terminals"].reshape(5, ROWS)
    assert ends.sum() == ends[:, -2:].sum() == 10
    assert (whole["valids"].reshape(5, ROWS) == (np.arange(ROWS) < ROWS - 1)).all()
    assert all(one.flags.writeable for one in (*train.values(), *whole.values()))
    by_path, _ = make_env_and_datasets(NAME, dataset_path=data / f"{NAME}.npz", dataset_only=True)
    assert all((by_path[name] == train[name]).all() for name in train)
    floats = load_dataset(data / f"{NAME}.npz")
    assert floats["observations"].dtype == floats["actions"].dtype == np.float32
    alone = make_env_and_datasets(NAME, env_only=True, mode="data_collection", backend="torch")
    assert alone.reset()[1] == {}


def test_missing_and_damaged_data_are_named(data: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="powderdsl ogbench easy --out"):
        make_env_and_datasets(NAME, dataset_dir=tmp_path, dataset_only=True)
    for name in ("powderworld-easy-v0", "powderworld-simple-play-v0", "antmaze-large-play-v0", ""):
        with pytest.raises(ValueError, match="no dataset named"):
            make_env_and_datasets(name, env_only=True)
    whole = (data / f"{NAME}.npz").read_bytes()
    path = tmp_path / "damaged.npz"
    rows = {"observations": np.zeros((4, 2)), "actions": np.zeros(4), "terminals": np.array([0, 1, 0, 1])}
    for damage in (
        whole[:1000],
        {**rows, "actions": np.zeros(3)},
        {**rows, "terminals": np.zeros(4)},
        {**rows, "terminals": np.array([1, 0, 0, 1])},
        {**rows, "actions": np.array(["a"] * 4)},
        {"actions": np.zeros(4)},
    ):
        if isinstance(damage, bytes):
            path.write_bytes(damage)
        else:
            np.savez(path, **damage)
        with pytest.raises(ValueError, match=r"damaged\.npz is not a dataset"):
            load_dataset(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("observations.npy", b"\x93NUMPY\1\0 ")
    with pytest.raises(ValueError, match="is not a dataset"):
        load_dataset(path)


def test_the_command_collects(tmp_path: Path, torch: Any) -> None:
    """In whole episodes; a second call finds all of it there."""
    call = ("ogbench", "easy", "--out", tmp_path, "--episodes", 1, "--backend", "wasm")
    for _ in range(2):
        assert "2 files" in powderdsl(*call, exits=0).stderr
    assert json.loads((tmp_path / f"{NAME}.json").read_text())["count"] == 1
    assert len(load_dataset(tmp_path / f"{NAME}.npz", np.uint8, np.int32)["actions"]) == 1000
    assert "another number of episodes" in powderdsl(*call, "--episodes", 2, exits=2).stderr
