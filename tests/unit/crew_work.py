"""What processes do in the tests of `tests.fuzz.crew`: they import it by name."""

from __future__ import annotations

import os
import signal
import time

from tests.fuzz.crew import Tell


def work(task: int, tell: Tell) -> int:
    """Squares; 13 kills its process, 17 ends it, 19 never comes back."""
    tell(f"at {task}")
    if task == 13:
        os.kill(os.getpid(), signal.SIGKILL)
    if task == 17:
        os._exit(3)
    if task == 19:
        time.sleep(600)
    return task * task
