"""Every command without torch, and without NumPy: it works, or says which package it needs and how to install it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

from powderdsl.cli.dispatch import COMMANDS
from powderdsl.compiler import BACKENDS
from tests.cli.commands import environment_with
from tests.studies.test_study_paths import STUDY

BLOCKED = {"torch": ["torch"], "NumPy": ["numpy", "torch"], "only NumPy": ["numpy"]}
"""Modules that cannot be imported."""

PROGRAM = """
import io, json, sys
from contextlib import redirect_stderr, redirect_stdout
blocked, lines = json.loads(sys.argv[1])
sys.modules.update(dict.fromkeys(blocked))
from powderdsl.cli.dispatch import main
for line in lines:
    told = io.StringIO()
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(told):
            main(line.split())
    except SystemExit as ended:
        print(json.dumps([line, ended.code, told.getvalue()]))
"""

WORKS = ""
PRINTED = [name for name in BACKENDS if name not in ("auto", "reference")]
QUICK = [
    # a command; the package that it lacks without torch; without NumPy
    ("run life --steps 1", WORKS, WORKS),
    ("run life --steps 1 --out x.png", WORKS, WORKS),
    ("run life --steps 1 --out x.npz", WORKS, WORKS),
    ("run life --steps 1 --out x.gif", WORKS, "numpy"),
    ("run life --steps 1 --out x.mp4", WORKS, "numpy"),
    ("run life --steps 1 --backend torch", "torch", "torch"),
    ("run life --steps 1 --backend native", "torch", "torch"),
    ("run life --steps 1 --backend cuda", "torch", "torch"),
    ("run life --steps 1 --device cuda", "torch", "torch"),
    ("check life --quick", WORKS, WORKS),
    *(
        (f"compile core+sand+wind --emit {stage}", WORKS, WORKS)
        for stage in ("tree", "model", "ir", "planes")
    ),
    *((f"compile core+sand+wind --emit kernels --backend {name}", WORKS, WORKS) for name in PRINTED),
    ("compile life --emit schedule --backend native", WORKS, WORKS),
    ("show life", WORKS, WORKS),
    ("test core --mutate --mutants 2 --jobs 1", WORKS, "numpy"),
    ("prove life == life", WORKS, WORKS),
    ("trace life --at 1,1 --step 1", WORKS, WORKS),
    ("record sand-pushing --episodes 1 --out ds", "torch", "numpy"),
    ("record --verify ds", "torch", "numpy"),
    ("ogbench easy --out og --episodes 1", "torch", "numpy"),
    ("bench life --seconds 0.01", "torch", "torch"),
    ("train sand-pushing --steps 10", "torch", "numpy"),
    ("evaluate sand-pushing --episodes 1", "torch", "numpy"),
    ("evaluate run", "torch", "numpy"),
    ("curves run --metric loss --out c.png", WORKS, "numpy"),
    ("watch sand-pushing --out w.gif", "torch", "numpy"),
    ("wm train --iterations 1", "torch", "numpy"),
    ("wm eval run", "torch", "numpy"),
    ("wm finetune run --packs gas", "torch", "numpy"),
    ("study", WORKS, WORKS),
    ("cache list", WORKS, WORKS),
    ("new thing", WORKS, WORKS),
    ("render life --out r.png", WORKS, WORKS),
    ("export life --out l.wasm", WORKS, WORKS),
    ("export --env sand-pushing --out e.h", "torch", "numpy"),
    ("explain PD612", WORKS, WORKS),
    ("universe 7", WORKS, WORKS),
    ("schema", WORKS, WORKS),
    ("fmt study.yaml", WORKS, WORKS),
    ("lsp --help", WORKS, WORKS),
]
SLOW = [
    ("check sand-pushing", WORKS, WORKS),
    ("show sand-pushing", WORKS, WORKS),
    ("test core --examples 4 --no-keep", WORKS, WORKS),
    ("study study.yaml --dry-run", WORKS, WORKS),
    ("play life --export page", WORKS, WORKS),
]


def ends(blocked: str, lines: Iterable[str], folder: Path) -> dict[str, tuple[int, str]]:
    """The exit status and stderr of commands that run one after the other in a process."""
    (folder / "study.yaml").write_text(STUDY, encoding="utf-8")
    (folder / "run").mkdir()
    (folder / "run" / "run.json").write_text('{"kind": "ppo", "config": {}}', encoding="utf-8")
    (folder / "run" / "metrics.jsonl").write_text('{"step": 1, "loss": 2.0}\n', encoding="utf-8")
    given = json.dumps([BLOCKED[blocked], [*lines]])
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, given],
        cwd=folder, env=environment_with(XDG_CACHE_HOME=str(folder / "cache")), capture_output=True, text=True,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    return {line: (code, told) for line, code, told in map(json.loads, ended.stdout.splitlines())}


@pytest.mark.parametrize("blocked", BLOCKED)
def test_every_command_has_help(blocked: str, tmp_path: Path) -> None:
    groups = ("wm train", "wm eval", "wm finetune", "study collect", "cache list", "cache clear")
    lines = ["--help", *(f"{name} --help" for name in (*COMMANDS, *groups))]
    assert ends(blocked, lines, tmp_path) == dict.fromkeys(lines, (0, ""))


@pytest.mark.parametrize("blocked", BLOCKED)
@pytest.mark.parametrize("jobs", [QUICK, pytest.param(SLOW, marks=pytest.mark.slow)], ids=["quick", "slow"])
def test_every_command_works_or_names_what_it_lacks(
    jobs: list[tuple[str, str, str]], blocked: str, tmp_path: Path
) -> None:
    place = [*BLOCKED].index(blocked)
    lacking = {line: (torch, numpy, numpy and "numpy")[place] for line, torch, numpy in jobs}
    found = ends(blocked, lacking, tmp_path)
    assert found.keys() == lacking.keys()
    for line, (code, told) in found.items():
        if lacking[line] == WORKS:
            assert (code, "error" in told) == (0, False), (line, told)
        else:
            assert code == 2, (line, told)
            assert "error[PD612]" in told or "error[PD701]" in told, (line, told)
            assert f"{lacking[line]}" in told, (line, told)
            assert "pip install" in told, (line, told)


def test_all_commands_are_in_the_tables() -> None:
    assert {line.split()[0] for line, *_ in QUICK + SLOW} == {*COMMANDS}
