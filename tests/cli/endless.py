"""Commands that run for hours, to be ended in the middle: each in a folder of its own, with its own cache."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from powderdsl.system.writing import MARK
from tests.cli.commands import command_line, environment_with
from tests.processes import alive, started, waited

TASK = """
task: dig
rules: core+sand
size: [8, 8]
fill: sand
agent: {may: [empty], brush: 2, bins: 4, actions: 3}
reward: {final: count(empty)}
splits: {test: {generate: [frame wall]}}
"""

STUDY = """
study: tiny
about: Many small runs.
seeds: {seeds}
vary: {{steps: {steps}}}
steps:
  trained: {{command: train, on: dig.yaml, preset: small, envs: 4, rollout: 3, batch: 12, backend: torch, steps: $steps, seed: $seed, save-every: 0}}
  tested: {{command: evaluate, on: trained, episodes: 4, policies: "trained,random"}}
measures:
  reward: {{of: trained, value: splits/test/trained/mean, expect: rises}}
"""

COMPILER = """#!/bin/bash
if [ "${@: -1}" = --version ]; then echo "g++ 1"; exit; fi
if [ "$POWDERDSL_ENDLESS" = no ]; then exit 1; fi
touch FOLDER/compiling
sleep 1000 & wait
"""
"""A compiler that works in another process, as compilers do, and never ends; or fails."""

TINY = ("--envs", "4", "--rollout", "3", "--batch", "12", "--backend", "torch")
SMALL = ("--backend", "reference", "--size", "8x8")


@dataclass(frozen=True)
class Endless:
    """A command, and a pattern for the file that shows it is in the middle of its work. `again` ends soon, in the same
    folder; `status` is its exit code."""

    words: Sequence[str]
    busy: str
    again: Sequence[str] = ("run", "life", *SMALL, "--steps", "3", "--out", "x.npz")
    status: int = 0
    processes: int = 1
    """So many run when it is in the middle of its work."""


COMMANDS = {
    "run": Endless(("run", "life", *SMALL, "--steps", "900000000", "--out", "x.gif"), ".x.*.gif"),
    "video": Endless(("run", "life", *SMALL, "--steps", "900000000", "--out", "x.mp4"), ".x.*.mp4"),
    "compile": Endless(
        ("run", "life", "--backend", "native", "--size", "8x8", "--out", "x.npz"),
        "compiling",
        ("run", "life", "--backend", "native", "--size", "8x8", "--out", "x.npz"),
        2,  # by then the compiler fails
    ),
    "record": Endless(
        ("record", "dig.yaml", "--out", "data", "--episodes", "150000", "--shard", "3", "--backend", "torch"),
        "data/shard-*",
        ("run", "life", *SMALL, "--steps", "3", "--out", "data/x.npz"),
    ),
    "train": Endless(
        ("train", "dig.yaml", *TINY, "--run", "agent", "--steps", "900000000", "--save-every", "0"),
        "agent/checkpoints/[0-9]*.safetensors",
        ("train", "dig.yaml", *TINY, "--run", "agent", "--steps", "12", "--save-every", "0"),
    ),
    "evaluate": Endless(
        ("evaluate", "dig.yaml", "--episodes", "1000000", "--backend", "reference", "--out", "x.json"),
        "",
    ),
    "wm train": Endless(
        (
            *("wm", "train", "dig.yaml", "--width", "4", "--batch", "4", "--buffer", "32"),
            *("--refresh", "2", "--worlds", "100", "--backend", "torch", "--run", "model"),
            *("--iterations", "900000000", "--store", "disk", "--save-every", "0.02"),
        ),
        "model/checkpoints/[0-9]*.safetensors",
    ),
    "bench": Endless(("bench", "life", "--backend", "wasm", "--seconds", "3600"), ""),
    "fuzz": Endless(
        ("fuzz", "--jobs", "2", "--seeds", "0..900000", "--backends", "torch,native", "--save", "found"),
        "tmp/.powderdsl-*/*",
        ("fuzz", "--jobs", "1", "--seeds", "0..1", "--backends", "torch", "--save", "found"),
    ),
    "test": Endless(
        ("test", "core+sand", "--examples", "9000000", "--seconds", "86400", "--no-keep"),
        "",
    ),
    "mutate": Endless(("test", "--mutate", "powderworld", "--jobs", "2"), "", processes=3),
    "study": Endless(
        ("study", "study.yaml", "--out", "out", "--jobs", "2"),
        "out/runs/*seed=1/trained/checkpoints/[0-9]*.safetensors",
    ),
}


class Place:
    """A folder in which commands run, find their files, and leave nothing outside."""

    def __init__(self, folder: Path):
        self.folder = folder
        for name in ("cache", "tmp"):
            (folder / name).mkdir()
        (folder / "dig.yaml").write_text(TASK, encoding="utf-8")
        (folder / "study.yaml").write_text(STUDY.format(seeds=2, steps=[900000000]), encoding="utf-8")
        self.compiler = folder / "compiler"
        self.compiler.write_text(COMPILER.replace("FOLDER", str(folder)), encoding="utf-8")
        self.compiler.chmod(0o755)

    def environment(self, command: Endless, *, endless: bool) -> dict[str, str]:
        found = environment_with(
            XDG_CACHE_HOME=str(self.folder / "cache"),
            TMPDIR=str(self.folder / "tmp"),
            POWDERDSL_PLACE=str(self.folder),  # how its processes are found, whoever their parent is now
            POWDERDSL_ENDLESS="yes" if endless else "no",
        )
        return found | {"CXX": str(self.compiler)} if command.busy == "compiling" else found

    @contextmanager
    def begun(self, command: Endless) -> Iterator[subprocess.Popen[str]]:
        """The command, begun; it does not outlive the block."""
        log = self.folder / "stderr"
        self.earlier = set(self.folder.glob(command.busy)) if command.busy else set()
        with (
            log.open("w") as errors,
            started(
                command_line(*command.words),
                env=self.environment(command, endless=True),
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
            ) as running,
        ):
            yield running

    def busy(self, command: Endless, running: subprocess.Popen[str]) -> bool:
        """Wait until a command is in the middle of its work; False if it ended before."""
        if command.busy:
            waited(lambda: running.poll() is not None or set(self.folder.glob(command.busy)) - self.earlier)
        elif command.processes > 1:
            waited(lambda: running.poll() is not None or len(self.survivors()) >= command.processes)
        else:  # it writes nothing: it has imported everything once it has used some processor time
            waited(lambda: running.poll() is not None or seconds_of(running.pid) > 4)
        return running.poll() is None

    def said(self) -> str:
        """What the last command wrote to stderr."""
        return (self.folder / "stderr").read_text(encoding="utf-8")

    def survivors(self) -> list[int]:
        """Processes that commands in this folder have started, and that still run."""
        found = []
        for place in Path("/proc").glob("[0-9]*"):
            try:
                ours = f"POWDERDSL_PLACE={self.folder}\0".encode() in (place / "environ").read_bytes()
            except OSError:
                continue
            if ours and alive(int(place.name)):
                found.append(int(place.name))
        return found

    def scratch(self) -> list[Path]:
        """Temporary files that lie somewhere in the folder."""
        return [path for path in self.folder.rglob("*") if MARK in path.name or path.suffix == ".bin"]

    def run_again(self, command: Endless) -> None:
        """A short command in the same folder: it succeeds, whatever was killed there."""
        run = subprocess.run(
            command_line(*command.again),
            env=self.environment(command, endless=False),
            cwd=self.folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
        )
        assert run.returncode == command.status, run.stderr


def seconds_of(pid: int) -> float:
    """Processor time that a process has used so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
