"""Scratch files and folders: nothing of them is left by whoever ends, and what killed processes leave is removed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from powderdsl.system import scratch
from powderdsl.system.scratch import is_scratch, scratch_file, scratch_folder, sweep
from powderdsl.system.writing import replacing
from tests.cli.commands import environment_with
from tests.processes import started, waited

HOLDING = """
import sys, time
from pathlib import Path
from powderdsl.system.scratch import scratch_file, scratch_folder
place = Path(sys.argv[1])
with scratch_folder(place) as folder, scratch_file(place / "world.npz") as file:
    (folder / "inner").mkdir()
    (folder / "inner" / "part").write_text("half")
    print("ready", flush=True)
    time.sleep(1000)
"""


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_nothing_is_left_however_a_block_ends(tmp_path: Path) -> None:
    def interrupted() -> None:
        with scratch_folder(tmp_path) as folder, scratch_file(tmp_path / "x.png") as file:
            (folder / "part").write_text("half")
            assert file.suffix == ".png"
            assert all(is_scratch(name) for name in names(tmp_path))
            assert len(names(tmp_path)) == 2
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert names(tmp_path) == []
    assert scratch._mine == {}


def test_a_file_may_be_moved_away(tmp_path: Path) -> None:
    with replacing(tmp_path / "x.txt") as temporary:
        temporary.write_text("whole")
    assert names(tmp_path) == ["x.txt"]
    assert (tmp_path / "x.txt").read_text() == "whole"


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_what_a_killed_process_leaves_is_removed_by_the_next(tmp_path: Path, how: int) -> None:
    command = [sys.executable, "-c", HOLDING, str(tmp_path)]
    with started(
        command, env=environment_with(), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "ready\n"
        sweep(tmp_path)
        assert len(names(tmp_path)) == 2, "its owner lives"
        holder.send_signal(how)
        holder.wait()
        assert len(names(tmp_path)) == (2 if how == signal.SIGKILL else 0)
    with replacing(tmp_path / "other.txt") as temporary:
        assert names(tmp_path) == [temporary.name]


def test_files_of_others_are_left_alone(tmp_path: Path) -> None:
    """Other names, links and what is neither a file nor a folder."""
    name = ".x.powderdsl-0123456789abcdef"
    (tmp_path / "kept").write_text("mine")
    (tmp_path / ".x-0123abcd.png").touch()
    (tmp_path / f"{name}.png").symlink_to(tmp_path / "kept")
    os.mkfifo(tmp_path / f"{name}.fifo")
    before = names(tmp_path)
    sweep(tmp_path)
    assert names(tmp_path) == before
    assert (tmp_path / "kept").read_text() == "mine"
    sweep(tmp_path / "nothing")


def test_a_fork_removes_nothing_of_its_parents(tmp_path: Path) -> None:
    program = """
import os, sys
from pathlib import Path
from powderdsl.system.scratch import scratch_file
with scratch_file(Path(sys.argv[1]) / "x") as path:
    pid = os.fork()
    if pid == 0:
        sys.exit(0)
    os.waitpid(pid, 0)
    print(path.exists())
"""
    command = [sys.executable, "-c", program, str(tmp_path)]
    run = subprocess.run(command, env=environment_with(), capture_output=True, text=True, timeout=60)
    assert run.stdout.split()[-1] == "True", run.stderr
    assert names(tmp_path) == []


def test_without_locks_only_old_leftovers_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scratch, "fcntl", None)
    old, new = (tmp_path / f".x.powderdsl-{digit * 16}" for digit in "01")
    old.touch()
    new.touch()
    os.utime(old, (0, 0))
    with scratch_folder(tmp_path) as mine:
        assert set(names(tmp_path)) == {new.name, mine.name}


def test_many_processes_may_write_to_one_folder(tmp_path: Path) -> None:
    program = """
import sys
from pathlib import Path
from powderdsl.system import scratch
from powderdsl.system.writing import replacing
for turn in range(300):
    scratch._swept.clear()
    with replacing(Path(sys.argv[1]) / "x.txt") as path:
        path.write_text(str(turn))
"""
    command = [sys.executable, "-c", program, str(tmp_path)]
    running = [subprocess.Popen(command, env=environment_with()) for _ in range(3)]
    assert waited(lambda: all(one.poll() is not None for one in running))
    assert [one.returncode for one in running] == [0, 0, 0]
    assert names(tmp_path) == ["x.txt"]
