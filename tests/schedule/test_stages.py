"""Every stage of the schedule keeps what it means: each variable is compared with its node, on all shipped rules."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pytest

from powderdsl.compiler import load, lower
from powderdsl.ir.bits import Segment, plane_slots, segments
from powderdsl.ir.ops import PassGraph, Program, plane_name
from powderdsl.model.state import slots as state_slots
from powderdsl.model.types import Ruleset
from powderdsl.schedule.lifetimes import Pending, Pool, assign_buffers, insert_barriers
from powderdsl.schedule.stages import CPU, CUDA, Stage, steps
from powderdsl.schedule.types import Schedule
from tests.fuzz.rulemaker import random_ruleset
from tests.schedule.interpreter import SNAP, World, run_graph, run_schedule
from tests.schedule.verify import verify
from tests.semantics.texts import load_text
from tests.tiers import tiered

WORLDS = 4


def packed_passes(rules: Ruleset) -> Iterator[tuple[Segment, PassGraph]]:
    for part in segments(lower(rules)):
        if part.planes is not None:
            for pass_ in part.planes.passes:
                yield part, pass_


def random_world(rules: Ruleset, program: Program, seed: int) -> World:
    """Some worlds full of everything, some nearly empty, some without floats; floats are clamped as stored ones are."""
    random = np.random.default_rng(seed)
    shape = tuple(random.integers(1, 9, 2))
    busy = (1.0, 0.3, 0.05, 1.0)[seed % 4]
    kinds = {slot.name: slot.kind for slot in state_slots(rules)}
    slots = {}
    for slot in program.slots:
        some = random.random(shape) < busy
        if slot.resets:  # what it can hold when a pass reads it is known to be less than its range
            some = np.zeros(shape, bool)
        if slot.type.name == "real":
            kind = kinds[slot.state or slot.name]
            value = (random.normal(size=shape) * 3 * some * (seed % 4 != 3)).astype(np.float32)
            value = np.clip(value, np.float32(kind.lo), np.float32(kind.hi))
            value = np.where(np.abs(value) < SNAP, np.float32(0), value)
            slots[slot.name] = np.full(shape, slot.default, np.float32) if slot.resets else value
        elif slot.type.name == "flag":
            found = random.random(shape) < busy / 2
            slots[slot.name] = np.full(shape, bool(slot.default)) if slot.resets else found
        else:
            value = random.integers(slot.type.lo, slot.type.hi + 1, shape) * some
            value = np.clip(value, slot.type.lo, slot.type.hi)
            value = np.full(shape, int(slot.default)) if slot.resets else value
            for i in range(slot.type.bits):
                slots[plane_name(slot.name, i)] = value >> i & 1 != 0
    draws = {name: random.integers(0, 1 << bits, shape) for name, _, bits in program.streams}
    params = {}
    for param in rules.params:
        low, high = (0, 1) if param.kind.name in ("flag", "chance") else (param.kind.lo, param.kind.hi)
        number = low + (high - low) * random.random()
        params[param.name] = float(round(number) if param.kind.name in ("flag", "int") else number)
    return World(shape, slots, params, draws, int(random.integers(0, 9)))


QUICK = ("life", "margolus", "langtons_ant", "forest_fire", "core+fire")
RULES = (
    *(*QUICK, "brians_brain", "cyclic", "wireworld", "powderworld"),
    *(
        f"core+water+fire+lava+docs/examples/{name}.yaml"
        for name in ("beetle", "electricity", "salt", "steam")
    ),
)

SEEDS = (0, 2, 3, 533, 5351)
"""The last two random rulesets found faults."""

both_pipelines = pytest.mark.parametrize("stages", [CPU, CUDA], ids=("cpu", "cuda"))


@both_pipelines
@pytest.mark.parametrize("rules", tiered(RULES, QUICK))
def test_every_stage_keeps_the_meaning_of_shipped_rules(rules: str, stages: tuple[Stage, ...]) -> None:
    run_stages(load(rules), stages)


@both_pipelines
@pytest.mark.parametrize("seeds", tiered([SEEDS, range(4, 600)], [SEEDS]), ids=("few", "many"))
def test_every_stage_keeps_the_meaning_of_random_rules(
    seeds: Sequence[int], stages: tuple[Stage, ...]
) -> None:
    for ruleset in filter(None, map(random_ruleset, seeds)):
        run_stages(ruleset, stages)


BEFORE_AND_AFTER = """
pack: marks
elements:
  ground: {id: 0, color: '#000000'}
  block: {id: 8, color: '#808080'}
passes:
  move:
    conflicts: first_wins
    let:
      was_free: here not in block
    do: block swaps right, with chance 0.5
    then:
      - block swaps below if was_free
"""


@both_pipelines
def test_a_mask_may_depend_on_a_cell_before_and_after_it_changed(stages: tuple[Stage, ...]) -> None:
    """`presence` took the element before a swap for that after it: no cell is a block and is not."""
    run_stages(load_text(BEFORE_AND_AFTER, "marks.yaml"), stages)


def run_stages(rules: Ruleset, stages: tuple[Stage, ...]) -> None:
    for part, pass_ in packed_passes(rules):
        worlds = [random_world(rules, part.program, seed) for seed in range(WORLDS)]
        truths = [run_graph(pass_, world) for world in worlds]
        for stage, schedule in steps(part.planes, pass_, stages):
            verify(schedule, stage)
            for world, truth in zip(worlds, truths, strict=True):
                compare(pass_, schedule, world, truth)


@pytest.mark.parametrize("in_place", [False, True])
@pytest.mark.parametrize("rules", tiered(RULES, QUICK))
def test_buffers_are_not_read_after_they_are_overwritten(rules: str, in_place: bool) -> None:
    """Values end in their slots' own buffers."""
    pool: Pool | None = None
    loaded = load(rules)
    for part, pass_ in packed_passes(loaded):
        planes = plane_slots(part.program.slots)
        kinds = {slot.name: "real" if slot.type.name == "real" else "flag" for slot in planes}
        homes = {name: [n for n in kinds if kinds[n] == kinds[name]].index(name) for name in kinds}
        own = {kind: sum(1 for one in kinds.values() if one == kind) for kind in ("flag", "real")}
        pool = pool or Pool(own, dict(own))
        *_, (_, schedule) = steps(part.planes, pass_, CUDA)
        schedule = insert_barriers(assign_buffers(schedule, homes, pool, in_place=in_place), Pending())
        verify(schedule, "buffers")
        ends = dict(schedule.buffers)
        assert all(ends[node.attr][1] == homes[slot] for slot, node in schedule.outputs)
        for seed in range(WORLDS):
            world = random_world(loaded, part.program, seed)
            compare(pass_, schedule, world, run_graph(pass_, world))


def compare(pass_: PassGraph, schedule: Schedule, world: World, truth: Mapping[int, np.ndarray]) -> None:
    found = run_schedule(schedule, world, truth)
    assert found.keys() == dict(pass_.outputs).keys()
    for slot, node in pass_.outputs:
        expected = np.broadcast_to(truth[id(node)], world.shape)
        assert np.array_equal(found[slot], expected), (pass_.name, slot)
