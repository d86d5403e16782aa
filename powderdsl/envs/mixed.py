"""Environments whose worlds run under different rulesets, and `environment`, which creates all kinds."""

from __future__ import annotations

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


COLUMNS = ("observed", "reward", "terminated", "truncated", "success", "episode_return", "episode_length")
"""The results of a step, one row per episode: names of `Results`."""


class Joint:
    """Steps the episodes of several steppers, one call each, into shared memory.

    Args:
        steppers: in order.
        members: the numbers of their episodes, int64 [B].
        shape: of one observation.
        dtype: of observations.
    """

    def __init__(self, steppers: Sequence[Stepper], members: Array, shape: tuple[int, ...], dtype: Any):
        self._steppers, self._members = steppers, members
        order, sizes = np.argsort(members), [len(stepper.begins) for stepper in steppers]
        self._order = order
        self._numbers = np.empty((len(members), steppers[0].play.numbers), np.int64)
        self._observed = np.zeros((len(members), *shape), dtype)
        self._shown: list[ReusedArray] = []
        ends = np.cumsum([0, *sizes])
        memory = np.empty(int(Results.SIZE * ends[-1]), np.uint8)
        columns: list[list[Array]] = [[] for _ in COLUMNS[1:]]
        for stepper, start, end in zip(steppers, ends, ends[1:], strict=False):
            part = Results(memory[Results.SIZE * start : Results.SIZE * end], self._observed[start:end])
            stepper.write_to(part)
            stepper.read_from(self._numbers[start:end])
            for column, name in zip(columns, COLUMNS[1:], strict=True):
                column.append(getattr(part, name))
        self._places = [(memory.view(column[0].dtype), _places(memory, column)[order]) for column in columns]

    def step(self, actions: Array) -> list[Array]:
        """Step all episodes: the columns of `COLUMNS`, in the order of their numbers."""
        np.take(actions.reshape(self._numbers.shape), self._members, 0, self._numbers, mode="clip")
        for stepper in self._steppers:
            stepper.step()
        shown = next(filter(ReusedArray.is_free, self._shown), None)
        if shown is None:
            shown = ReusedArray(self._observed.shape, self._observed.dtype)
            self._shown = [shown, *self._shown[:2]]
        # Other modes make another copy.
        np.take(self._observed, self._order, 0, shown.rows, mode="clip")
        return [shown.rows, *(values[places] for values, places in self._places)]


def _places(memory: Array, parts: Sequence[Array]) -> Array:
    """The places of the parts' numbers in some memory that is seen as numbers of their dtype: int64 [B]."""
    start = memory.ctypes.data
    return np.concatenate(
        [(part.ctypes.data - start) // part.itemsize + np.arange(len(part)) for part in parts]
    )


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
        self._envs: dict[int, CompiledEnv] = {}
        self._groups: dict[int, tuple[CompiledEnv, Array]] = {}
        """The environment of the episodes under each ruleset, and the numbers of these episodes, int64 [n]."""
        self._ahead: dict[int, tuple[dict[int, int], Episodes]] = {}
        """By ruleset: start worlds made ahead, and the place of each world's number in them."""
        self._ahead_from: tuple[Tensor, Tensor] | None = None
        """The seeds of the environments, and the first episodes whose worlds were made ahead: int64 [B]."""

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
        rows = mask.nonzero()[:, 0].numpy()
        numbers = self.program.ruleset_of(worlds).numpy()
        for number in numbers[rows].tolist():
            self._env(number)  # raises before anything has changed
        began = mask.numpy()
        for number in sorted({*self._groups, *numbers[rows].tolist()}):
            old = self._groups[number][1] if number in self._groups else rows[:0]
            staying, new = ~began[old], rows[numbers[rows] == number]
            if staying.all() and not len(new):
                continue
            members = np.concatenate([old[staying], new])
            if not len(members):
                del self._groups[number]
                continue
            env = self._env(number)
            self._groups[number] = env, members
            episodes = self._start(number, worlds[new]) if len(new) else None
            if staying.any():
                assert env.episodes is not None
                count = int(staying.sum())
                places = torch.from_numpy(np.flatnonzero(staying))
                repeated = torch.cat([places, places[:1].expand(len(new))])
                whole, last = env.program.select(env.episodes, repeated), torch.arange(count, len(members))
                episodes = whole if episodes is None else env.program.put(whole, last, episodes, reuse=True)
            assert episodes is not None
            known = {param.name for param in env.task.ruleset.params}
            params = {name: value[members] for name, value in self.params.items() if name in known}
            env.adopt(episodes, self._returned.masked_fill(mask, 0)[members], params)
        self.episodes = self._regroup(dict(sorted(self._groups.items())))

    def _start(self, number: int, worlds: Tensor) -> Episodes:
        """Return the start of episodes under a ruleset: worlds that were made ahead, or new ones."""
        program, (places, ahead) = self._env(number).program, self._ahead.get(number, ({}, None))
        rows = [places.get(world, -1) for world in worlds.tolist()]
        if ahead is None or -1 in rows:
            return program.start(worlds)
        return program.select(ahead, torch.tensor(rows))

    def _make_ahead(self, base: Tensor, first: Tensor, depth: int) -> None:
        """Make start worlds of `depth` episodes from `first`, int64 [B], on, under the rulesets in use.

        A batch of many worlds takes little longer than one of a few.
        """
        episodes = first + torch.arange(depth)[:, None]
        worlds = self._choose(base.expand_as(episodes).flatten(), episodes.flatten()).unique()
        rulesets, self._ahead, self._ahead_from = self.program.ruleset_of(worlds), {}, (base, first)
        for number, env in self._envs.items():
            own = worlds[rulesets == number]
            if len(own):
                places = {world: place for place, world in enumerate(own.tolist())}
                self._ahead[number] = places, env.program.start(own)

    def _regroup(self, groups: dict[int, tuple[CompiledEnv, Array]]) -> Episodes:
        """Continue with these groups. Returns their episodes."""
        self._groups = groups
        members = np.concatenate([rows for _, rows in groups.values()])
        episodes = MixedEpisodes([*groups.values()])
        self._order = episodes.order.numpy()
        steppers = [env._ready() for env, _ in groups.values()]
        space, ready = self.observation.space, [stepper for stepper in steppers if stepper is not None]
        self._joint = None
        if len(ready) == len(steppers):
            self._joint = Joint(ready, members, space.shape, space.dtype)
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
        self._checked(actions)
        assert self.episodes is not None
        numbers, mode = np.asarray(actions), self.autoreset_mode
        step = self._step_apart if self._joint is None else self._joint.step
        observed, reward, terminated, truncated, success, returned, length = step(numbers)
        if self.observation.kind == "laws":
            observed[:, 1].reshape(self.num_envs, -1)[:, : self._laws.shape[1]] = self._laws
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
        depth = episodes_ahead(self.num_envs, self.task.size)
        if self.curriculum is None and depth > 1:
            base, first = self._ahead_from or (None, self._episode)
            passed = (self._episode - first)[rows]
            if base is not self._base or not bool(((passed >= 0) & (passed < depth)).all()):
                self._make_ahead(self._base, self._episode + ~mask, depth)
        worlds = torch.zeros_like(self._episode)
        worlds[rows] = self._choose(self._base[rows], self._episode[rows])
        self._restart(mask, worlds)
        begun = mask.numpy()
        for env, members in self._groups.values():
            if begun[members].any():
                assert env.episodes is not None
                places = torch.from_numpy(np.flatnonzero(begun[members]))
                shown = env.observation.of(env.episodes)
                observed[members[places]] = shown[places].numpy()

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
        if sorted(members.tolist()) != [*range(self.num_envs)]:
            raise ValueError("the saved worlds are not those of an environment")
        groups = {number: (self._env(number), own) for number, own in rows.items()}
        for number, (env, own) in groups.items():
            env.num_envs = len(own)
            env.restore(state["groups"][number]["env"])
        self._returned[members] = torch.cat([env.returns for env, _ in groups.values()])
        return self._regroup(groups)
