"""Commands in forks of one process that has imported everything: what each printed and took."""

from __future__ import annotations

import importlib
import os
import resource
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from powderdsl.cli import main
from powderdsl.cli.dispatch import COMMANDS

PATIENCE = 90.0
"""Seconds by the clock after which a command counts as one that hangs."""
ROOM = 16 << 30
"""Bytes of addresses that a command may have, so that a mistake does not take the machine's memory."""

MODULES = (
    *(f"powderdsl.cli.commands.{name}" for name in COMMANDS),
    "powderdsl.cli.start_worlds",
    "powderdsl.datasets.dataset",
    "powderdsl.testing.properties.refute",
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


def import_everything() -> None:
    """Import what commands need, once."""
    for name in MODULES:
        importlib.import_module(name)


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
