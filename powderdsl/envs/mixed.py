"""Environments whose worlds run under different rulesets, and `environment`, which creates all kinds."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from powderdsl.envs.compiled import CompiledEnv, Stepper, Steps, episodes_ahead, tensors_of
from powderdsl.envs.tensor_env import Info
from powderdsl.tasks.compiled import Results, ReusedArray
from powderdsl.tasks.episodes import Episodes, TaskProgram, load_program
from powderdsl.tasks.mixed import MixedEpisodes
from powderdsl.tasks.task import Task

Array = np.ndarray[Any, Any]


def environment(task: str | Path | Task | TaskProgram, num_envs: int = 1, **how: Any) -> CompiledEnv:
    """Return a `MixedEnv` if the worlds of a split run under different rulesets, else a `CompiledEnv`.

    Arguments and errors are those of `TensorEnv`.
    """
    names = ("split", "knobs", "params", "backend", "device", "threads")
    program = load_program(task, **{name: how.pop(name) for name in names if name in how})
    return (MixedEnv if program.is_mixed else CompiledEnv)(program, num_envs, **how)


MOST_ROWS = 4
"""Maximum number of rows per environment, including idle ones."""

COLUMNS = ("observed", "reward", "terminated", "truncated", "success", "episode_return", "episode_length")
"""The results of a step, one row per episode: names of `Results`."""


class Joint:
    """Steps the episodes of several steppers in one call, into shared memory.

    Args:
        steppers: in order. The rows of their episodes follow one another.
        shape: of one observation.
        dtype: of observations.
    """

    def __init__(self, steppers: Sequence[Stepper], shape: tuple[int, ...], dtype: Any):
        self._steppers, sizes = steppers, [len(stepper.begins) for stepper in steppers]
        ends = np.cumsum([0, *sizes])
        self._numbers = np.zeros((ends[-1], steppers[0].play.numbers), np.int64)
        self.observed = np.zeros((ends[-1], *shape), dtype)
        """The last observations of all rows."""
        self._shown: list[ReusedArray] = []
        memory = np.empty(int(Results.SIZE * ends[-1]), np.uint8)
        columns: list[list[Array]] = [[] for _ in COLUMNS[1:]]
        for stepper, start, end in zip(steppers, ends, ends[1:], strict=False):
            part = Results(memory[Results.SIZE * start : Results.SIZE * end], self.observed[start:end])
            stepper.write_to(part)
            stepper.read_from(self._numbers[start:end])
            stepper.begin()
            for column, name in zip(columns, COLUMNS[1:], strict=True):
                column.append(getattr(part, name))
        self._columns = [(memory.view(column[0].dtype), _places(memory, column)) for column in columns]
        self._bound = [stepper.episodes for stepper in steppers]
        self._calls = np.array([stepper.call for stepper in steppers], np.int64)

    def has(self, steppers: Sequence[Stepper]) -> bool:
        """True if these are its steppers, and none has been bound to other episodes."""
        bound = [stepper.episodes for stepper in steppers]
        return len(bound) == len(self._bound) and all(map(operator.is_, bound, self._bound))

    def seat(self, members: Sequence[Array], rows: Array) -> None:
        """Continue with the episodes of these numbers in the rows of each stepper, int64 [n]; −1: the row is idle.

        `rows`: the row of each episode, int64 [B].
        """
        self.rows = rows
        self._places = [(values, places[rows]) for values, places in self._columns]
        busy = np.array([bool((own >= 0).any()) for own in members])
        threads = self._steppers[0].native.threads
        self._threads = threads if busy.sum() >= threads else 1
        for stepper, own in zip(self._steppers, members, strict=True):
            stepper.rest(own < 0)
            stepper.play.threads = threads // self._threads
        self._states = [stepper.state for stepper in self._steppers]
        together = busy & [not stepper.measures_cells for stepper in self._steppers]
        self._together = np.ascontiguousarray(self._calls[together].T)
        self._apart = [self._steppers[int(place)] for place in np.flatnonzero(busy & ~together)]

    def step(self, actions: Array) -> list[Array]:
        """Step all episodes: the columns of `COLUMNS`, in the order of their numbers."""
        self._numbers[self.rows] = actions.reshape(len(self.rows), -1)
        for state in self._states:  # faster than `prepare`, which `seat` has called
            state.forget()
        addresses = [row.ctypes.data for row in self._together]
        self._steppers[0].native.library.pd_play_all(self._together.shape[1], *addresses, self._threads)
        for stepper in self._apart:
            stepper.step()
        shown = next(filter(ReusedArray.is_free, self._shown), None)
        if shown is None:
            shown = ReusedArray((len(self.rows), *self.observed.shape[1:]), self.observed.dtype)
            self._shown = [shown, *self._shown[:2]]
        # Other modes make another copy.
        np.take(self.observed, self.rows, 0, shown.rows, mode="clip")
        return [shown.rows, *(values[places] for values, places in self._places)]


def _places(memory: Array, parts: Sequence[Array]) -> Array:
    """The places of the parts' numbers in some memory that is seen as numbers of their dtype: int64 [B]."""
    start = memory.ctypes.data
    return np.concatenate(
        [(part.ctypes.data - start) // part.itemsize + np.arange(len(part)) for part in parts]
    )


Groups = dict[int, tuple[CompiledEnv, Array]]
"""By ruleset: the environment of the episodes under it, and the numbers of these episodes, int64 [n]; −1: the row is idle."""


class MixedEnv(CompiledEnv):
    """A `TensorEnv` whose worlds run under different rulesets.

    The number of an episode's world decides its ruleset (`TaskProgram.ruleset_of`). The episodes under one ruleset form
    a `CompiledEnv`, with the results that they would have alone. Its code is compiled when the first of them begins.

    Raises:
        ValueError: observations or actions have another shape under one of the rulesets. `reset` and `step` can raise
            it too, when a ruleset is first needed.
    """

    takes_mixed = True
    rows = ("base", "episode", "ended")

    def __init__(self, task: str | Path | Task | TaskProgram, num_envs: int = 1, **how: Any):
        super().__init__(task, num_envs, **how)
        self._joint: Joint | None = None
        self._actions = np.empty((self.num_envs, *(self.single_action_space.shape or ())), np.int64)
        self._most = np.array(self.action_nvec, np.uint64)
        self._envs: dict[int, CompiledEnv] = {}
        self._groups: Groups = {}
        self._planned: dict[int, Array] = {}
        """By ruleset: the ascending numbers of worlds that will be needed, int64 [n]."""
        self._ahead: dict[int, Episodes] = {}
        """The starts of planned worlds, by ruleset."""
        self._planned_from: tuple[Tensor, Tensor] | None = None
        """The seeds of the environments, and the first episodes whose worlds were planned: int64 [B]."""

    def _env(self, number: int) -> CompiledEnv:
        """The environment of the episodes under a ruleset."""
        if number not in self._envs:
            env = CompiledEnv(
                self.program.under(number),
                observation=self.observation.kind,
                autoreset_mode="disabled",
                last_action="terminates" if self.last_action_terminates else "truncates",
                max_episode_steps=self.max_episode_steps,
                actions=self.action_form.kind,
            )
            ours, theirs = (
                (each.observation.channels, each.single_action_space, each.task.agent.choices)
                for each in (self, env)
            )
            if ours != theirs:
                rules = "+".join(self.program.rulesets[number])
                raise ValueError(f"{self.task.name}: observations or actions differ under {rules}")
            self._envs[number] = env
        return self._envs[number]

    # Beginning

    def _restart(self, mask: Tensor, worlds: Tensor) -> None:
        """Begin episodes where `mask`, bool [B], is set, in the worlds with these numbers, int64 [B]."""
        rows, began = mask.nonzero()[:, 0].numpy(), mask.numpy()
        entered, starting = self.program.ruleset_of(worlds).numpy()[rows], worlds.numpy()
        for number in entered.tolist():
            self._env(number)  # raises before anything has changed
        groups, entering = dict(self._groups), []
        for number in sorted({*groups, *entered.tolist()}):
            env, members = groups.get(number, (self._env(number), rows[:0]))
            leaving, new = (members >= 0) & began[members], rows[entered == number]
            if not leaving.any() and not len(new):
                continue
            members = np.where(leaving, -1, members)
            free = np.flatnonzero(members < 0)[: len(new)]
            if self._joint is None or len(free) < len(new) or (self.params and len(new)):
                members = self._rebuild(number, members, new, starting)
            elif len(new):
                members[free] = new
                entering.append((number, free, starting[new]))
            groups[number] = env, members
        size = sum(len(members) for _, members in groups.values())
        if self._joint is None or size > MOST_ROWS * self.num_envs:
            groups = {number: group for number, group in groups.items() if (group[1] >= 0).any()}
        self.episodes = self._regroup(dict(sorted(groups.items())), entering)

    def _rebuild(self, number: int, members: Array, new: Array, worlds: Array) -> Array:
        """Make room for new episodes under a ruleset. Returns the numbers of all its episodes, −1 in idle rows.

        `members` are those of its rows so far; the environments `new`, int64 [n], begin in their `worlds`, int64 [B].
        """
        env, staying = self._env(number), np.flatnonzero(members >= 0)
        stay, count, idle, env.running = len(staying), len(staying) + len(new), 0, 0
        if env.simulator.native(self.task.size[1]) is not None:
            usual = self.num_envs // len(self.program.rulesets)
            idle = max(usual + 3 * math.isqrt(usual), count + count // 4) - count
            env.running = max(usual, count // 2, 1)
        members = np.concatenate([members[staying], new, np.full(idle, -1)])
        if not count:
            return members
        episodes = None
        if len(new):
            ahead, entries = self._starts(number, worlds[new])
            entries = np.concatenate([entries, np.full(idle, entries[0])])
            episodes = env.program.select(ahead, torch.from_numpy(entries))
        if stay:
            assert env.episodes is not None
            places, rest = torch.from_numpy(staying), torch.arange(stay, count + idle)
            whole = env.program.select(env.episodes, torch.cat([places, places[:1].expand(len(rest))]))
            episodes = env.program.put(whole, rest, episodes, reuse=True) if episodes else whole
        assert episodes is not None
        known = {param.name for param in env.task.ruleset.params}
        params = {name: value[members] for name, value in self.params.items() if name in known}
        returned = self._returned[members]
        returned[stay:] = 0
        env.adopt(episodes, returned, params)
        return members

    def _starts(self, number: int, worlds: Array) -> tuple[Episodes, Array]:
        """Return starts of episodes under a ruleset, and the places among them of worlds, int64 [n].

        If they are planned, these are all planned worlds: a batch of many takes little longer than one of a few.
        """
        planned = self._planned.get(number, worlds[:0])
        places = np.searchsorted(planned, worlds)
        known = bool((places < len(planned)).all() and (planned[places] == worlds).all())
        if not known or number not in self._ahead:
            env, needed = self._env(number), torch.from_numpy(planned if known else worlds)
            starts = env.program.start(needed, env.simulator.native(self.task.size[1]))
            if not known:
                return starts, np.arange(len(worlds))
            self._ahead[number] = starts
        return self._ahead[number], places

    def _plan(self, base: Tensor, first: Tensor, depth: int) -> None:
        """Plan the start worlds of `depth` episodes from `first`, int64 [B], on."""
        episodes = first + torch.arange(depth)[:, None]
        worlds = self._choose(base.expand_as(episodes).flatten(), episodes.flatten()).unique()
        rulesets = self.program.ruleset_of(worlds)
        numbers, counts = rulesets.unique(return_counts=True)
        parts = worlds[rulesets.argsort(stable=True)].split(counts.tolist())
        self._planned, self._ahead = dict(zip(numbers.tolist(), map(Tensor.numpy, parts), strict=True)), {}
        self._planned_from = base, first

    def _regroup(self, groups: Groups, entering: Sequence[tuple[int, Array, Array]] = ()) -> Episodes:
        """Continue with these groups. Returns their episodes.

        `entering`: the ruleset, rows and worlds, int64 [n] each, of episodes that begin in idle rows.
        """
        self._groups, members = groups, [rows for _, rows in groups.values()]
        steppers = [env._ready() for env, _ in groups.values()]
        ready = [stepper for stepper in steppers if stepper is not None]
        if len(ready) < len(steppers):
            self._joint = None
            for env, _ in groups.values():
                env.unbind()  # from the memory that steppers shared
        elif self._joint is None or not self._joint.has(ready):
            space = self.observation.space
            self._joint = Joint(ready, space.shape, space.dtype)
        numbers = np.concatenate(members)
        self._order = np.argsort(numbers, kind="stable")[np.count_nonzero(numbers < 0) :]
        if self._joint is not None:
            self._joint.seat(members, self._order)
        for number, rows, worlds in entering:
            stepper, (ahead, entries) = groups[number][0]._stepper, self._starts(number, worlds)
            assert stepper is not None
            stepper.enter(ahead, entries, rows)
        episodes = MixedEpisodes([env for env, _ in groups.values()], torch.from_numpy(self._order))
        if self.observation.kind == "laws":
            self._laws = episodes.joined(TaskProgram.law_bytes).numpy()
        return episodes  # type: ignore[return-value]  # same attributes

    # Stepping

    def step(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Info]:
        """Act once in every episode: see `TensorEnv.step`."""
        *parts, info = self.step_arrays(actions)
        observed, reward, terminated, truncated = map(torch.from_numpy, parts)
        return observed, reward, terminated, truncated, tensors_of(info)

    def step_arrays(self, actions: Any) -> Steps:
        """Act once in every episode: `step` with NumPy arrays."""
        mode, numbers = self.autoreset_mode, self._actions
        self._read(actions, numbers)
        if (
            self.episodes is None
            or mode is AutoresetMode.DISABLED
            or (numbers.view(np.uint64) >= self._most).any()
        ):
            self._checked(actions)
        assert self.episodes is not None
        step = self._step_apart if self._joint is None else self._joint.step
        observed, reward, terminated, truncated, success, returned, length = step(numbers)
        if self.observation.kind == "laws":
            self._write_own(observed, slice(None))
        active = np.ones(self.num_envs, bool)
        waiting = self._ended
        if mode is AutoresetMode.NEXT_STEP:
            active = ~waiting.numpy()
            reward = np.where(active, reward, 0)
            terminated, truncated, success = terminated & active, truncated & active, success & active
        self._returned = self._returned + torch.from_numpy(reward)
        ended = terminated | truncated
        info: dict[str, Any] = {
            "success": success,
            "_success": active,
            "episode_return": returned * ended,
            "episode_length": length * ended,
            "_episode_return": ended,
            "_episode_length": ended,
        }
        self._ended = torch.from_numpy(ended)
        if mode is AutoresetMode.SAME_STEP:
            last = {"world": self.episodes.seed.numpy().copy()}
            last |= {name: info[name] for name in ("success", "episode_return", "episode_length")}
            info["final_info"] = last | {f"_{name}": ended for name in last}
            info["final_obs"] = observed[ended]
            info["_final_obs"] = info["_final_info"] = ended
            waiting, self._ended = self._ended, torch.zeros_like(self._ended)
        if mode is not AutoresetMode.DISABLED:
            self._next_episodes(waiting, observed)
        info["world"], info["_world"] = self.episodes.seed.numpy().copy(), np.ones(self.num_envs, bool)
        if self.shows_mask:
            info["action_mask"] = self.action_masks().to(torch.int8).numpy()
            info["_action_mask"] = info["_world"]
        return observed, reward, terminated, truncated, info

    def _write_own(self, observed: Array, envs: Any) -> None:
        """Write the laws of some environments into their observations, [n, …]."""
        observed[:, 1].reshape(len(observed), -1)[:, : self._laws.shape[1]] = self._laws[envs]

    def _step_apart(self, actions: Array) -> list[Array]:
        """Step environment after environment; the columns of `COLUMNS`, rows in the order of `self`."""
        parts = []
        for env, rows in self._groups.values():
            env._ended.zero_()  # waiting episodes step too; their results are masked below
            *first, info = env.step_arrays(actions[rows])
            parts.append([*first, *(info[name] for name in COLUMNS[4:])])
        return [np.concatenate(column)[self._order] for column in zip(*parts, strict=True)]

    def _next_episodes(self, mask: Tensor, observed: Array) -> None:
        """Begin the next episodes where `mask`, bool [B], is set, and write their first observations."""
        if not bool(mask.any()):
            return
        assert self._base is not None
        self._episode, rows = self._episode + mask, mask.nonzero()[:, 0]
        self._returned = self._returned.masked_fill(mask, 0)
        depth = min(len(self.program.rulesets), 2) * episodes_ahead(self.num_envs, self.task.size)
        if self.curriculum is None:
            base, first = self._planned_from or (None, self._episode)
            passed = (self._episode - first)[rows]
            if base is not self._base or not bool(((passed >= 0) & (passed < depth)).all()):
                self._plan(self._base, self._episode + ~mask, depth)
        worlds = torch.zeros_like(self._episode)
        worlds[rows] = self._choose(self._base[rows], self._episode[rows])
        self._restart(mask, worlds)
        begun = mask.numpy()
        if self._joint is not None:
            shown = self._joint.observed[self._order[begun]]
            if self.observation.kind == "laws":
                self._write_own(shown, begun)
            observed[begun] = shown
            return
        for env, members in self._groups.values():
            places = np.flatnonzero((members >= 0) & begun[members])
            if len(places):
                assert env.episodes is not None
                observed[members[places]] = env.observation.of(env.episodes).numpy()[places]

    # Saving

    def _saved(self, episodes: Episodes) -> dict[str, Any]:
        return {
            "groups": {
                number: {"rows": torch.from_numpy(rows), "env": env.state()}
                for number, (env, rows) in self._groups.items()
            },
        }

    def _loaded(self, state: Mapping[str, Any]) -> Episodes:
        rows = {number: saved["rows"].numpy().copy() for number, saved in state["groups"].items()}
        for number in rows:
            if not 0 <= number < len(self.program.rulesets):
                raise ValueError(f"no ruleset {number}: there are {len(self.program.rulesets)}")
        members = np.concatenate([*rows.values()])
        if sorted(members[members >= 0].tolist()) != [*range(self.num_envs)]:
            raise ValueError("the saved worlds are not those of an environment")
        groups = {number: (self._env(number), own) for number, own in rows.items()}
        for number, (env, own) in groups.items():
            env.num_envs = len(own)
            env.restore(state["groups"][number]["env"])
        busy, returns = members >= 0, torch.cat([env.returns for env, _ in groups.values()])
        self._returned[members[busy]] = returns[busy]
        return self._regroup(groups)
