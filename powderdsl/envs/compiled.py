"""Environments whose whole step, from actions to observations, is one call of native code.

`Stepper` lays out the call's inputs and outputs. Tensors of the episodes are written in place.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from powderdsl.envs.tensor_env import Info, TensorEnv, check_going, reset_mask, world_seeds
from powderdsl.simulation.simulator import World
from powderdsl.targets.cpp.episodes import MODES, Play
from powderdsl.targets.cpp.program import NativeProgram, PackedState, Places
from powderdsl.tasks.compiled import Arguments, Results, operations
from powderdsl.tasks.episodes import Episodes, params_of
from powderdsl.tasks.goals import ACTION_WORDS
from powderdsl.tasks.tensors.actions import CLOCK
from powderdsl.tasks.tensors.measures import Masks

POOL_CELLS = 1 << 22
"""Approximate number of cells of start worlds made ahead: many small worlds, or few large ones."""

MOST_AHEAD, FEW_CELLS = 64, 1 << 16
"""Maximum number of start worlds made ahead per episode; more for few cells, where batch overhead dominates."""

READY, EMPTY = -1, -2
"""Results of `pd_play`: done, or start worlds must be made before `pd_begin`."""


def episodes_ahead(worlds: int, size: tuple[int, int], rulesets: int = 1) -> int:
    """The number of episodes of each environment whose start worlds are planned together."""
    cells, most = worlds * size[0] * size[1], POOL_CELLS * min(rulesets, 2)
    return min(-(-most // cells), rulesets * max(MOST_AHEAD, FEW_CELLS // cells))


Steps = tuple[Any, Any, Any, Any, dict[str, Any]]
"""Observations, reward, terminated, truncated and infos: arrays."""


def side_by_side(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return contiguous copies of tensors, one after another in memory, so that those of few worlds share cache lines."""
    sizes = [-(-tensor.nbytes // 8) * 8 for tensor in tensors.values()]
    parts = torch.empty(sum(sizes), dtype=torch.uint8).split(sizes)
    return {
        name: part[: tensor.nbytes].view(tensor.dtype).view(tensor.shape).copy_(tensor)
        for (name, tensor), part in zip(tensors.items(), parts, strict=True)
    }


class Plan(Arguments):
    """The part of a step that does not depend on the worlds: `play` without their arrays.

    Args:
        env: the environment.
        places: the state's layout in the code of its rules.
    """

    def __init__(self, env: TensorEnv, places: Places):
        super().__init__(places)
        self.program = program = env.program
        agent, goal, hands, form = env.task.agent, env.task.goal, program.hands, env.action_form
        kind = "ids" if env.observation.kind == "laws" else env.observation.kind
        self.views = views = env.simulator.observer.views(kind, places, env.task.size[0] * env.task.size[1])
        space = env.observation.space
        assert space.dtype is not None
        self.counts = program.meter.counts(places)
        counted = 0 if self.counts is None else len(self.counts.numbers)
        self.measures_cells = counted < len(program.measures)
        """True if some measures are computed from tensors, between two parts of a step."""
        self.play = play = Play(
            threads=1,
            steps=agent.steps_per_action,
            free_steps=agent.free_steps,
            actions=agent.actions,
            limit=env.max_episode_steps,
            mode=MODES.index(env.autoreset_mode.name),
            last_terminates=env.last_action_terminates,
            counts_always=program.counts_always,
            numbers=len(form.nvec),
            speed=agent.speed,
            measures=len(program.measures),
            views=len(views.parts),
            view=ctypes.addressof(views.array),
            size=int(np.prod(space.shape)) * space.dtype.itemsize,
            counts=0 if self.counts is None else ctypes.addressof(self.counts.plan),
            counts_painted=hands.counts,
        )
        play.most = self.address("most", np.array(form.nvec, np.int64))
        if form.kind == "discrete":
            play.table = self.address("table", form.table)
        else:
            play.column = self.address("column", form.columns)
        play.choices = self.address("choices", np.array(agent.choices, np.int64))
        self.set_blocks(play, hands.blocks, np.array(agent.choices).clip(0))
        speeds = [] if agent.speed_field is None else places.pieces[agent.speed_field]
        play.speed_row, play.speed_column = [places.homes[piece.name][0] for piece in speeds] or (-1, -1)
        for name in ("each", "final", "success", "failure"):
            steps = operations(getattr(goal, name), program.measure_numbers)
            getattr(play, name).count, getattr(play, name).ops = len(steps), self.address(name, steps)


class Stepper(Plan):
    """Steps a batch of episodes of an environment in native code."""

    def __init__(self, env: TensorEnv, native: NativeProgram):
        super().__init__(env, native)
        self.native = native
        self.filled: Tensor | None = None
        """int64 [B]: the first episode of each row whose start world has not been made."""
        self._ahead: Episodes | None = None
        self._play = ctypes.byref(self.play)
        self._has_maps = False

    def bind(
        self, episodes: Episodes, params: Mapping[str, Tensor], kept: Mapping[str, Tensor], running: int = 0
    ) -> Episodes:
        """Return the episodes in memory that later steps write to.

        Args:
            params: float64 [B] each, as `TaskProgram.act` takes them.
            kept: an environment's tensors by the names of `Play`, [B] each: ``episode``, ``returned``, and ``waiting``,
                the episodes that are over.
            running: the usual number of episodes that are not idle; 0: all.
        """
        world, worlds = episodes.world, len(episodes)
        state = self.native.pack(world.state, running)
        names = ("acted", "failed", "start", "before")
        # Copies: `start` and `before`, and numbers of worlds, may be the same tensors.
        tensors = side_by_side(
            {name: getattr(world, name) for name in CLOCK}
            | {name: getattr(episodes, name) for name in names}
            | {"world": episodes.seed, "masks": episodes.masks.words, "sizes": episodes.masks.sizes}
            | {"now": episodes.before, "action": torch.zeros(worlds, len(ACTION_WORDS), dtype=torch.int64)}
            | {"begins": torch.zeros(worlds, dtype=torch.bool)}
        )
        self._now, self.begins = tensors["now"], tensors["begins"]
        own = {name: cells.clone() for name, cells in self._own(episodes.regions).items()}
        self.episodes = replace(
            episodes,
            world=World(self.program.simulator, state, tensors["seed"], tensors["index"], tensors["step"]),
            seed=tensors["world"],
            regions={**episodes.regions, **own},
            targets={name: target.clone() for name, target in episodes.targets.items()},
            params={name: value.clone() for name, value in episodes.params.items()},
            masks=Masks(tensors["masks"], tensors["sizes"]),
            **{name: tensors[name] for name in names},
        )
        self._has_maps = bool(own or episodes.targets or episodes.params)
        self._overrides = params
        chosen, simulator = params_of(episodes, params), self.program.simulator
        self._params = simulator.parameters(chosen, worlds) if chosen else simulator.defaults(worlds)
        inputs = self.native.inputs(self._params, worlds)
        if episodes.params:  # `copy_maps` writes to them
            bits, reals = (part.repeat(worlds // len(part), 1) for part in inputs[1:])
            inputs = inputs._replace(bits=bits, reals=reals)
        self._inputs = inputs
        if self.filled is None or len(self.filled) != worlds:
            self.filled, self._ahead = torch.zeros(worlds, dtype=torch.int64), None
        self.read_from(np.empty((worlds, self.play.numbers), np.int64))
        self._results: Results | None = None
        self.play.entry = self.play.places = 0
        self._tensors: dict[str, Tensor] = {
            **tensors,
            **kept,
            "param_bits": inputs.bits,
            "param_reals": inputs.reals,
            "filled": self.filled,
        }
        for name, tensor in self._tensors.items():
            setattr(self.play, name, tensor.data_ptr())
        self.play.threads, self.play.own_params = self.native.threads, inputs.own
        self.play.mask_words, self.play.own_masks = tensors["masks"][0].numel(), self.program.meter.own
        return self.episodes

    def write_to(self, results: Results) -> None:
        """Let the next calls write to results."""
        if results is not self._results:
            for name, address in results.addresses.items():
                setattr(self.play, name, address)
            self._results, self.play.rows = results, len(results.observed)

    def read_from(self, numbers: Any) -> None:
        """Let the next calls read actions from an array, int64 [n, k]."""
        self.numbers, self._numbers_at = numbers, numbers.ctypes.data

    def step(self) -> int:
        """Step with `numbers`. Returns READY or EMPTY, or the index of the first number out of range (nothing has
        changed then).
        """
        library, play, address = self.native.library, self._play, self._numbers_at
        self.prepare()
        if not self.measures_cells:
            status: int = library.pd_play(play, address)
            if status == READY and self._has_maps:
                self.copy_maps()
            return status
        status = library.pd_act(play, address)
        if status >= 0:
            return status
        if self.play.counted:
            episodes = self.episodes
            places = episodes.regions, episodes.targets, self._params, episodes.masks
            self.program.meter.take(episodes.world, *places, self._now)
        if not library.pd_finish(play):
            return EMPTY
        self.begin()
        return READY

    def share(self, places: Any, entry: Any, begins: Any) -> None:
        """Let the next calls read from arrays, [B] each, until it is bound anew.

        Args:
            places: int64: the places of actions and results; −1: the episode is idle. Changes apply from `begin` on.
            entry: int64: the start worlds of the next episodes among those of `draw_from`.
            begins: bool: the episodes that begin.
        """
        self._places, self._entry, self.begins = map(torch.from_numpy, (places, entry, begins))
        for name, tensor in (("places", self._places), ("entry", self._entry), ("begins", self.begins)):
            setattr(self.play, name, tensor.data_ptr())

    def begin(self) -> None:
        """Begin the next episodes where `begins` is set, and write observations."""
        self.prepare()
        self.native.library.pd_begin(self._play)
        self.copy_maps()

    def prepare(self) -> None:
        """Let the library write to the worlds. Raises RuntimeError if they were stepped with `reuse`."""
        self.state.forget()
        self.play.batch = self.state.handle

    @property
    def state(self) -> PackedState:
        """The state of its worlds."""
        return self.episodes.world.state  # type: ignore[return-value]

    @property
    def call(self) -> tuple[int, int]:
        """The addresses of `pd_play` and of its `Play`."""
        function = ctypes.cast(self.native.library.pd_play, ctypes.c_void_p).value
        return function or 0, ctypes.addressof(self.play)

    def _own(self, regions: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the regions that differ between worlds."""
        return {name: cells for name, cells in regions.items() if name not in self.program.fixed}

    def copy_maps(self) -> None:
        """Copy the regions, targets and parameters of episodes that have begun."""
        if not self._has_maps or self._ahead is None or not bool(self.begins.any()):
            return
        own = self._own(self.episodes.regions)
        rows = self.begins.nonzero()[:, 0]
        if self.play.entry:
            places = self._entry[rows]
        else:
            places = rows * self.play.depth + self._tensors["episode"][rows] % self.play.depth
        for name, cells in own.items():
            cells[rows] = self._ahead.regions[name][places]
        for name, target in self.episodes.targets.items():
            target[rows] = self._ahead.targets[name][places]
        if self.episodes.params:
            for name, drawn in self.episodes.params.items():
                drawn[rows] = self._ahead.params[name][places]
            for name, value in (params_of(self.episodes, self._overrides) or {}).items():
                self._params[name].copy_(value)
            own_params = {name: value[rows] for name, value in self._params.items()}
            parts = self.native.layout.parameters(torch, own_params, len(rows))
            self._inputs.bits[rows], self._inputs.reals[rows] = (part.T for part in parts)

    def fill(self, numbers: Callable[[Tensor, Tensor], Tensor]) -> None:
        """Make the start worlds of the next episodes if one that begins lacks its own.

        `numbers` maps rows and episodes to worlds, int64 [n] each.
        """
        worlds = len(self.begins)
        depth = self.play.depth = episodes_ahead(worlds, self.program.task.size)
        assert self.filled is not None
        episode = self._tensors["episode"]
        if not bool((self.begins & (episode + 1 >= self.filled)).any()):
            return
        first, end = torch.maximum(self.filled, episode + 1), episode + 1 + depth
        count = end - first
        rows = torch.arange(worlds).repeat_interleave(count)
        episodes = torch.arange(len(rows)) - (count.cumsum(0) - count - first)[rows]
        places = rows * depth + episodes % depth
        order = places.argsort()
        ahead = self.program.start(numbers(rows[order], episodes[order]), self.native)
        if self._ahead is not None:
            ahead = self.program.put(self._ahead, places[order], ahead, reuse=True)
        self.filled.copy_(end)
        self.draw_from(ahead)

    def draw_from(self, ahead: Episodes) -> None:
        """Let episodes begin in these start worlds."""
        if ahead is self._ahead:
            return
        self._ahead, self._pool = ahead, (state := self.native.pack(ahead.world.state))
        self.play.pool, self.play.pool_world = state.handle, ahead.seed.data_ptr()
        self.play.pool_start, self.play.pool_sizes = ahead.start.data_ptr(), ahead.masks.sizes.data_ptr()
        self.play.pool_masks = ahead.masks.words.data_ptr()


class CompiledEnv(TensorEnv):
    """A `TensorEnv` whose step is one call of native code, if there is native code, with the same results.

    Measures that bit planes cannot give (`Stepper.measures_cells`) are computed from tensors between two calls.
    """

    _stepper: Stepper | None = None
    _results: Sequence[Results] = ()
    _bound: tuple[Any, Any] = (None, None)
    """The episodes and parameters of the stepper."""
    running = 0
    """The usual number of episodes that are not idle; 0: all."""

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
            self._stepper = Stepper(self, native)
        self._results = ()
        kept = {"episode": self._episode, "returned": self._returned, "waiting": self._ended}
        self.episodes = self._stepper.bind(self.episodes, self.params, kept, self.running)
        self._waiting, numbers = self._ended.numpy(), self._stepper.numbers
        self._places = numbers[:, 0] if self.action_form.kind == "discrete" else numbers
        if self.observation.kind == "laws":
            self._laws = self.program.law_bytes(self.episodes).numpy()
        self._bound = self.episodes, self.params
        return self._stepper

    def unbind(self) -> None:
        """Let the next call lay out the episodes anew."""
        self._bound = None, None

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
        results = self._new_results()
        stepper.write_to(results)
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

    def _new_results(self) -> Results:
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
        results = self._new_results()
        stepper.write_to(results)
        status = stepper.step()
        if status >= 0:
            self.action_form.decode(actions)  # raises ValueError
            raise AssertionError(f"action {status} is out of range")
        if status == EMPTY:
            stepper.fill(self._numbers)
            stepper.begin()
        self._write_laws(results, results.ended)
        return self._steps(results, stepper.play.ended)

    def _steps(self, results: Results, ended: int) -> Steps:
        """Return the results as `step_arrays` does; `ended`: the number of episodes that ended."""
        info = results.info.copy()
        if results.last_observed is not None:
            info["final_info"], info["final_obs"] = results.final_info.copy(), results.last_observed[:ended]
            info["_final_obs"] = info["_final_info"] = results.ended
        if self.shows_mask:
            info["action_mask"] = self.action_masks().to(torch.int8).numpy()
            info["_action_mask"] = results.everyone
        return results.observed, results.reward, results.terminated, results.truncated, info

    def _read(self, actions: Any, places: Any) -> None:
        """Write actions into `places`, int64 [B, k] or [B]. Raises TypeError and ValueError as `TensorEnv.step`."""
        given = actions.numpy() if isinstance(actions, Tensor) else actions
        if not isinstance(given, np.ndarray) or given.shape != places.shape or given.dtype.kind not in "iu":
            self._checked(actions)
            given = np.asarray(actions)
        places[...] = given


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
