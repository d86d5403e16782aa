"""Inputs of native code that steps episodes, and the memory that it writes results to."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from itertools import pairwise
from sys import getrefcount
from typing import Any

import numpy as np

from powderdsl.model.types import Expr
from powderdsl.targets.cpp.episodes import OPS, Fresh
from powderdsl.targets.cpp.program import Places
from powderdsl.tasks.goals import ACTION_WORDS
from powderdsl.tasks.tensors.actions import Blocks

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
