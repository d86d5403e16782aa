"""Claims: one owner at a time, on one machine and across machines, whoever dies, sleeps or comes back."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from powderdsl.experiments.studies import claims
from powderdsl.experiments.studies.claims import LAST, LEASE, Claim, Claims, Held, Lost
from tests.cli.commands import environment_with
from tests.processes import started, waited


class Clock:
    """Time that passes when a test says so."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(claims, "_clock", found)
    return found


@pytest.fixture
def on(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Continue on a machine of a name."""
    return lambda name: monkeypatch.setattr(claims, "machine", lambda: name)


def numbers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def refused(taker: Claims, folder: Path) -> Held:
    with pytest.raises(Held) as caught:
        taker.take(folder)
    return caught.value


def test_a_folder_has_one_owner_at_a_time(tmp_path: Path) -> None:
    claim, elsewhere = Claims().take(tmp_path)
    with claim:
        claim.check()
        found = refused(Claims(), tmp_path)
        assert found.sure
        assert f"process {os.getpid()}" in str(found)
    assert not elsewhere
    assert numbers(tmp_path) == []
    with Claims().take(tmp_path)[0]:
        pass


HOLD = """
import sys, time
from pathlib import Path
from powderdsl.experiments.studies.claims import Claims
with Claims().take(Path(sys.argv[1]))[0]:
    print("taken", flush=True)
    time.sleep(600)
"""


@pytest.mark.skipif(claims.fcntl is None, reason="needs file locks")
def test_the_claim_of_a_killed_process_is_free_at_once(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with started(command, stdout=subprocess.PIPE, env=environment_with()) as running:
        assert running.stdout is not None
        assert running.stdout.readline() == "taken\n"
        taker = Claims()
        assert refused(taker, tmp_path).sure
        running.kill()
        running.wait()
        claim, elsewhere = taker.take(tmp_path)
    assert not elsewhere
    with claim:
        assert numbers(tmp_path) == ["claim-000001", "claim-000002"]
    assert numbers(tmp_path) == []


def test_a_machine_that_shows_no_life_for_the_length_of_a_lease_is_dead(
    tmp_path: Path, clock: Clock, on: Callable[[str], None]
) -> None:
    on("one")
    dead, _ = Claims().take(tmp_path)
    on("two")
    taker = Claims()
    assert not refused(taker, tmp_path).sure  # nobody has watched it yet
    clock.now += LEASE
    assert not refused(taker, tmp_path).sure
    os.utime(dead.path)
    assert refused(taker, tmp_path).sure
    clock.now += LEASE
    assert not refused(taker, tmp_path).sure
    clock.now += 1
    claim, elsewhere = taker.take(tmp_path)
    assert elsewhere
    stopped = threading.Event()
    dead.stop_if_lost(stopped.set)
    with claim:
        with pytest.raises(Lost):  # it was not dead, only slow
            dead.check()
        assert stopped.is_set()
        with dead:
            pass
        assert numbers(tmp_path) == ["claim-000001", "claim-000002"]
        claim.check()
    assert numbers(tmp_path) == []


def test_an_owner_that_slept_gives_up_before_others_may_begin(tmp_path: Path, clock: Clock) -> None:
    claim, _ = Claims().take(tmp_path)
    clock.now += LEASE / 2
    claim.check()
    clock.now += 1
    with pytest.raises(Lost):
        claim.check()


@pytest.mark.parametrize("what", ["taken over", "removed", "slept"])
def test_a_thread_keeps_a_claim_alive_and_notices_its_loss(
    what: str, tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(claims, "BEAT", 0.01)
    claim, _ = Claims().take(tmp_path)
    stopped = threading.Event()
    with claim:
        claim.stop_if_lost(stopped.set)
        os.utime(claim.path, (1, 1))
        assert waited(lambda: claim.path.stat().st_mtime > 1, 10)
        assert not stopped.is_set()
        match what:
            case "taken over":
                (tmp_path / "claim-000002").touch()
            case "removed":
                claim.path.unlink()
            case "slept":
                clock.now += LEASE
        assert stopped.wait(10)
        with pytest.raises(Lost):
            claim.check()
    assert claim.path.exists() == (what != "removed")  # somebody else's to remove


@pytest.mark.skipif(claims.fcntl is None, reason="needs file locks")
@pytest.mark.parametrize("dead", [False, True])
def test_of_many_that_try_at_once_one_gets_it(dead: bool, tmp_path: Path) -> None:
    for attempt in range(20):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        if dead:
            about = f'{{"machine": "{claims.machine()}", "pid": 1, "locked": true}}'
            (folder / "claim-000007").write_text(about, encoding="utf-8")
        barrier, taken = threading.Barrier(8), []
        threads = [threading.Thread(target=_attempt, args=(folder, barrier, taken)) for _ in range(8)]
        for one in threads:
            one.start()
        for one in threads:
            one.join()
        for claim in taken:
            with claim:
                pass
        assert len(taken) == 1
        assert numbers(folder) == []


def _attempt(folder: Path, barrier: threading.Barrier, taken: list[Claim]) -> None:
    taker = Claims()
    barrier.wait()
    while not taken:
        try:
            taken.append(taker.take(folder)[0])
        except Held as error:
            if error.sure:
                return
            time.sleep(0.001)


def _garbage(path: Path) -> None:
    path.write_bytes(b"\xff{" * 5000)


def _not_what_it_says(path: Path) -> None:
    path.write_text(
        '{"machine": [1], "host": {"a": "\\u001b[2J"}, "pid": 1e999, "locked": 1}', encoding="utf-8"
    )


@pytest.mark.parametrize("make", [_garbage, _not_what_it_says, Path.mkdir, Path.touch, os.mkfifo])
def test_whatever_lies_there_is_dead_once_it_has_not_changed(
    make: Callable[[Path], None], tmp_path: Path, clock: Clock
) -> None:
    make(tmp_path / "claim-000001")
    taker = Claims()
    assert not refused(taker, tmp_path).sure
    clock.now += LEASE + 1
    with taker.take(tmp_path)[0] as claim:
        assert isinstance(claim, Claim)


def test_links_and_the_last_number_are_errors_not_owners(tmp_path: Path) -> None:
    (tmp_path / "other").touch()
    for name, to in (("claim-000001", "other"), (f"claim-{LAST}", None)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).touch() if to is None else (folder / name).symlink_to(tmp_path / to)
        with pytest.raises(OSError, match=r"links|claims"):
            Claims().take(folder)
