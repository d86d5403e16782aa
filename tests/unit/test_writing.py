"""Temporary files and folders: nothing of them is left by whoever ends, and files are replaced whole."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from powderdsl.system.writing import MARK, replacing, scratch_folder, write_text
from tests.cli.commands import environment_with
from tests.processes import waited
from tests.refusals import refusal


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_nothing_is_left_however_a_block_ends(tmp_path: Path) -> None:
    def interrupted() -> None:
        with scratch_folder(tmp_path) as folder, replacing(tmp_path / "x.png") as file:
            (folder / "part").write_text("half")
            assert file.suffix == ".png"
            assert all(MARK in name for name in names(tmp_path))
            assert len(names(tmp_path)) == 2
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert names(tmp_path) == []


def test_nothing_is_left_by_a_signal_between_two_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    close = os.close

    def interrupted(handle: int) -> None:
        close(handle)
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "close", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_text(tmp_path / "x.txt", "whole")
    assert names(tmp_path) == []


@pytest.mark.parametrize("name", ["x\0.txt", "\ud800.txt", "none/x.txt", "file/x.txt", "."])
def test_a_path_that_cannot_be_a_file_is_named(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (error,) = refusal(write_text, tmp_path / name, "whole")
    assert (error.code, error.message) == ("PD613", f"cannot write {tmp_path / name}")


def test_a_file_is_replaced_at_the_end(tmp_path: Path) -> None:
    (tmp_path / "x.txt").write_text("old")
    with replacing(tmp_path / "x.txt") as temporary:
        temporary.write_text("whole")
        assert (tmp_path / "x.txt").read_text() == "old"
    assert names(tmp_path) == ["x.txt"]
    assert (tmp_path / "x.txt").read_text() == "whole"


def test_many_processes_may_write_to_one_folder(tmp_path: Path) -> None:
    program = """
import sys
from pathlib import Path
from powderdsl.system.writing import replacing
for turn in range(300):
    with replacing(Path(sys.argv[1]) / "x.txt") as path:
        path.write_text(str(turn))
"""
    command = [sys.executable, "-c", program, str(tmp_path)]
    running = [subprocess.Popen(command, env=environment_with()) for _ in range(3)]
    assert waited(lambda: all(one.poll() is not None for one in running))
    assert [one.returncode for one in running] == [0, 0, 0]
    assert names(tmp_path) == ["x.txt"]
