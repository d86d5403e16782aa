"""The compiler runs without torch and NumPy, as in a browser."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import powderdsl
from powderdsl.cli.pictures import pictures
from powderdsl.cli.start_worlds import start
from powderdsl.worlds.ascii import write_ascii
from powderdsl.worlds.media import write_png
from powderdsl.worlds.strewn import strew
from tests.semantics.test_counterexamples import WISHES as COUNTEREXAMPLES
from tests.tiers import tiered

SCENE = """\
scene: spring
size: [12, 37]
fill: empty
draw:
  - frame wall
  - disk sand at (5, 9) radius 3
  - line water from (2, 2) to (9, 33) width 2
  - box cloner rows 2 columns 20:24
  - clone := water in box rows 2 columns 20:24
  - velocity := (-1, 4) in disk at (5, 9) radius 2
"""

WISHES = f"""{COUNTEREXAMPLES.replace("RULE", "with chance 20%")}\
  - age stays in 5..8
  - nothing reaches beyond 0 cells
tests:
  - nuts wait:
      given: |
        n . o .
        . n . .
      fields:
        drift: |
          2,0 . (-2.5,3) .
          . . . .
        facing: |
          left . . .
          . above . .
        awake: yes
      after: 3 steps
      expect: |
        n . o .
        . n . o
      expect_fields: {{age: 5..6, wish: air}}
  - nuts grow:
      given: n . n .
      fields: {{wish: oak, facing: left, awake: yes}}
      after: 1 step
      often: {{nut -> oak: 50%}}
"""

BLOCK = "import sys; sys.modules.update(numpy=None, torch=None)"
MAIN = "from powderdsl.cli.dispatch import main; main()"
BLOCKED = f"{BLOCK}\n{MAIN}"


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", BLOCKED, *arguments], capture_output=True, text=True)


@pytest.mark.slow
def test_worlds_run_and_are_saved_as_with_torch(tmp_path: Path) -> None:
    """A scene that sets fields, then the saved world; shapes at random, drawn in the terminal."""
    scene = tmp_path / "scene.yaml"
    scene.write_text(SCENE)
    ended = run("run", "powderworld", "--world", str(scene), "--steps", "7", "--out", f"{tmp_path}/first.npz")
    assert ended.returncode == 0, ended.stderr
    more = ("--world", f"{tmp_path}/first.npz", "--steps", "5", "--out", f"{tmp_path}/second.npz", "-v")
    ended = run("run", "powderworld", *more, "--backend", "wasm")
    assert "wasm on cpu" in ended.stderr
    sim = powderdsl.compile("powderworld", backend="torch")
    world = start(sim.ruleset, str(scene), None, None, None, backend="torch")
    for name, steps in (("first", 7), ("second", 5)):
        world = sim.step(world, steps)
        powderdsl.save(world, tmp_path / "expected.npz")
        assert (tmp_path / f"{name}.npz").read_bytes() == (tmp_path / "expected.npz").read_bytes()
    drawn = run("run", "powderworld", "--steps", "3", "--size", "9x20", "--seed", "4").stdout
    ids = sim.step(sim.world(strew(sim.ruleset, (9, 20), 1, 4), seed=4), 3).ids[0]
    assert drawn.split() == write_ascii(ids, sim.ruleset.elements).split()


@pytest.mark.slow
def test_pictures_are_those_with_numpy(tmp_path: Path) -> None:
    first, second = tmp_path / "first.png", tmp_path / "second.png"
    assert run("render", "powderworld", "--world", "garden", "--out", str(first)).returncode == 0
    ruleset = powderdsl.load("powderworld")
    write_png(
        second, pictures(start(ruleset, "garden", None, None, None, backend="wasm"), most=1, factor=None)
    )
    assert first.read_bytes() == second.read_bytes()


LINES = [
    ("trace", "core+sand+water", "--at", "9,9", "--step", "4", "--size", "16x16", "--seed", "2"),
    ("check", "core+sand+water", "--ledger", "--notes"),
    ("test", "wishes.yaml", "--examples", "32", "--no-keep"),
    ("test", "core+wind", "--examples", "32", "--no-keep"),
]


@pytest.mark.parametrize("arguments", tiered(LINES, LINES[:1]), ids=" ".join)
def test_output_is_that_with_numpy(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """Invariants that a world breaks, tests that fail by chance, fields of all kinds."""
    (tmp_path / "wishes.yaml").write_text(WISHES, encoding="utf-8")
    ended = [
        subprocess.run([sys.executable, "-c", one, *arguments], capture_output=True, text=True, cwd=tmp_path)
        for one in (BLOCKED, MAIN)
    ]
    assert ended[0].stderr == ended[1].stderr == ""
    first, second = (re.sub(r" in [0-9]+ s\b", "", one.stdout) for one in ended)
    assert first == second
    assert ended[0].returncode == ended[1].returncode
    assert first
