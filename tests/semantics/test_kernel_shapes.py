"""Kernels with a radius: which cells they have, and that every backend counts and sums in them alike."""

from __future__ import annotations

import numpy as np
import pytest

from powderdsl.analysis.costs import costs
from powderdsl.compiler import lower
from powderdsl.model.builtins import KERNEL_SHAPES, KERNELS, shaped_kernel
from powderdsl.simulation.draw import to_numpy
from powderdsl.testing.pack_tests.runner import run_examples
from tests.semantics.texts import load_text, simulator

CELLS = {
    "box": lambda y, x, r: True,
    "ring": lambda y, x, r: abs(y) == r or abs(x) == r,
    "disc": lambda y, x, r: (y * y + x * x) ** 0.5 < r + 0.5,
    "diamond": lambda y, x, r: abs(y) + abs(x) <= r,
    "cross": lambda y, x, r: y == 0 or x == 0,
    "plus": lambda y, x, r: (y == 0 or x == 0) and (y, x) != (0, 0),
}
BOSCO = """\
pack: bosco
elements:
  off: {id: 0, color: "#14213D"}
  lit: {id: 1, color: "#FCA311"}
fields:
  level: {type: 0..9, at: place}
  total: {type: 0..999, at: place}
kernels:
  near: {shape: box(5), edges: wrap}
passes:
  sums: {do: total := sum(level in disc(4))}
  bosco:
    do:
      - off -> lit if count(lit in near) in 34..45
      - lit -> off if count(lit in near) not in 33..57
"""


@pytest.mark.parametrize("shape", KERNEL_SHAPES)
@pytest.mark.parametrize("radius", [1, 2, 5, 15])
def test_a_shape_has_its_cells(shape, radius):
    reach = range(-radius, radius + 1)
    wanted = [(y, x, 1) for y in reach for x in reach if CELLS[shape](y, x, radius)]
    assert list(shaped_kernel(shape, radius).weights) == wanted
    if shape in KERNELS and radius == 1:
        assert shaped_kernel(shape, 1).weights == KERNELS[shape].weights


def test_larger_than_life():
    sim = simulator(BOSCO)
    random = np.random.default_rng(3)
    lit = (random.random((2, 40, 70)) < 0.5).astype(np.uint8)
    level = random.integers(0, 10, lit.shape)
    world = sim.replace(sim.world(lit), level=level)
    for _ in range(3):
        count = sum(np.roll(lit, (y, x), (1, 2)) for y in range(-5, 6) for x in range(-5, 6)).astype(int)
        lit = np.where(lit == 1, (count >= 33) & (count <= 57), (count >= 34) & (count <= 45)).astype(
            np.uint8
        )
        world = sim.step(world)
        assert np.array_equal(to_numpy(world.ids), lit)
    padded = np.pad(level, ((0, 0), (4, 4), (4, 4)))
    height, width = level.shape[1:]
    total = sum(
        padded[:, 4 + y : 4 + y + height, 4 + x : 4 + x + width]
        for y, x, _ in shaped_kernel("disc", 4).weights
    )
    assert np.array_equal(to_numpy(world["total"]), total)


def test_a_large_kernel_stays_on_planes():
    """Rows are counted once and shifted: 961 neighbors take about a thousand gates."""
    text = BOSCO.replace("box(5)", "box(15)").replace("34..45", "240..330").replace("33..57", "230..430")
    (row,) = [row for row in costs(lower(load_text(text))) if row.name == "bosco"]
    assert row.form == "planes"
    assert row.gates < 1200


def test_radii_follow_loops():
    rules = load_text(
        "pack: loops\nelements: {off: {id: 0, color: '#000000', glyph: '.'}, lit: {id: 1, color: '#111111'}}\n"
        "passes: {p: {do: 'off -> lit if any(count(lit in ring(r)) == 1 for r in (2, 4))'}}\n"
        "tests: [{t: {given: l . . . . . ., after: 1 step, expect: l . l . l . .}}]\n"
    )
    assert [result.problem for result in run_examples(rules)] == [""]
