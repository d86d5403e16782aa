"""Runs commands side by side, and ends them with everything that they started when stdin closes, since then nobody waits.

A process that is killed cannot end its compilers, but the kernel closes its pipes. Runs as a script, in a session of its
own, where Ctrl-C does not reach it: `python compiler_guard.py COMMANDS`, a JSON list of lists of words. The exit code is
that of the first command that fails.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading


def guard(commands: list[list[str]]) -> int:
    """Run commands until all have ended; the exit code, 127 if one cannot be run."""
    if os.getpgrp() != os.getpid():
        os.setsid()  # otherwise every process of our group would be ended too
    children = []
    try:
        for command in commands:
            children.append(subprocess.Popen(command, stdin=subprocess.DEVNULL))
    except OSError as error:
        print(error, file=sys.stderr)
        for child in children:
            child.kill()
            child.wait()
        return 127

    def watch() -> None:
        sys.stdin.buffer.read()
        os.killpg(os.getpgrp(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()
    status = next((one for one in [child.wait() for child in children] if one), 0)
    return status if status >= 0 else 128 - status


if __name__ == "__main__":
    code = guard(json.loads(sys.argv[1]))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # the other thread is still reading
