"""Classic cellular automata written in the rule language, against what is known of them.

The packs (rules/life.yaml and so on) share nothing with the physics of Powderworld: they show that the
language is general. Each is checked against patterns from the literature, or against a few lines of NumPy or
plain Python that say the same thing in another way. That all backends run them alike is tested elsewhere.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch

import powderdsl
from powderdsl.simulation.simulator import Simulator, World
from powderdsl.worlds.ascii import read_ascii

Cells = set[tuple[int, int]]


@cache
def simulator(pack: str) -> Simulator:
    return powderdsl.compile(powderdsl.load(pack), backend="wasm")


def rows(art: str) -> list[str]:
    return art.split()


def noise(sim: Simulator, shape: tuple[int, ...], *, seed: int, p: list[float] | None = None) -> np.ndarray:
    """Random ids uint8 [B, H, W], with these probabilities by id."""
    return np.random.default_rng(seed).choice(len(sim.elements), shape, p=p).astype(np.uint8)


def around(cells: np.ndarray) -> np.ndarray:
    """How many of the eight neighbors hold, on a torus: bool [..., H, W] -> int [..., H, W]."""
    shifts = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
    return sum(np.roll(cells, shift, (-2, -1)).astype(int) for shift in shifts)  # type: ignore[return-value]


# Life

GLIDER = rows(
    """
    .O...
    ..O..
    OOO..
    .....
    .....
    """
)
GOSPER_GUN = rows(
    """
    ........................O...........
    ......................O.O...........
    ............OO......OO............OO
    ...........O...O....OO............OO
    OO........O.....O...OO..............
    OO........O...O.OO....O.O...........
    ..........O.....O.......O...........
    ...........O...O....................
    ............OO......................
    """
)


def life(sim: Simulator, pattern: list[str], height: int, width: int, at: tuple[int, int]) -> World:
    """A Life world with a pattern in it, its top left corner `at` a row and a column."""
    ids = np.zeros((1, height, width), np.uint8)
    art = read_ascii("\n".join(pattern), sim.ruleset.elements)
    ids[0, at[0] : at[0] + art.shape[0], at[1] : at[1] + art.shape[1]] = art
    return sim.world(ids)


def test_a_glider_moves_one_cell_down_and_right_in_four_generations() -> None:
    sim = simulator("life")
    world = life(sim, GLIDER, 20, 20, at=(3, 4))
    for i in range(1, 5):
        world = sim.step(world, 4)
        expected = life(sim, GLIDER, 20, 20, at=(3 + i, 4 + i))
        assert torch.equal(world.ids, expected.ids)


def test_the_gosper_gun_fires_a_glider_every_thirty_generations() -> None:
    sim = simulator("life")
    start = life(sim, GOSPER_GUN, 60, 60, at=(4, 4))
    gun = (slice(None), slice(0, 13), slice(None))
    world = start
    for shots in range(1, 5):
        world = sim.step(world, 30)
        assert int(world.ids.sum()) == 36 + 5 * shots
        assert torch.equal(world.ids[gun], start.ids[gun]), "the gun is as it was"
    # In the 60 generations of two shots a glider flies 15 cells.
    assert int(world.ids[0, 18:26].sum()) == 5
    assert torch.equal(sim.step(world, 60).ids[0, 33:41], torch.roll(world.ids[0, 18:26], 15, 1))


@pytest.mark.parametrize("shape", [(3, 16, 16), (2, 7, 33), (1, 3, 64), (1, 50, 3)])
def test_random_life_agrees_with_a_direct_formula(shape: tuple[int, int, int]) -> None:
    sim = simulator("life")
    alive = noise(sim, shape, seed=1) == 1
    world = sim.world(alive.astype(np.uint8))
    for _ in range(8):
        neighbors = around(alive)
        alive = (neighbors == 3) | (alive & (neighbors == 2))
        world = sim.step(world)
        assert np.array_equal(world.ids.numpy() == 1, alive)


# Forest fire


def forest(growth: float, lightning: float) -> Simulator:
    params = {"forest_fire.growth": growth, "forest_fire.lightning": lightning}
    return powderdsl.compile(powderdsl.load("forest_fire", params=params), backend="wasm")


def test_fire_spreads_to_the_four_neighbors_and_burns_out() -> None:
    sim = forest(growth=0, lightning=0)
    ids = np.full((1, 15, 17), 1, np.uint8)
    ids[0, 7, 8] = 2
    world = sim.world(ids)
    y, x = np.mgrid[:15, :17]
    distance = abs(y - 7) + abs(x - 8)
    for step in range(1, 18):
        world = sim.step(world)
        # Nothing crosses the edges: neighbors outside the grid count as nothing.
        expected = np.select([distance < step, distance == step], [0, 2], 1)
        assert np.array_equal(world.ids[0].numpy(), expected)


def test_every_fire_leaves_bare_ground_and_every_change_is_a_lawful_one() -> None:
    sim = forest(growth=0.3, lightning=0.1)
    ground, tree, fire = 0, 1, 2
    world = sim.world(noise(sim, (2, 40, 40), seed=3), seed=5)
    for _ in range(10):
        before, world = world.ids.numpy(), sim.step(world)
        after = world.ids.numpy()
        assert (after[before == fire] == ground).all()
        assert np.isin(after[before == tree], (tree, fire)).all()
        assert np.isin(after[before == ground], (ground, tree)).all()


def test_growth_and_lightning_come_as_often_as_they_should() -> None:
    growth, lightning = 0.02, 1e-5
    cells = 2**21
    bare = forest(growth, lightning).world(np.zeros((2, 1024, 1024), np.uint8), seed=11)
    grown = int((bare.sim.step(bare).ids == 1).sum())
    assert abs(grown - growth * cells) < 5 * np.sqrt(growth * cells)
    wood = bare.sim.world(np.ones((2, 1024, 1024), np.uint8), seed=12)
    struck = int((wood.sim.step(wood).ids == 2).sum())
    # 21 are expected; draws of 16 bits could only give 0 or 32, and that is 5 deviations from neither.
    assert 5 <= struck <= 45


# Margolus: balls fly diagonally in blocks of 2×2 cells


def test_a_ball_flies_diagonally() -> None:
    sim = simulator("margolus")
    for start, step in (((2, 2), (1, 1)), ((2, 3), (1, -1)), ((3, 2), (-1, 1)), ((3, 3), (-1, -1))):
        ids = np.zeros((1, 8, 10), np.uint8)
        ids[0][start] = 1
        world = sim.world(ids)
        for i in range(1, 50):
            world = sim.step(world)
            place = [(start[0] + i * step[0]) % 8, (start[1] + i * step[1]) % 10]
            assert world.ids[0].nonzero().tolist() == [place]


BALLS = [(0.05, (14, 22)), (0.3, (8, 40)), (0.7, (6, 6)), (0.3, (13, 9))]


@pytest.mark.parametrize(("density", "shape"), BALLS)
def test_no_ball_is_lost_or_made(density: float, shape: tuple[int, int]) -> None:
    """Not even where a side is odd: blocks that overlap at the seam rest."""
    sim = simulator("margolus")
    ids = noise(sim, (4, *shape), seed=4, p=[1 - density, density])
    world = sim.world(ids)
    for _ in range(20):
        world = sim.step(world)
        assert world.ids.sum((1, 2)).tolist() == ids.sum((1, 2)).tolist()


def test_time_runs_backwards() -> None:
    """A step undoes itself, and an odd number of steps meets the same blocks from either end."""
    sim = simulator("margolus")
    start = sim.world(noise(sim, (3, 16, 24), seed=6, p=[0.7, 0.3]))
    end = sim.step(start, 41)
    assert not torch.equal(end.ids, start.ids)
    assert torch.equal(sim.step(sim.world(end.ids), 41).ids, start.ids)


# Others, each against a direct formula


def test_wireworld() -> None:
    sim = simulator("wireworld")
    wire, head, tail = 1, 2, 3
    ids = np.pad(noise(sim, (2, 18, 31), seed=6), ((0, 0), (1, 1), (1, 1))).astype(int)  # no edges
    world = sim.world(ids)
    for _ in range(10):
        lit = np.isin(around(ids == head), (1, 2))
        cases = [ids == head, ids == tail, (ids == wire) & lit]
        ids = np.select(cases, [tail, wire, head], ids)
        world = sim.step(world)
        assert np.array_equal(world.ids.numpy(), ids)


def test_brians_brain() -> None:
    sim = simulator("brians_brain")
    ids = noise(sim, (2, 20, 30), seed=8)
    world = sim.world(ids)
    for _ in range(10):
        ids = np.select([ids == 1, ids == 2], [2, 0], (around(ids == 1) == 2).astype(int))
        world = sim.step(world)
        assert np.array_equal(world.ids.numpy(), ids)


def test_cyclic() -> None:
    sim = simulator("cyclic")
    ids = noise(sim, (2, 24, 18), seed=9).astype(int)
    world = sim.world(ids)
    for _ in range(20):
        eater = (ids + 1) % 6
        sides = [np.roll(ids, shift, (1, 2)) for shift in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        ids = np.where(np.any([side == eater for side in sides], axis=0), eater, ids)
        world = sim.step(world)
        assert np.array_equal(world.ids.numpy(), ids)


def test_langtons_ant() -> None:
    sim = simulator("langtons_ant")
    ids = np.zeros((1, 32, 40), np.uint8)
    ids[0, 16, 20] = 2
    world = sim.world(ids)
    black: Cells = set()
    (y, x), heading = (16, 20), 0
    for _ in range(6):
        for _ in range(50):
            heading = (heading + (3 if (y, x) in black else 1)) % 4
            black ^= {(y, x)}
            dy, dx = ((-1, 0), (0, 1), (1, 0), (0, -1))[heading]
            y, x = (y + dy) % 32, (x + dx) % 40
        world = sim.step(world, 50)
        assert (world.ids[0] == 2).nonzero().tolist() == [[y, x]]
        assert {(r, c) for r, c in (world.ids[0] == 1).nonzero().tolist()} == black - {(y, x)}
