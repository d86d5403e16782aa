"""The replay buffer: its pairs are those of worlds stepped by hand, whatever way it came about."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from powderdsl.simulation.simulator import compile as compile_rules
from powderdsl.tasks.episodes import compile_task
from powderdsl.worldmodel import DataConfig, Replay, TaskWorlds, unseen_seeds
from powderdsl.worldmodel.config import TEST_SEEDS


def worlds_of(config: DataConfig) -> TaskWorlds:
    return TaskWorlds(config, backend="torch")


def by_hand(task: str, seed: int, config: DataConfig) -> list[tuple[Tensor, Tensor]]:
    """The pairs of one world, alone, one step at a time."""
    program = compile_task(task, backend="torch")
    ids = program.start(torch.tensor([seed])).world.ids
    sim = compile_rules(program.task.ruleset, backend="torch")
    world, found = sim.world(ids, seed=[seed]), []
    for _ in range(config.pairs):
        start = world.ids[0].clone()
        for _ in range(config.steps):
            world = sim.step(world)
        found.append((start, world.ids[0].clone()))
    return found


def pairs_in(replay: Replay) -> list[bytes]:
    """Every pair as bytes, sorted."""
    both = torch.stack([replay.starts, replay.ends], 1)
    return sorted(pair.numpy().tobytes() for pair in both)


def as_bytes(pairs: list[tuple[Tensor, Tensor]]) -> list[bytes]:
    return sorted(torch.stack(pair).numpy().tobytes() for pair in pairs)


def test_n_states_are_exactly_those_worlds_and_each_goes_on_in_time(dunes: str) -> None:
    config = DataConfig(task=dunes, states=3, steps=2, pairs=4, capacity=100, refresh=5)
    replay = Replay(worlds_of(config), config, seed=9)
    replay.advance_to(0)
    expected = as_bytes([pair for seed in range(3) for pair in by_hand(dunes, seed, config)])
    assert replay.size == 12
    assert pairs_in(replay) == expected
    for _ in range(6):  # more iterations bring nothing else
        replay.advance()
    assert pairs_in(replay) == expected
    drawn = {
        torch.stack(pair).numpy().tobytes()
        for iteration in range(40)
        for pair in zip(*replay.batch(iteration, 8), strict=True)
    }
    assert sorted(drawn) == sorted(set(expected))


def test_the_oldest_pairs_give_way_to_the_next_worlds(dunes: str) -> None:
    config = DataConfig(task=dunes, states=1000, steps=2, pairs=4, capacity=24, refresh=3)
    replay = Replay(worlds_of(config), config, seed=4)
    replay.advance_to(0)
    seed = replay._first
    assert 0 < seed < 1000
    worlds = [by_hand(dunes, (seed + number) % 1000, config) for number in range(12)]
    stream = [pair for world in worlds[:6] for pair in world]
    # Two turns of three worlds: each iteration brings one pair of each.
    stream += [world[moment] for turn in (worlds[6:9], worlds[9:12]) for moment in range(4) for world in turn]
    for iteration in range(8):
        assert pairs_in(replay) == as_bytes(stream[3 * iteration : 3 * iteration + 24]), iteration
        replay.advance()


@pytest.mark.parametrize(("capacity", "refresh"), [(24, 3), (10, 3), (7, 20), (64, 1)])
def test_any_iteration_can_be_gone_to(dunes: str, capacity: int, refresh: int) -> None:
    config = DataConfig(task=dunes, states=500, steps=1, pairs=4, capacity=capacity, refresh=refresh)
    worlds = worlds_of(config)
    walked = Replay(worlds, config, seed=1)
    walked.advance_to(0)
    for iteration in range(31):
        if iteration in (1, 5, 8, 19, 30):
            jumped = Replay(worlds, config, seed=1)
            jumped.advance_to(iteration)
            assert torch.equal(jumped.starts, walked.starts), iteration
            assert torch.equal(jumped.ends, walked.ends), iteration
            jumped.advance()
            walked.advance()
            assert torch.equal(jumped.ends, walked.ends), iteration
        else:
            walked.advance()


def test_disk_holds_what_memory_holds(dunes: str, tmp_path: Path) -> None:
    config = DataConfig(task=dunes, states=500, steps=1, pairs=4, capacity=20, refresh=3)
    worlds = worlds_of(config)
    memory = Replay(worlds, config, store="memory")
    disk = Replay(worlds, config, store="disk", folder=tmp_path)
    for replay in (memory, disk):
        replay.advance_to(3)
        replay.advance()
    assert torch.equal(memory.starts, disk.starts)
    assert torch.equal(memory.ends, disk.ends)
    assert all(torch.equal(a, b) for a, b in zip(memory.batch(3, 7), disk.batch(3, 7), strict=True))
    assert not list(tmp_path.glob("replay-*"))  # a killed process would leave them


def test_batches_depend_on_seed_and_iteration_alone(dunes: str) -> None:
    config = DataConfig(task=dunes, states=50, steps=1, pairs=4, capacity=200)
    worlds = worlds_of(config)
    one, other = Replay(worlds, config, seed=1), Replay(worlds, config, seed=2)
    one.advance_to(0)
    other.advance_to(0)
    assert torch.equal(one.batch(7, 32)[0], one.batch(7, 32)[0])
    assert not torch.equal(one.batch(7, 32)[0], one.batch(8, 32)[0])
    assert not torch.equal(one.batch(7, 32)[0], other.batch(7, 32)[0])
    assert not torch.equal(one.batch(7, 32)[0], one.batch(7 + (1 << 32), 32)[0])


def test_worlds_for_tests_are_no_worlds_of_training(dunes: str) -> None:
    seeds = unseen_seeds(3, 8)
    assert len(set(seeds.tolist())) == 24
    assert int(seeds.min()) >= TEST_SEEDS
    assert (seeds.view(8, 3) % 8 == torch.arange(8)[:, None]).all()
    with pytest.raises(ValueError, match="`states` must be an integer from 1 to 4,294,967,296"):
        DataConfig(task=dunes, states=TEST_SEEDS + 1)
