"""Environments whose worlds run under different rulesets, and `environment`, which creates all kinds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from powderdsl.envs.compiled import POOL_CELLS, CompiledEnv, Stepper, Steps, episodes_ahead, tensors_of
from powderdsl.envs.tensor_env import Info
from powderdsl.tasks.compiled import Results
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


MOST_ROWS = 6
"""Rows per environment above which rulesets without episodes lose their rows, unless `POOL_CELLS` allows more rows."""

COLUMNS = ("reward", "terminated", "truncated", "success", "episode_return", "episode_length")
"""Results of a step that are 0 while an episode waits: names of `Results`."""


class Joint:
    """Steps the episodes of several steppers in one call, with shared results.

    Args:
        steppers: in order. The rows of their episodes follow one another.
        members: the number of the episode in each row, int64 [n]; −1: the row is idle. `begin` changes them.
        actions: where to read actions, int64 [B, k].
        results: where to write the first observations.
    """

    def __init__(self, steppers: Sequence[Stepper], members: Array, actions: Array, results: Results):
        self._steppers, self._members, self._actions = steppers, members, actions
        sizes = [len(stepper.begins) for stepper in steppers]
        self._parts = np.repeat(np.arange(len(sizes)), sizes)
        """The number of the stepper of each row, int64 [n]."""
        self._entry, self._begins = np.zeros(len(members), np.int64), np.zeros(len(members), bool)
        shared = [np.split(all_rows, np.cumsum(sizes)) for all_rows in (members, self._entry, self._begins)]
        for stepper, *rows in zip(steppers, *shared, strict=False):
            stepper.read_from(actions)
            stepper.write_to(results)
            stepper.share(*rows)
            stepper.begin()
        self._play_all = steppers[0].native.library.pd_play_all
        self._calls = np.array([stepper.call for stepper in steppers], np.int64).T
        self._apart = np.array([stepper.measures_cells for stepper in steppers])
        self._arrange()

    def _arrange(self) -> None:
        """Find the steppers whose episodes are not all idle."""
        busy = self._of(self._members >= 0)
        self._states = [self._steppers[part].state for part in np.flatnonzero(busy).tolist()]
        self._together = np.compress(busy & ~self._apart, self._calls, 1)
        self._alone = [self._steppers[part] for part in np.flatnonzero(busy & self._apart).tolist()]
        threads = self._steppers[0].native.threads
        self._threads = threads if busy.sum() >= threads else 1
        for stepper in self._steppers if threads > 1 else ():
            stepper.play.threads = threads // self._threads

    def _of(self, rows: Array) -> Array:
        """The steppers of some rows, bool [k]."""
        return np.bincount(self._parts[rows], minlength=len(self._steppers)) > 0

    def room(self, members: Array, parts: Array) -> Array | None:
        """Return an idle row for a new episode of each of these steppers, int64 [n]; None if there are too few.

        `members`: as above, when some episodes have left.
        """
        order, idle = np.argsort(parts, kind="stable"), np.flatnonzero(members < 0)
        parts, own = parts[order], self._parts[idle]
        places = np.searchsorted(own, parts) + np.arange(len(parts)) - np.searchsorted(parts, parts)
        if places.max() >= len(idle) or (own[places] != parts).any():
            return None
        rows = np.empty_like(order)
        rows[order] = idle[places]
        return rows

    def begin(self, members: Array, rows: Array, entries: Array, results: Results) -> None:
        """Continue with other members, and write their observations and worlds to `results`.

        Episodes begin in the rows `rows`, in the start worlds `entries`, int64 [n] each.
        """
        changed = members != self._members
        changed[rows] = self._begins[rows] = True
        self._entry[rows], self._members[:] = entries, members
        self._arrange()
        parts = self._of(changed)
        self._call(np.compress(parts, self._calls, 1), None, results)
        for part in np.flatnonzero(parts).tolist():
            self._steppers[part].copy_maps()
        self._begins[rows] = False

    def step(self, results: Results) -> None:
        """Step all episodes."""
        self._call(self._together, self._actions.ctypes.data, results)
        for stepper in self._alone:
            stepper.write_to(results)
            stepper.step()

    def _call(self, calls: Array, actions: int | None, results: Results) -> None:
        """Call functions with their arguments, int64 [2, n]; without an address of actions, episodes only begin."""
        for state in self._states:  # faster than `prepare`
            state.forget()
        functions, count, addresses = calls.ctypes.data, calls.shape[1], results.addresses
        memory = addresses["results"], addresses["observed"]
        self._play_all(count, functions, functions + 8 * count, actions, *memory, self._threads)


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
        self._members = np.empty(0, np.int64)
        """The rows of all groups, one after another, int64 [n]: see `Joint`."""
        self._needed: dict[int, Tensor] = {}
        """By ruleset: the ascending numbers of planned worlds, int64 [n]."""
        self._planned = np.array([-1]), np.array([0])
        """All planned worlds in ascending order, and their numbers among those of their ruleset: int64 [n] each."""
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

    def _restart(self, mask: Tensor, worlds: Tensor, results: Results | None = None) -> None:
        """Begin episodes where `mask`, bool [B], is set, in the worlds numbered `worlds`; `results`: see `Joint`."""
        results = results or self._new_results()
        envs = mask.nonzero()[:, 0].numpy()
        numbers, entries = self.program.ruleset_of(worlds[mask]).numpy(), self._entries(worlds[mask])
        for number in np.unique(numbers).tolist():
            self._env(number)  # raises before anything has changed
        members = np.where((self._members >= 0) & mask.numpy()[self._members], -1, self._members)
        while not self._enter(members, envs, numbers, entries, results):
            self._make_room(members, envs, numbers, entries, results)
            members, waiting = self._members, ~np.isin(envs, self._members)
            envs, numbers, entries = envs[waiting], numbers[waiting], entries[waiting]

    def _enter(self, members: Array, envs: Array, numbers: Array, entries: Array, results: Results) -> bool:
        """Begin episodes in idle rows of `members`. Returns False, and begins none, if there are too few.

        The environments `envs` begin under the rulesets `numbers`, in start worlds with the numbers `entries`: int64
        [n] each.
        """
        if not len(envs):
            return True
        joint, known = self._joint, np.array([*self._groups])
        if joint is None or self._has_params() or not np.isin(numbers, known).all():
            return False
        rows = joint.room(members, np.searchsorted(known, numbers))
        if rows is None:
            return False
        for number in np.unique(numbers).tolist():
            stepper = self._groups[number][0]._stepper
            assert stepper is not None
            stepper.draw_from(self._starts(number))
        members[rows] = envs
        joint.begin(members, rows, entries, results)
        self._join()
        return True

    def _has_params(self) -> bool:
        """True if parameters have been set for some episodes, before or after the next reset."""
        return bool(self.params) or any(env.params for env, _ in self._groups.values())

    def _make_room(
        self, members: Array, envs: Array, numbers: Array, entries: Array, results: Results
    ) -> None:
        """Begin episodes under the rulesets that have too few idle rows. Arguments are those of `_enter`."""
        joint, ends = self._joint, np.cumsum([len(rows) for _, rows in self._groups.values()])
        held = dict(zip(self._groups, np.split(members, ends), strict=False))
        for number in sorted({*held, *numbers.tolist()}):
            own, new = held.get(number, envs[:0]), numbers == number
            idle = np.count_nonzero(own < 0)
            if idle < new.sum() or (idle and joint is None) or (new.any() and self._has_params()):
                held[number] = self._rebuild(number, own, envs[new], entries[new])
        most = max(MOST_ROWS * self.num_envs, POOL_CELLS // math.prod(self.task.size))
        if joint is None or sum(map(len, held.values())) > most:
            held = {number: rows for number, rows in held.items() if (rows >= 0).any()}
        self._regroup({number: (self._env(number), held[number]) for number in sorted(held)}, results)

    def _rebuild(self, number: int, members: Array, new: Array, entries: Array) -> Array:
        """Make room for new episodes under a ruleset. Returns the numbers of all its episodes, −1 in idle rows.

        `members` are those of its rows so far; the environments `new` begin in the start worlds `entries`, int64 [n]
        each.
        """
        env, staying = self._env(number), np.flatnonzero(members >= 0)
        stay, count, idle, env.running = len(staying), len(staying) + len(new), 0, 0
        if env.simulator.native(self.task.size[1]) is not None:
            usual = self.num_envs // len(self.program.rulesets)
            idle = max(usual + 4 * math.isqrt(usual), count + -(-count // 4)) - count
            env.running = max(usual, count // 2, 1)
        members = np.concatenate([members[staying], new, np.full(idle, -1)])
        if not count:
            return members
        episodes = None
        if len(new):
            entries = np.concatenate([entries, np.full(idle, entries[0])])
            episodes = env.program.select(self._starts(number), torch.from_numpy(entries))
        if stay:
            assert env.episodes is not None
            places, rest = torch.from_numpy(staying), torch.arange(stay, count + idle)
            whole = env.program.select(env.episodes, torch.cat([places, places[:1].expand(len(rest))]))
            episodes = env.program.put(whole, rest, episodes, reuse=True) if episodes else whole
        assert episodes is not None
        known = {param.name for param in env.task.ruleset.params}
        params = {name: value[members] for name, value in self.params.items() if name in known}
        returned = torch.zeros(len(members), dtype=torch.float64)
        returned[:stay] = env.returns[staying]
        env.adopt(episodes, returned, params)
        return members

    def _regroup(self, groups: Groups, results: Results) -> None:
        """Continue with the episodes of these groups, and write their observations to `results`."""
        envs, rows = zip(*groups.values(), strict=True)
        self._members = np.concatenate(rows)
        parts = np.split(self._members, np.cumsum([*map(len, rows)]))
        self._groups = dict(zip(groups, zip(envs, parts, strict=False), strict=True))
        steppers = [env._ready() for env in envs]
        ready = [stepper for stepper in steppers if stepper is not None]
        self._joint = None
        if len(ready) == len(steppers):
            self._joint = Joint(ready, self._members, self._actions.reshape(self.num_envs, -1), results)
        else:
            for env in envs:
                env.unbind()  # from the memory that steppers shared
        self._join()

    def _join(self) -> None:
        """Find the row of each episode."""
        self._order = np.argsort(self._members, kind="stable")[np.count_nonzero(self._members < 0) :]
        episodes = MixedEpisodes([env for env, _ in self._groups.values()], torch.from_numpy(self._order))
        if self.observation.kind == "laws":
            self._laws = episodes.joined(TaskProgram.law_bytes).numpy()
        self.episodes = episodes  # type: ignore[assignment]  # same attributes

    def _plan(self, worlds: Tensor) -> None:
        """Plan the start worlds with these numbers, int64 [n]."""
        worlds = worlds.unique()
        rulesets = self.program.ruleset_of(worlds)
        order, (numbers, counts) = rulesets.argsort(stable=True), rulesets.unique(return_counts=True)
        self._needed = dict(zip(numbers.tolist(), worlds[order].split(counts.tolist()), strict=True))
        self._ahead = {}
        places = torch.empty_like(order)
        places[order] = torch.cat([*map(torch.arange, counts.tolist())])
        self._planned = worlds.numpy(), places.numpy()

    def _entries(self, worlds: Tensor) -> Array:
        """Return the numbers of worlds among `_starts`: int64 [n] each. Plans them if they are not planned."""
        numbers, (known, places) = worlds.numpy(), self._planned
        indices = np.searchsorted(known, numbers)
        if not np.array_equal(known.take(indices, mode="clip"), numbers):
            self._plan(worlds)
            self._planned_from = None
            return self._entries(worlds)
        return places[indices]

    def _starts(self, number: int) -> Episodes:
        """The planned starts under a ruleset: a batch of many takes little longer than one of a few."""
        if number not in self._ahead:
            program, needed = self._env(number).program, self._needed[number]
            self._ahead[number] = program.start(needed, program.simulator.native(self.task.size[1]))
        return self._ahead[number]

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
        results, waiting = self._new_results(), self._ended.numpy()
        (self._joint.step if self._joint else self._step_apart)(results)
        if mode is AutoresetMode.NEXT_STEP:
            results.active[:] = ~waiting
            for name in (*COLUMNS, "ended"):
                getattr(results, name)[waiting] = 0
        self._write_own(results.observed)
        ended = int(np.count_nonzero(results.ended))
        if mode is not AutoresetMode.SAME_STEP:
            self._ended = torch.from_numpy(results.ended.copy())
        elif ended:
            np.compress(results.ended, results.observed, 0, out=results.last_observed[:ended])
            waiting = results.ended
        if mode is not AutoresetMode.DISABLED and np.count_nonzero(waiting):
            self._next_episodes(torch.from_numpy(waiting), results)
        return self._steps(results, ended)

    def _write_own(self, observed: Array) -> None:
        """Write laws into observations, if these have them."""
        if self.observation.kind == "laws":
            observed[:, 1].reshape(len(observed), -1)[:, : self._laws.shape[1]] = self._laws

    def _step_apart(self, results: Results) -> None:
        """Step environment after environment."""
        for env, rows in self._groups.values():
            env._ended.zero_()  # waiting episodes step too; their results are masked below
            observed, *parts, info = env.step_arrays(self._actions[rows])
            columns = {**dict(zip(COLUMNS, parts, strict=False)), **info, "observed": observed}
            for name in (*COLUMNS, "observed", "world"):
                getattr(results, name)[rows[rows >= 0]] = columns[name][rows >= 0]
        results.active[:] = results.everyone[:] = True
        results.ended[:] = results.terminated | results.truncated
        results.last_world[:] = results.world

    def _next_episodes(self, mask: Tensor, results: Results) -> None:
        """Begin the next episodes where `mask`, bool [B], is set, and write first observations to `results`."""
        assert self._base is not None
        self._episode, rows = self._episode + mask, mask.nonzero()[:, 0]
        depth = episodes_ahead(self.num_envs, self.task.size, len(self.program.rulesets))
        if self.curriculum is None:
            base, first = self._planned_from or (None, self._episode)
            passed = (self._episode - first)[rows]
            if base is not self._base or not bool(((passed >= 0) & (passed < depth)).all()):
                first = self._episode + ~mask
                episodes = first + torch.arange(depth)[:, None]
                self._plan(self._choose(self._base.expand_as(episodes).flatten(), episodes.flatten()))
                self._planned_from = self._base, first
        worlds = torch.zeros_like(self._episode)
        worlds[rows] = self._choose(self._base[rows], self._episode[rows])
        self._restart(mask, worlds, results)
        if self._joint is None and self.episodes is not None:
            begun = mask.numpy()
            results.observed[begun] = self.observation.of(self.episodes).numpy()[begun]
            results.world[begun] = worlds.numpy()[begun]
        self._write_own(results.observed)

    @property
    def returns(self) -> Tensor:
        """The return of each current episode so far: float64 [B]."""
        if self.episodes is None:
            return super().returns
        return torch.cat([env.returns for env, _ in self._groups.values()])[self._order]

    # Saving

    def _saved(self, episodes: Episodes) -> dict[str, Any]:
        return {
            "groups": {
                number: {"rows": torch.from_numpy(rows.copy()), "env": env.state()}
                for number, (env, rows) in self._groups.items()
            },
        }

    def _loaded(self, state: Mapping[str, Any]) -> Episodes:
        rows = {number: saved["rows"].numpy() for number, saved in state["groups"].items()}
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
        self._regroup(groups, self._new_results())
        assert self.episodes is not None
        return self.episodes
