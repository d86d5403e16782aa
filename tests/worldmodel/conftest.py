"""Small worlds to learn from: stochastic ones of shipped packs, and deterministic ones of a pack of our own."""

from __future__ import annotations

from pathlib import Path

import pytest

MOSS = """
pack: moss
needs: core
elements:
  moss: {id: 5, color: "#308030", glyph: m}
passes:
  grow:
    do: empty -> moss if count(moss) > 0
"""

GARDEN = """
task: garden
rules: core+moss.yaml
size: [16, 16]
fill: empty
generate:
  - scatter moss chance 2%
  - scatter wall chance 10%
agent: {may: nothing, actions: 4}
"""

DUNES = """
task: dunes
rules: core+sand+water+stone
size: [14, 18]
fill: empty
knobs:
  kinds: {default: 4, range: 0..4}
  squares: {default: 4, range: 0..8}
generate:
  - repeat 1..squares:
      - square (first kinds + 1 of empty, sand, water, wall, stone) at (0..13, 0..17) half 1..4
  - frame wall
agent: {may: nothing, actions: 4}
splits:
  two:
    stands:
      - {stand: falling, generate: ["box sand rows 2:6 columns 3:9", "frame wall"]}
      - {stand: lying, generate: ["box stone rows 9:13 columns 3:9", "frame wall"]}
"""


@pytest.fixture
def garden(tmp_path: Path) -> str:
    """A task file: moss grows by a cell a step, and walls stand in its way. Nothing in it is random but the start."""
    (tmp_path / "moss.yaml").write_text(MOSS, encoding="utf-8")
    (tmp_path / "garden.yaml").write_text(GARDEN, encoding="utf-8")
    return str(tmp_path / "garden.yaml")


@pytest.fixture
def dunes(tmp_path: Path) -> str:
    """A task file: sand, water and stone, which fall and flow at random."""
    (tmp_path / "dunes.yaml").write_text(DUNES, encoding="utf-8")
    return str(tmp_path / "dunes.yaml")
