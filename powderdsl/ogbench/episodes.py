"""The executable worlds of a level, and batches of its episodes: stages, invalid actions, goals and success.

Environments wrap this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray
from torch import Tensor

from powderdsl.compiler import load, lower
from powderdsl.diagnostics import with_suggestion
from powderdsl.model.types import Ruleset
from powderdsl.ogbench.compiled import INVALID, CompiledSteps
from powderdsl.ogbench.levels import GoalTask, Level, read_task
from powderdsl.simulation.draw import palette
from powderdsl.simulation.programs import BackendProgram
from powderdsl.simulation.simulator import Simulator, World, compile
from powderdsl.system.random import MASK, base_keys, mix, name_number
from powderdsl.targets.cpp.program import PackedState
from powderdsl.targets.torch.program import TorchProgram
from powderdsl.tasks.compiled import ReusedArray
from powderdsl.tasks.tensors.actions import Blocks, put_rows, put_worlds, take_worlds

Numbers = NDArray[np.int64]


class _WithoutSnap(Simulator):
    """A simulator on torch that does not flush small floats to zero."""

    def __init__(self, ruleset: Ruleset, device: str | torch.device):
        super().__init__(ruleset, "torch", device)
        self._program = BackendProgram("torch", TorchProgram(lower(ruleset), self.device, snap=0.0))


class LevelProgram:
    """The worlds of a level on one backend and device.

    Args:
        level: from `find_level`.
        backend, device, threads: those of `powderdsl.compile`.
        as_ogbench: round as OGBench does, on the backend ``torch``: use the level's `rounded` rules and 32-bit draws,
            and do not flush small floats to zero.
    """

    def __init__(
        self,
        level: Level,
        *,
        backend: str = "auto",
        device: str | torch.device = "cpu",
        threads: int = 1,
        as_ogbench: bool = False,
    ):
        self.level = level
        if as_ogbench:
            ruleset = load(level.rounded)
            ruleset = replace(ruleset, streams=tuple(replace(stream, bits=32) for stream in ruleset.streams))
            self.simulator: Simulator = _WithoutSnap(ruleset, device)
        else:
            ruleset = load(level.rules)
            self.simulator = compile(ruleset, backend, str(device), threads)
        self.device = self.simulator.device
        self.streams = tuple(stream.name for stream in ruleset.streams)
        self.ids = np.array([_number(ruleset, name) for name in level.elements], dtype=np.int64)
        """The ids of the elements that agents paint, in the order of actions."""
        fill, frame = _number(ruleset, level.fill), _number(ruleset, level.frame)
        start = torch.full((level.side, level.side), fill, dtype=torch.uint8, device=self.device)
        start[0], start[-1], start[:, 0], start[:, -1] = frame, frame, frame, frame
        self._start = start
        first = torch.arange(level.places, device=self.device) * level.grid
        edges = torch.stack([first, first + level.brush], 1).clamp(1, level.side - 1)
        self.blocks = Blocks(self.simulator, (level.side, level.side), (edges, edges))
        """The blocks of all positions, without the frame."""
        self._covers = (edges[:, 1] > edges[:, 0]).cpu().numpy()
        self.paints = torch.from_numpy(palette(ruleset.elements)[self.ids, :3]).to(self.device)
        """The colors of the elements that agents paint: uint8 [n, 3]."""
        line, begins = np.arange(level.side), first.cpu().numpy()[:, None]
        inside = (line >= begins) & (line < begins + level.brush)
        # Rows of frames, uint8 [n + 1, 6 W], after one for what is not chosen yet: 255 where an x is lit; colors.
        self.lit = np.repeat(np.vstack([line >= 0, inside]) * np.uint8(255), 6, 1)
        self.colors = np.tile(np.pad(self.paints.cpu().numpy(), ((1, 0), (3, 0))), level.side)

    def start(self, seeds: Numbers, indices: Numbers) -> World:
        """New worlds. Their draws depend on seed and index, int64 [B] of at least 0 each."""
        ids = self._start.repeat(len(seeds), 1, 1)
        return self.simulator.world(ids, torch.from_numpy(seeds), index=torch.from_numpy(indices))

    def act(self, world: World, painted: Numbers, planes: NDArray[np.float64] | None = None) -> World:
        """Run one step of the rules, then paint a block in each world, except on the frame.

        The memory of `world`, which must not be used afterwards, is overwritten.

        Args:
            painted: int64 [B, 3]: the index of the element, x and y.
            planes: [streams, B, H, W] in [0, 1): draws to use instead of random numbers, in the order of the rules'
                streams.
        """
        draws: Mapping[str, Any] | None = None
        if planes is not None:
            draws = dict(zip(self.streams, planes, strict=True))
        stepped = self.simulator.step(world, random=draws, reuse=True)
        element, x, y = painted.T
        where: Any = self._covers[x] & self._covers[y]
        ids: Any = self.ids[element]
        if not isinstance(stepped.state, PackedState):
            ids, x, y, where = (torch.from_numpy(part).to(self.device) for part in (ids, x, y, where))
        values = self.blocks.fresh_cells(stepped.state, ids)
        cells = self.blocks.cells(stepped.state, y, x)
        return stepped.with_state(self.blocks.filled(stepped.state, cells, where, values, reuse=True))

    def frames(self, stage: Numbers, element: Numbers, x: Numbers) -> NDArray[np.uint8]:
        """A line of each action frame, as observations have it: uint8 [B, 1, 6 W]. All are int64 [B]."""
        colors = self.colors.take((1 + element) * (stage > 0), 0)
        return (colors & self.lit.take((1 + x) * (stage > 1), 0))[:, None]

    def errors(self, ids: Tensor, goals: Tensor) -> Numbers:
        """Number of cells of goals, uint8 [B, H, W], without their element there or next to it in `ids`: int64 [B]."""
        matched = ids == goals
        for axis in (1, 2):
            for by in (1, -1):
                matched |= ids.roll(by, axis) == goals
        counts: Numbers = (~matched).sum((1, 2)).cpu().numpy()
        return counts


def _number(ruleset: Ruleset, name: str) -> int:
    element = ruleset.element(name)
    if element is None:
        names = [element.name for element in ruleset.elements]
        raise ValueError(with_suggestion(f"no element {name!r} in {ruleset.name}", name, names, "elements"))
    return element.id


MODES = ("task", "data_collection")
"""``task``: goals, rewards, and a first painted block. ``data_collection``: only the worlds."""

GOALS = 0xFFFFFFFF
"""The index of worlds for computing goals; episodes have the indices 0, 1, …"""

MAX_GOALS = 1 << 13
"""Maximum number of cached goals."""

RANDOMNESS = ("counter", "ogbench")
"""``counter``: hashes of the seed, the episode, the step and what is drawn. ``ogbench``: a generator for each environment."""

FIRST = ("ogbench element", "ogbench x", "ogbench y")
"""The draws of each stage of a first action."""


def keyed(parts: Sequence[Any], what: str, count: int) -> NDArray[np.float64]:
    """Numbers in [0, 1), float64 [n, count], hashed from integers [n] of at least 0 and what they are for.

    The first of `parts` is a seed of up to 62 bits, the others have 32.
    """
    seed, *rest = (np.asarray(part, dtype=np.int64) for part in parts)
    keys = base_keys(seed, rest[0], np)
    for part in (*rest[1:], np.int64(name_number(what))):
        keys = mix((keys + part) & MASK)
    numbers = np.arange(count, dtype=np.int64) * 0x9E3779B1 & MASK
    with np.errstate(over="ignore"):
        drawn = mix((mix(keys[0] ^ mix(keys[1]))[:, None] + numbers) & MASK)
    return np.asarray(drawn / float(1 << 32), dtype=np.float64)


class EpisodeDraws:
    """Random numbers of environments `which`, int64 [n]: hashes of their seeds, episode numbers and steps."""

    fixes_goals = True
    """True if a goal depends only on the seed and its task."""

    def __init__(self, seeds: Numbers):
        self._seeds = seeds

    def integers(self, which: Numbers, what: str, episode: Numbers, time: Numbers, count: int) -> Numbers:
        """A number in 0..count − 1 for each: int64 [n]. `episode` and `time` are int64 [n]."""
        drawn = keyed((self._seeds[which], episode, time), what, 1)[:, 0]
        return (drawn * count).astype(np.int64)

    def planes(self, which: Numbers) -> NDArray[np.float64] | None:
        """Draws for one step of their worlds, [streams, n, H, W] in [0, 1); None: the simulator's own."""
        return None

    def seed(self, which: int, seed: int) -> None:
        """Restart the draws of an environment from a seed."""
        self._seeds[which] = seed


class LegacyDraws(EpisodeDraws):
    """OGBench's order of draws: each environment has its own `numpy.random.RandomState`, instead of the global one."""

    fixes_goals = False

    def __init__(self, seeds: Numbers, streams: int, side: int):
        self._states = [np.random.RandomState(int(seed) & MASK) for seed in seeds]
        self._streams, self._side = streams, side

    def seed(self, which: int, seed: int) -> None:
        self._states[which] = np.random.RandomState(seed & MASK)

    def integers(self, which: Numbers, what: str, episode: Numbers, time: Numbers, count: int) -> Numbers:
        return np.array([self._states[number].randint(count) for number in which], dtype=np.int64)

    def planes(self, which: Numbers) -> NDArray[np.float64]:
        shape = (self._streams, self._side, self._side)
        drawn = np.stack([self._states[number].rand(*shape) for number in which], 1)
        # In single precision, as in the engine; numbers that would round to 1 stay below.
        single = drawn.astype(np.float32).astype(np.float64)
        return np.minimum(single, np.nextafter(1.0, 0.0))


class GoalWorld(NamedTuple):
    """A goal world: ids uint8 [H, W] and picture uint8 [H, W, 3]."""

    ids: Tensor
    picture: Tensor


class LevelEpisodes:
    """A batch of episodes of one level. Environment i has the seed `seeds`[i]; its first episode has number 0.

    Args:
        program: a program of the level, created with `as_ogbench` if `randomness` is ``ogbench``.
        seeds: int64 [B], of 0 or more.
        randomness: one of RANDOMNESS, or other draws. mode: one of MODES.
    """

    def __init__(
        self,
        program: LevelProgram,
        seeds: Sequence[int] | Numbers,
        *,
        randomness: str | EpisodeDraws = "counter",
        mode: str = "task",
    ):
        self.program, self.level, self.mode = program, program.level, mode
        self.seeds = np.array(seeds, dtype=np.int64)
        self.count = batch = len(self.seeds)
        if randomness == "counter":
            randomness = EpisodeDraws(self.seeds)
        elif isinstance(randomness, str):
            randomness = LegacyDraws(self.seeds, len(program.streams), self.level.side)
        self._draws = randomness
        side, device = self.level.side, program.device
        self.episode = np.full(batch, -1, dtype=np.int64)
        """The number of each environment's episode."""
        self.stage = np.zeros(batch, dtype=np.int64)
        """The choice of the next action: 0 the element, 1 x, 2 y."""
        self.elapsed = np.zeros(batch, dtype=np.int64)
        """Environment steps of each episode."""
        self.errors = np.zeros(batch, dtype=np.int64)
        """Number of cells of the goal without a match in the world."""
        self.tolerance = np.zeros(batch, dtype=np.int64)
        self.task_number = np.zeros(batch, dtype=np.int64)
        """The task of each episode, from 1; 0 for a custom task."""
        self.chosen = np.zeros((batch, 3), dtype=np.int64)
        """The last element, x and y that were chosen."""
        self.world: World | None = None
        self.pictures = torch.zeros(batch, side, side, 6, dtype=torch.uint8, device=device)
        """The worlds' pictures, without action frames."""
        self._memory: list[ReusedArray] = []
        """Of observations."""
        self.goal_ids = torch.zeros(batch, side, side, dtype=torch.uint8, device=device)
        self.goal_pictures = torch.zeros(batch, side, side, 3, dtype=torch.uint8, device=device)
        self._goals: dict[tuple[int, GoalTask], GoalWorld] = {}
        self._compiled: CompiledSteps | None = None

    # Beginning

    def begin(
        self,
        which: Numbers,
        tasks: Sequence[int | GoalTask | None],
        seeds: Sequence[int | None] | None = None,
    ) -> None:
        """Begin the next episodes of environments `which`, int64 [n]; the first call begins all.

        Args:
            tasks: for each, the number of a task, from 1, a custom task, or None to draw one.
            seeds: for each, a new seed, of which this is episode 0, or None.
        """
        for place, seed in zip(which, seeds or (), strict=seeds is not None):
            if seed is not None:
                self.seeds[place], self.episode[place] = seed, -1
                self._draws.seed(place, seed)
        self.episode[which] += 1
        self.stage[which], self.elapsed[which] = 0, 0
        if self.mode == "task":
            self._set_goals(
                which, [self._task(place, task) for place, task in zip(which, tasks, strict=True)]
            )
        fresh = self.program.start(self.seeds[which], self.episode[which])
        if self.mode == "task":
            first = [self._drawn(which, what, self.level.choices(stage)) for stage, what in enumerate(FIRST)]
            fresh = self.program.act(fresh, np.stack(first, 1), self._draws.planes(which))
        self._put(which, fresh)

    def _task(self, place: int, task: int | GoalTask | None) -> GoalTask:
        if task is None:
            task = 1 + int(self._drawn(np.array([place]), "ogbench task", len(self.level.tasks))[0])
        self.task_number[place] = 0 if isinstance(task, GoalTask) else task
        return task if isinstance(task, GoalTask) else self.level.tasks[task - 1]

    def _drawn(self, which: Numbers, what: str, count: int) -> Numbers:
        return self._draws.integers(which, what, self.episode[which], self.elapsed[which], count)

    def _set_goals(self, which: Numbers, tasks: Sequence[GoalTask]) -> None:
        fixed = self._draws.fixes_goals
        if not fixed or len(self._goals) > MAX_GOALS:
            self._goals.clear()
        of = self.seeds[which] if fixed else which
        keys = [(int(number), task) for number, task in zip(of, tasks, strict=True)]
        missing = [at for at, key in enumerate(keys) if key not in self._goals]
        new_goals = self.play_goals(which[missing], [tasks[at] for at in missing])
        self._goals |= zip([keys[at] for at in missing], new_goals, strict=True)
        goals = [self._goals[key] for key in keys]
        places = torch.from_numpy(which).to(self.program.device)
        self.goal_ids[places] = torch.stack([goal.ids for goal in goals])
        self.goal_pictures[places] = torch.stack([goal.picture for goal in goals])
        self.tolerance[which] = [task.tolerance for task in tasks]

    def play_goals(self, which: Numbers, tasks: Sequence[GoalTask]) -> list[GoalWorld]:
        """The goals of tasks, one for each of environments `which`, int64 [n], computed by playing their actions."""
        goals: dict[int, GoalWorld] = {}
        if not tasks:
            return []
        lists = [self.level.numbers(task) for task in tasks]
        world = self.program.start(self.seeds[which], np.full(len(which), GOALS, dtype=np.int64))
        active = list(range(len(lists)))
        for time in count():
            left = [row for row, at in enumerate(active) if len(lists[at]) > time]
            if len(left) < len(active):
                ids, pictures = world.ids, world.rgb()
                ended = sorted({*range(len(active))}.difference(left))
                goals |= {active[row]: GoalWorld(ids[row].clone(), pictures[row].clone()) for row in ended}
                if not left:
                    break
                world, active = world.select(left), [active[row] for row in left]
            painted = np.array([lists[at][time] for at in active], dtype=np.int64)
            world = self.program.act(world, painted, self._draws.planes(which[active]))
        return [goals[at] for at in range(len(lists))]

    # Stepping

    def step(self, actions: Numbers, active: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """Take one environment step in the episodes where `active`, bool [B], is set (None: all).

        Actions, int64 [B], that are not valid at their stage are replaced by random valid ones. Returns success, bool
        [B]: whether the worlds match their goals now.
        """
        part, steps = self._world, self._ready()
        if steps is not None:
            steps.choose(actions, np.ones(self.count, np.bool_) if active is None else active)
            return self.success
        which = np.arange(self.count) if active is None else np.flatnonzero(active)
        stages = self.stage[which]
        choices = np.where(stages == 0, self.level.choices(0), self.level.choices(1))
        parts = actions[which]
        invalid = (parts < 0) | (parts >= choices)
        if invalid.any():
            for stage in range(3):
                bad = np.flatnonzero(invalid & (stages == stage))
                if len(bad):
                    parts[bad] = self._drawn(which[bad], INVALID, self.level.choices(stage))
        self.chosen[which, stages] = parts
        self.stage[which] = (stages + 1) % 3
        self.elapsed[which] += 1
        painting = which[stages == 2]
        if len(painting):
            if len(painting) < self.count:
                part = take_worlds(part, torch.from_numpy(painting).to(self.program.device))
            planes = self._draws.planes(painting)
            self._put(painting, self.program.act(part, self.chosen[painting], planes))
        return self.success

    def _ready(self) -> CompiledSteps | None:
        """Return the steps in native code; None if the worlds do not run as native code."""
        native = self.program.simulator.native(self.level.side)
        if native is None or type(self._draws) is not EpisodeDraws:
            return None
        if self._compiled is None or self._compiled.native is not native:
            self._compiled = CompiledSteps(self, native)
        return self._compiled

    @property
    def success(self) -> NDArray[np.bool_]:
        """True where a world matches its goal: bool [B]."""
        return (self.errors < self.tolerance) & (self.mode == "task")

    @property
    def _world(self) -> World:
        if self.world is None:
            raise ResetNeeded("reset the environment before its first step, and before rendering it")
        return self.world

    def _put(self, which: Numbers, part: World) -> None:
        """Update the pictures and errors of the worlds `which`."""
        if len(which) == self.count:
            self.world, goals = part, self.goal_ids
            part.sim.observer.rgb(part.state, self.pictures, size=6)
        else:
            places = torch.from_numpy(which).to(self.program.device)
            shown = torch.empty_like(self.pictures[: len(which)])
            put_rows(self.pictures, places, part.sim.observer.rgb(part.state, shown, size=6), reuse=True)
            self.world = put_worlds(self._world, places, part, reuse=True)
            goals = self.goal_ids[places]
        if self.mode == "task":
            self.errors[which] = self.program.errors(part.ids, goals)

    # Showing

    def observations(self) -> Tensor:
        """Observations uint8 [B, H, W, 6]: the worlds' pictures, then the action frames. They are never overwritten.

        Raises ResetNeeded before the first episode.
        """
        assert self._world
        steps = self._ready()
        if steps is None:
            frames = torch.from_numpy(self.program.frames(self.stage, *self.chosen[:, :2].T))
            shown = self.pictures.flatten(2) | frames.to(self.pictures.device)
            return shown.view_as(self.pictures)
        memory = next(filter(ReusedArray.is_free, self._memory), None)
        if memory is None:
            memory = ReusedArray(tuple(self.pictures.shape), np.uint8)
            self._memory = [*self._memory[-3:], memory]
        steps.observe(memory.address)
        return torch.from_numpy(memory.rows)

    def goals(self) -> Tensor:
        """The goals as observations: uint8 [B, H, W, 6]."""
        return torch.cat([self.goal_pictures, torch.zeros_like(self.goal_pictures)], -1)


def task_of(level: Level, options: Mapping[str, Any]) -> int | GoalTask | None:
    """The task named by options of `reset`: a number from 1, a custom task, or None.

    Raises TypeError or ValueError if the level does not have it.
    """
    number, info = options.get("task_id"), options.get("task_info")
    if info is not None:
        if number is not None:
            raise ValueError("pass `task_id` or `task_info`, not both")
        task = read_task(info)
        level.numbers(task)
        return task
    if number is None:
        return None
    if not hasattr(number, "__index__") or isinstance(number, bool):
        raise TypeError(f"task_id must be an integer, found {number!r}")
    if not 1 <= number <= len(level.tasks):
        raise ValueError(f"task_id must be in 1..{len(level.tasks)}, found {number}")
    return int(number)
