"""A new element is one short file: docs/examples/salt.yaml, the second example of the README."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import powderdsl
from powderdsl.simulation.simulator import Simulator

ROOT = Path(__file__).parents[2]
SALT = ROOT / "docs" / "examples" / "salt.yaml"

backends = pytest.mark.parametrize("backend", ["reference", "wasm"])


@cache
def simulator(backend: str) -> Simulator:
    return powderdsl.compile(powderdsl.load("core", "sand", "water", SALT), backend=backend)


def id_of(sim: Simulator, element: str) -> int:
    found = sim.ruleset.element(element)
    assert found is not None
    return found.id


def boxes(sim: Simulator, worlds: int, *layers: str) -> np.ndarray:
    """Walled boxes with a row of each of these elements from the top, ids uint8 [worlds, layers + 2, 10]."""
    ids = np.full((worlds, len(layers) + 2, 10), id_of(sim, "wall"), np.uint8)
    for row, layer in enumerate(layers, 1):
        ids[:, row, 1:-1] = id_of(sim, layer)
    return ids


def amount(ids: torch.Tensor, sim: Simulator, element: str) -> int:
    return int((ids == id_of(sim, element)).sum())


def test_its_rules_are_ten_lines_of_yaml() -> None:
    text = SALT.read_text(encoding="utf-8")
    lines = text[: text.index("invariants:")].splitlines()
    assert len([line for line in lines if line.strip()]) <= 10
    assert max(map(len, lines)) <= 100
    assert set(yaml.safe_load("\n".join(lines))) == {"pack", "about", "needs", "elements", "passes"}


@backends
def test_ice_melts_faster_beside_salt_than_in_warm_air(backend: str) -> None:
    sim = simulator(backend)
    left = {}
    for neighbor in ("salt", "empty", "sand"):
        world = sim.step(sim.world(boxes(sim, 8, neighbor, "ice")), 12)
        left[neighbor] = amount(world.ids, sim, "ice") / (8 * 8)
    assert left["salt"] < 0.25
    assert 0.6 < left["empty"] < 1, "2 % a step"
    assert left["sand"] == 1, "nothing melts it there"


@backends
def test_salt_dissolves_in_water_and_keeps_where_it_is_dry(backend: str) -> None:
    sim = simulator(backend)
    sunk = sim.step(sim.world(boxes(sim, 8, "salt", "water", "water")), 60)
    assert 0 < amount(sunk.ids, sim, "salt") < 0.75 * 8 * 8, "1 % a step"
    dry = sim.world(boxes(sim, 8, "salt", "sand", "wall"))
    assert torch.equal(sim.step(dry, 60).ids, dry.ids)


@backends
def test_salt_falls_and_piles_up_like_sand(backend: str) -> None:
    sim = simulator(backend)
    world = sim.step(sim.world(boxes(sim, 1, "salt", "empty", "empty")), 4)
    assert torch.equal(world.ids, torch.from_numpy(boxes(sim, 1, "empty", "empty", "salt")))


def test_the_readme_runs_it(tmp_path: Path) -> None:
    picture = tmp_path / "salt.png"
    rules = "powderworld+docs/examples/salt.yaml"
    command = [sys.executable, "-m", "powderdsl", "run", rules, "--size", "16", "--steps", "2", "--out"]
    result = subprocess.run(
        [*command, str(picture)], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")
