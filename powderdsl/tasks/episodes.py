"""Running tasks: batches of episodes on tensors, from actions to rewards, on the simulator's device."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from powderdsl.simulation.simulator import Simulator, World
from powderdsl.simulation.simulator import compile as compile_rules
from powderdsl.targets.cpp.program import NativeProgram
from powderdsl.tasks.file import task_under
from powderdsl.tasks.goals import measures_in, scalars_of
from powderdsl.tasks.laws import Laws
from powderdsl.tasks.shipped import check_split, load_task
from powderdsl.tasks.task import Task
from powderdsl.tasks.tensors.actions import CLOCK, Hands, put_rows, put_worlds, take_worlds
from powderdsl.tasks.tensors.generator import StartWorlds
from powderdsl.tasks.tensors.measures import Masks, Meter, ScalarInputs, scalar_value

__all__ = ["Episodes", "TaskProgram", "compile_task", "load_task"]

ROWS = ("seed", "acted", "failed", "start", "before")
"""Tensors of `Episodes`, one row per episode."""

Params = Mapping[str, Any] | None
Seen = Callable[[World], None] | None

ACTION = ("x", "y", "choice", "vx", "vy")
"""The numbers of an action."""


@dataclass(frozen=True)
class Episodes:
    """A batch of episodes.

    `seed`, int64 [B], has the numbers of their start worlds; `acted`, int64 [B], the numbers of actions so far;
    `failed`, bool [B], is true if `failure` of `end:` holds now. `regions` are bool [B, H, W], or [1, H, W] if all
    worlds have the same; `targets` uint8 [B, H, W], 255 for no element; `params`, float64 [B] each, the parameters of
    the rules that each world has drawn; `start` and `before`, float64 [B, n], the measures at the start and after the
    previous action (not updated if only the last action is rewarded); `masks` are regions and targets as counts of
    packed worlds read them.
    """

    world: World
    seed: Tensor
    acted: Tensor
    failed: Tensor
    regions: Mapping[str, Tensor]
    targets: Mapping[str, Tensor]
    params: Mapping[str, Tensor]
    masks: Masks
    start: Tensor
    before: Tensor

    def __len__(self) -> int:
        return int(self.seed.shape[0])


class TaskProgram:
    """An executable task for one split, with the first `rulesets` of its rulesets (0: all), created by `compile_task`.

    If the worlds of a split run under different rulesets, episodes belong to the programs returned by `under`.
    """

    def __init__(
        self,
        task: Task,
        split: str,
        simulator: Simulator,
        *,
        rulesets: int = 0,
        ruleset: int | None = None,
    ):
        self.task, self.split, self.simulator = task, split, simulator
        self.rulesets, self.ruleset = task.split(split).rulesets[: rulesets or None], ruleset
        """The rulesets of the split, and the number of this program's ruleset; None if it has no particular one."""
        self._under: dict[int, TaskProgram] = {}
        device = simulator.device
        self._starts = StartWorlds(task, split, simulator.kind)
        scalars = scalars_of(task.goal)
        self.measures = measures_in(scalars)
        self.measure_numbers = {measure: number for number, measure in enumerate(self.measures)}
        self.fixed = self._starts.fixed
        """Regions that are the same in all worlds of the split, bool [1, H, W]."""
        self.meter = Meter(simulator.ruleset, self.measures, task.size, self.fixed, device)
        goal = task.goal
        asks_now = (goal.each, goal.success, goal.failure) != (None, None, None)
        self.counts_always = asks_now or any(part.op == "before" for part in scalars)
        """True if measures are needed after every action, not only after the last."""
        self._asked = {part.value for part in scalars if part.op == "action"}
        """The numbers of an action that the goal uses."""
        self.hands = Hands(simulator, task.agent, task.size, counts="painted" in self._asked)
        self.laws = Laws(task, simulator.ruleset)
        """The laws that observations can show."""
        self.action_nvec = task.agent.action_nvec
        """The numbers of values of x, y, choice, vx and vy. `Task.agent.choices` lists the choices."""

    def __deepcopy__(self, memo: Any) -> TaskProgram:
        """Return the same program, which is immutable, so that copies of its users share it."""
        return self

    # Rulesets

    @property
    def is_mixed(self) -> bool:
        """True if worlds run under different rulesets, which only the programs of `under` can run."""
        return len(self.rulesets) > 0 and self.ruleset is None

    def ruleset_of(self, worlds: Tensor) -> Tensor:
        """The numbers, int64 [B], of the rulesets of worlds, int64 [B]."""
        return worlds // len(self.task.split(self.split).variants) % max(1, len(self.rulesets))

    def under(self, number: int) -> TaskProgram:
        """The program of the worlds under the ruleset with a number, created on first use.

        Raises CompileError if the task does not fit that ruleset.
        """
        if not self.is_mixed:
            return self
        if number not in self._under:
            task, simulator = task_under(self.task, self.rulesets[number]), self.simulator
            if task.ruleset != self.task.ruleset:
                simulator = simulator.of(task.ruleset)
            self._under[number] = TaskProgram(task, self.split, simulator, ruleset=number)
        return self._under[number]

    def apart(self, worlds: Tensor) -> Iterator[tuple[Tensor, TaskProgram]]:
        """Yield the indices of the worlds under each ruleset, int64 [n], and the program of that ruleset."""
        rulesets = self.ruleset_of(worlds)
        for number in rulesets.unique().tolist():
            yield (rulesets == number).nonzero()[:, 0], self.under(number)

    # Beginning

    def start(self, seeds: Tensor, native: NativeProgram | None = None) -> Episodes:
        """New episodes of the worlds `seeds`, int64 [B], 0 or more each; packed for `native` code if it is given."""
        if self.is_mixed:
            raise ValueError(f"the worlds of {self.task.name}, {self.split}, run under different rulesets")
        seeds = torch.as_tensor(seeds, dtype=torch.int64, device=self.simulator.device)
        starts = self._starts.make(seeds)
        nothing = torch.zeros_like(seeds)
        clock = (seeds, nothing.clone(), nothing.clone())
        state: Any = self.hands.fresh_state(starts.ids, shares=native is not None)
        for name, (values, where) in starts.fields.items():
            state[name] = torch.where(where if values.ndim == 3 else where[:, None], values, state[name])
        world = World(self.simulator, native.pack(state) if native else state, *clock)
        masks, params = self.meter.masks(starts.regions, starts.targets), self._starts.params(seeds)
        measured = self.meter.take(world, starts.regions, starts.targets, params, masks)
        flags, maps = nothing.bool(), (starts.regions, starts.targets, params, masks)
        return Episodes(world, seeds, nothing.clone(), flags, *maps, measured, measured)

    def restart(self, episodes: Episodes, mask: Tensor, seeds: Tensor, *, reuse: bool = False) -> Episodes:
        """The episodes where `mask`, bool [B], is set, rebuilt as worlds `seeds`, int64 [B]; the others unchanged.

        `reuse` overwrites the tensors of `episodes`, which must not be used afterwards.
        """
        places = mask.nonzero()[:, 0]
        seeds = torch.as_tensor(seeds, dtype=torch.int64, device=self.simulator.device)
        return self.put(episodes, places, self.start(seeds[places]), reuse=reuse) if len(places) else episodes

    def put(self, episodes: Episodes, places: Tensor, new: Episodes, *, reuse: bool = False) -> Episodes:
        """The episodes with those of numbers `places`, int64 [n], replaced by `new` ones, in order. `reuse`: see above."""
        if len(places) == len(episodes):
            return new

        def placed(old: Mapping[str, Tensor], fresh: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {name: put_rows(value, places, fresh[name], reuse) for name, value in old.items()}

        own = {name: value for name, value in episodes.regions.items() if name not in self.fixed}
        return Episodes(
            put_worlds(episodes.world, places, new.world, reuse=reuse),
            regions={**episodes.regions, **placed(own, new.regions)},
            targets=placed(episodes.targets, new.targets),
            params=placed(episodes.params, new.params),
            masks=episodes.masks.put(places, new.masks, len(episodes), reuse),
            **placed({name: getattr(episodes, name) for name in ROWS}, vars(new)),
        )

    def select(self, episodes: Episodes, places: Tensor) -> Episodes:
        """The episodes of numbers `places`, int64 [n], which may repeat."""
        masks = episodes.masks
        if len(masks.sizes) == len(episodes):
            masks = Masks(masks.words[places], masks.sizes[places])
        maps = {name: getattr(episodes, name) for name in ("regions", "targets", "params")}
        chosen: dict[str, Any] = {
            kind: {name: value if name in self.fixed else value[places] for name, value in values.items()}
            for kind, values in maps.items()
        }
        rows = {name: getattr(episodes, name)[places] for name in ROWS}
        return Episodes(take_worlds(episodes.world, places), **chosen, masks=masks, **rows)

    # Saving

    def saved(self, episodes: Episodes) -> dict[str, Any]:
        """Episodes as dicts of CPU tensors, from which any backend and device can continue."""
        maps = {name: getattr(episodes, name) for name in ("regions", "targets", "params")}
        maps["state"] = episodes.world.state
        return {
            **{name: _copy(getattr(episodes, name)) for name in ROWS},
            **{name: {key: _copy(value) for key, value in values.items()} for name, values in maps.items()},
            "clock": [_copy(getattr(episodes.world, name)) for name in CLOCK],
        }

    def loaded(self, saved: Mapping[str, Any]) -> Episodes:
        """The episodes passed to `saved`. Raises KeyError and ValueError for those of other rules or sizes."""
        device = self.simulator.device

        def tensors(values: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {name: _copy(value, device) for name, value in values.items()}

        state = tensors(saved["state"])
        names = {slot.name for slot in self.simulator.slots}
        if set(state) != names or tuple(state["element"].shape[1:]) != self.task.size:
            raise ValueError(f"these episodes do not belong to {self.task.name}: their state or size differs")
        seed, index, step = (_copy(part, device) for part in saved["clock"])
        regions, targets = {**tensors(saved["regions"]), **self.fixed}, tensors(saved["targets"])
        return Episodes(
            world=World(self.simulator, state, seed, index, step),
            regions=regions,
            targets=targets,
            params=tensors(saved["params"]),
            masks=self.meter.masks(regions, targets),
            **tensors({name: saved[name] for name in ROWS}),
        )

    # Acting

    def act(
        self,
        episodes: Episodes,
        actions: Tensor | None,
        *,
        reuse: bool = False,
        params: Params = None,
        seen: Seen = None,
    ) -> tuple[Episodes, Tensor, Tensor, Tensor]:
        """Take one action in each episode, int64 [B, 5] within bounds, and run the steps after it.

        Args:
            actions: None lets the worlds run without an agent. The action counts, but nothing is painted, placed or
                blown.
            reuse: overwrite the tensors of `episodes`, which must not be used afterwards.
            params: parameters of the rules for this action, each a number or [B]; NaN keeps the world's own draw.
            seen: called with the worlds after the action and after each step, which then run one at a time. Free steps
                are shown if all episodes have them. Not allowed with `reuse`.

        Returns:
            the episodes; reward float32 [B]; success bool [B], whether `success` of `end:` holds now; over bool [B]:
            success, failure, or no action left. With the last action the free steps have run.
        """
        agent, goal = self.task.agent, self.task.goal
        world, params = episodes.world, params_of(episodes, params)
        if actions is not None:
            world, done = self.hands.act(world, actions, reuse=reuse)
        else:
            done = dict.fromkeys(("painted", "placed", "blown"), torch.zeros_like(episodes.acted))
        if seen is not None:
            seen(world)
        world = self._run(world, agent.steps_per_action, params, reuse, seen)
        acted = episodes.acted + 1
        last = acted >= agent.actions
        if agent.free_steps:
            world = self._free(world, last, params, seen)
        now = episodes.before
        if self.counts_always or bool(last.any()):
            now = self.meter.take(world, episodes.regions, episodes.targets, params, episodes.masks)
        action = {"taken": acted, **done}
        if "left" in self._asked:
            action["left"] = agent.actions - acted
        inputs = ScalarInputs(self.measure_numbers, now, episodes.start, episodes.before, action)
        success, failed = (
            torch.zeros_like(last) if scalar is None else scalar_value(scalar, inputs) != 0
            for scalar in (goal.success, goal.failure)
        )
        over = last
        for scalar, holds in ((goal.success, success), (goal.failure, failed)):
            over = over if scalar is None else over | holds
        if goal.each is None:
            reward = torch.zeros_like(acted, dtype=torch.float64)
        else:
            reward = scalar_value(goal.each, inputs)
        if goal.final is not None:
            final = scalar_value(goal.final, inputs)
            reward = reward + torch.where(over, final, torch.zeros_like(final))
        after = replace(episodes, world=world, acted=acted, failed=failed, before=now)
        return after, reward.float(), success, over

    def law_bytes(self, episodes: Episodes) -> Tensor:
        """Return the laws that observations of episodes show, uint8 [B, n]: see `Laws`."""
        return self.laws.of(episodes.params, len(episodes)).to(episodes.seed.device)

    def measured(self, episodes: Episodes, params: Params = None) -> Tensor:
        """The current values of `measures`: float64 [B, n]."""
        places = episodes.regions, episodes.targets
        return self.meter.take(episodes.world, *places, params_of(episodes, params), episodes.masks)

    def _run(self, world: World, steps: int, params: Params, reuse: bool, seen: Seen) -> World:
        """The worlds after some steps, run one at a time if `seen` is given."""
        if seen is None:
            return self.simulator.step(world, steps, params=params, reuse=reuse)
        for _ in range(steps):
            world = self.simulator.step(world, 1, params=params)
            seen(world)
        return world

    def _free(self, world: World, last: Tensor, params: Params, seen: Seen) -> World:
        """The steps after the last action, in the worlds that had it."""
        steps = self.task.agent.free_steps
        places = last.nonzero()[:, 0]
        if len(places) == 0:
            return world
        if len(places) == len(last):
            return self._run(world, steps, params, False, seen)
        own = {
            name: value[places] if isinstance(value, Tensor) and value.ndim else value
            for name, value in (params or {}).items()
        }
        ahead = self.simulator.step(world.select(places), steps, params=own)
        state = {name: value.index_copy(0, places, ahead.state[name]) for name, value in world.state.items()}
        return world.with_state(state, start=world.step.index_copy(0, places, ahead.step), since=0)


def params_of(episodes: Episodes, params: Params) -> Params:
    """The parameters of a step that differ from the rules' own: those drawn by worlds, overridden by `params`."""
    chosen = dict(params or {})
    for name, drawn in episodes.params.items():
        value = torch.as_tensor(chosen.get(name, torch.nan), dtype=torch.float64, device=drawn.device)
        chosen[name] = torch.where(value.isnan(), drawn, value)
    return chosen or None


def _copy(tensor: Tensor, device: torch.device | str = "cpu") -> Tensor:
    return tensor.detach().to(device, copy=True)


def load_program(
    task: str | Path | Task | TaskProgram,
    *,
    split: str = "train",
    knobs: Mapping[str, int] | None = None,
    params: Mapping[str, Any] | None = None,
    **machine: Any,
) -> TaskProgram:
    """The program of a task, for arguments of an environment; a program is returned unchanged.

    `machine`: backend, device and threads, as `compile_task` takes them. Raises CompileError as `compile_task`, and
    ValueError for knobs or parameters of a task that is loaded already.
    """
    if isinstance(task, Task | TaskProgram) and (knobs or params):
        raise ValueError("for a loaded task, pass knobs and params to `load_task`")
    if isinstance(task, str | Path):
        task = load_task(task, knobs=knobs, params=params)
    return compile_task(task, split=split, **machine) if isinstance(task, Task) else task


def compile_task(
    task: Task | str,
    *,
    split: str = "train",
    backend: str = "auto",
    device: str | torch.device = "cpu",
    threads: int = 1,
    rulesets: int = 0,
) -> TaskProgram:
    """A program for one split of a task, or of the task of a name or path; under its first `rulesets` only, if not 0.

    Other options are those of `powderdsl.compile`. Raises CompileError: PD801 for a split that the task does not have, PD701
    for a backend or device that is not available.
    """
    loaded = task if isinstance(task, Task) else load_task(task)
    check_split(loaded, split)
    simulator = compile_rules(loaded.ruleset, backend, str(device), threads)
    return TaskProgram(loaded, split, simulator, rulesets=rulesets)


def integer_tensor(name: str, values: Any) -> Tensor:
    """Convert a caller's values to int64. Raises TypeError if they are not integers."""
    try:
        tensor = torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name}: {' '.join(str(error).split())}") from None
    if tensor.is_floating_point() or tensor.is_complex() or tensor.dtype == torch.bool:
        raise TypeError(f"{name} must be integers, found {tensor.dtype}")
    return tensor.to(torch.int64)


def check_numbers(actions: Any, nvec: tuple[int, ...], names: tuple[str, ...]) -> Tensor:
    """Convert a caller's numbers to int64 [B, k], in column i from 0 to ``nvec[i] − 1``.

    Raises TypeError if they are not integers, ValueError for a wrong shape, or a number out of range, with its index.
    """
    tensor = integer_tensor("actions", actions)
    if tensor.ndim != 2 or tensor.shape[1] != len(nvec):
        raise ValueError(f"actions must have the shape [episodes, {len(nvec)}], found {list(tensor.shape)}")
    numbers = tensor.cpu().numpy()  # NumPy's overhead for a few numbers is a fraction of torch's
    bad = (numbers < 0) | (numbers >= np.array(nvec))
    if bad.any():
        row, column = np.argwhere(bad)[0].tolist()
        value, most = int(tensor[row, column]), nvec[column] - 1
        raise ValueError(f"actions[{row}, {column}] ({names[column]}) is {value}: it must be in 0..{most}")
    return tensor
