"""Signals that ask a process to end: Ctrl-C, SIGTERM, and SIGHUP of a terminal that is closed.

A command ends through exceptions, so that every `finally` runs: KeyboardInterrupt for Ctrl-C, its subclass `Terminated`
for the others. Importing this module installs nothing, since a library should not handle signals.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

# Windows has no SIGHUP.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

REPEATED = 2.0
"""Seconds in which the same SIGTERM or SIGHUP counts once: `timeout` sends two."""

LIFELINE = "POWDERDSL_LIFELINE"
"""Environment variable of processes that end when their stdin, held open by their starter, is closed."""

GRACE = 30.0
"""Seconds that such a process has for its last checkpoint."""

Handler = Callable[[int, FrameType | None], None]


class Terminated(KeyboardInterrupt):
    """The interrupt by SIGTERM or SIGHUP. `number` is the signal's."""

    def __init__(self, number: int):
        super().__init__(f"terminated by {signal.Signals(number).name}")
        self.number = number


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise Terminated in the main thread for SIGTERM and SIGHUP, unless they are already handled or ignored."""

    def terminate(number: int, frame: FrameType | None) -> None:
        raise Terminated(number)

    with _handlers(_ignoring_repeats(terminate), lambda usual: usual == signal.SIG_DFL):
        yield


@contextmanager
def delay_signal() -> Iterator[Callable[[], bool]]:
    """Defer the first signal to the end of the block; a second one raises immediately.

    Yields a function that says whether one has come. Threads other than the main one receive no signals.
    """
    pending: list[int] = []

    def hold(number: int, frame: FrameType | None) -> None:
        pending.append(number)
        if len(pending) > 1:
            usual[number](number, frame)

    with _handlers(_ignoring_repeats(hold), callable) as usual:
        try:
            yield lambda: bool(pending)
        finally:
            if pending:
                usual[pending[0]](pending[0], None)


def end_with_stdin() -> None:
    """End this process, as after SIGTERM, when its stdin is closed because its parent has ended."""

    def watch() -> None:
        while os.read(0, 1 << 10):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def _ignoring_repeats(handler: Handler) -> Handler:
    """A handler that ignores a SIGTERM or SIGHUP that comes again within REPEATED."""
    last: dict[int, float] = {}

    def handle(number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        repeated = number != signal.SIGINT and now - last.get(number, -REPEATED) < REPEATED
        last[number] = now
        if not repeated:
            handler(number, frame)

    return handle


@contextmanager
def _handlers(handler: Handler, replaces: Callable[[Any], bool]) -> Iterator[dict[int, Any]]:
    """Handle signals in place of the handlers that are to be replaced; yields these."""
    in_main = threading.current_thread() is threading.main_thread()
    handlers = {number: signal.getsignal(number) for number in SIGNALS if in_main}
    replaced = {number: usual for number, usual in handlers.items() if replaces(usual)}
    for number in replaced:
        signal.signal(number, handler)
    try:
        yield replaced
    finally:
        for number, usual in replaced.items():
            signal.signal(number, usual)
