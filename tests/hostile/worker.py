"""The process that runs commands on damaged files, each in a fork that finds everything imported; what each took."""

from __future__ import annotations

import importlib
import json
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from powderdsl.cli import main
from powderdsl.cli.dispatch import COMMANDS
from tests.hostile.damage_kinds import KINDS, Kind, damage

PATIENCE = 90.0
"""Seconds by the clock after which a command counts as one that hangs."""
ROOM = 16 << 30
"""Bytes of addresses that a command may have, so that a mistake does not take the machine's memory."""

MODULES = (
    *(f"powderdsl.cli.commands.{name}" for name in COMMANDS),
    "powderdsl.cli.start_worlds",
    "powderdsl.datasets.dataset",
    "powderdsl.testing.properties.search",
    "powderdsl.rl.evaluation",
    "powderdsl.experiments.studies.run",
    "powderdsl.tasks.shipped",
    "powderdsl.worldmodel.evaluation",
    "powderdsl.worlds.image",
    "powderdsl.worlds.scene",
    "powderdsl.worlds.store",
    "PIL.PngImagePlugin",
)
"""What commands import late: forks find it there."""


@dataclass(frozen=True)
class Measured:
    """What a command did: its exit code, or minus the signal that ended it; processor time; memory at most."""

    status: int
    output: bytes
    seconds: float
    megabytes: float
    hung: bool = False


def measured(words: Sequence[str], folder: Path, **environment: str) -> Measured:
    """Run a command in a folder, in a fork, with its output in a file beside the folder."""
    log = folder.parent / f"{folder.name}.log"
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        _run(words, folder, log, environment)
    end, hung = time.monotonic() + PATIENCE, False
    while True:
        found, status, used = os.wait4(pid, os.WNOHANG)
        if found:
            break
        if time.monotonic() > end and not hung:
            hung = True
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.002)
    output = log.read_bytes()
    log.unlink()
    code = os.waitstatus_to_exitcode(status)
    return Measured(code, output, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, hung)


def _run(words: Sequence[str], folder: Path, log: Path, environment: dict[str, str]) -> None:
    """What the fork does; it never returns."""
    status = 99
    try:
        os.setsid()
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        nothing = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nothing, 0)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        os.chdir(folder)
        os.environ.update(environment)
        resource.setrlimit(resource.RLIMIT_AS, (ROOM, ROOM))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False, buffering=1)  # noqa: SIM115
        try:
            main([*words])
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        except BaseException:
            import traceback

            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(status)


def work(valid: str, place: str, name: str) -> None:
    """Run the command of a kind on files of all its seeds."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    for module in MODULES:
        importlib.import_module(module)
    kind = next(kind for kind in KINDS if kind.name == name)
    usual = [_try(kind, Path(valid), Path(place) / f"usual-{number}", None)[1] for number in range(2)]
    assert usual[-1].status == 0, usual[-1].output.decode(errors="replace")
    for seed in range(100, 100 + kind.many):
        how, found, escaped = _try(kind, Path(valid), Path(place) / str(seed), seed)
        row: dict[str, Any] = {
            **asdict(found),
            "seed": seed,
            "how": how,
            "output": found.output[-20_000:].hex(),
            "usual_seconds": min(one.seconds for one in usual),
            "usual_megabytes": max(one.megabytes for one in usual),
            "escaped": escaped,
        }
        print(json.dumps(row), file=out, flush=True)


def _try(kind: Kind, valid: Path, place: Path, seed: int | None) -> tuple[str, Measured, list[str]]:
    """Run on a copy of the valid folder, damaged if there is a seed; what changed around it."""
    folder, outside = place / "files", place / "outside"
    outside.mkdir(parents=True)
    (outside / "victim.json").write_text("victim")
    shutil.copytree(valid, folder)
    how = "valid" if seed is None else damage(kind, folder, seed)
    before = _around(place)
    home = {"XDG_CACHE_HOME": str(folder / "cache"), "HOME": str(folder), "TMPDIR": str(folder)}
    found = measured(kind.words, folder, NO_COLOR="1", **home)
    after = _around(place)
    escaped = sorted(name for name in {*before, *after} if before.get(name) != after.get(name))
    shutil.rmtree(place, ignore_errors=True)
    return how, found, escaped


def _around(place: Path) -> dict[str, str]:
    """What lies beside the folder of a command."""
    return {
        str(path.relative_to(place)): path.read_text() if path.is_file() else ""
        for path in sorted(place.rglob("*"))
        if path.relative_to(place).parts[0] != "files"
    }
