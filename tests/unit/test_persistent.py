"""Results that outlive a process: made once, made again where the stored one cannot be trusted."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from powderdsl import compiler
from powderdsl.compiler import load_with_diagnostics
from powderdsl.diagnostics import CompileError
from powderdsl.system import cache
from powderdsl.worlds.scene import read
from powderdsl.worlds.scene.read import read_file


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "QUICK", -1.0)
    for module in (compiler, read):
        monkeypatch.setattr(module, "persistent", cache.persistent)
    return tmp_path / "powderdsl" / "compiled"


def counted(calls: list[int]) -> Callable[[], tuple[int]]:
    def make() -> tuple[int]:
        calls.append(len(calls))
        return (len(calls),)

    return make


def test_a_result_is_made_once_for_each_input_and_version(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []
    for inputs, expected in (("a", 1), ("a", 1), ("b", 2), ("a", 1)):
        assert cache.persistent("stage", inputs, counted(calls)) == (expected,)
    monkeypatch.setattr(cache, "code_hash", lambda: "another")
    assert cache.persistent("stage", "a", counted(calls)) == (3,)


def test_a_damaged_file_is_made_again(folder: Path) -> None:
    calls: list[int] = []
    cache.persistent("stage", "a", counted(calls))
    (path,) = folder.glob("*/*-stage")
    path.write_bytes(path.read_bytes()[:-1])
    assert cache.persistent("stage", "a", counted(calls)) == (2,)
    assert cache.persistent("stage", "a", counted(calls)) == (2,)


def test_a_folder_that_others_may_write_to_is_not_read(folder: Path) -> None:
    calls: list[int] = []
    cache.persistent("stage", "a", counted(calls))
    folder.chmod(0o777)
    assert cache.persistent("stage", "a", counted(calls)) == (2,)


def test_quick_work_and_what_cannot_be_pickled_is_not_stored(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep: list[object] = []
    for _ in range(100_000):
        deep = [deep]
    assert cache.persistent("stage", "deep", lambda: deep) is deep
    monkeypatch.setattr(cache, "QUICK", 60.0)
    cache.persistent("stage", "quick", lambda: 1)
    assert not folder.is_dir() or not any(folder.glob("*/*-stage"))


def test_the_folder_stays_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "MOST", 3)
    for key in ("0a", "1a", "2a", "3a", "00"):
        cache.add(tmp_path, key, b"code", "stage")
        time.sleep(0.01)
    keys = [entry.path.name.partition("-")[0] for entry in cache.entries(tmp_path)]
    assert keys == ["00", "3a", "2a"]


def test_a_model_and_its_remarks_are_those_of_the_text(folder: Path, tmp_path: Path) -> None:
    pack = tmp_path / "pack.yaml"
    text = 'pack: yard\nneeds: core\nelements:\n  moss: {id: 40, color: "#112233", glyph: m}\npasses:\n  growth:\n    do:\n      - moss -> wall with chance 5%\n'
    pack.write_text(text)
    first = load_with_diagnostics("core", pack)
    again = load_with_diagnostics("core", pack)
    assert again == first
    assert again[0] is not first[0]
    pack.write_text(text.replace("5%", "6%"))
    changed = load_with_diagnostics("core", pack)
    assert changed[0] != first[0]
    with pytest.raises(CompileError, match="scene"):
        read_file(pack)
    pack.write_text(text.replace("-> wall", "-> moos"))
    for _ in range(2):
        with pytest.raises(CompileError) as caught:
            load_with_diagnostics("core", pack)
        assert [diagnostic.code for diagnostic in caught.value.diagnostics] == ["PD301"]
