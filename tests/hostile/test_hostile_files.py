"""Files from strangers: whatever is in them, a command ends soon, in little memory, says what is wrong, and writes nowhere else."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path
from typing import Any

import pytest

from tests.cli.commands import ROOT, environment_with, powderdsl
from tests.hostile.damage_kinds import KINDS, Kind, make_valid
from tests.processes import started

SECONDS, MEGABYTES = 5.0, 300.0
"""Processor time of a command, and memory beyond that for a valid file of the kind."""
RAW = re.compile(rb"[\x00-\x08\x0b-\x1f\x7f]|\xc2[\x80-\x9f]|\xe2\x80[\xaa-\xae]|\xe2\x81[\xa6-\xa9]")


def run_there(folder: Path, *words: str) -> None:
    with chdir(folder):
        run = powderdsl(*words, XDG_CACHE_HOME=str(folder / "own"))
    assert run.exit_code == 0, run.stderr


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a valid file of each kind."""
    folder = tmp_path_factory.mktemp("valid") / "files"
    make_valid(folder, lambda *words: run_there(folder, *words))
    return folder


def run_all(kind: Kind, valid: Path, place: Path) -> Iterator[dict[str, Any]]:
    """What came of the files of a kind, in a process that has imported everything and trains nothing itself."""
    script = "import sys; from tests.hostile.worker import work; work(*sys.argv[1:])"
    words = [sys.executable, "-c", script, str(valid), str(place), kind.name]
    options = {"stdout": subprocess.PIPE, "cwd": ROOT, "env": environment_with(OMP_NUM_THREADS="1")}
    with started(words, **options) as running:
        yield from map(json.loads, running.stdout)
        assert running.wait() == 0


def problems(found: dict[str, Any]) -> list[str]:
    """What a command did that it must not do."""
    output = bytes.fromhex(found["output"])
    told = []
    if found["hung"]:
        told.append("hangs")
    if found["status"] not in (0, 1, 2):
        told.append(f"ends with {found['status']}")
    if b"Traceback (most recent call last)" in output or re.search(rb"^error\[PD901\]", output, re.MULTILINE):
        told.append("reports a mistake of ours")
    if found["seconds"] - found["usual_seconds"] > SECONDS:
        told.append(f"takes {found['seconds']:.1f} s")
    if found["megabytes"] - found["usual_megabytes"] > MEGABYTES:
        told.append(f"takes {found['megabytes'] - found['usual_megabytes']:.0f} MB more than usual")
    if RAW.search(output):
        told.append(f"prints {RAW.findall(output)[:3]}")
    if found["escaped"]:
        told.append(f"writes outside: {found['escaped']}")
    return told


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_hostile_files(kind: Kind, valid: Path, tmp_path: Path) -> None:
    wrong: list[str] = []
    statuses: Counter[int] = Counter()
    slowest = largest = 0.0
    for found in run_all(kind, valid, tmp_path):
        statuses[found["status"]] += 1
        slowest = max(slowest, found["seconds"] - found["usual_seconds"])
        largest = max(largest, found["megabytes"] - found["usual_megabytes"])
        told = problems(found)
        if told:
            output = bytes.fromhex(found["output"]).decode("utf-8", "replace")
            wrong.append(f"{found['seed']} ({found['how']}): {'; '.join(told)}\n{output[-600:]}")
    assert sum(statuses.values()) == kind.many
    codes = ", ".join(f"{code}: {count}" for code, count in sorted(statuses.items()))
    print(f"{kind.name}: exit codes {codes}, at most {slowest:.1f} s and {largest:.0f} MB more")
    assert not wrong, "\n\n".join(wrong[:20])
