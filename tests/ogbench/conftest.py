"""Levels, compiled once for all tests of OGBench's environments."""

from __future__ import annotations

from typing import Any

import pytest

from powderdsl.ogbench.env import EnvOptions
from powderdsl.ogbench.episodes import LevelProgram


@pytest.fixture(scope="session")
def easy(torch: Any) -> LevelProgram:
    """The easy level on the backend `wasm`."""
    return EnvOptions(backend="wasm").program("easy")


@pytest.fixture(scope="session")
def hard(torch: Any) -> LevelProgram:
    """The hard level on the backend `wasm`."""
    return EnvOptions(backend="wasm").program("hard")
