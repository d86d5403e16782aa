"""The data layouts for stepping episodes in one call: `Play` of episodes.hpp, and `LevelPlay` of levels.hpp."""

from __future__ import annotations

import ctypes
from typing import Any

MODES = ("SAME_STEP", "NEXT_STEP", "DISABLED")

OPS = (
    "const", "measure", "start", "before", "action", "neg", "abs", "not", "choose", "add", "sub", "mul", "and",
    "div", "quotient", "mod", "min", "max", "or", "lt", "le", "eq",
)  # fmt: skip
"""Operations of formulas, by their numbers."""


class Formula(ctypes.Structure):
    """An expression as operations on a stack."""

    _fields_ = (("count", ctypes.c_int64), ("ops", ctypes.c_void_p))


class Fresh(ctypes.Structure):
    """The values that a placed element sets in a slot, by the agent's choice: int64, or float32 if there are no bits."""

    _fields_ = (("slot", ctypes.c_int64), ("bits", ctypes.c_int64), ("values", ctypes.c_void_p))


def _whole(names: str) -> tuple[tuple[str, Any], ...]:
    return tuple((name, ctypes.c_int64) for name in names.split())


class Play(ctypes.Structure):
    """Everything that a step of a task reads and writes. Addresses point to arrays that the caller keeps."""

    _fields_ = (
        *_whole("threads steps free_steps actions limit mode last_terminates counts_always"),
        *_whole("numbers most column table row_edges column_edges choices"),
        *_whole("fresh_count counts_painted element element_bits speed_row speed_column fresh"),
        ("speed", ctypes.c_double),
        *_whole("batch seed index step own_params param_bits param_reals"),
        *_whole("world acted episode failed waiting start before now returned"),
        *_whole("counts masks sizes measures mask_words own_masks"),
        *((name, Formula) for name in ("each", "final", "success", "failure")),
        *_whole("pool depth start_worlds base entry pool_world filled pool_start pool_sizes pool_masks"),
        *_whole("views size view places rows observed last_observed results action begins counted ended"),
    )


class LevelPlay(ctypes.Structure):
    """Everything that a step of an OGBench level reads and writes. Addresses point to arrays that the caller keeps."""

    _fields_ = _whole(
        "threads elements places row_edges column_edges fresh_count element element_bits fresh views size line view"
        " colors lit name batch seed index step own_params param_bits param_reals stage elapsed chosen errors goals pictures"
    )
