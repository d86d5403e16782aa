"""Steps of a level's episodes in native code, equivalent to those on tensors."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from powderdsl.simulation.simulator import World
from powderdsl.system.random import name_number
from powderdsl.targets.cpp.episodes import LevelPlay
from powderdsl.targets.cpp.program import NativeProgram, PackedState
from powderdsl.tasks.compiled import Arguments

if TYPE_CHECKING:
    from powderdsl.ogbench.episodes import LevelEpisodes

INVALID = "ogbench invalid"
"""The draws that replace invalid choices."""


class CompiledSteps(Arguments):
    """Steps the episodes of a level by calls of native code, which write to their arrays in place."""

    def __init__(self, episodes: LevelEpisodes, native: NativeProgram):
        super().__init__(native)
        self.native, self._episodes = native, episodes
        self._world: World | None = None
        """The episodes' world, in memory that steps write to."""
        program, level = episodes.program, episodes.level
        picture = episodes.pictures[0]
        self._views = program.simulator.observer.views("rgb", native, level.side**2, picture.shape[2])
        self._structure = structure = LevelPlay(
            threads=native.threads,
            elements=level.choices(0),
            places=level.choices(1),
            views=len(self._views.parts),
            view=self.address("views", self._views.array),
            size=picture.numel(),
            line=picture[0].numel(),
            name=name_number(INVALID),
            pictures=episodes.pictures.data_ptr(),
            goals=episodes.goal_ids.data_ptr() if episodes.mode == "task" else 0,
        )
        self.set_blocks(structure, program.blocks, program.ids)
        for name in ("colors", "lit"):
            setattr(structure, name, self.address(name, getattr(program, name)))
        for name in ("stage", "elapsed", "chosen", "errors"):
            setattr(structure, name, self.address(name, getattr(episodes, name)))
        inputs = native.inputs(program.simulator.parameters({}, episodes.count), episodes.count)
        self._inputs, self._level = inputs, ctypes.byref(structure)
        structure.own_params = inputs.own
        structure.param_bits, structure.param_reals = inputs.bits.data_ptr(), inputs.reals.data_ptr()

    def choose(self, actions: NDArray[np.int64], active: NDArray[np.bool_]) -> None:
        """Take a choice, contiguous int64 [B], in the episodes that are `active`, bool [B]."""
        state = self._state()
        state.forget()
        self._structure.batch = state.handle
        self.native.library.pd_choose(self._level, actions.ctypes.data, active.ctypes.data)

    def observe(self, address: int) -> None:
        """Write observations, uint8 [B, H, W, 6]."""
        self.native.library.pd_observe(self._level, address, self._episodes.count)

    def _state(self) -> PackedState:
        """Return the state of the episodes, moved to memory that steps write to if they have begun anew."""
        world = self._episodes.world
        assert world is not None
        if world is not self._world:
            clock = {name: getattr(world, name).clone() for name in ("seed", "index", "step")}
            for name, numbers in clock.items():
                setattr(self._structure, name, numbers.data_ptr())
            world = World(world.sim, self.native.pack(world.state), *clock.values())
            self._episodes.world = self._world = world
        state: PackedState = world.state  # type: ignore[assignment]
        return state
