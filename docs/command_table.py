"""Least processor time and time by the clock of commands, with an empty cache and with a warm one: the table of docs/performance.md.

.venv/bin/python docs/command_table.py
"""

from __future__ import annotations

import os
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROUNDS = 5

BYTECODE = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": tempfile.mkdtemp()}
"""Modules are compiled once, as pip does while it installs a package."""

COMMANDS = (
    "--help",
    "run powderworld --world garden --steps 240 --out demo.gif",
    "render powderworld --world garden --out garden.png",
    "run powderworld --steps 240 --out world.npz",
    "check powderworld",
    "check powderworld2",
    "check lab.yaml",
    "show powderworld",
    "show sand-pushing",
    "explain PD301",
    "test powderworld",
    "trace powderworld --world garden --at 40,20 --step 20",
    "compile core+water --emit ir",
    "export powderworld --out rules.wasm",
    "bench core+water --seconds 0.1 --rounds 1 --backend wasm",
    "evaluate sand-pushing --episodes 8",
    "record sand-pushing --episodes 4 --out data",
    "train sand-pushing --steps 256 --envs 4 --rollout 64 --run agent",
    "wm train --iterations 2 --run model",
    "ogbench easy --episodes 1 --out ogbench",
    "study complexity --dry-run",
)
LAB = """pack: lab
needs: [core, water]
elements:
  salt: {id: 40, density: 4, gravity: yes, color: "#FFF8E7", tags: powder}
passes:
  brine:
    do: salt -> empty if count(water) > 0 with chance 1%
"""


def measured(command: str, cache: Path) -> tuple[float, float]:
    """Processor time and time by the clock, in seconds, in a new folder."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "lab.yaml").write_text(LAB)
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        words = [sys.executable, "-m", "powderdsl", *shlex.split(command)]
        environment = {**os.environ, **BYTECODE, "XDG_CACHE_HOME": str(cache), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        elapsed, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(f"{command}: {done.stderr[-2000:]}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, elapsed


def main() -> None:
    print("| command | cold, s | warm, s | warm, by the clock, s |\n|---|--:|--:|--:|")
    for command in COMMANDS:
        cold, warm = [], []
        for rounds in (0, 0, ROUNDS):
            with tempfile.TemporaryDirectory() as cache:
                cold.append(measured(command, Path(cache))[0])
                warm += [measured(command, Path(cache)) for _ in range(rounds)]
        processor, clock = (min(column) for column in zip(*warm, strict=True))
        print(f"| `{command}` | {min(cold):.2f} | {processor:.2f} | {clock:.2f} |", flush=True)


if __name__ == "__main__":
    main()
