"""Every stage of the schedule keeps what it means: each variable is compared with its node, on all shipped rules."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pytest

from powderdsl.compiler import load, lower
from powderdsl.ir.bits import plane_slots
from powderdsl.ir.gates import width
from powderdsl.ir.ops import PassGraph, Program
from powderdsl.ir.segments import segments
from powderdsl.schedule.barriers import Pending, barriers
from powderdsl.schedule.buffers import Pool, buffers
from powderdsl.schedule.stages import ARRAYS, CPP, CUDA, Stage, steps
from powderdsl.schedule.types import Schedule
from powderdsl.schedule.verify import verify
from tests.schedule.interpreter import World, run_graph, run_schedule

WORLDS = 4


def packed_passes(rules: str) -> Iterator[tuple[Program, PassGraph]]:
    for part in segments(lower(load(rules))):
        if part.planes is not None:
            for pass_ in part.planes.passes:
                yield part.program, pass_


def random_world(program: Program, pass_: PassGraph, seed: int) -> World:
    """Some worlds full of everything, some nearly empty, some without floats."""
    random = np.random.default_rng(seed)
    shape = tuple(random.integers(1, 9, 2))
    busy = (1.0, 0.3, 0.05, 1.0)[seed % 4]
    slots = {}
    for slot in program.slots:
        if slot.type.name == "real":
            value = random.normal(size=shape) * 3 * (random.random(shape) < busy) * (seed % 4 != 3)
            slots[slot.name] = value.astype(np.float32)
        elif slot.type.name == "flag":
            slots[slot.name] = random.random(shape) < busy / 2
        else:
            value = random.integers(slot.type.lo, slot.type.hi + 1, shape) * (random.random(shape) < busy)
            value = np.clip(value, slot.type.lo, slot.type.hi)
            for i in range(width(slot.type.lo, slot.type.hi)[0]):
                slots[f"{slot.name}:{i}"] = value >> i & 1 != 0
    draws = {name: random.integers(0, 1 << bits, shape) for name, _, bits in program.streams}
    params = {
        name: float(random.integers(0, 2)) if kind == "flag" else float(random.random())
        for name, kind in program.params
    }
    return World(shape, slots, params, draws, int(random.integers(0, 9)))


RULES = (
    *(
        "powderworld",
        "life",
        "brians_brain",
        "cyclic",
        "margolus",
        "wireworld",
        "langtons_ant",
        "forest_fire",
    ),
    *(
        f"core+water+fire+lava+docs/examples/{name}.yaml"
        for name in ("beetle", "electricity", "salt", "steam")
    ),
)


@pytest.mark.parametrize("stages", [ARRAYS, CUDA, CPP], ids=["arrays", "cuda", "cpp"])
@pytest.mark.parametrize("rules", RULES)
def test_every_stage(rules: str, stages: tuple[Stage, ...]) -> None:
    for program, pass_ in packed_passes(rules):
        worlds = [random_world(program, pass_, seed) for seed in range(WORLDS)]
        truths = [run_graph(pass_, world) for world in worlds]
        for stage, schedule in steps(pass_, stages):
            verify(schedule, stage)
            for world, truth in zip(worlds, truths, strict=True):
                compare(pass_, schedule, world, truth)


@pytest.mark.parametrize("in_place", [False, True])
@pytest.mark.parametrize("rules", RULES)
def test_buffers(rules: str, in_place: bool) -> None:
    """No variable is read after its buffer has been written over; values end in their slots' own buffers."""
    pool: Pool | None = None
    for program, pass_ in packed_passes(rules):
        planes = [plane for slot in program.slots for plane in plane_slots(slot)]
        kinds = {slot.name: "real" if slot.type.name == "real" else "flag" for slot in planes}
        homes = {name: [n for n in kinds if kinds[n] == kinds[name]].index(name) for name in kinds}
        own = {kind: sum(1 for one in kinds.values() if one == kind) for kind in ("flag", "real")}
        pool = pool or Pool(own, dict(own))
        *_, (_, schedule) = steps(pass_, CUDA)
        schedule = barriers(buffers(schedule, homes, pool, in_place=in_place), Pending())
        verify(schedule, "buffers")
        ends = dict(schedule.buffers)
        assert all(ends[node.attr][1] == homes[slot] for slot, node in schedule.leaves)
        for seed in range(WORLDS):
            world = random_world(program, pass_, seed)
            compare(pass_, schedule, world, run_graph(pass_, world))


def compare(pass_: PassGraph, schedule: Schedule, world: World, truth: Mapping[int, np.ndarray]) -> None:
    found = run_schedule(schedule, world, truth)
    assert found.keys() == dict(pass_.outputs).keys()
    for slot, node in pass_.outputs:
        expected = np.broadcast_to(truth[id(node)], world.shape)
        assert np.array_equal(found[slot], expected), (pass_.name, slot)
