"""A small Ray cluster of several nodes on this machine, and ways to kill its parts.

Each node is a raylet with the processes that it starts, all found by a word in their environment.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from random import Random
from secrets import token_hex

from tests.cli.commands import environment_with
from tests.processes import alive, waited

MARK = "POWDERDSL_RAY_NODE"
OPTIONS = (
    *("--num-cpus=1", "--num-gpus=0", "--object-store-memory=100000000", "--disable-usage-stats"),
    *("--min-worker-port=0", "--max-worker-port=0"),
)


class Nodes:
    """A cluster. `address` is that of its head."""

    def __init__(self, folder: str):
        self.mark, self.folder = token_hex(8), folder
        self.address = ""
        self.started = 0

    def start_head(self) -> None:
        port, client = free_ports(2)
        self.address = f"127.0.0.1:{port}"
        self._start(
            "--head",
            f"--port={port}",
            f"--ray-client-server-port={client}",
            "--node-ip-address=127.0.0.1",
            "--include-dashboard=false",
            f"--temp-dir={self.folder}",
        )

    def start_node(self) -> int:
        """One more node; returns its number."""
        return self._start(f"--address={self.address}", "--node-ip-address=127.0.0.1")

    def _start(self, *words: str) -> int:
        self.started += 1
        environment = environment_with(
            **{MARK: f"{self.mark}-{self.started}", "RAY_USAGE_STATS_ENABLED": "0"}
        )
        run = subprocess.run(
            [str(Path(sys.executable).with_name("ray")), "start", *words, *OPTIONS],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=180,
            check=False,
        )
        assert run.returncode == 0, run.stdout
        return self.started

    def processes(self, node: int | None = None) -> dict[int, str]:
        """The processes of a node, or of all, with their command lines: daemons, workers and what these have started."""
        of = "" if node is None else f"{node}\0"
        word = f"{MARK}={self.mark}-{of}".encode()
        found = {}
        for place in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if word in (place / "environ").read_bytes() and alive(int(place.name)):
                    line = (place / "cmdline").read_bytes().replace(b"\0", b" ")
                    found[int(place.name)] = line.decode(errors="replace").strip()
        return found

    def kill_worker(self, tasks: str, chance: Random) -> bool:
        """Kill a process that is running a task whose name starts with a word; False if there is none."""
        found = [pid for pid, line in self.processes().items() if line.startswith(f"ray::{tasks}")]
        with suppress(ProcessLookupError, IndexError):
            os.kill(chance.choice(found), signal.SIGKILL)
            return True
        return False

    def kill_node(self, node: int | None = None) -> int:
        """Kill all processes of a node at once, as when a machine dies, or of all; returns how many there were."""
        doomed = self.processes(node)
        # What is stopped starts nothing new.
        for number in (signal.SIGSTOP, signal.SIGKILL):
            for pid in doomed:
                with suppress(ProcessLookupError):
                    os.kill(pid, number)
            doomed |= self.processes(node)
        return len(doomed)

    def end(self) -> None:
        """Kill everything, also processes that are just being started."""
        assert waited(lambda: self.kill_node() == 0, 60)


@contextmanager
def cluster(nodes: int) -> Iterator[Nodes]:
    """A cluster with so many nodes, the head included, of one CPU core each."""
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # names of sockets are short
    found = Nodes(folder)
    try:
        found.start_head()
        for _ in range(nodes - 1):
            found.start_node()
        yield found
    finally:
        found.end()
        shutil.rmtree(folder, ignore_errors=True)


def free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]
