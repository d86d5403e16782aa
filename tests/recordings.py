"""Recorded steps of the published engines: which files there are, and the draws in them."""

from __future__ import annotations

import os
from pathlib import Path

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
