"""Environments whose whole step, from actions to observations, is one call of native code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from powderdsl.envs.tensor_env import (
    Info,
    TensorEnv,
    check_going,
    reset_mask,
    world_seeds,
)
from powderdsl.targets.cpp.program import Places
from powderdsl.tasks.compiled import EMPTY, Results, Stepper

Steps = tuple[Any, Any, Any, Any, dict[str, Any]]
"""Observations, reward, terminated, truncated and infos: arrays."""


class CompiledEnv(TensorEnv):
    """A `TensorEnv` whose step is one call of native code, if there is native code, with the same results.

    Measures that bit planes cannot give (`Stepper.measures_cells`) are computed from tensors between two calls.
    """

    _stepper: Stepper | None = None
    _results: Sequence[Results] = ()
    _bound: tuple[Any, Any] = (None, None)
    """The episodes and parameters of the stepper."""

    def _ready(self) -> Stepper | None:
        """Return the stepper of the current episodes; None if they do not run as native code."""
        if self.episodes is self._bound[0] and self.params is self._bound[1]:
            return self._stepper
        self._bound = None, None
        if self.curriculum is not None:  # start worlds would be chosen too early if made ahead
            return None
        native = self.simulator.native(self.task.size[1])
        if native is None or self.episodes is None:
            return None
        if self._stepper is None or self._stepper.native is not native:
            self._stepper = Stepper(self.program, native, *plan_arguments(self, native))
        self._results = ()
        kept = {"episode": self._episode, "returned": self._returned, "waiting": self._ended}
        self.episodes = self._stepper.bind(self.episodes, self.params, kept)
        self._waiting, numbers = self._ended.numpy(), self._stepper.numbers
        self._places = numbers[:, 0] if self.action_form.kind == "discrete" else numbers
        if self.observation.kind == "laws":
            self._laws = self.program.law_bytes(self.episodes).numpy()
        self._bound = self.episodes, self.params
        return self._stepper

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Tensor, Info]:
        """Begin all episodes, or those of a mask: see `TensorEnv.reset`."""
        known = self.episodes is not None and self.episodes is self._bound[0]
        if not known or seed is not None or (options and options.keys() != {"reset_mask"}):
            base = self._base
            result = super().reset(seed=seed, options=options)
            if self._stepper is not None and self._stepper.filled is not None and base is not None:
                self._stepper.filled[self._base != base] = 0  # made for other seeds
            return result
        stepper, nobody = self._ready(), torch.zeros(self.num_envs, dtype=torch.bool)
        assert stepper is not None
        mask = reset_mask((options or {}).get("reset_mask"), self.num_envs, True, self.device)
        stepper.begins.copy_(mask)
        stepper.fill(self._numbers)
        self._ended &= ~mask
        results = self._new_results(stepper)
        stepper.begin()
        self._write_laws(results, None)
        info: Info = {"success": nobody, "_success": nobody.clone()}
        self._add_ended(info, nobody)
        self._add_shown(info, mask)
        return torch.from_numpy(results.observed), info

    def _write_laws(self, results: Results, ended: Any) -> None:
        """Write laws after the elements, if observations have them; `ended`: the episodes with last observations."""
        if self.observation.kind != "laws":
            return
        assert self.episodes is not None
        before, self._laws = self._laws, self.program.law_bytes(self.episodes).numpy()
        count, cells = self._laws.shape[1], results.observed[0, 1].size
        results.observed.reshape(-1, 2, cells)[:, 1, :count] = self._laws
        if results.last_observed is not None and ended is not None:
            lasts = results.last_observed.reshape(-1, 2, cells)
            lasts[: np.count_nonzero(ended), 1, :count] = before[ended]

    def _numbers(self, rows: Tensor, episodes: Tensor) -> Tensor:
        """Return the numbers of the worlds of episodes of environments: int64 [n]."""
        assert self._base is not None
        return world_seeds(self._base[rows], episodes, self.worlds)

    def _new_results(self, stepper: Stepper) -> Results:
        """Return unreferenced results for the next call to write to."""
        for results in self._results:
            if results.is_free():
                break
        else:
            space = self.observation.space
            keeps_last = self.autoreset_mode is AutoresetMode.SAME_STEP
            shown = [np.zeros((self.num_envs, *space.shape), space.dtype) for _ in range(1 + keeps_last)]
            results = Results(np.empty(Results.SIZE * self.num_envs, np.uint8), *shown)
            del shown
            results.watch()
            self._results = (results, *self._results[:2])
        stepper.write_to(results)
        return results

    def step(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Info]:
        """Take one action in every episode: see `TensorEnv.step`."""
        if self._ready() is None:
            return super().step(actions)
        *parts, info = self.step_arrays(actions)
        observed, reward, terminated, truncated = map(torch.from_numpy, parts)
        return observed, reward, terminated, truncated, tensors_of(info)

    def step_arrays(self, actions: Any) -> Steps:
        """Take one action in every episode: `step` with NumPy arrays."""
        stepper = self._ready()
        if stepper is None:
            *parts, shown = super().step(actions)
            observed, reward, terminated, truncated = (part.cpu().numpy() for part in parts)
            return observed, reward, terminated, truncated, arrays_of(shown)
        self._read(actions, self._places)
        if self.autoreset_mode is AutoresetMode.DISABLED and np.count_nonzero(self._waiting):
            check_going(self._ended)
        results = self._new_results(stepper)
        status = stepper.step()
        if status >= 0:
            self.action_form.decode(actions)  # raises ValueError
            raise AssertionError(f"action {status} is out of range")
        if status == EMPTY:
            stepper.fill(self._numbers)
            stepper.begin()
        info, ended = results.info.copy(), results.ended
        self._write_laws(results, ended)
        if results.last_observed is not None:
            info["final_info"] = results.final_info.copy()
            info["final_obs"] = results.last_observed[: stepper.play.ended]
            info["_final_obs"] = info["_final_info"] = ended
        if self.shows_mask:
            info["action_mask"] = self.action_masks().to(torch.int8).numpy()
            info["_action_mask"] = results.everyone
        return results.observed, results.reward, results.terminated, results.truncated, info

    def _read(self, actions: Any, places: Any) -> None:
        """Write actions into `places`, int64 [B, k] or [B]. Raises TypeError and ValueError as `TensorEnv.step`."""
        given = actions.numpy() if isinstance(actions, Tensor) else actions
        if not isinstance(given, np.ndarray) or given.shape != places.shape or given.dtype.kind not in "iu":
            checked = self.action_form.decode(actions)
            if len(checked) != self.num_envs:
                raise ValueError(f"{len(checked)} actions for {self.num_envs} environments")
            given = np.asarray(actions)
        places[...] = given


def plan_arguments(env: TensorEnv, places: Places) -> tuple[Any, ...]:
    """Return the arguments of `Plan` after the first two, for the step of an environment."""
    form, space, size = env.action_form, env.observation.space, env.task.size
    assert space.dtype is not None
    kind = "ids" if env.observation.kind == "laws" else env.observation.kind
    return (
        env.simulator.observer.views(kind, places, size[0] * size[1]),
        int(np.prod(space.shape)) * space.dtype.itemsize,
        env.autoreset_mode.name,
        env.max_episode_steps,
        env.last_action_terminates,
        form.nvec,
        None if form.kind == "discrete" else form.columns,
        form.table,
    )


def arrays_of(info: Info) -> dict[str, Any]:
    """The infos of a `TensorEnv` as arrays, copied from a device."""
    return {
        name: arrays_of(value) if isinstance(value, dict) else value.cpu().numpy()
        for name, value in info.items()
    }


def tensors_of(info: Mapping[str, Any]) -> Info:
    """Infos of arrays as tensors that share their memory."""
    return {
        name: tensors_of(value) if isinstance(value, dict) else torch.from_numpy(value)
        for name, value in info.items()
    }
