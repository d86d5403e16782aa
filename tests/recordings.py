"""Recorded steps of the published engines: which files there are, and what they hold.

A recording holds steps of an engine as it ran: the state before a step, the random numbers it drew, and the state after
each of its passes. Those in tests/data are a few steps of each file, chosen so that every event of the full files is
among them (tests/data/make_recordings.py). Tests read full recordings, or others of the same kind, from a folder that
is named by the variable `POWDERDSL_RECORDINGS`, or `POWDERDSL_SECOND_RECORDINGS` for the second Powderworld.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

STREAMS = ("movement", "interact", "element")


def recording_paths(variable: str, usual: Path, array: str) -> list[Path]:
    """The archives with an array of this name in the folder that an environment variable names, or in the usual one.

    Raises FileNotFoundError when there are none.
    """
    folder = Path(os.environ.get(variable) or usual)
    paths = []
    for path in sorted(folder.glob("*.npz")):
        with np.load(path, allow_pickle=False) as archive:
            if array in archive.files:
                paths.append(path)
    if not paths:
        raise FileNotFoundError(f"no recordings in {folder}")
    return paths


def draws_of(random: np.ndarray) -> dict[str, np.ndarray]:
    """The recorded draws by stream, float32 in [0, 1), of their bytes, uint8 [3, ...]."""
    draws = (random.astype(np.float32) + np.float32(0.5)) / np.float32(256)
    return dict(zip(STREAMS, draws, strict=True))


State = dict[str, np.ndarray]
"""A recorded state of n worlds: ``ids`` [n, H, W], ``velocity`` [n, 2, H, W], and the engine's other numbers."""


@dataclass(frozen=True)
class Recording:
    """n recorded steps: `states[k]` is the state after k passes, `random` the draws, float32 [n, H, W].

    `defect` is bool [passes, n, H, W], where the file has it: cells in which a defect of the engine shows.
    """

    elements: tuple[str, ...]
    passes: tuple[str, ...]
    random: dict[str, np.ndarray]
    states: tuple[State, ...]
    defect: np.ndarray | None


@cache
def read_recording(path: Path) -> Recording:
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    names = [name.removeprefix("before_") for name in arrays if name.startswith("before_")]
    passes = tuple(arrays["passes"].tolist())
    before = {name: arrays[f"before_{name}"] for name in names}
    after = [{name: arrays[f"after_{name}"][k] for name in names} for k in range(len(passes))]
    random = draws_of(arrays["random"])
    return Recording(
        tuple(arrays["elements"].tolist()), passes, random, (before, *after), arrays.get("defect")
    )


def given(array: np.ndarray, backend: str) -> Any:
    """An array as the backend's own type."""
    if backend == "reference":
        return array
    import torch

    return torch.from_numpy(array.copy())


def where_first(mask: np.ndarray) -> str:
    """How many cells a mask [n, H, W] has, and the first few of them, for a message."""
    cells = [tuple(cell) for cell in np.argwhere(mask)[:5].tolist()]
    return f"{np.count_nonzero(mask)} of {mask.size} cells, the first (world, row, column): {cells}"
