"""SIGTERM and SIGKILL: commands end cleanly, leave no processes, and resume."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.cli.commands import environment_with
from tests.cli.endless import COMMANDS, Place, last_step
from tests.processes import waited
from tests.tiers import tiered

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="looks for processes in /proc"
)


@pytest.mark.parametrize("name", tiered(COMMANDS, ["video"]))
def test_sigterm_ends_a_command_cleanly(name: str, tmp_path: Path) -> None:
    if name == "video":
        pytest.importorskip("imageio_ffmpeg")
    place, command = Place(tmp_path), COMMANDS[name]
    with place.begun(command) as running:
        assert place.busy(command, running), place.said()
        running.send_signal(signal.SIGTERM)
        running.wait(timeout=120)
        assert running.returncode == 143, place.said()
        # Processes that Python itself starts end when a pipe closes.
        assert waited(lambda: not place.survivors(), 5)
    assert place.said().endswith("terminated by SIGTERM\n")
    assert "Traceback" not in place.said()
    assert place.scratch() == []
    if name in ("train", "wm train", "study"):
        assert place.checkpoint_steps()


@pytest.mark.parametrize("name", tiered(["video", "fuzz", "mutate", "wm train"], ["video"]))
def test_after_sigkill_nothing_runs_on_and_the_next_command_works(name: str, tmp_path: Path) -> None:
    if name == "video":
        pytest.importorskip("imageio_ffmpeg")
    place, command = Place(tmp_path), COMMANDS[name]
    with place.begun(command) as running:
        assert place.busy(command, running), place.said()
        running.kill()
        running.wait()
    assert waited(lambda: not place.survivors(), 60)
    place.run_again(command)


@pytest.mark.slow
def test_a_killed_study_resumes_at_once(tmp_path: Path) -> None:
    """What it had started saves where it is and ends; the next call waits for that, and continues there."""
    place, command = Place(tmp_path), COMMANDS["study"]
    trained = [tmp_path / f"out/runs/batch=12,seed={seed}/trained/metrics.jsonl" for seed in (0, 1)]
    with place.begun(command) as running:
        # Either run may be the first to get so far.
        assert waited(lambda: running.poll() is not None or all(last_step(path) > 0 for path in trained))
        assert running.poll() is None, place.said()
        running.kill()
        running.wait()
    killed = time.monotonic()
    reached = {path: last_step(path) for path in trained}
    with place.begun(command) as running:
        assert waited(lambda: all(last_step(path) > step for path, step in reached.items()), 120)
        assert time.monotonic() - killed < 60
        running.send_signal(signal.SIGTERM)
        running.wait(timeout=120)
    assert waited(lambda: not place.survivors(), 60)
    logs = [path.read_text(encoding="utf-8") for path in tmp_path.rglob("*.log")]
    assert len(logs) == len(trained)
    for log in logs:
        assert log.count("terminated by SIGTERM") == 2, log
        assert "PD622" not in log


CAUGHT = """
import os, signal, sys, time
from powderdsl.system.interrupts import Terminated, delay_signal, interruptible

def twice():
    with delay_signal() as asked:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
        print("asked" if asked() else "not asked")

def held_in_a_failure():
    try:
        with delay_signal():
            os.kill(os.getpid(), signal.SIGTERM)
            raise OSError
    except OSError:
        print("lost")

def again():
    try:
        with delay_signal():
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
    except KeyboardInterrupt:
        print("at once")

with interruptible():
    try:
        {"twice": twice, "held": held_in_a_failure, "again": again}[sys.argv[1]]()
    except Terminated as error:
        print(error)
"""


@pytest.mark.parametrize(
    ("case", "said"),
    [
        ("twice", ["asked", "terminated by SIGTERM"]),
        ("held", ["terminated by SIGTERM"]),
        ("again", ["at once"]),
    ],
)
def test_a_signal_is_never_lost(case: str, said: list[str]) -> None:
    run = subprocess.run(
        [sys.executable, "-c", CAUGHT, case],
        env=environment_with(),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert run.stdout.splitlines() == said
    assert run.stderr == ""


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL], ids=["SIGTERM", "SIGKILL"])
@pytest.mark.parametrize("name", COMMANDS)
def test_signals_at_any_moment(name: str, how: signal.Signals, tmp_path: Path) -> None:
    """In the middle of the work, ten times each in one folder, then a command that ends well."""
    place, command = Place(tmp_path), COMMANDS[name]
    chance = random.Random(f"{name} {how}")
    for _ in range(10):
        (tmp_path / "compiling").unlink(missing_ok=True)
        with place.begun(command) as running:
            place.busy(command, running)
            time.sleep(chance.random())
            assert running.poll() is None, place.said()
            running.send_signal(how)
            running.wait(timeout=120)
            if how == signal.SIGTERM:
                assert running.returncode == 143, place.said()
                assert waited(lambda: not place.survivors(), 5), place.said()
                assert place.scratch() == [], place.said()
                assert "Traceback" not in place.said()
        assert waited(lambda: not place.survivors(), 60)
    place.run_again(command)
