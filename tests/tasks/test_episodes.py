"""Acting on tasks: what actions do, what rewards count, when episodes end; against slow NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from powderdsl.compiler import load
from powderdsl.diagnostics import Reporter, Source
from powderdsl.simulation.simulator import compile as compile_rules
from powderdsl.tasks.episodes import ACTION, TaskProgram, check_numbers, compile_task
from powderdsl.tasks.file import read_task

HEAD = "task: test\nrules: powderworld\nsize: [64, 64]\nfill: empty\n"
NOISE = "generate:\n" + "".join(
    f"  - repeat 5:\n      - {name} any at (0..63, 0..63) {word} 3..12\n"
    for name, word in (("disk", "radius"), ("square", "half"))
)


def task_of(text: str):
    """A task without a mistake."""
    reporter = Reporter()
    task = read_task(Source("test.yaml", text), reporter)
    assert [one.code for one in reporter.diagnostics] == []
    return task


@pytest.fixture(scope="module")
def program_of():
    """Programs of tasks on one simulator: they all have the same rules."""
    simulator = compile_rules(load("powderworld"), "wasm")
    return lambda text: TaskProgram(task_of(HEAD + text), "train", simulator)


# What actions do


def test_blowing_sets_the_speed_in_a_block_of_ten(torch, program_of):
    program = program_of(NOISE + "agent: {may: blow, speed: 20, actions: 9, steps_per_action: 0}\n")
    assert program.action_nvec == (16, 16, 1, 3, 3)
    episodes = program.start(torch.arange(4))
    actions = torch.tensor([[3, 8, 0, 2, 1], [0, 15, 0, 0, 2], [15, 0, 0, 1, 1], [7, 7, 0, 1, 0]])
    after, *_ = program.act(episodes, actions)
    expected = np.zeros((4, 2, 64, 64), dtype=np.float32)
    for number, (x, y, _, vx, vy) in enumerate(actions.tolist()):
        row, column = 4 * y + 2, 4 * x + 2  # the middle of a bin of four cells
        rows, columns = slice(max(row - 5, 0), row + 5), slice(max(column - 5, 0), column + 5)
        expected[number, 0, rows, columns] = 20 * (vy - 1)
        expected[number, 1, rows, columns] = 20 * (vx - 1)
    assert np.array_equal(after.world["velocity"], expected)
    assert torch.equal(after.world.ids, episodes.world.ids)
    assert not episodes.world["velocity"].any()  # what was given stays as it was


def test_an_element_fills_the_block_with_fresh_cells(torch, program_of):
    agent = "agent: {may: [any, blow, nothing], speed: 7, actions: 9, steps_per_action: 0}\n"
    program = program_of(NOISE + agent + "reward: {each: painted + 1000 * placed + 10000 * blown}\n")
    assert program.action_nvec == (16, 16, 16, 3, 3)
    assert program.task.agent.choices == (*range(14), -1, -2)
    episodes = program.start(torch.arange(6))
    old = program.simulator.step(episodes.world, 3)  # cells that have moved, and hold more than an element
    actions = torch.tensor(
        [
            [15, 1, 2, 0, 0],
            [0, 0, 13, 2, 2],
            [5, 9, 14, 0, 2],
            [5, 9, 15, 0, 2],
            [2, 2, 0, 1, 1],
            [9, 3, 10, 1, 1],
        ]
    )
    after, reward, *_ = program.act(replace(episodes, world=old), actions)
    where = torch.zeros(6, 64, 64, dtype=torch.bool)
    slow = old
    for number, (x, y, choice, _, _) in enumerate(actions.tolist()):
        where.zero_()[number, max(4 * y - 3, 0) : 4 * y + 7, max(4 * x - 3, 0) : 4 * x + 7] = True
        if choice < 14:
            slow = program.simulator.paint(slow, where=where, element=program.simulator.elements[choice])
        elif choice == 14:
            slow = program.simulator.paint(
                slow, where=where, velocity=torch.tensor([7.0, -7.0])[None, :, None, None]
            )
    for name, value in slow.state.items():
        assert torch.equal(after.world.state[name], value), name
    changed = (slow.ids != old.ids).sum((1, 2))
    assert reward.tolist() == [
        float(n) + b for n, b in zip(changed, (1000, 1000, 10000, 0, 1000, 1000), strict=True)
    ]


def test_invalid_actions_are_refused(torch, program_of):
    program = program_of("agent: {may: [wall, empty], actions: 9, bins: [4, 8]}\n")
    nvec = program.action_nvec
    assert nvec == (8, 4, 2, 3, 3)
    good = np.array([[7, 3, 1, 2, 2], [0, 0, 0, 0, 0]])
    assert check_numbers(good, nvec, ACTION).dtype == torch.int64
    for place, value, name in ((0, 8, "x"), (1, 4, "y"), (2, 2, "choice"), (3, 3, "vx"), (4, -1, "vy")):
        bad = good.copy()
        bad[1, place] = value
        with pytest.raises(
            ValueError, match=rf"actions\[1, {place}\] \({name}\) is {value}: it must be in 0\.\."
        ):
            check_numbers(bad, nvec, ACTION)
    for wrong in (good[0], good[:, :4], good[None]):
        with pytest.raises(ValueError, match="shape"):
            check_numbers(wrong, nvec, ACTION)
    for wrong in (good * 1.0, np.full((2, 5), np.nan), good > 0, "left", [[1, 2, 3, 4, None]]):
        with pytest.raises(TypeError, match="actions"):
            check_numbers(wrong, nvec, ACTION)


# What counts


REWARDS = """
knobs: {scale: {default: 150, range: 1..1000}}
regions:
  slot: box rows 22:42 columns 54:63
  moving: box rows at_row:at_row+20
  two:
    - disk at (20, 20) radius 9
    - box columns 60:end
let: {at_row: 0..40}
targets:
  wanted:
    - fill stone in slot
    - disk sand at (at_row, 9) radius 12
"""

EXPRESSIONS = {
    "count(sand in slot) / scale": lambda v: v.count(v.ids == 2, "slot") / 150,
    "count(empty)": lambda v: v.count(v.ids == 0),
    "count((sand, water) in moving)": lambda v: v.count((v.ids == 2) | (v.ids == 3), "moving"),
    "share(sand or gas)": lambda v: v.count((v.ids == 2) | (v.ids == 4)) / 4096,
    "share((water, gas, lava) in two)": lambda v: v.count(np.isin(v.ids, [3, 4, 10]), "two") / v.regions["two"].sum(),
    "sum(momentum in moving)": lambda v: (v.state["momentum"].astype(int) * v.regions["moving"]).sum(),
    "mean(velocity.row in slot)": lambda v: v.state["velocity"][0][v.regions["slot"]].astype(float).mean(),
    "count((density >= 3 and not sand) in moving)": lambda v: v.count((v.density >= 3) & (v.ids != 2), "moving"),
    "mean(density)": lambda v: v.density.mean(),
    "count(sand not in slot)": lambda v: ((v.ids == 2) & ~v.regions["slot"]).sum(),
    "count(sand and slot) + count(water and (moving or slot))": lambda v: v.count(v.ids == 2, "slot")
    + ((v.ids == 3) & (v.regions["moving"] | v.regions["slot"])).sum(),
    "count(wood and below is empty)": lambda v: ((v.ids == 5) & (np.roll(v.ids, -1, 0) == 0)).sum(),
    "count((count(sand) >= 4) in two)": lambda v: v.count(neighbors(v.ids == 2) >= 4, "two"),
    "highest(sand)": lambda v: highest(v.ids == 2),
    "highest(sand in slot)": lambda v: highest((v.ids == 2) & v.regions["slot"]),
    "match(wanted)": lambda v: (v.ids == v.target)[v.target != 255].mean(),
    "count(sand) - start(count(sand)) * 2": lambda v: v.count(v.ids == 2) - 2 * (v.start == 2).sum(),
    "change(count(gas))": lambda v: float((v.ids == 4).sum()) - (v.before == 4).sum(),
    "1 if count(lava) > count(ice) else -1": lambda v: 1 if (v.ids == 10).sum() > (v.ids == 6).sum() else -1,
    "min(count(sand), count(gas), 300)": lambda v: min((v.ids == 2).sum(), (v.ids == 4).sum(), 300),
    "min(count(sand), 9) + max(-3, -taken) + abs(left - 60)": lambda v: min((v.ids == 2).sum(), 9) - v.taken + abs(4 - v.taken),
    "(count(sand) mod 7) / max(0, taken - 99) + 2 * -taken": lambda v: -2 * v.taken,
    "(3 - taken) div 2 + taken div 0": lambda v: (3 - v.taken) // 2,
    "1 if 1 <= taken < 3 and not (count(sand) == count(sand) + 1) or no else 5": lambda v: 1 if v.taken < 3 else 5,
}  # fmt: skip


class View:
    """One world as NumPy sees it."""

    def __init__(self, episodes, number: int, start: np.ndarray, before: np.ndarray):
        self.state = {name: value[number].numpy() for name, value in episodes.world.state.items()}
        self.ids = self.state["element"]
        self.regions = {name: value[number % len(value)].numpy() for name, value in episodes.regions.items()}
        values = episodes.world.sim.ruleset.property("density").values
        self.density = np.array([int(value) for value in values])[self.ids]
        self.target = episodes.targets["wanted"][number].numpy()
        self.start, self.before, self.taken = start[number], before[number], int(episodes.acted[number])

    def count(self, cells: np.ndarray, region: str | None = None) -> float:
        return float((cells & self.regions[region]).sum() if region else cells.sum())


def neighbors(cells: np.ndarray) -> np.ndarray:
    """How many of the eight cells around, and the cell itself, hold; nothing lies outside the grid."""
    padded = np.pad(cells.astype(int), 1)
    return sum(padded[1 + y : 65 + y, 1 + x : 65 + x] for y in (-1, 0, 1) for x in (-1, 0, 1))


def highest(cells: np.ndarray) -> int:
    rows = np.nonzero(cells.any(1))[0]
    return int(64 - rows[0]) if len(rows) else 0


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_rewards_against_a_slow_count(torch, program_of, expression):
    agent = "agent: {may: [any, blow], speed: 20, actions: 64, steps_per_action: 2}\n"
    program = program_of(REWARDS + NOISE + agent + f"reward:\n  each: {expression}\n")
    episodes = program.start(torch.arange(5))
    start = before = episodes.world.ids.numpy()
    random = torch.Generator().manual_seed(5)
    for _ in range(3):
        actions = torch.stack([torch.randint(0, n, (5,), generator=random) for n in program.action_nvec], 1)
        episodes, reward, success, over = program.act(episodes, actions)
        wanted = [EXPRESSIONS[expression](View(episodes, i, start, before)) for i in range(5)]
        assert reward.dtype == torch.float32
        assert np.allclose(reward.numpy(), np.array(wanted, dtype=np.float64), rtol=1e-6, atol=1e-6)
        assert not success.any()
        assert not over.any()
        before = episodes.world.ids.numpy()


# When episodes end


def test_the_last_action_is_over_and_free_steps_run_in_it(torch, program_of):
    agent = "agent: {may: [sand], actions: 3, steps_per_action: 2, free_steps: 5}\n"
    program = program_of(f"{NOISE}{agent}reward: {{each: taken, final: 100 + 0 * taken}}\n")
    episodes = program.start(torch.arange(4))
    mask = torch.tensor([True, False, True, False])
    actions = torch.tensor([[3, 4, 0, 1, 1]]).expand(4, 5)
    episodes, reward, _, over = program.act(episodes, actions)
    assert (reward.tolist(), over.tolist()) == ([1.0] * 4, [False] * 4)
    episodes = program.restart(episodes, mask, torch.arange(4) + 10)
    episodes, _, _, over = program.act(episodes, actions)
    before = episodes
    episodes, reward, success, over = program.act(episodes, actions)
    assert over.tolist() == [False, True, False, True]
    assert reward.tolist() == [2.0, 103.0, 2.0, 103.0]
    assert not success.any()
    assert episodes.acted.tolist() == [2, 3, 2, 3]
    assert episodes.world.step.tolist() == [4, 11, 4, 11]
    done, _ = program.hands.act(before.world, actions, reuse=False)
    short, long = program.simulator.step(done, 2), program.simulator.step(done, 7)
    for name, value in episodes.world.state.items():
        for world in range(4):
            assert torch.equal(value[world], (long if over[world] else short).state[name][world]), name


def test_conditions_end_an_episode(torch, program_of):
    text = "agent: {may: [sand, water, empty], actions: 9, steps_per_action: 0}\nreward: {each: 1 + 0 * taken, final: 10 + 0 * taken}\n"
    text += "end: {success: count(sand) > 50, failure: count(water) > 50}\n"
    program = program_of(text)
    choices = program.task.agent.choices
    assert choices == (0, 2, 3)
    episodes = program.start(torch.arange(3))
    actions = torch.tensor([[3, 4, choice, 1, 1] for choice in (0, 1, 2)])
    episodes, reward, success, over = program.act(episodes, actions)
    assert success.tolist() == [False, True, False]
    assert episodes.failed.tolist() == [False, False, True]
    assert over.tolist() == [False, True, True]
    assert reward.tolist() == [1.0, 11.0, 11.0]


def test_restart_touches_the_masked_worlds_only(torch):
    program = compile_task("sand-pushing", backend="wasm")
    episodes = program.start(torch.arange(5))
    for _ in range(2):
        episodes, *_ = program.act(episodes, torch.tensor([[3, 4, 0, 2, 1]]).expand(5, 5))
    seeds = torch.tensor([90, 91, 92, 93, 94])
    mask = torch.tensor([False, True, False, False, True])
    after = program.restart(episodes, mask, seeds)
    new = program.start(seeds)
    for name, value in episodes.world.state.items():
        assert torch.equal(
            after.world.state[name],
            torch.where(mask.view(-1, *[1] * (value.ndim - 1)), new.world.state[name], value),
        )
    assert after.seed.tolist() == [0, 91, 2, 3, 94]
    assert after.world.seed.tolist() == [0, 91, 2, 3, 94]
    assert after.world.step.tolist() == [2, 0, 2, 2, 0]
    assert after.acted.tolist() == [2, 0, 2, 2, 0]
    nothing = program.restart(episodes, torch.zeros(5, dtype=torch.bool), seeds)
    assert nothing is episodes


def test_stands_follow_their_seeds(torch):
    program = compile_task("sand-pushing", split="handmade", backend="wasm")
    episodes = program.start(torch.arange(20))
    assert torch.equal(episodes.world.ids[:8], episodes.world.ids[8:16])
    assert len({one.numpy().tobytes() for one in episodes.world.ids}) == 8
    assert torch.equal(program.start(torch.tensor([11])).world.ids[0], episodes.world.ids[3])


def test_a_start_is_what_the_simulator_makes_of_its_ids(torch):
    program = compile_task("destroying", backend="wasm")
    episodes = program.start(torch.tensor([5, 9, 2**40]))
    world = program.simulator.world(episodes.world.ids, seed=[5, 9, 2**40])
    for name, value in world.state.items():
        assert torch.equal(value, episodes.world.state[name]), name
        assert value.dtype == episodes.world.state[name].dtype
    for name in ("seed", "index", "step"):
        assert torch.equal(getattr(world, name), getattr(episodes.world, name))


def test_without_actions_every_step_is_reported(torch, program_of):
    text = NOISE + "agent: {may: [sand, blow], speed: 20, actions: 2, steps_per_action: 3, free_steps: 2}\n"
    program = program_of(text + "reward: {each: painted + placed + blown, final: taken}\n")
    episodes = program.start(torch.arange(2))
    seen = []
    after, reward, _, _ = program.act(episodes, None, seen=seen.append)
    assert reward.tolist() == [0, 0]
    alone = program.simulator.step(episodes.world, 3)
    assert torch.equal(seen[0].ids, episodes.world.ids)
    assert torch.equal(seen[-1].ids, alone.ids)
    assert torch.equal(after.world["velocity"], alone["velocity"])
    assert len(seen) == 4
    action = torch.tensor([[3, 8, 0, 2, 1], [0, 15, 1, 0, 2]])
    shown, fast = (program.act(after, action, seen=one)[0] for one in (seen.append, None))
    assert torch.equal(shown.world.ids, fast.world.ids)
    assert len(seen) == 4 + 1 + 3 + 2
    assert torch.equal(seen[-1].ids, fast.world.ids)
