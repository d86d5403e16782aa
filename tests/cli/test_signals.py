"""SIGTERM and SIGKILL: commands end cleanly, leave no processes, and resume."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from powderdsl.experiments.runs import read_metrics
from powderdsl.system.interrupts import Terminated, delay_signal, interruptible
from tests.cli.endless import COMMANDS, Place
from tests.processes import waited
from tests.tiers import tiered

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="looks for processes in /proc"
)
ENDED = [("video", 1), *((name, 10) for name in COMMANDS)]
"""Commands, and how often each is ended."""


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL], ids=["SIGTERM", "SIGKILL"])
@pytest.mark.parametrize("ended", tiered(ENDED, ENDED[:1]), ids=str)
def test_an_ended_command_leaves_nothing_behind_and_the_next_one_works(
    ended: tuple[str, int], how: signal.Signals, tmp_path: Path
) -> None:
    """In the middle of its work, some times in one folder; then a command that ends well."""
    name, times = ended
    if name == "video":
        pytest.importorskip("imageio_ffmpeg")
    place, command = Place(tmp_path), COMMANDS[name]
    chance = random.Random(f"{name} {how}")
    for _ in range(times):
        (tmp_path / "compiling").unlink(missing_ok=True)
        with place.begun(command) as running:
            assert place.busy(command, running), place.said()
            time.sleep(chance.random())
            running.send_signal(how)
            running.wait(timeout=120)
            if how == signal.SIGTERM:
                assert running.returncode == 143, place.said()
                # Processes that Python itself starts end when a pipe closes.
                assert waited(lambda: not place.survivors(), 5), place.said()
                assert place.said().endswith("terminated by SIGTERM\n")
                assert "Traceback" not in place.said()
                assert place.scratch() == [], place.said()
                if name in ("train", "wm train", "study", "record"):
                    assert "run the same command again to resume" in place.said()
                if name in ("train", "wm train", "study"):
                    assert any(tmp_path.rglob("*.safetensors"))
        assert waited(lambda: not place.survivors(), 60)
    place.run_again(command)


def last_step(run: Path) -> int:
    return max((line["step"] for line in read_metrics(run)), default=0)


@pytest.mark.slow
def test_a_killed_study_resumes_at_once(tmp_path: Path) -> None:
    """What it had started saves where it is and ends; the next call waits for that, and continues there."""
    place, command = Place(tmp_path), COMMANDS["study"]
    trained = [tmp_path / f"out/runs/steps=900000000,seed={seed}/trained" for seed in (0, 1)]
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


def hold(numbers: Sequence[int], problem: Exception | None, reached: list[str]) -> None:
    """Get signals in a block that holds them back, and fail there; note how far that goes."""
    with interruptible():
        with delay_signal() as asked:
            for number in numbers:
                os.kill(os.getpid(), number)
            reached.append("asked" if asked() else "not asked")
            if problem is not None:
                raise problem
        reached.append("lost")


@pytest.mark.parametrize(
    ("numbers", "problem", "raised", "reached"),
    [
        ([signal.SIGTERM] * 2, None, Terminated, ["asked"]),  # `timeout` sends two
        ([signal.SIGTERM], OSError(), Terminated, ["asked"]),
        ([signal.SIGINT] * 2, None, KeyboardInterrupt, []),
    ],
)
def test_a_signal_is_never_lost(
    numbers: list[int], problem: Exception | None, raised: type[BaseException], reached: list[str]
) -> None:
    found: list[str] = []
    with pytest.raises(raised):
        hold(numbers, problem, found)
    assert found == reached
