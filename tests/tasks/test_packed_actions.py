"""Actions on worlds that stay packed in native code do what they do to tensors."""

from __future__ import annotations

from dataclasses import replace

import pytest

from powderdsl.diagnostics import Reporter, Source
from powderdsl.envs.tensor_env import observation_of
from powderdsl.simulation.simulator import compile as compile_rules
from powderdsl.tasks.episodes import compile_task
from powderdsl.tasks.file import read_task
from powderdsl.tasks.tensors.actions import put_worlds, take_worlds

TASK = """task: packed
rules: powderworld
size: SIZE
fill: empty
generate:
  - repeat 6:
      - disk any at (0..63, 0..63) radius 3..15
agent: {may: [any, blow, nothing], speed: 20, actions: 12, steps_per_action: 2, bins: [5, 16], free_steps: 3}
reward: {each: painted + count(sand) + 100 * placed}
"""


@pytest.mark.parametrize(
    ("backend", "size", "each"),
    [
        ("native", "[64, 64]", "painted + count(sand) + 100 * placed"),
        ("native", "[20, 70]", "painted + count(sand)"),
        ("native", "[24, 70]", "count(sand) + 100 * placed + 10 * blown + left"),
        ("torch", "[20, 20]", "painted + count(sand)"),  # which reuses tensors
    ],
)
def test_packed_worlds_are_acted_on_observed_and_restarted_alike(torch, backend, size, each):
    """Few worlds are cut into strips in native code, many are not; 70 columns are more than one word."""
    text = TASK.replace("SIZE", size).replace("painted + count(sand) + 100 * placed", each)
    task = read_task(Source("packed.yaml", text), Reporter())
    native, plain = (compile_task(task, backend=name) for name in (backend, "wasm"))
    observations = [observation_of(kind, native) for kind in ("ids", "compact")]
    for batch, reuse in ((1, True), (3, False), (20, True), (20, False)):
        one, other = native.start(torch.arange(batch)), plain.start(torch.arange(batch))
        random = torch.Generator().manual_seed(batch)
        for turn in range(13):
            actions = torch.stack(
                [torch.randint(0, n, (batch,), generator=random) for n in native.action_nvec], 1
            )
            given = one
            before = {} if reuse else {name: value.clone() for name, value in one.world.state.items()}
            one, reward, _, over = native.act(one, actions, reuse=reuse)
            other, expected, _, also = plain.act(other, actions)
            assert torch.equal(reward, expected)
            assert torch.equal(over, also)
            if turn < 2:  # what is never restarted ends
                seeds, mask = torch.arange(batch) + 100 * turn, torch.arange(batch) % 3 == turn
                acted, kept = one, one.world.state["element"].clone()
                one = native.restart(one, mask, seeds, reuse=reuse)
                other = plain.restart(other, mask, seeds)
                assert reuse or torch.equal(native.simulator.step(acted.world, 0).ids, kept)
            assert one.world.step.tolist() == other.world.step.tolist()
            for observation in observations:
                assert torch.equal(observation.of(one), observation.of(other))
            for name, value in other.world.state.items():
                assert torch.equal(one.world.state[name], value), name
            for name, value in before.items():
                fresh = native.simulator.step(given.world, 0).state[name]  # unpacked again
                assert torch.equal(fresh, value), name


MEASURES = """task: measured
rules: powderworld
size: SIZE
fill: empty
regions:
  west: box columns :21
  pit: box rows 9:17 columns 3:69
  blob: disk at (10, 40) radius 7
  drawn: box rows 4..6:9 columns :33
targets:
  aim:
    - disk sand at (10, 10..60) radius 9
generate:
  - repeat 9:
      - disk any at (0..19, 0..69) radius 2..6
agent: {may: [blow], actions: 3, speed: 9}
reward: {each: EACH}
"""


@pytest.mark.parametrize("size", ["[24, 70]", "[17, 70]"])
@pytest.mark.parametrize(
    ("each", "on_planes"),
    [
        ("count(sand) + 2 * count(not empty in west) - share(density > 1 or gas in pit)", True),
        (
            "highest(sand) + highest(water or fire in pit) / share(empty) + count(wall in blob and not (west))",
            True,
        ),
        ("count(not empty in drawn)", True),
        ("share(sand in west) + share(water in drawn) + highest(not empty in drawn)", True),
        ("sum(density in drawn) + mean(density - 2) + match(aim)", True),
        ("count(count(sand) > 2)", False),
        ("sum(velocity.column) + count(sand)", False),
        ("sum(row mod 32 if sand else 0) + count(sand)", False),
    ],
)
def test_packed_worlds_are_measured_alike(torch, size, each, on_planes):
    """In strips (few worlds of 24 rows) and side by side, in words that are not full."""
    text = MEASURES.replace("SIZE", size).replace("EACH", each)
    program = compile_task(read_task(Source("measured.yaml", text), Reporter()), backend="native")
    for batch in (1, 20):
        episodes = program.start(torch.arange(batch))
        for steps in (0, 3):
            world = program.simulator.step(episodes.world, steps)
            found = program.measured(replace(episodes, world=world))
            plain = replace(world, state={name: value.clone() for name, value in world.state.items()})
            wanted = program.measured(replace(episodes, world=plain))
            assert torch.equal(found, wanted)
            assert batch < 20 or found.any()
            unpacked = program.simulator.step(episodes.world, steps).state
            program.measured(replace(episodes, world=replace(world, state=unpacked)))
            assert any(unpacked.has(name) for name in unpacked) is not on_planes


def test_spent_worlds_are_refused(torch):
    native = compile_rules("core+sand", "native")
    ids = torch.zeros(2, 16, 16, dtype=torch.uint8)
    world = native.step(native.world(ids), 1)
    after = native.step(world, 1, reuse=True)
    assert torch.equal(after.ids, ids)
    for read in (lambda: world.ids, lambda: native.step(world), world.rgb):
        with pytest.raises(RuntimeError, match="reuse"):
            read()


@pytest.mark.parametrize("size", ["[32, 32]", "[64, 64]", "[24, 70]", "[9, 19]"])
def test_packed_worlds_are_taken_and_put_without_unpacking(torch, size):
    task = read_task(Source("packed.yaml", TASK.replace("SIZE", size)), Reporter())
    program = compile_task(task, backend="native")
    for batch in (3, 40):
        world = program.simulator.step(program.start(torch.arange(batch)).world, 2)
        cells, places = dict(world.state.items()), torch.tensor([2, 0])
        part = take_worlds(world, places)
        assert part.step.tolist() == world.step[places].tolist()
        for name, value in cells.items():
            assert torch.equal(part.state[name], value[places]), name
        after = put_worlds(world, places.flip(0), part, reuse=False)
        for name, value in cells.items():
            value[[0, 2]] = value[[2, 0]]
            assert torch.equal(after.state[name], value), name
