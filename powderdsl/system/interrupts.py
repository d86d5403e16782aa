"""Signals that ask a process to end: Ctrl-C, SIGTERM, and SIGHUP of a terminal that is closed.

A command ends through exceptions, so that every `finally` runs: KeyboardInterrupt for Ctrl-C, its subclass `Terminated`
for the others. Nothing here is installed by importing it; a library leaves signals alone.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)  # Windows has no SIGHUP

REPEATED = 2.0
"""Seconds in which the same signal counts once: `timeout` sends two, a service manager one to each process."""

LIFELINE = "POWDERDSL_LIFELINE"
"""Environment variable of processes that end when their stdin is closed: whoever holds the other end started them."""

GRACE = 30.0
"""Seconds that such a process has for its last checkpoint."""


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP came. `number` is the signal's."""

    def __init__(self, number: int):
        super().__init__(f"terminated by {signal.Signals(number).name}")
        self.number = number


@dataclass
class _State:
    """The signals so far. `held`: the number of open `held_back` blocks; `pending`: the signal that came in them."""

    last: int = 0
    when: float = -1e9
    held: int = 0
    pending: int = 0
    ending: bool = False


_state = _State()


@contextmanager
def interruptible(*, until_exit: bool = False) -> Iterator[Callable[[], None]]:
    """Turn signals into exceptions in the main thread, unless somebody else handles or ignores them.

    Yields a function to call when the work is over and only its end is left to be reported.

    Args:
        until_exit: the process ends after the block. Signals that come when the work is over are ignored; a second one
            ends the process at once.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    _state.last, _state.when = 0, -1e9
    before = _installed(SIGNALS)
    hook, sys.unraisablehook = sys.unraisablehook, _redeliver(sys.unraisablehook)

    def over() -> None:
        _state.ending = until_exit

    try:
        yield over
    finally:
        over()
        if not until_exit:
            sys.unraisablehook = hook
            _restore(before)


@contextmanager
def held_back() -> Iterator[Callable[[], bool]]:
    """Hold signals back until the end of the block, which raises then; a second signal is not held back.

    Yields a function that says whether one has come. In threads other than the main one nothing is held back: signals
    do not reach them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = _installed((signal.SIGINT,))  # where `interruptible` is not in use: Ctrl-C alone
    _state.held += 1
    try:
        yield lambda: _state.pending != 0
    finally:
        _state.held -= 1
        _restore(before)
        if not _state.held and _state.pending:
            number, _state.pending = _state.pending, 0
            raise _exception(number)


def end_with_stdin() -> None:
    """End this process, as after SIGTERM, when its stdin is closed: then whoever started it is gone."""

    def watch() -> None:
        while os.read(0, 1 << 10):
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(GRACE)
        os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))

    threading.Thread(target=watch, daemon=True).start()


def _installed(signals: tuple[int, ...]) -> dict[int, Any]:
    """Install our handler for signals with default handlers; returns the previous handlers."""
    usual = (signal.SIG_DFL, signal.default_int_handler)
    before = {number: signal.getsignal(number) for number in signals if signal.getsignal(number) in usual}
    for number in before:
        signal.signal(number, _handle)
    return before


def _restore(before: dict[int, Any]) -> None:
    for number, handler in before.items():
        signal.signal(number, handler)


def _handle(number: int, frame: FrameType | None) -> None:
    now = time.monotonic()
    if number == _state.last != signal.SIGINT and now - _state.when < REPEATED:
        return
    first = not _state.last
    _state.last, _state.when = number, now
    if _state.ending:
        if not first:
            os._exit(128 + number)
        return
    if _state.held and not _state.pending:
        _state.pending = number
    elif _importing(frame):
        _send_again(number)  # modules in C++, such as torch's, abort the process when an import raises
    else:
        raise _exception(number)


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _send_again(number: int) -> None:
    _state.last, _state.when = 0, -1e9
    again = threading.Timer(0.02, os.kill, (os.getpid(), number))
    again.daemon = True
    again.start()


def _exception(number: int) -> KeyboardInterrupt:
    return KeyboardInterrupt() if number == signal.SIGINT else Terminated(number)


def _redeliver(usual: Callable[[Any], Any]) -> Callable[[Any], None]:
    """A hook for exceptions that cannot be raised, such as in `__del__`: a signal that came there is sent again."""

    def hook(found: Any) -> None:
        if not isinstance(found.exc_value, KeyboardInterrupt):
            usual(found)
            return
        _send_again(found.exc_value.number if isinstance(found.exc_value, Terminated) else signal.SIGINT)

    return hook
