"""Least processor time of commands with an empty and with a warm cache: the table of docs/performance.md.

.venv/bin/python docs/command_table.py
"""

from __future__ import annotations

import os
import resource
import shlex
import subprocess
import sys
import tempfile
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


def measured(command: str, cache: Path) -> float:
    """Processor time in seconds, in a new folder."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "lab.yaml").write_text(LAB)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        words = [sys.executable, "-m", "powderdsl", *shlex.split(command)]
        environment = {**os.environ, **BYTECODE, "XDG_CACHE_HOME": str(cache), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(f"{command}: {done.stderr[-2000:]}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    print("| command | cold, s | warm, s |\n|---|--:|--:|")
    for command in COMMANDS:
        cold, warm = [], []
        for rounds in (0, 0, ROUNDS):
            with tempfile.TemporaryDirectory() as cache:
                cold.append(measured(command, Path(cache)))
                warm += [measured(command, Path(cache)) for _ in range(rounds)]
        print(f"| `{command}` | {min(cold):.2f} | {min(warm):.2f} |", flush=True)


if __name__ == "__main__":
    main()
