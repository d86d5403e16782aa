"""Worlds to measure with, made from a ruleset's tables alone: no element has a name here."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from powderdsl.experiments.bench.plan import Cell
from powderdsl.model.types import Field, Ruleset
from powderdsl.worlds.raster import mask
from powderdsl.worlds.strewn import random_shape

if TYPE_CHECKING:
    from powderdsl.simulation.simulator import Simulator, World

SHAPES, GUSTS = 26, 4
"""In 64×64 cells; larger worlds have more, so that a cell has as much to do."""
PER_CELLS = 64 * 64
REACH = 7
"""Of the shapes. They cover about a quarter of the world."""
GUST_SIDE, GUST_SPEED = 10, 20.0
NOISE = 3.0
"""Standard deviation of noisy floats."""


def start_worlds(sim: Simulator, cell: Cell, workload: str, seed: int) -> World:
    """The worlds of a cell: world i depends on `seed`, its size and i alone."""
    random = [np.random.default_rng([seed, index]) for index in range(cell.batch)]
    ids = np.stack([_ids(sim.ruleset, cell, workload, one) for one in random])
    fields = {
        field.name: np.stack([_field(field, cell, workload, one) for one in random])
        for field in _fields(sim.ruleset, workload)
    }
    return sim.replace(sim.world(ids, seed=seed), **fields)


def _ids(ruleset: Ruleset, cell: Cell, workload: str, random: np.random.Generator) -> NDArray[np.uint8]:
    """One world: uint8 [H, W]."""
    found = [ruleset.element(name) for name in cell.elements]
    ids = [element.id for element in found if element is not None]
    if workload == "noise":
        return random.choice(np.array(ids, dtype=np.uint8), cell.size)
    ground = ruleset.elements[0].id
    world = np.full(cell.size, ground, dtype=np.uint8)
    others = [number for number in ids if number != ground]
    for i in range(_many(SHAPES, cell) if others else 0):
        world[mask(random_shape(random, cell.size, REACH), cell.size)] = others[i % len(others)]
    return world


def _fields(ruleset: Ruleset, workload: str) -> list[Field]:
    """The fields that do not start at their default."""
    lasting = [field for field in ruleset.fields if not field.resets and field.of is None]
    if workload == "noise":
        return [field for field in lasting if field.kind.name in ("real", "vec2")]
    if workload == "gusts":
        return [field for field in lasting if field.kind.name == "vec2" and field.at == "place"]
    return []


def _field(field: Field, cell: Cell, workload: str, random: np.random.Generator) -> NDArray[np.float32]:
    """A field of one world: float32 [H, W], or [2, H, W] of a vector."""
    shape = (2, *cell.size) if field.kind.name == "vec2" else cell.size
    if workload == "noise":
        values = NOISE * random.standard_normal(shape, dtype=np.float32)
    else:
        values = np.zeros(shape, dtype=np.float32)
        for _ in range(_many(GUSTS, cell)):
            top, left = (int(random.integers(max(side - GUST_SIDE, 1))) for side in cell.size)
            speed = GUST_SPEED * random.integers(-1, 2, 2)
            values[:, top : top + GUST_SIDE, left : left + GUST_SIDE] = speed[:, None, None]
    bounded = field.kind.hi > field.kind.lo
    return np.clip(values, field.kind.lo, field.kind.hi) if bounded else values


def _many(count: int, cell: Cell) -> int:
    return max(1, round(count * cell.world_cells / PER_CELLS))
