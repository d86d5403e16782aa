"""The process that runs commands on damaged files, each in a fork. It writes a line of JSON for each."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any, TextIO

from tests.hostile.damage_kinds import KINDS, Kind, damage
from tests.hostile.measured import Measured, import_everything, measured


def work(valid: str, place: str, *jobs: str) -> None:
    """Run the command of a kind on files of its seeds, for each job: ``KIND|START|STOP``."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    import_everything()
    for job in jobs:
        name, start, stop = job.split("|")
        kind = next(kind for kind in KINDS if kind.name == name)
        _work(kind, range(int(start), int(stop)), valid, place, out)
    sys.stdout.flush()


def _work(kind: Kind, seeds: range, valid: str, place: str, out: TextIO) -> None:
    usual = [_run(kind, Path(valid), Path(place) / f"usual-{number}", None)[1] for number in range(2)]
    assert usual[-1].status == 0, usual[-1].output.decode(errors="replace")
    for seed in seeds:
        how, found, escaped = _run(kind, Path(valid), Path(place) / str(seed), seed)
        row: dict[str, Any] = {
            "kind": kind.name,
            "seed": seed,
            "how": how,
            "status": found.status,
            "output": found.output[-20_000:].hex(),
            "seconds": found.seconds,
            "megabytes": found.megabytes,
            "usual_seconds": min(one.seconds for one in usual),
            "usual_megabytes": max(one.megabytes for one in usual),
            "hung": found.hung,
            "escaped": escaped,
        }
        out.write(json.dumps(row) + "\n")
        out.flush()


def _run(kind: Kind, valid: Path, place: Path, seed: int | None) -> tuple[str, Measured, list[str]]:
    """Run on a copy of the valid folder, damaged if there is a seed; what changed around it."""
    folder, outside = place / "files", place / "outside"
    outside.mkdir(parents=True)
    (outside / "victim.json").write_text("victim")
    shutil.copytree(valid, folder)
    how = "valid" if seed is None else damage(kind, folder, seed)
    before = _around(place)
    home = {"XDG_CACHE_HOME": str(folder / "cache"), "HOME": str(folder), "TMPDIR": str(folder)}
    found = measured(kind.words, folder, NO_COLOR="1", **home)
    after = _around(place)
    escaped = sorted(name for name in {*before, *after} if before.get(name) != after.get(name))
    shutil.rmtree(place, ignore_errors=True)
    return how, found, escaped


def _around(place: Path) -> dict[str, str]:
    """What lies beside the folder of a command."""
    return {
        str(path.relative_to(place)): path.read_text() if path.is_file() else ""
        for path in sorted(place.rglob("*"))
        if path.relative_to(place).parts[0] != "files"
    }
