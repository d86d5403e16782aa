"""Runs commands side by side, and ends them with everything that they started when stdin closes, since then nobody waits.

A process that is killed cannot end its compilers, but the kernel closes its pipes. Runs as a script, in a session of its
own, where Ctrl-C does not reach it: `python compiler_guard.py SCRATCH COMMANDS`, a folder for temporary files, which is
removed if stdin closes, and a JSON list of lists of words. The exit code is that of the first command that fails.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading


def guard(scratch: str, commands: list[list[str]]) -> int:
    """Run commands until all have ended; the exit code, 127 if one cannot be run."""
    children, closed = [], threading.Event()
    signal.signal(signal.SIGTERM, lambda number, frame: None)  # it is for the commands

    def end() -> None:
        os.killpg(os.getpgrp(), signal.SIGTERM)

    def watch() -> None:
        sys.stdin.buffer.read()
        closed.set()
        end()

    try:
        for command in commands:
            children.append(subprocess.Popen(command, stdin=subprocess.DEVNULL))
    except OSError as error:
        print(error, file=sys.stderr)
        end()
    threading.Thread(target=watch, daemon=True).start()
    codes = [child.wait() for child in children]
    if closed.is_set():
        import shutil

        shutil.rmtree(scratch, ignore_errors=True)
    if len(children) < len(commands):
        return 127
    status = next(filter(None, codes), 0)
    return status if status >= 0 else 128 - status


if __name__ == "__main__":
    code = guard(sys.argv[1], json.loads(sys.argv[2]))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # the other thread is still reading
