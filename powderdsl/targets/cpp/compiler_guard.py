"""Runs a command, and ends it with everything that it started when stdin closes, since then nobody waits for it.

A process that is killed cannot end its compiler, but the kernel closes its pipes. Runs as a script, in a session of its
own, where Ctrl-C does not reach it: `python compiler_guard.py COMMAND …`. The exit code is the command's.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading


def guard(command: list[str]) -> int:
    """Run a command until it ends; the exit code, 127 if it cannot be run."""
    if os.getpgrp() != os.getpid():
        os.setsid()  # otherwise every process of our group would be ended too
    try:
        child = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    except OSError as error:
        print(error, file=sys.stderr)
        return 127

    def watch() -> None:
        sys.stdin.buffer.read()
        os.killpg(os.getpgrp(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()
    status = child.wait()
    return status if status >= 0 else 128 - status


if __name__ == "__main__":
    code = guard(sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # the other thread is still reading
