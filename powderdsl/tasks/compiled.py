"""A task's episodes, stepped by one call of native code, equivalent to `TaskProgram.act` and the environment's part.

`Stepper` lays out the call's inputs and outputs. Tensors of the episodes are written in place.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from sys import getrefcount
from typing import Any

import numpy as np
import torch
from torch import Tensor

from powderdsl.model.types import Expr
from powderdsl.simulation.simulator import World
from powderdsl.targets.cpp.episodes import MODES, OPS, Fresh, Play
from powderdsl.targets.cpp.program import NativeProgram, PackedState, Places, Views
from powderdsl.tasks.episodes import Episodes, TaskProgram, params_of
from powderdsl.tasks.goals import ACTION_WORDS
from powderdsl.tasks.tensors.actions import Blocks
from powderdsl.tasks.tensors.measures import Masks

POOL_CELLS = 1 << 22
"""Approximate number of cells of start worlds made ahead: many small worlds, or few large ones."""

MOST_AHEAD, FEW_CELLS = 64, 1 << 16
"""Maximum number of start worlds made ahead per episode; more for few cells, where batch overhead dominates."""

READY, EMPTY = -1, -2
"""Results of `pd_play`: done, or start worlds must be made before `pd_begin`."""


_OP = np.dtype([("op", "i8"), ("number", "i8"), ("value", "f8")])


def operations(scalar: Expr | None, measures: Mapping[Any, int]) -> Any:
    """Return the operations of an expression, arguments first (none for None). `measures` numbers the measures."""
    return np.array([] if scalar is None else [*_operations(scalar, measures, "measure")], _OP)


def _operations(scalar: Expr, measures: Mapping[Any, int], when: str) -> Iterator[tuple[int, int, float]]:
    """Yield operations. `when`: the operation that reads a measure, now or earlier."""
    match scalar.op:
        case "const":
            yield OPS.index("const"), 0, float(scalar.value)
        case "measure":
            yield OPS.index(when), measures[scalar.value], 0
        case "action":
            yield OPS.index("action"), ACTION_WORDS.index(scalar.value), 0
        case "start" | "before":
            yield from _operations(scalar.args[0], measures, scalar.op)
        case _:
            for arg in scalar.args:
                yield from _operations(arg, measures, when)
            yield OPS.index(scalar.op), 0, 0


class Recycled:
    """Arrays to reuse once they are unreferenced, since new memory costs more than a step."""

    _arrays: list[Any]

    def watch(self) -> None:
        """Count the current references. The caller must not hold the arrays, as it does during `__init__`."""
        self._counts = [*map(getrefcount, self._arrays)]

    def is_free(self) -> bool:
        """Return True if no array and no view of one has other references."""
        return [*map(getrefcount, self._arrays)] == self._counts


class ReusedArray(Recycled):
    """One array to reuse, such as observations."""

    def __init__(self, shape: tuple[int, ...], dtype: Any):
        self.rows = np.empty(shape, dtype)
        self.address = self.rows.ctypes.data
        self._arrays = [self.rows]
        self.watch()


class Results(Recycled):
    """The results of a step, one row per world: see `Results` in episodes.hpp.

    Args:
        memory: `SIZE` bytes for each world.
        observed: observations, [B, …].
        last_observed: if requested, the last observations of episodes, in addition to the first ones of the next.
    """

    SIZE = 40
    """Bytes for each world, a multiple of the size of any number."""

    def __init__(self, memory: Any, observed: Any, last_observed: Any = None):
        worlds = len(observed)
        kinds = (*[np.int64] * 3, *[np.float32] * 2, *[np.bool_] * 6)
        ends = np.cumsum([0] + [worlds * np.dtype(kind).itemsize for kind in kinds])
        rows: list[Any] = [memory[a:b].view(kind) for (a, b), kind in zip(pairwise(ends), kinds, strict=True)]
        self.episode_length, self.world, self.last_world, self.reward, self.episode_return = rows[:5]
        self.terminated, self.truncated, self.success, self.ended, self.active, self.everyone = rows[5:]
        self.observed, self.last_observed = observed, last_observed
        names = ("success", "episode_return", "episode_length")
        self.final_info: dict[str, Any] = {
            "world": self.last_world,
            **{name: getattr(self, name) for name in names},
        }
        self.final_info |= {f"_{name}": self.ended for name in self.final_info}
        """Infos of ended episodes."""
        self.info: dict[str, Any] = {
            **{name: getattr(self, name) for name in (*names, "world")},
            **dict.fromkeys(("_episode_return", "_episode_length"), self.ended),
            "_success": self.active,
            "_world": self.everyone,
        }
        """Infos of all episodes."""
        self._arrays = [memory, *rows, observed]
        if last_observed is not None:
            self._arrays.append(last_observed)
        self.addresses = {"results": memory.ctypes.data, "observed": self.observed.ctypes.data}
        self.addresses["last_observed"] = 0 if self.last_observed is None else self.last_observed.ctypes.data


class Arguments:
    """Arrays whose addresses are in a structure, for worlds with a state's layout."""

    def __init__(self, places: Places):
        self.places = places
        self.arrays: dict[str, Any] = {}
        """By the names of the structure's members."""

    def address(self, name: str, values: Any) -> int:
        """Return the address of an array, which is kept alive under a name."""
        if isinstance(values, ctypes.Array):
            self.arrays[name] = values
            return ctypes.addressof(values)
        self.arrays[name] = array = np.ascontiguousarray(values)
        return int(array.ctypes.data)

    def set_blocks(self, structure: Any, blocks: Blocks, ids: Any) -> None:
        """Describe the blocks that actions fill with one of the elements `ids`, int64 [n], chosen by index."""
        fresh = []
        for name, table in blocks.fresh.items():
            values = table.cpu()[ids]
            for piece in self.places.pieces[name]:
                part = piece.of(values)
                slot, bits, _ = self.places.homes[piece.name]
                numbers = part.long() if bits else part.float()
                fresh.append(Fresh(slot, bits, self.address(f"fresh {piece.name}", numbers)))
        structure.fresh_count, structure.fresh = (
            len(fresh),
            self.address("fresh", (Fresh * len(fresh))(*fresh)),
        )
        structure.element, structure.element_bits, _ = self.places.homes["element"]
        for name, edges in zip(("row_edges", "column_edges"), blocks.edges, strict=True):
            setattr(structure, name, self.address(name, edges.cpu()))


class Plan(Arguments):
    """The part of a step that does not depend on the worlds: `play` without their arrays.

    Args:
        program: the task.
        places: the state's layout in the code of its rules.
        views: the contents of an observation, of `size` bytes per world.
        mode: the name of an autoreset mode.
        limit: actions after which an episode is truncated.
        last_terminates: whether the task's last action terminates.
        most: the number of values of each number of an action.
        columns: which of the five numbers they are; None for a single number.
        table: the five numbers of each value of one number, int64 [n, 5].
    """

    def __init__(
        self,
        program: TaskProgram,
        places: Places,
        views: Views,
        size: int,
        mode: str,
        limit: int,
        last_terminates: bool,
        most: tuple[int, ...],
        columns: Tensor | None,
        table: Tensor,
    ):
        super().__init__(places)
        self.program, self.views = program, views
        agent, goal, hands = program.task.agent, program.task.goal, program.hands
        self.counts = program.meter.counts(places)
        counted = 0 if self.counts is None else len(self.counts.numbers)
        self.measures_cells = counted < len(program.measures)
        """True if some measures are computed from tensors, between two parts of a step."""
        self.play = play = Play(
            threads=1,
            steps=agent.steps_per_action,
            free_steps=agent.free_steps,
            actions=agent.actions,
            limit=limit,
            mode=MODES.index(mode),
            last_terminates=last_terminates,
            counts_always=program.counts_always,
            numbers=len(most),
            speed=agent.speed,
            measures=len(program.measures),
            views=len(views.parts),
            view=ctypes.addressof(views.array),
            size=size,
            counts=0 if self.counts is None else ctypes.addressof(self.counts.plan),
            counts_painted=hands.counts,
        )
        play.most = self.address("most", np.array(most, np.int64))
        if columns is None:
            play.table = self.address("table", table)
        else:
            play.column = self.address("column", columns)
        play.choices = self.address("choices", np.array(agent.choices, np.int64))
        self.set_blocks(play, hands.blocks, np.array(agent.choices).clip(0))
        speeds = [] if agent.speed_field is None else places.pieces[agent.speed_field]
        play.speed_row, play.speed_column = [places.homes[piece.name][0] for piece in speeds] or (-1, -1)
        for name in ("each", "final", "success", "failure"):
            steps = operations(getattr(goal, name), program.measure_numbers)
            getattr(play, name).count, getattr(play, name).ops = len(steps), self.address(name, steps)


class Stepper(Plan):
    """Steps a batch of episodes in native code. `how`: the arguments of `Plan`."""

    def __init__(self, program: TaskProgram, native: NativeProgram, *how: Any):
        super().__init__(program, native, *how)
        self.native, self.play.threads = native, native.threads
        self.filled: Tensor | None = None
        """int64 [B]: the first episode of each row whose start world has not been made."""
        self._ahead: Episodes | None = None
        self._play = ctypes.byref(self.play)
        self._has_maps = False

    def bind(self, episodes: Episodes, params: Mapping[str, Tensor], kept: Mapping[str, Tensor]) -> Episodes:
        """Return the episodes in memory that later steps write to.

        `params` are float64 [B] each, as `TaskProgram.act` takes them; `kept` are an environment's tensors by the names of `Play`, [B] each: ``episode``,
        ``returned``, and ``waiting``, the episodes that are over.
        """
        world, worlds = episodes.world, len(episodes)
        state = self.native.pack(world.state)
        # Copies: `start` and `before`, and numbers of worlds, may be the same tensors.
        clock = [tensor.clone() for tensor in (world.seed, world.index, world.step)]
        names = ("seed", "acted", "failed", "start", "before")
        rows = {name: getattr(episodes, name).clone(memory_format=torch.contiguous_format) for name in names}
        masks = Masks(episodes.masks.words.clone(), episodes.masks.sizes.clone())
        own = {name: cells.clone() for name, cells in self._own(episodes.regions).items()}
        self.episodes = replace(
            episodes,
            world=World(self.program.simulator, state, *clock),
            regions={**episodes.regions, **own},
            targets={name: target.clone() for name, target in episodes.targets.items()},
            params={name: value.clone() for name, value in episodes.params.items()},
            masks=masks,
            **rows,
        )
        self._has_maps = bool(own or episodes.targets or episodes.params)
        self._overrides = params
        self._params = self.program.simulator.parameters(params_of(episodes, params) or {}, worlds)
        self._inputs = inputs = self.native.inputs(self._params, worlds)
        if self.filled is None or len(self.filled) != worlds:
            self.filled, self._ahead = torch.zeros(worlds, dtype=torch.int64), None
        self._now = torch.zeros_like(rows["before"])
        self.begins = torch.zeros(worlds, dtype=torch.bool)
        clocks = zip(("seed", "index", "step"), clock, strict=True)
        rows["world"] = rows.pop("seed")
        self.read_from(np.empty((worlds, self.play.numbers), np.int64))
        self._results: Results | None = None
        self._tensors: dict[str, Tensor] = {
            **dict(clocks),
            **rows,
            **kept,
            "param_planes": inputs.planes,
            "param_reals": inputs.reals,
            "now": self._now,
            "masks": masks.words,
            "sizes": masks.sizes,
            "action": torch.zeros(worlds, len(ACTION_WORDS), dtype=torch.int64),
            "begins": self.begins,
            "filled": self.filled,
        }
        for name, tensor in self._tensors.items():
            setattr(self.play, name, tensor.data_ptr())
        self.play.mask_words, self.play.own_masks = masks.words[0].numel(), self.program.meter.own
        return self.episodes

    def write_to(self, results: Results) -> None:
        """Let the next calls write to results."""
        if results is not self._results:
            for name, address in results.addresses.items():
                setattr(self.play, name, address)
            self._results = results

    def read_from(self, numbers: Any) -> None:
        """Let the next calls read actions from an array, int64 [B, k]."""
        self.numbers, self._numbers_at = numbers, numbers.ctypes.data

    def step(self) -> int:
        """Step with `numbers`. Returns READY or EMPTY, or the index of the first number out of range (nothing has
        changed then).
        """
        library, play, address = self.native.library, self._play, self._numbers_at
        self._state().forget()
        if not self.measures_cells:
            status: int = library.pd_play(play, address)
            if status == READY and self._has_maps:
                self._copy_maps()
            return status
        status = library.pd_act(play, address)
        if status >= 0:
            return status
        if self.play.counted:
            episodes, meter = self.episodes, self.program.meter
            places = episodes.regions, episodes.targets, self._params, episodes.masks.sizes
            meter.take_cells(episodes.world, *places, self._now, self.counts)
        if not library.pd_finish(play):
            return EMPTY
        self.begin()
        return READY

    def begin(self) -> None:
        """Begin the next episodes where `begins` is set, and write observations."""
        self._state().forget()
        self.native.library.pd_begin(self._play)
        self._copy_maps()

    def _state(self) -> PackedState:
        """Return the worlds that the library writes to. Raises RuntimeError if they were stepped with `reuse`."""
        state: PackedState = self.episodes.world.state  # type: ignore[assignment]
        self.play.batch = state.handle
        return state

    def _own(self, regions: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the regions that differ between worlds."""
        return {name: cells for name, cells in regions.items() if name not in self.program.fixed}

    def _copy_maps(self) -> None:
        """Copy the regions, targets and parameters of episodes that have begun."""
        if not self._has_maps or self._ahead is None or not bool(self.begins.any()):
            return
        own = self._own(self.episodes.regions)
        rows = self.begins.nonzero()[:, 0]
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
            bits, floats = self.native.layout.parameters(torch, own_params, len(rows))
            self._inputs.planes[:, rows], self._inputs.reals[:, rows] = bits, floats

    def fill(self, numbers: Callable[[Tensor, Tensor], Tensor]) -> None:
        """Make the start worlds of the next episodes if one that begins lacks its own.

        `numbers` maps rows and episodes to worlds, int64 [n] each.
        """
        worlds = len(self.begins)
        cells = worlds * self.program.task.size[0] * self.program.task.size[1]
        depth = self.play.depth = min(-(-POOL_CELLS // cells), max(MOST_AHEAD, FEW_CELLS // cells))
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
        self._ahead = ahead
        state: PackedState = ahead.world.state  # type: ignore[assignment]
        self.filled.copy_(end)
        self.play.pool, self.play.pool_world = state.handle, ahead.seed.data_ptr()
        self.play.pool_start, self.play.pool_sizes = ahead.start.data_ptr(), ahead.masks.sizes.data_ptr()
        self.play.pool_masks = ahead.masks.words.data_ptr()
